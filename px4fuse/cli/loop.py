"""Command ``px4fuse loop``: measures and corrects the loop closure error."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.core.reading import display_name, split_path_and_part
from px4fuse.core.writing import STANDARD_OUTPUT
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.request import GivenClosure, Landing, LoopRequest, command_line, format_settings_suffix

from . import options, outputs

if TYPE_CHECKING:
    from px4fuse.loop.model import Loop

# Maximum distance (m) from take-off to landing place (--landed-at); more is a typing error
MAX_LANDING_DISTANCE_M = 10_000.0
# Parameters of the command that are allowed if SOURCE is a pose graph
POSE_GRAPH_ARGUMENT_NAMES = ("source", "json_path", "g2o_path", "robust")


def _parse_numbers(text: str, syntax: str, max_absolute_value: float) -> list[float]:
    """Parse two or three numbers with commas between them."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(
        abs(number) <= max_absolute_value for number in numbers
    ):
        raise click.BadParameter(f"The value {text!r} is not {syntax}.")
    return numbers


def parse_landing(text: str) -> Landing:
    """Parse the landing place relative to the vehicle at take-off.

    The text is ``FORWARD,RIGHT`` (m) or ``FORWARD,RIGHT,DEG``, with the clockwise rotation (°).
    """
    return Landing(
        *_parse_numbers(
            text,
            "FORWARD,RIGHT (m from take-off) or FORWARD,RIGHT,DEG (and heading change in °)",
            MAX_LANDING_DISTANCE_M,
        )
    )


def parse_closure(text: str) -> GivenClosure:
    """Parse a loop closure: ``T1,T2`` (s) or ``T1,T2,SIGMA`` (m)."""
    # the limit on the magnitude is the largest float, which excludes only infinity
    return GivenClosure(
        *_parse_numbers(
            text, "T1,T2 (times at the same place, s) or T1,T2,SIGMA (σ in m)", sys.float_info.max
        )
    )


_loop_option = partial(options.request_option, LoopRequest)


@click.command()
@click.argument("source", type=options.InputPath())
@click.option(
    "--landed-at",
    type=parse_landing,
    metavar="FORWARD,RIGHT[,DEG]",
    help="Measured landing place relative to take-off: distances (m) forward (along the nose at "
    "take-off) and right, and clockwise rotation (°).  [default: ground truth in the log, else "
    "0,0]",
)
@options.flag_option(
    "--open",
    "is_open_path",
    help="Do not use the landing as a loop closure: the vehicle did not return to the take-off "
    "place.",
)
@click.option(
    "--closure",
    "closures",
    type=parse_closure,
    metavar="T1,T2[,SIGMA]",
    multiple=True,
    help="Loop closure: same place at times T1 and T2 (s), with σ of the distance (m); "
    "repeatable.  [default SIGMA: 0.1 m]",
)
@options.flag_option(
    "--robust",
    help="Also optimise pose graphs with more than 1000 loop closures robustly (takes minutes).",
)
@_loop_option(
    "start_s",
    "Start of the loop: time (s) after the first sample, or timestamp.  [default: take-off]",
)
@_loop_option(
    "end_s",
    "End of the loop: time (s) after the first sample, or timestamp.  [default: landing]",
)
@click.option(
    "--reference",
    type=options.InputPath(str),
    metavar="FILE|LOG:TRACK",
    help="Reference trajectory for the ATE and RPE of each path, in addition to the ground truth "
    "of the log.",
)
@_loop_option(
    "position_drift_m",
    "Position drift (m, 1 σ) of the odometry after 100 m.",
)
@_loop_option(
    "heading_drift_deg",
    "Heading drift (°, 1 σ) of the odometry after 100 m.",
)
@_loop_option(
    "key_frames_m",
    "Distance (m) between key frames of the pose graph.  [default: 2 % of the extent of the path, "
    "0.02 to 0.5 m]",
)
@_loop_option("frame", "Coordinate frame of a trajectory file.  [default: detected]")
@options.system_option
@options.max_size_option
@options.student_options
@options.report_options("Report to write (PDF).  [default: reports/SOURCE_loop.pdf]")
@click.option(
    "--tum",
    "tum_path",
    type=options.NonEmptyPath(),
    metavar="FILE",
    help="Corrected path to write (TUM), in the frame of SOURCE.",
)
@click.option(
    "--g2o",
    "g2o_path",
    type=options.NonEmptyPath(),
    metavar="FILE",
    help="Optimised pose graph to write (g2o).",
)
@options.show_option
def loop(
    source: Path,
    output: Path | None,
    json_path: Path | None,
    tum_path: Path | None,
    g2o_path: Path | None,
    **option_values: Any,
) -> None:
    """Measure and correct the loop closure error of odometry.

    SOURCE is a flight log, a trajectory (TUM, EuRoC, ORB-SLAM3, KITTI, BAG:TOPIC), or a pose graph
    (g2o), which is optimised. LOG:vio, LOG:ekf2 or LOG:kf selects the track of a log; the default
    is VIO, or else EKF2. Writes a PDF report and the results as JSON, except for a pose graph.
    """
    from px4fuse.diagnose import analyse_loop_closure
    from px4fuse.loop.tracks import is_g2o, make_file_stem
    from px4fuse.report.loop import make_loop_page
    from px4fuse.results.build import make_loop_results

    log = split_path_and_part(str(source))[0]  # SOURCE may be LOG:TRACK
    student = options.read_student(option_values, log)
    for name, path in (("--tum", tum_path), ("--g2o", g2o_path)):
        if path == STANDARD_OUTPUT:
            raise SettingsError(
                f"{name} cannot write to standard output, only --json can",
                f"Give a file name after {name}.",
            )
    if is_g2o(log):
        _solve_graph(source, json_path, g2o_path, option_values["robust"] or None)
        return
    request = make_loop_request(source, option_values)
    outputs.check_output_paths(
        [tum_path, g2o_path, *outputs.choose_report_paths(output, json_path)]
    )
    with outputs.progress(json_path) as show_progress:
        loop_result = analyse_loop_closure(request, show_progress)
        results = make_loop_results(request, loop_result, student)
        name = f"{make_file_stem(source)}_loop{format_settings_suffix(request)}"
        contents = _format_output_files(
            loop_result, tum_path, g2o_path
        ) | outputs.make_result_files(results, json_path, output, loop_result, show_progress, name)
    outputs.write_and_print_results(
        contents, make_loop_page(loop_result, results.findings), request
    )


def make_loop_request(source: Path, option_values: dict[str, Any]) -> LoopRequest:
    """Make the request from the options of the command; ``option_values`` is changed."""
    # robust concerns only pose graphs in g2o files
    del option_values["robust"]
    return LoopRequest(
        source=str(source), closed_loop=not option_values.pop("is_open_path"), **option_values
    )


def _format_output_files(
    loop_result: Loop, tum_path: Path | None, g2o_path: Path | None
) -> dict[Path, bytes]:
    """Return the contents of the TUM file (corrected path) and the g2o file (pose graph)."""
    from px4fuse.loop.closure import from_z_down
    from px4fuse.readers.g2o import format_g2o
    from px4fuse.readers.trajectory import format_tum

    contents = {}
    if tum_path is not None:
        best_flight_path = loop_result.choose_best_path()
        if best_flight_path is loop_result.odometry:
            raise MissingDataError(
                f"--tum {display_name(tum_path)}: the path is not corrected: no loop closure was "
                "accepted. Give a loop closure (--closure) or the landing place (--landed-at)."
            )
        contents[tum_path] = format_tum(
            from_z_down(best_flight_path.trajectory, loop_result.original_frame)
        ).encode()
    if g2o_path is not None:
        contents[g2o_path] = format_g2o(loop_result.solved_graph()).encode()
    return contents


def _solve_graph(
    source: Path, json_path: Path | None, g2o_path: Path | None, robust: bool | None
) -> None:
    """Optimise a pose graph from a g2o file, and write the results."""
    from px4fuse.readers.g2o import format_g2o, read_g2o
    from px4fuse.report.loop import make_pose_graph_page
    from px4fuse.results.build import make_graph_results
    from px4fuse.trajectory.graph.solver import analyse_graph

    path, track = split_path_and_part(str(source))
    name = display_name(source)
    if track is not None:
        raise SettingsError(
            f"{name}: a pose graph contains no trajectory {track!r}",
            f"Omit :{track}.",
        )
    for parameter in options.list_given_parameters():
        if parameter.name not in POSE_GRAPH_ARGUMENT_NAMES:
            raise SettingsError(
                f"{name}: {parameter.opts[-1]} is not available for a pose graph.",
                "Use only --g2o FILE, --json FILE and --robust.",
            )
    with outputs.progress(json_path, g2o_path) as show_progress:
        show_progress(f"reading {name}")
        results, solved_graph = analyse_graph(
            name, read_g2o(path), show_progress, use_robust_optimisation=robust
        )
    command = command_line(LoopRequest(source=str(source))) + (" --robust" if robust else "")
    contents = {} if g2o_path is None else {g2o_path: format_g2o(solved_graph).encode()}
    contents |= outputs.make_result_files(make_graph_results(results, command), json_path)
    outputs.write_and_print_results(contents, make_pose_graph_page(results))
