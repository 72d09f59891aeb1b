"""Command ``px4fuse lesson``: prints the worked examples of the course UAT 366, module 2."""

import click


@click.group()
def lesson() -> None:
    """Print the worked examples of the course UAT 366, module 2."""


@lesson.command()
def kalman() -> None:
    """Print Example 1 of the course: KF with UWB positions in an aisle at 1 m/s."""
    from px4fuse.lesson import format_kalman_example_lines

    for line in format_kalman_example_lines():
        click.echo(line)


@lesson.command()
def loop() -> None:
    """Print worked example 2: loop closure error, distributed by distance."""
    from px4fuse.lesson import format_loop_example_lines

    for line in format_loop_example_lines():
        click.echo(line)
