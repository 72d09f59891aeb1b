"""Follow each proposed action by machine, and compare errors against ground truth.

``followed_fixes.py [LOG …]`` analyses flights with ground truth and makes each change that a
finding or the card proposes, one by one:

- parameters of EKF2 ("Set EKF2_EV_DELAY to 264 ms"), with a replay of EKF2
- a shift of the timestamps at the sender, with a replay of EKF2
- options (``--clock-offset``, ``--sigma-a``, ``--start``, …), with another run of KF
- the conversion of axes, unit and timestamps that the analysis itself applies, with a run of KF as
  the positions were sent

It prints the horizontal position RMSE before and after. A change is harmful if the RMSE afterwards
is larger by more than its 95 % uncertainty.
"""

from __future__ import annotations

import argparse
import math
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from equal_statements import NUMBER, PARAMETER, Job, jobs, texts_of
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison, ErrorsAgainstTruth, PreparedComparison
from px4fuse.comparison.preparation import prepare_comparison_inputs
from px4fuse.diagnose import diagnose, prepare_comparison, read_flight
from px4fuse.ekf2.model import Ekf2Model, misalign_positions, prepare_ekf2_model
from px4fuse.ekf2.whatif import what_if
from px4fuse.errors import Px4FuseError
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Truth, Unavailable
from px4fuse.request import ComparisonRequest, PositionFile
from px4fuse.results import build
from px4fuse.results.contract import to_json_dict

# Block length (s) of independent errors for the uncertainty of an RMSE
BLOCK_S = 5.0
HORIZON = "EKF2_DELAY_MAX"
OPTIONS = {
    "--clock-offset": "clock_offset_s", "--sigma-a": "sigma_a_m_s2", "--sigma-z": "sigma_z_m",
    "--start": "start_s", "--end": "end_s", "--position-source": "position_source",
}  # fmt: skip
POSITION_OPTIONS = {"--position-frame": "frame", "--position-yaw": "yaw_deg"}


class Fix(NamedTuple):
    """Followed action: its places, and the RMSE (m) before and after."""

    action: str
    places: tuple[str, ...]
    before_m: float = math.nan
    after_m: float = math.nan
    limit_m: float = math.nan

    @property
    def is_harmful(self) -> bool:
        return self.after_m > self.limit_m


def rmse_m(comparison: Comparison) -> float:
    """Return KF's horizontal position RMSE (m) against ground truth."""
    axes = [comparison.axes[name] for name in ("north", "east") if name in comparison.axes]
    errors = [result.filters["kf"].truth for result in axes or [comparison.main]]
    if not all(isinstance(error, ErrorsAgainstTruth) for error in errors):
        return math.nan
    return math.hypot(*(error.position_rmse_m for error in errors))


def compare_with_kf(prepared: PreparedComparison) -> Comparison:
    return compare(prepared)


def limit_m(before_m: float, duration_s: float) -> float:
    """Return the largest RMSE (m) that does not differ significantly."""
    count = max(duration_s / BLOCK_S, 4.0)
    return before_m * (1.0 + 1.96 / math.sqrt(2.0 * count)) + 0.002


def proposed(outputs: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield kind, change and place of each action that a machine can follow."""
    for place, text in texts_of(outputs):
        if not place.startswith(("fix of", "card action", "card do this")):
            continue
        changes = dict(re.findall(rf"param set {PARAMETER} {NUMBER}", text))
        if sentence := re.search(rf"(?:Set|Increase) {PARAMETER} to .*?(?:\.\s|\.$|$)", text):
            changes |= dict(re.findall(rf"{PARAMETER} to {NUMBER}", sentence[0]))
        known = {name: float(value) for name, value in changes.items() if name in MODEL_PARAMETERS}
        if known:
            yield "EKF2", known, place
        if found := re.search(rf"(?i)(subtract|add) {NUMBER} s (?:from|to) the timestamp", text):
            sign = -1.0 if found[1].lower() == "subtract" else 1.0
            yield "sender", {"shift_s": sign * float(found[2])}, place
        for command in re.findall(r"(--[a-z][^(]*)", text):
            words = shlex.split(command.rstrip(".)").replace("'", ""))
            pairs = dict(pairwise(words))
            options = {
                name: value.rstrip(".,)")
                for name, value in pairs.items()
                if name in {**OPTIONS, **POSITION_OPTIONS}
                and re.match(r"[+-]?\d|auto|enu|ned|nwu|vehicle_|estimator_", value)
            }
            if options:
                yield "KF", options, place


def apply_options(request: ComparisonRequest, options: dict[str, str]) -> ComparisonRequest:
    """Return the request with options as typed."""
    fields: dict[str, Any] = {}
    position: dict[str, Any] = {}
    for name, text in options.items():
        value: Any = text
        with suppress(ValueError):
            value = float(text)
        (fields if name in OPTIONS else position)[{**OPTIONS, **POSITION_OPTIONS}[name]] = value
    if position and isinstance(request.position, PositionFile):
        fields["position"] = structs.replace(request.position, **position)
    return structs.replace(request, **fields)


def replayed_m(model: Ekf2Model, change: dict[str, float]) -> tuple[float, float]:
    """Return the horizontal RMSE (m) of EKF2's replay as flown and with changed parameters."""
    found = what_if(model, [change])
    if isinstance(found, Unavailable):
        return math.nan, math.nan
    before, after = (
        found.replayed.position_rmse_to_truth_m,
        found.whatif[0].position_rmse_to_truth_m,
    )
    both = [value if isinstance(value, float) else math.nan for value in (before, after)]
    return both[0], both[1]


def follow(analysis: Analysis, request: ComparisonRequest) -> list[Fix]:
    """Return the fixes of one analysed flight with their effect."""
    outputs = {"json": to_json_dict(build.make_comparison_results(request, analysis))}
    actions: dict[tuple[str, tuple[tuple[str, Any], ...]], list[str]] = {}
    for kind, change, place in proposed(outputs):
        actions.setdefault((kind, tuple(sorted(change.items()))), []).append(place)
    # a longer fusion horizon belongs to the shift of the timestamps
    horizon = next((dict(items) for _, items in actions if dict(items).keys() == {HORIZON}), {})
    if any(kind == "sender" for kind, _ in actions):
        actions = {key: places for key, places in actions.items() if dict(key[1]) != horizon}
    segment, flight, fixes = analysis.segment, analysis.flight, list[Fix]()
    limit = partial(limit_m, duration_s=segment.end_s - segment.start_s)
    model = prepare_ekf2_model(flight) if any(kind != "KF" for kind, _ in actions) else None
    for (kind, items), found_in in actions.items():
        places = list(dict.fromkeys(found_in))
        change, before_m, after_m = dict(items), math.nan, math.nan
        try:
            if kind == "KF":
                fixed = apply_options(request, change)
                fixed_flight = read_flight(fixed) if request.position else flight
                again = compare_with_kf(prepare_comparison(fixed_flight, fixed))
                before_m, after_m = rmse_m(analysis), rmse_m(again)
            elif isinstance(model, Ekf2Model) and kind == "EKF2":
                before_m, after_m = replayed_m(model, change)
            elif isinstance(model, Ekf2Model):
                before_m, _ = replayed_m(model, {})
                shifted = misalign_positions(model, 0.0, change["shift_s"])
                found = what_if(replace(shifted, agreement=model.agreement), [horizon])
                if not isinstance(found, Unavailable):
                    after = found.whatif[0].position_rmse_to_truth_m
                    after_m = after if isinstance(after, float) else math.nan
        except Px4FuseError as error:
            places.append(f"refused: {error}")
        name = f"{kind}: {', '.join(f'{key} {value}' for key, value in items)}"
        fixes.append(Fix(name, tuple(places), before_m, after_m, limit(before_m)))
    faults = [one for one in analysis.findings if "convention" in one.evidence]
    if faults:
        try:
            sent = compare_with_kf(
                prepare_comparison_inputs(
                    read_flight(request) if request.position else flight,
                    request,
                    keep_positions_as_sent=True,
                )
            )
            fixes.append(
                Fix(
                    "KF: convention corrected",
                    tuple(one.id for one in faults),
                    rmse_m(sent),
                    rmse_m(analysis),
                    limit(rmse_m(sent)),
                )
            )
        except Px4FuseError as error:
            fixes.append(Fix("KF: convention corrected", (f"refused: {error}",)))
    return fixes


def run(job: Job) -> tuple[str, list[Fix]]:
    """Return the fixes of one flight; none without ground truth."""
    try:
        request, flight = job.read()
        if not isinstance(flight.truth, Truth):
            return job.name, []
        return job.name, follow(diagnose(request, flight=flight), request)
    except Px4FuseError:
        return job.name, []


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="part of the name of the flights")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        for name, fixes in pool.map(run, [job for job in jobs() if options.only in job.name]):
            for fix in fixes:
                effect = "not tested"
                if np.isfinite([fix.before_m, fix.after_m]).all():
                    effect = (
                        "harmful"
                        if fix.is_harmful
                        else "better"
                        if fix.after_m < 0.95 * fix.before_m
                        else "equal"
                    )
                counts[effect] += 1
                change = f"{fix.action}: {fix.before_m:.3f} → {fix.after_m:.3f} m"
                print(f"{effect:10s} {name:32s} {change} ({'; '.join(fix.places)})", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
