"""``px4fuse practice``: writes a quiz page with simulated flights and hidden mistakes."""

import secrets
import sys
from pathlib import Path

import click

from px4fuse.cli.inputs import options
from px4fuse.cli.outputs import OPEN_KEY, check_default_page, progress, web_page, write_and_print


@click.command()
@options("practice")
@click.option(
    "--open/--no-open", "opened", default=None, help="Open the page.  [default: on a terminal]"
)
@click.pass_context
def practice(
    ctx: click.Context,
    seed: int | None,
    output: Path | None,
    opened: bool | None,
    level: int = 1,
    flights: int = 10,
) -> None:
    """Write a quiz page with simulated flights and hidden mistakes.

    For each flight: inspect the plots, test a setting, choose the mistake, then see the solution.
    For practice only: the page contains the solutions.
    """
    seed = secrets.randbelow(10**6) if seed is None else seed
    target = web_page(output, Path("reports", f"practice_{seed}.html"))
    ctx.meta[OPEN_KEY] = sys.stdout.isatty() if opened is None else opened
    with progress(target) as step:
        from px4fuse.practice import practice_text

        page = practice_text(seed, level, flights, step)
        if output is None:
            check_default_page(target, page)
    write_and_print({target: page.encode()})
