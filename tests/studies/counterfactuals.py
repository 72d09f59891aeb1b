"""Whether what px4fuse predicts of EKF2 with another setting is what EKF2 does when it is flown.

``python tests/studies/counterfactuals.py [SEEDS]`` flies pairs of simulated flights that differ in
one parameter of EKF2 alone (the same seed), predicts the second from the first, and prints for each
pair the predicted and the flown mean NIS and rejected share, and at the end how many were
available, steady and right: NIS within 10 %, rejections within 3 points. EKF2 in these flights is
px4fuse's model, so that the study tests the way from a log to the prediction, not the model.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

from px4fuse.ekf2.model import open_model
from px4fuse.ekf2.whatif import WhatIf, what_if
from px4fuse.flight import Unavailable
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

NIS_WITHIN, REJECTED_WITHIN = 0.10, 0.03
# Of a mistake of ``simulate``: PX4's parameter, what it is without the mistake, what is flown, and
# how many of the parameter's units one of the mistake's is
KNOBS = {
    "ekf2-noise": ("EKF2_EVP_NOISE", 0.1, (0.02, 0.03, 0.05, 0.2, 0.5, 1.0), 1.0),
    "ekf2-delay": ("EKF2_EV_DELAY", 0.0, (0.05, 0.1, 0.175, 0.25), 1e3),
    "ekf2-gate": ("EKF2_EVP_GATE", 5.0, (1.0, 1.5, 2.0, 3.0, 10.0, 50.0), 1.0),
}
# Seed, what was flown first and then, as ``--mistake`` takes it, and what is predicted
Pair = tuple[int, str, str, str, float]


def pairs(seeds: int) -> Iterator[Pair]:
    """From the right setting to each wrong one, and back."""
    for seed in range(1, seeds + 1):
        for mistake, (name, right, values, per_unit) in KNOBS.items():
            for value in values:
                wrong = f"{mistake}={value:g}"
                yield seed, "", wrong, name, value * per_unit
                yield seed, wrong, "", name, right


def flown(seed: int, mistake: str) -> WhatIf | Unavailable:
    """EKF2 as flown with a mistake, replayed."""
    flight = simulate_flight(Scenario(seed=seed, passes=3), parse((mistake,) if mistake else ()))
    model = open_model(flight)
    return model if isinstance(model, Unavailable) else what_if(model, [])


def tried(pair: Pair) -> tuple[Pair, str, tuple[float, ...]]:
    """Verdict on one pair, and predicted and flown NIS and rejected share."""
    seed, first, then, name, value = pair
    flight = simulate_flight(Scenario(seed=seed, passes=3), parse((first,) if first else ()))
    model = open_model(flight)
    found = model if isinstance(model, Unavailable) else what_if(model, [{name: value}])
    truth = flown(seed, then)
    if isinstance(found, Unavailable):
        return pair, f"refused: {found.reason}", ()
    if isinstance(truth, Unavailable):
        return pair, "the other flight cannot be replayed", ()
    predicted, real = found.whatif[0], truth.logged
    numbers = (predicted.nis_mean, real.nis_mean, predicted.rejected_share, real.rejected_share)
    if not predicted.steady:
        return pair, "chaotic", numbers
    near = abs(predicted.nis_mean / real.nis_mean - 1.0) <= NIS_WITHIN
    near &= abs(predicted.rejected_share - real.rejected_share) <= REJECTED_WITHIN
    return pair, "right" if near else "WRONG", numbers


def main() -> None:
    seeds, counts = int(sys.argv[1]) if len(sys.argv) > 1 else 3, dict[str, int]()
    with ProcessPoolExecutor() as pool:
        for (seed, first, then, *_), verdict, numbers in pool.map(tried, pairs(seeds)):
            counts[verdict.split(":")[0]] = counts.get(verdict.split(":")[0], 0) + 1
            said = ""
            if numbers:
                nis, real_nis, rejected, real_rejected = numbers
                said = f"NIS {nis:.3g} / {real_nis:.3g}, rejected {rejected:.1%} / "
                said += f"{real_rejected:.1%}"
            print(f"seed {seed}: {first or 'right'} → {then or 'right'}: {verdict} {said}")
    total = sum(counts.values())
    print(f"{total} pairs: " + ", ".join(f"{count} {name}" for name, count in counts.items()))


if __name__ == "__main__":
    main()
