"""``px4fuse loop``: the loop-closure error of a flight or a trajectory, and its correction."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli import inputs, outputs
from px4fuse.errors import SettingsError
from px4fuse.reading import shown
from px4fuse.request import (
    LOOP_OPTIONS,
    GivenClosure,
    Landing,
    LoopRequest,
    command_line,
    settings_name,
)
from px4fuse.writing import STANDARD_OUTPUT

if TYPE_CHECKING:
    from px4fuse.loop.model import Loop

# Nobody's tape is longer
MAX_LANDED_AT = 10_000.0
# What may be given with a pose graph
FOR_GRAPHS = ("source", "json_path", "g2o", "robust")


def _numbers(text: str, meant: str, most: float) -> list[float]:
    """Two or three finite numbers between commas."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(abs(number) <= most for number in numbers):
        raise click.BadParameter(f"{text!r} is not {meant}.")
    return numbers


def landing(text: str) -> Landing:
    """Read ``FORWARD,RIGHT`` or ``FORWARD,RIGHT,DEG``."""
    return Landing(*_numbers(text, "FORWARD,RIGHT in m, or FORWARD,RIGHT,DEG", MAX_LANDED_AT))


def closure(text: str) -> GivenClosure:
    """Read ``T1,T2`` or ``T1,T2,SIGMA``."""
    return GivenClosure(*_numbers(text, "T1,T2 in s, or T1,T2,SIGMA", sys.float_info.max))


@click.command()
@click.argument("source", type=inputs.InputPath())
@inputs.options(
    "loop",
    landed_at={"type": landing},
    opened={"is_flag": True},
    closures={"type": closure, "multiple": True},
    robust={"is_flag": True},
)
@inputs.request_options(LoopRequest, LOOP_OPTIONS)
@inputs.max_size_option
@inputs.person_options
@inputs.report_options("The report.  [default: reports/SOURCE_loop.pdf]")
@inputs.options("loop-writes")
@inputs.show_option
def loop(
    source: Path,
    output: Path | None,
    json_path: Path | None,
    tum: Path | None,
    g2o: Path | None,
    **given: Any,
) -> None:
    """Measure how far a loop fails to close, and correct its path.

    SOURCE is a flight log (its visual-inertial odometry, or EKF2's track; LOG:vio, LOG:ekf2 and
    LOG:kf choose), a trajectory (TUM, EuRoC, ORB-SLAM3), or a pose graph (g2o), which is solved.
    Writes a report (PDF) and its results as JSON, except of a pose graph.
    """
    from px4fuse.analysis import run_loop
    from px4fuse.loop.tracks import file_name, is_g2o, split_part
    from px4fuse.report.loop import summary
    from px4fuse.results.build import loop_results

    person = inputs.read_person(given)
    for name, path in (("--tum", tum), ("--g2o", g2o)):
        if path == STANDARD_OUTPUT:
            raise SettingsError(f"{name} -: only --json can print", "Give a file name.")
    if is_g2o(split_part(str(source))[0]):
        _solve(source, json_path, g2o, True if given["robust"] else None)
        return
    request = loop_request(source, given)
    outputs.check_targets([tum, g2o, *outputs.report_paths(output, json_path)])
    with outputs.progress(json_path) as step:
        found = run_loop(request, step)
        made = loop_results(request, found, person)
        if output is None and json_path is None:
            output = outputs.default_report(
                f"{file_name(source)}_loop", settings_name(request), made
            )
        contents = _files(found, tum, g2o)
        contents |= outputs.result_files(made, json_path, output, found, step)
    outputs.finish(contents, summary(found, made.findings), request)


def loop_request(source: Path, given: dict[str, Any]) -> LoopRequest:
    """What the command's options gave, as a request."""
    del given["robust"]
    return LoopRequest(source=str(source), came_back=not given.pop("opened"), **given)


def _files(found: Loop, tum: Path | None, g2o: Path | None) -> dict[Path, bytes]:
    """The corrected path and the solved graph, as files for other tools."""
    from px4fuse.errors import MissingDataError
    from px4fuse.loop.closure import in_frame
    from px4fuse.readers.g2o import g2o_text
    from px4fuse.readers.trajectory import tum_text

    contents = {}
    if tum is not None:
        best = found.best
        if best is found.odometry:
            raise MissingDataError.of("no_corrected_path", tum=shown(tum))
        contents[tum] = tum_text(in_frame(best.trajectory, found.given_frame)).encode()
    if g2o is not None:
        contents[g2o] = g2o_text(found.solved_graph()).encode()
    return contents


def _solve(source: Path, json_path: Path | None, g2o: Path | None, robust: bool | None) -> None:
    """Solve a pose graph from a file."""
    from px4fuse.loop.tracks import split_part
    from px4fuse.readers.g2o import g2o_text, read_g2o
    from px4fuse.report.loop import graph_summary
    from px4fuse.results.build import graph_results
    from px4fuse.trajectory.graph.analysis import analyse_graph

    path, part = split_part(str(source))
    if part is not None:
        raise SettingsError(f"{shown(source)}: a pose graph has no part {part!r}", "Leave it out.")
    for parameter in inputs.typed_parameters():
        if parameter.name not in FOR_GRAPHS:
            raise SettingsError.of(
                "not_for_graphs", source=shown(source), option=parameter.opts[-1]
            )
    outputs.check_targets([json_path, g2o])
    with outputs.progress(json_path) as step:
        step(f"reading {shown(source)}")
        solved = analyse_graph(shown(source), read_g2o(path), step, robust=robust)
    command = command_line(LoopRequest(source=str(source))) + (" --robust" if robust else "")
    contents = {} if g2o is None else {g2o: g2o_text(solved.graph).encode()}
    contents |= outputs.result_files(graph_results(solved, command), json_path)
    outputs.finish(contents, graph_summary(solved))
