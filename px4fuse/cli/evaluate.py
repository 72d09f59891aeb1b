"""``px4fuse evaluate``: ATE and RPE of one trajectory against another."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.inputs import (
    command_line,
    json_option,
    max_size_option,
    system_option,
)
from px4fuse.cli.outputs import (
    progress,
    terminal,
    write_json,
)
from px4fuse.cli.quantity import Quantity
from px4fuse.errors import SettingsError
from px4fuse.request import AUTO
from px4fuse.writing import STANDARD_OUTPUT

if TYPE_CHECKING:
    from px4fuse.trajectory.scores import Delta

MAX_DELTA = 1e6
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
@click.argument("estimate", type=click.Path(path_type=Path))
@click.argument("reference", type=click.Path(path_type=Path))
@click.option(
    "--alignment",
    type=click.Choice(["none", "yaw", "se3", "sim3"]),
    default=None,
    help="What is fitted before comparing.  [default: yaw for VIO, EKF2 and our filter; se3 for "
    "SLAM; sim3 for monocular SLAM]",
)
@click.option(
    "--association",
    type=click.Choice(["interpolate", "nearest"]),
    default="interpolate",
    show_default=True,
    help="Interpolate the reference, or take its nearest pose (as evo does).",
)
@click.option(
    "--max-gap",
    type=click.FloatRange(min=0.0, min_open=True),
    default=None,
    metavar="S",
    help="Longest gap of the reference to interpolate across; for nearest the largest difference "
    "in time.  [default: from its rate; 0.01 for nearest]",
)
@click.option(
    "--time-offset",
    type=Quantity("s", auto=True),
    default=None,
    metavar="S|auto",
    help="Added to the estimate's stamps; auto finds it from the motion.  [default: auto where the "
    "two do not overlap]",
)
@click.option(
    "--rpe",
    type=DeltaType(),
    multiple=True,
    metavar="DELTA",
    help="RPE over a distance (5m), a time (10s) or frames (1f); may be repeated.  [default: some "
    "that suit the path]",
)
@click.option(
    "--consecutive", is_flag=True, help="RPE over pairs end to end, instead of from every pose."
)
@system_option
@max_size_option
@json_option
def evaluate(
    estimate: Path,
    reference: Path,
    alignment: str | None,
    association: str,
    max_gap: float | None,
    time_offset: float | str | None,
    rpe: tuple[Any, ...],
    consecutive: bool,
    system: int | None,
    json_path: Path | None,
) -> None:
    """Score a trajectory against a reference: ATE and RPE, with intervals.

    Either is a trajectory file (TUM, EuRoC, ORB-SLAM3) or a part of a flight log: LOG:vio,
    LOG:ekf2, LOG:kf (our filter) or LOG:truth.
    """
    from px4fuse.loop.sources import read_source
    from px4fuse.report.loop_terminal import print_evaluation
    from px4fuse.results.build_trajectories import evaluation_results
    from px4fuse.trajectory.evaluation import evaluate as score

    for option, value in (("--max-gap", max_gap), ("--time-offset", time_offset)):
        if isinstance(value, float) and not abs(value) < float("inf"):
            raise SettingsError(f"{option} {value:g} is not a finite number.")
    with progress(json_path == STANDARD_OUTPUT) as step:
        step("reading")
        first = read_source(str(estimate), system=system)
        second = read_source(str(reference), default="truth", system=system)
        step("scoring")
        found = score(
            first.trajectory,
            second.trajectory,
            alignment=alignment,  # type: ignore[arg-type]
            association=association,  # type: ignore[arg-type]
            max_gap_s=max_gap,
            time_offset_s=AUTO if isinstance(time_offset, str) else time_offset,
            rpe_deltas=rpe or None,
            all_pairs=not consecutive,
        )
    if write_json(
        evaluation_results(found, command_line("evaluate", estimate, reference)), json_path
    ):
        return
    print_evaluation(terminal(), found)
