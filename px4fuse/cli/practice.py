"""Command ``px4fuse practice``: writes a quiz page with simulated flights and injected faults."""

import secrets
import sys
from pathlib import Path

import click

from .options import count_option, output_option
from .outputs import (
    OPENS_OUTPUT_KEY,
    check_default_page,
    choose_web_page_path,
    progress,
    write_and_print_results,
)


@click.command()
@count_option(
    "--seed",
    0,
    2**32 - 1,
    help="Seed: the same N gives the same flights.  [default: random]",
)
@count_option(
    "--level",
    1,
    3,
    default=1,
    help="Difficulty. 1: one large fault; 2: one smaller fault; 3: one or two small faults.",
)
@count_option("--flights", 1, 20, default=10, help="Number of flights.")
@output_option("FILE.html", "Web page to write.  [default: reports/practice_SEED.html]")
@click.option(
    "--open/--no-open",
    "opens_browser",
    default=None,
    help="Open the page in the browser.  [default: yes on a terminal]",
)
@click.pass_context
def practice(
    ctx: click.Context,
    seed: int | None,
    level: int,
    flights: int,
    output: Path | None,
    opens_browser: bool | None,
) -> None:
    """Write a quiz page with simulated flights and injected faults.

    For each flight: inspect the plots, test a setting, choose the fault, and compare with the
    solution. Not for exams: the page contains the solutions.
    """
    seed = secrets.randbelow(10**6) if seed is None else seed
    page_path = choose_web_page_path(output, Path("reports", f"practice_{seed}.html"))
    ctx.meta[OPENS_OUTPUT_KEY] = sys.stdout.isatty() if opens_browser is None else opens_browser
    with progress(page_path) as show_progress:
        from px4fuse.explore.practice import make_practice_page

        page = make_practice_page(seed, level, flights, show_progress)
        if output is None:
            check_default_page(page_path, page)
    write_and_print_results({page_path: page.encode()})
