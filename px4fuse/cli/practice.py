"""``px4fuse practice``: flights with hidden mistakes, to find them by the knobs."""

import secrets
import sys
from pathlib import Path

import click

from px4fuse.cli.inputs import options
from px4fuse.cli.outputs import OPEN_KEY, progress, web_page, write_and_print


@click.command()
@options("practice")
@click.option("--open/--no-open", "opened", default=None, help="Open it.  [default: on a terminal]")
@click.pass_context
def practice(
    ctx: click.Context,
    seed: int | None,
    output: Path | None,
    opened: bool | None,
    level: int = 1,
    flights: int = 10,
) -> None:
    """Find what is wrong with simulated flights, ten in a row.

    Simulates flights with hidden mistakes and writes one page: look, turn the knobs to prove it,
    choose what is wrong, then see the truth. Practice, not an exam: the answers are in the page.
    """
    seed = secrets.randbelow(10**6) if seed is None else seed
    target = web_page(output, Path("reports", f"practice_{seed}.html"))
    ctx.meta[OPEN_KEY] = sys.stdout.isatty() if opened is None else opened
    with progress(target) as step:
        from px4fuse.practice import practice_text

        content = practice_text(seed, level, flights, step).encode()
    write_and_print({target: content})
