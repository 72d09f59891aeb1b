"""Command ``px4fuse diff``: lists the differences between the results of two flights."""

import sys
from pathlib import Path

import click

from px4fuse.cli import options, outputs


@click.command()
@click.argument("a", type=options.InputPath())
@click.argument("b", type=options.InputPath())
@options.max_size_option
@options.json_option
def diff(a: Path, b: Path, json_path: Path | None) -> None:
    """List the settings, numbers and findings that differ from A to B.

    A and B are flight logs, reports (PDF) of px4fuse compare, or their results (JSON).

    The exit code is 1 if a verdict is worse in B: the mean NIS or mean NEES of KF or EKF2 along an
    axis is consistent in A and not in B, or B has a new finding of severity error. A mean NIS is
    consistent inside its 95 % band, or if √S is wrong by a factor below 1.25. A mean NEES is
    consistent if the position σ is wrong by a factor of at most 2. The exit code is 2 for invalid
    input, otherwise 0.
    """
    from px4fuse.batch.changes import diff as compare_inputs
    from px4fuse.batch.terminal import format_differences

    with outputs.progress(json_path) as show_progress:
        results = compare_inputs(a, b, progress=show_progress)
    outputs.write_and_print(outputs.result_files(results, json_path), format_differences(results))
    if results.worse:
        sys.exit(1)
