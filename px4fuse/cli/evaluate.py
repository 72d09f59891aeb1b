"""Command ``px4fuse evaluate``: computes ATE and RPE of one trajectory against another."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.errors import SettingsError
from px4fuse.request import EvaluationRequest, format_settings_suffix

from . import options, outputs

if TYPE_CHECKING:
    from px4fuse.trajectory.scores import RpePairDistance

# Maximum RPE delta (m, s or frames)
MAX_RPE_DELTA = 1e6
_DELTA_PATTERN = re.compile(r"(\d+\.?\d*|\.\d+) ?(m|s|frames|f)")


def parse_delta(text: str) -> RpePairDistance:
    """Parse the delta of the RPE: a distance (``5m``), time (``10s``) or frame count (``1f``)."""
    from px4fuse.trajectory.scores import RpePairDistance

    match = _DELTA_PATTERN.fullmatch(text.strip())
    if match is None or not 0.0 < float(match[1]) <= MAX_RPE_DELTA:
        raise click.BadParameter(
            f"The RPE delta {text!r} is not a distance (5m), time (10s) or number of frames (1f)."
        )
    unit: Any = "frames" if match[2] == "f" else match[2]
    return RpePairDistance(float(match[1]), unit)


_evaluation_option = partial(options.request_option, EvaluationRequest)


@click.command()
@click.argument("estimate", type=options.InputPath())
@click.argument("reference", type=options.InputPath())
@click.option(
    "--rpe",
    type=parse_delta,
    metavar="DELTA",
    multiple=True,
    help="Delta of the RPE: a distance (5m), time (10s) or number of frames (1f); repeatable.  "
    "[default: distances and times that fit the path]",
)
@_evaluation_option(
    "alignment",
    "Alignment of the estimate with the reference.  [default: yaw for VIO, EKF2 and KF; se3 for "
    "SLAM; sim3 for monocular SLAM]",
)
@_evaluation_option(
    "association",
    "Reference pose for each estimated pose: interpolated, or the nearest in time.",
)
@_evaluation_option(
    "max_gap_s",
    "Maximum gap (s) in the reference for interpolation; with --association nearest, maximum time "
    "difference.  [default: from the rate of the reference; 0.01 s for nearest]",
)
@_evaluation_option(
    "time_offset_s",
    "Time (s) to add to the timestamps of the estimate; auto estimates it.  [default: auto if the "
    "trajectories do not overlap in time, else 0]",
)
@_evaluation_option(
    "consecutive",
    "Compute the RPE over consecutive, non-overlapping pairs of poses instead of all pairs.",
)
@options.system_option
@options.max_size_option
@options.report_options("Report to write (PDF).  [default: reports/A_against_B.pdf]")
@options.open_option
def evaluate(
    estimate: Path,
    reference: Path,
    output: Path | None,
    json_path: Path | None,
    **option_values: Any,
) -> None:
    """Compute ATE and RPE of a trajectory against a reference.

    ESTIMATE and REFERENCE are trajectory files (TUM, EuRoC, ORB-SLAM3, KITTI), recordings of
    positions (FILE:BODY), topics of ROS bags (BAG:TOPIC) or tracks of a flight log: LOG:vio,
    LOG:ekf2, LOG:kf or LOG:truth. Prints errors with 95 % intervals. Writes a PDF report and the
    results as JSON.
    """
    from px4fuse.loop.tracks import make_file_stem, read_trajectory_source
    from px4fuse.report.evaluation import make_evaluation_page
    from px4fuse.results.build import make_evaluation_results
    from px4fuse.trajectory.evaluation import evaluate as evaluate_trajectory

    rpe_deltas = option_values.pop("rpe")
    request = EvaluationRequest(
        estimate=str(estimate),
        reference=str(reference),
        rpe=tuple(map(str, rpe_deltas)),
        **option_values,
    )
    if request.max_gap_s is not None and request.max_gap_s <= 0.0:
        raise SettingsError(f"--max-gap {request.max_gap_s:g} is not above 0 s.")
    outputs.choose_report_paths(output, json_path)
    with outputs.progress(json_path) as show_progress:
        show_progress("reading")
        estimate_source = read_trajectory_source(request.estimate, system=request.system)
        reference_source = read_trajectory_source(
            request.reference, default_track="truth", system=request.system
        )
        show_progress("computing errors")
        evaluation = evaluate_trajectory(
            estimate_source.trajectory,
            reference_source.trajectory,
            rpe_deltas=rpe_deltas or None,
            all_pairs=not request.consecutive,
            alignment=request.alignment,
            association=request.association,
            max_gap_s=request.max_gap_s,
            time_offset_s=request.time_offset_s,
        )
        results = make_evaluation_results(request, evaluation)
        report_stem = f"{make_file_stem(estimate)}_against_{make_file_stem(reference)}"
        report_stem += format_settings_suffix(request)
        contents = outputs.make_result_files(
            results, json_path, output, evaluation, show_progress, report_stem
        )
    outputs.write_and_print_results(contents, make_evaluation_page(evaluation))
