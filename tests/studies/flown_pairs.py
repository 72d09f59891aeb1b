"""Predictions of EKF2 with another parameter, compared with flights of PX4's own EKF2.

``python tests/studies/flown_pairs.py [FOLDER ...]`` reads flights (default:
``../shared/logs/flown``). It prints for each flight the correlation of replayed and logged
innovations, with EKF2's own rejections. Flights of one seed have identical sensor data and differ
only in EKF2 parameters. For each ordered pair of such flights it prints the predicted and the flown
mean NIS, rejected percentage, horizontal RMSE and height RMSE. Flown NIS and rejections are those
of all samples in flight (``figures`` in the JSON file beside a log); flown RMSE is over the time of
the prediction.
"""

import json
import sys
import time
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from px4fuse.ekf2.model import Ekf2Model, prepare_ekf2_model, replay_with_logged_rejections
from px4fuse.ekf2.replay import (
    compare_with_log,
    compute_rmse_to_truth,
    interpolate_component,
    is_inside_spans,
)
from px4fuse.ekf2.whatif import Ekf2Statistics, WhatIf, what_if
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Columns, Ekf2, Flight, Unavailable
from px4fuse.readers import read_log

FLOWN = Path(__file__).parents[2].parent / "shared" / "logs" / "flown"
MAX_NIS_ERROR, MAX_RMSE_ERROR, MAX_HEIGHT_ERROR = 0.10, 0.10, 0.15
MAX_REJECTED_ERROR = 0.03


class FlownFlight(NamedTuple):
    """A flight with the description of its JSON file and its EKF2 model."""

    flight: Flight
    description: dict[str, Any]
    model: Ekf2Model | Unavailable


def read_flight(path: Path) -> FlownFlight:
    flight = read_log(path)
    json_file = path.with_suffix(".json")
    description = json.loads(json_file.read_text()) if json_file.exists() else {}
    return FlownFlight(flight, description, prepare_ekf2_model(flight))


def describe_agreement(flown: FlownFlight) -> str:
    """Return the lowest correlation of each aiding source, with EKF2's own rejections."""
    if isinstance(flown.model, Unavailable):
        return flown.model.reason
    replay = replay_with_logged_rejections(flown.model)
    agreement = compare_with_log(flown.model.flight, replay)
    if isinstance(agreement, Unavailable):
        return agreement.reason
    correlations = {
        aid: min(axis.innovation_correlation for axis in getattr(agreement, aid).values())
        for aid in ("ev_pos", "gnss_pos", "gnss_vel", "gnss_hgt", "baro_hgt")
        if getattr(agreement, aid)
    }
    text = ", ".join(f"{aid} {correlation:.4f}" for aid, correlation in correlations.items())
    height = flown.model.inputs.reason_to_use_logged_height
    return (
        f"{text}; rejected {agreement.rejected_fraction_logged:.1%}, published position "
        f"{agreement.published_rms_difference_m:.3f} m, good {flown.model.agreement.good}"
        + (f"; height: {height}" if height else "")
    )


def changed_parameters(before: FlownFlight, after: FlownFlight) -> dict[str, float]:
    """Return the parameters of ``after`` that differ from ``before``."""
    first, second = (
        flown.flight.ekf2.record.parameters  # type: ignore[union-attr]
        for flown in (before, after)
    )
    return {
        name: value
        for name, value in second.items()
        if name in MODEL_PARAMETERS and first.get(name) != value
    }


def flown_errors_m(before: FlownFlight, after: FlownFlight, found: WhatIf) -> tuple[float, float]:
    """Return horizontal RMSE and height RMSE of a flight over the time of a prediction."""
    ekf2 = after.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    lift_off_s = [flown.flight.airborne[0][0] for flown in (before, after)]  # type: ignore[index]
    shift_s = lift_off_s[1] - lift_off_s[0]
    spans = [(begin + shift_s, end + shift_s) for begin, end in found.evaluated_s]
    times = ekf2.state.index[is_inside_spans(ekf2.state.index, tuple(spans))].to_numpy()
    north, east, down = (
        compute_rmse_to_truth(
            after.flight,
            interpolate_component(ekf2.state, Columns.POSITION, axis, times),
            axis,
            times,
        )
        for axis in np.eye(3)
    )
    assert north is not None
    assert east is not None
    return float(np.hypot(north, east)), float("nan") if down is None else down


def describe_pair(
    predicted: Ekf2Statistics, description: dict[str, Any], aid: str, errors_m: tuple[float, float]
) -> tuple[str, list[bool | None]]:
    """Return the numbers of a pair, and whether NIS, rejections, RMSE and height are right."""
    figures = description["figures"]["aids"][aid]
    nis, rejected = float(np.mean(figures["nis"][:2])), figures["rejected_share"]
    rmse = predicted.position_rmse_to_truth_m
    height = predicted.height_rmse_to_truth_m
    assert isinstance(rmse, float)
    text = (
        f"NIS {predicted.nis_mean:.3g} / {nis:.3g}, rejected {predicted.rejected_fraction:.1%} / "
        f"{rejected:.1%}, RMSE {rmse:.3f} / {errors_m[0]:.3f} m"
    )
    is_right: list[bool | None] = [
        abs(predicted.nis_mean / nis - 1.0) <= MAX_NIS_ERROR,
        abs(predicted.rejected_fraction - rejected) <= MAX_REJECTED_ERROR,
        abs(rmse / errors_m[0] - 1.0) <= MAX_RMSE_ERROR,
        None,
    ]
    if isinstance(height, float):
        text += f", height {height:.3f} / {errors_m[1]:.3f} m"
        is_right[3] = abs(height / errors_m[1] - 1.0) <= MAX_HEIGHT_ERROR
    return text, is_right


def main() -> None:
    folders = [Path(folder) for folder in sys.argv[1:]] or [FLOWN]
    paths = [path for folder in folders for path in sorted(folder.glob("*.ulg"))]
    flights = {path.stem: read_flight(path) for path in paths}
    for name, flown in flights.items():
        print(f"{name}: {describe_agreement(flown)}")
    pairs = [
        (first, second)
        for first, second in permutations(flights, 2)
        if "seed" in flights[first].description
        and flights[first].description["seed"] == flights[second].description.get("seed")
    ]
    results = []
    for first, second in pairs:
        before, after = flights[first], flights[second]
        if isinstance(before.model, Unavailable):
            print(f"{first} -> {second}: refused: {before.model.reason}")
            continue
        changes = changed_parameters(before, after)
        started_s = time.process_time()
        try:
            found = what_if(before.model, [changes])
        except SettingsError as error:
            print(f"{first} -> {second}: refused: {error}")
            continue
        if isinstance(found, Unavailable):
            print(f"{first} -> {second}: refused: {found.reason}")
            continue
        predicted = found.whatif[0]
        text, is_right = describe_pair(
            predicted,
            after.description,
            before.model.inputs.aid.name,
            flown_errors_m(before, after, found),
        )
        results.append((predicted.is_predictable, *is_right))
        wrong = [
            name
            for name, right in zip(("NIS", "rejected", "RMSE", "height"), is_right, strict=True)
            if right is False
        ]
        print(
            f"{first} -> {second}: {text}; {'steady' if predicted.is_predictable else 'chaotic'}; "
            f"{'wrong: ' + ', '.join(wrong) if wrong else 'right'}; "
            f"{time.process_time() - started_s:.1f} s"
        )
    for label, chosen in {
        "all": results,
        "steady": [row for row in results if row[0]],
    }.items():
        nis, rejected, rmse = (sum(bool(row[k]) for row in chosen) for k in (1, 2, 3))
        heights = [row[4] for row in chosen if row[4] is not None]
        print(
            f"{label}: {len(chosen)} of {len(pairs)} pairs answered; NIS {nis}, rejections "
            f"{rejected}, RMSE {rmse} right; height {sum(heights)} of {len(heights)}"
        )


if __name__ == "__main__":
    main()
