"""``px4fuse evaluate``: ATE and RPE of one trajectory against another."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.inputs import Named, max_size_option, path_option, request_options
from px4fuse.cli.outputs import finish, free_report, progress, report_paths
from px4fuse.errors import OutputError, SettingsError
from px4fuse.request import EVALUATION_OPTIONS, EvaluationRequest, command_line, settings_name
from px4fuse.writing import STANDARD_OUTPUT

if TYPE_CHECKING:
    from px4fuse.results.contract import EvaluationResults
    from px4fuse.trajectory.scores import Delta

STEPS = ("reading", "scoring", "drawing the page", "drawing the picture")
MAX_DELTA = 1e6
# Of each of the two names in the default name of the report: with both it stays below 255
MAX_NAME_BYTES = 90
_DELTA = re.compile(r"(\d+\.?\d*|\.\d+) ?(m|s|frames|f)")


class DeltaType(click.ParamType["Delta"]):
    """A distance, a time or a number of frames: ``5m``, ``10s``, ``1f``."""

    name = "delta"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Delta:
        """Convert what was typed."""
        from px4fuse.trajectory.scores import Delta

        if isinstance(value, Delta):
            return value
        match = _DELTA.fullmatch(value.strip())
        if match is None or not 0.0 < float(match[1]) <= MAX_DELTA:
            self.fail(
                f"{value!r} is not a distance (5m), a time (10s) or a number of frames (1f).",
                param,
                ctx,
            )
        unit = {"m": "m", "s": "s"}.get(match[2], "frames")
        return Delta(float(match[1]), unit)  # type: ignore[arg-type]


@click.command()
@click.argument("estimate", type=Named())
@click.argument("reference", type=Named())
@click.option(
    "--max-gap",
    "max_gap_s",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="S",
    help="Longest gap of the reference to interpolate across; for nearest the largest difference "
    "in time.  [default: from its rate; 0.01 for nearest]",
)
@click.option(
    "--rpe",
    type=DeltaType(),
    multiple=True,
    metavar="DELTA",
    help="RPE over a distance (5m), a time (10s) or frames (1f); may be repeated.  [default: some "
    "that suit the path]",
)
@request_options(EvaluationRequest, EVALUATION_OPTIONS)
@max_size_option
@path_option(
    "-o",
    "--output",
    metavar="FILE.pdf",
    help="The page.  [default: reports/ESTIMATE_against_REFERENCE.pdf]",
)
@path_option(
    "--picture",
    metavar="FILE.png",
    help="The picture: the path by its error, APE, RPE.  [default: beside the PDF]",
)
@path_option(
    "--json",
    "json_path",
    metavar="FILE",
    help="The results; - prints them alone on standard output.  [default: beside the PDF]",
)
def evaluate(
    estimate: Path,
    reference: Path,
    rpe: tuple[Delta, ...],
    output: Path | None,
    picture: Path | None,
    json_path: Path | None,
    **given: Any,
) -> None:
    """Score a trajectory against a reference: ATE and RPE, with intervals.

    Either is a trajectory file (TUM, EuRoC, ORB-SLAM3) or a part of a flight log: LOG:vio,
    LOG:ekf2, LOG:kf (our filter) or LOG:truth. Writes a page (PDF), a picture (PNG) and the results
    (JSON); where -o, --picture or --json names a file, only what is named and what stands beside
    the PDF.
    """
    from px4fuse.loop.sources import read_source
    from px4fuse.report.evaluation import print_evaluation
    from px4fuse.results.build_trajectories import evaluation_results
    from px4fuse.results.contract import to_json
    from px4fuse.trajectory.evaluation import evaluate as score

    for name in ("max_gap_s", "time_offset_s"):
        if isinstance(given[name], float) and not math.isfinite(given[name]):
            option = EVALUATION_OPTIONS[name].name
            raise SettingsError(f"{option} {given[name]:g} is not a finite number.")
    request = EvaluationRequest(
        estimate=str(estimate), reference=str(reference), rpe=tuple(map(str, rpe)), **given
    )
    alone = json_path == STANDARD_OUTPUT
    _targets(output, picture, json_path)  # before the work, not after it
    contents: dict[Path, bytes] = {}
    with progress(alone, STEPS) as step:
        step("reading")
        first = read_source(request.estimate, system=request.system)
        second = read_source(request.reference, default="truth", system=request.system)
        step("scoring")
        found = score(
            first.trajectory,
            second.trajectory,
            alignment=given["alignment"],
            association=given["association"],
            max_gap_s=request.max_gap_s,
            time_offset_s=given["time_offset_s"],
            rpe_deltas=rpe or None,
            all_pairs=not request.consecutive,
        )
        results = evaluation_results(found, command_line(request))
        text = to_json(results)
        if output is None and picture is None and json_path is None:
            output = _default(estimate, reference, settings_name(request), results)
        output, picture, beside = _targets(output, picture, json_path)
        if output is not None:
            from px4fuse.report.pdf import render

            step("drawing the page")
            contents[output] = render(found, text)
        if picture is not None:
            from px4fuse.report.evaluation import picture as draw

            step("drawing the picture")
            contents[picture] = draw(found)
    for path in (beside, json_path):
        if path is not None:
            contents[path] = text.encode()
    finish(contents, lambda console: print_evaluation(console, found), alone=alone)


def _default(estimate: Path, reference: Path, settings: str, mine: EvaluationResults) -> Path:
    """Where a page goes that was given no name: the two and the settings are in its name."""
    from px4fuse.results.contract import EvaluationResults, Results

    def is_same(old: Results) -> bool:
        return isinstance(old, EvaluationResults) and (
            (old.provenance.command, old.estimate.sha256, old.reference.sha256)
            == (mine.provenance.command, mine.estimate.sha256, mine.reference.sha256)
        )

    return free_report(f"{_name(estimate)}_against_{_name(reference)}", settings, is_same)


def _name(source: Path) -> str:
    """What a trajectory is called in a file name: ``flight_vio`` of ``flight.ulg:vio``."""
    from px4fuse.loop.sources import split_part

    path, part = split_part(str(source))
    stem = os.fsencode(path.stem)[:MAX_NAME_BYTES].decode(errors="ignore")
    return stem if part is None else f"{stem}_{part}"


def _targets(
    output: Path | None, picture: Path | None, json_path: Path | None
) -> tuple[Path | None, Path | None, Path | None]:
    """Page, picture and results, the latter two beside the page unless they are named."""
    results = None if json_path == STANDARD_OUTPUT else json_path
    if output is not None:
        output, results = report_paths(output, json_path)
        picture = picture or output.with_suffix(".png")
    if picture is None:
        return output, picture, results
    if picture.suffix.lower() != ".png":
        raise OutputError(
            f"{picture}: the picture is a PNG. Give a name that ends in .png with --picture."
        )
    if results is not None and picture.resolve() == results.resolve():
        raise OutputError(f"{picture}: --picture and --json name the same file. Give two names.")
    return output, picture, results
