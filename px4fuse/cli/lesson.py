"""``px4fuse lesson``: the worked examples of the lesson."""

import click


@click.group()
def lesson() -> None:
    """Run the lesson's worked examples through px4fuse's own engine."""


@lesson.command()
def kalman() -> None:
    """Print Example 1: fusing the IMU with UWB on an aisle at 1 m/s."""
    from px4fuse.lesson import kalman_lines

    for line in kalman_lines():
        click.echo(line)


@lesson.command()
def loop() -> None:
    """Print Example 2: the loop-closure error, distributed by distance."""
    from px4fuse.lesson import loop_lines

    for line in loop_lines():
        click.echo(line)
