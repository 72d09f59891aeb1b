"""Predictions of EKF2 with another parameter, compared with flights that use it.

``python tests/studies/whatif_pairs.py [SEEDS] [outdoor]`` simulates pairs of flights that
differ in one EKF2 parameter only (same seed), predicts the second from the first, and prints for
each pair the predicted and the flown mean NIS, rejected share and position error. At the end it
prints how many were available, predictable and correct: NIS and error within 10 %, rejections
within 3 points. EKF2 in these flights is px4fuse's model, so the study tests the path from a log to
the prediction, not the model.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

from px4fuse.ekf2.model import Ekf2Model, prepare_ekf2_model
from px4fuse.ekf2.whatif import WhatIf, what_if
from px4fuse.flight.model import Unavailable
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import ScenarioKind, make_scenario

NIS_WITHIN, REJECTED_WITHIN, ERROR_WITHIN = 0.10, 0.03, 0.10
# By fault of ``simulate``: PX4 parameter, correct value, sizes of the fault, and the factor
# from the unit of the fault to that of the parameter
KNOBS: dict[ScenarioKind, dict[str, tuple[str, float, tuple[float, ...], float]]] = {
    "aisle": {
        "ekf2-noise": ("EKF2_EVP_NOISE", 0.1, (0.02, 0.03, 0.05, 0.2, 0.5, 1.0), 1.0),
        "ekf2-delay": ("EKF2_EV_DELAY", 0.0, (0.05, 0.1, 0.175, 0.25), 1e3),
        "ekf2-gate": ("EKF2_EVP_GATE", 5.0, (1.0, 1.5, 2.0, 3.0, 10.0, 50.0), 1.0),
    },
    # the receiver reports 0.4 m; smaller values of the parameter have no effect
    "outdoor": {
        "ekf2-noise": ("EKF2_GPS_P_NOISE", 0.4, (0.6, 1.0, 2.0), 1.0),
        "ekf2-delay": ("EKF2_GPS_DELAY", 110.0, (0.0, 0.05, 0.2, 0.25), 1e3),
        "ekf2-gate": ("EKF2_GPS_P_GATE", 5.0, (1.0, 1.5, 2.0, 3.0, 10.0), 1.0),
    },
}
# Kind, seed, faults of the first and the second flight, predicted parameter and its value
Pair = tuple[ScenarioKind, int, str, str, str, float]


def pairs(seeds: int, kind: ScenarioKind = "aisle") -> Iterator[Pair]:
    """Yield pairs from the correct setting to each wrong one, and back."""
    for seed in range(1, seeds + 1):
        for mistake, (name, right, values, per_unit) in KNOBS[kind].items():
            for value in values:
                wrong = f"{mistake}={value:g}"
                yield kind, seed, "", wrong, name, value * per_unit
                yield kind, seed, wrong, "", name, right


def opened(kind: ScenarioKind, seed: int, mistake: str) -> Ekf2Model | Unavailable:
    """Open the EKF2 model of a flight with a fault."""
    scenario = make_scenario(kind, seed=seed, passes=3)
    return prepare_ekf2_model(
        simulate_flight(scenario, parse_faults((mistake,) if mistake else ()))
    )


def flown(kind: ScenarioKind, seed: int, mistake: str) -> WhatIf | Unavailable:
    """Replay EKF2 of a flight with a fault."""
    model = opened(kind, seed, mistake)
    return model if isinstance(model, Unavailable) else what_if(model, [])


def tried(pair: Pair) -> tuple[Pair, str, tuple[float, ...]]:
    """Return verdict, mean NIS, rejected share and RMSE (m) of prediction and second flight."""
    kind, seed, first, then, name, value = pair
    model = opened(kind, seed, first)
    found = model if isinstance(model, Unavailable) else what_if(model, [{name: value}])
    truth = flown(kind, seed, then)
    if isinstance(found, Unavailable):
        return pair, f"refused: {found.reason}", ()
    if isinstance(truth, Unavailable):
        return pair, "the other flight cannot be replayed", ()
    predicted, real = found.whatif[0], truth.logged
    errors_m = predicted.position_rmse_to_truth_m, real.position_rmse_to_truth_m
    assert not isinstance(errors_m[0], Unavailable)
    assert not isinstance(errors_m[1], Unavailable)
    numbers = (
        predicted.nis_mean, real.nis_mean, predicted.rejected_fraction, real.rejected_fraction,
        *errors_m
    )  # fmt: skip
    if not predicted.is_predictable:
        return pair, "chaotic", numbers
    near = abs(predicted.nis_mean / real.nis_mean - 1.0) <= NIS_WITHIN
    near &= abs(errors_m[0] / errors_m[1] - 1.0) <= ERROR_WITHIN
    near &= abs(predicted.rejected_fraction - real.rejected_fraction) <= REJECTED_WITHIN
    return pair, "right" if near else "WRONG", numbers


def main() -> None:
    seeds, counts = int(sys.argv[1]) if len(sys.argv) > 1 else 3, dict[str, int]()
    kind: ScenarioKind = "outdoor" if "outdoor" in sys.argv[2:] else "aisle"
    with ProcessPoolExecutor() as pool:
        for (_, seed, first, then, *_), verdict, numbers in pool.map(tried, pairs(seeds, kind)):
            counts[verdict.split(":")[0]] = counts.get(verdict.split(":")[0], 0) + 1
            said = ""
            if numbers:
                nis, real_nis, rejected, real_rejected, error_m, real_m = numbers
                said = f"NIS {nis:.3g} / {real_nis:.3g}, rejected {rejected:.1%} / "
                said += f"{real_rejected:.1%}, error {error_m:.3f} / {real_m:.3f} m"
            print(f"seed {seed}: {first or 'right'} → {then or 'right'}: {verdict} {said}")
    total = sum(counts.values())
    print(f"{total} pairs: " + ", ".join(f"{count} {name}" for name, count in counts.items()))


if __name__ == "__main__":
    main()
