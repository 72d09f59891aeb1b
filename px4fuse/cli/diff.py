"""Command ``px4fuse diff``: lists the differences between the results of two flights."""

import sys
from pathlib import Path

import click

from . import options, outputs


@click.command()
@click.argument("a", type=options.InputPath())
@click.argument("b", type=options.InputPath())
@options.max_size_option
@options.json_option
def diff(a: Path, b: Path, json_path: Path | None) -> None:
    """List the settings, numbers and findings that differ from A to B.

    A and B are flight logs, reports (PDF) of px4fuse compare, or their results (JSON).

    Exit code 0: B is not worse; 1: B is worse; 2: invalid input. B is worse if it has a new finding
    of severity error, or if a mean NIS or mean NEES of KF or EKF2 is consistent in A but not in B.
    A mean NIS is consistent if it is in its 95 % band, or if √S is wrong by a factor of at most
    1.25. A mean NEES is consistent if the position σ is wrong by a factor of at most 2.
    """
    from px4fuse.batch.changes import diff as compare_inputs
    from px4fuse.batch.terminal import format_differences

    with outputs.progress(json_path) as show_progress:
        results = compare_inputs(a, b, progress=show_progress)
    outputs.write_and_print_results(
        outputs.make_result_files(results, json_path), format_differences(results)
    )
    if results.worse:
        sys.exit(1)
