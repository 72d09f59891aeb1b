"""Findings for known position errors: models of errors on real motion.

``python tests/studies/source_errors.py LOG … --flights 8`` takes IMU and attitude of logs of PX4's
EKF2 and the ground truth of the JSON file next to each, adds simulated errors of a positioning
system at several rates, and prints for each model of errors the frequency of each finding, and the
causes in the summary. ``--pairs`` combines two models. The study is independent of
``px4fuse.simulation``. EKF2's states are left out, because EKF2 fused other positions. Logs need
the positions as received (``vehicle_visual_odometry``); positions reconstructed from EKF2 are
excluded from some findings.

Ground truth stays in the flight; ``--no-truth`` removes it, as on an outdoor flight. A flight
counts as correct if its first finding, except the missing EKF2, is that of the model, and for white
noise if there is none. The timestamps are correct: the ground truth of JSON files and logs agrees
at 0.000 s. The estimated clock offset is 10 to 20 ms late on average at 0.1 m, which is half its σ;
it is the same with an IMU simulated from ground truth with other noise, and within 5 ms of zero
without IMU noise. Several logs of PX4's simulation share one seeded sequence of IMU noise, so their
IMU errors are not independent. At 2 Hz errors with a time constant of 0.2 s are practically white:
their correlation between positions is 8 %.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from comparisons import compare
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from px4fuse.diagnose import diagnose_comparison
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.readers import read_log

Values = NDArray[np.float64]
SIGMA_M = 0.10
Rng = np.random.Generator
# Position errors (m) and timestamp errors (s); made by a model from times and true positions
Made = tuple[Values, Values | float]
Model = Callable[[Rng, Values, Values], Made]


def white(rng: Rng, time: Values, true: Values, sigma: Values | float = SIGMA_M) -> Made:
    return rng.normal(size=true.shape) * sigma, 0.0


def coloured(rng: Rng, time: Values, true: Values, tau_s: float, share: float = 0.5) -> Made:
    """White noise plus a first-order process of time constant tau with this share of variance."""
    slow = np.zeros_like(true)
    keep = np.exp(-np.diff(time) / tau_s)
    slow[0] = rng.normal(size=3)
    for i, rho in enumerate(keep):
        slow[i + 1] = rho * slow[i] + np.sqrt(1.0 - rho**2) * rng.normal(size=3)
    fast = rng.normal(size=true.shape)
    return SIGMA_M * (np.sqrt(share) * slow + np.sqrt(1.0 - share) * fast), 0.0


def held(rng: Rng, time: Values, true: Values, share: float) -> Made:
    """Repeat the previous position in a share of the samples."""
    sent = true + rng.normal(size=true.shape) * SIGMA_M
    again = rng.random(len(time)) < share
    for i in range(1, len(time)):
        if again[i]:
            sent[i] = sent[i - 1]
    return sent - true, 0.0


def low_pass(rng: Rng, time: Values, true: Values, tau_s: float) -> Made:
    sent = true + rng.normal(size=true.shape) * SIGMA_M
    for i, dt in enumerate(np.diff(time)):
        rho = np.exp(-dt / tau_s)
        sent[i + 1] = rho * sent[i] + (1.0 - rho) * sent[i + 1]
    return sent - true, 0.0


def with_outliers(rng: Rng, time: Values, true: Values, share: float) -> Made:
    error = rng.normal(size=true.shape) * SIGMA_M
    far = rng.random(len(time)) < share
    size = far.sum(), 2
    error[far, :2] += rng.choice([-1.0, 1.0], size) * rng.uniform(1.0, 3.0, size)
    return error, 0.0


def two_levels(rng: Rng, time: Values, true: Values, factor: float) -> Made:
    """White noise with a larger σ in the middle third."""
    middle = (time > time[len(time) // 3]) & (time < time[2 * len(time) // 3])
    sigma = np.where(middle, factor * SIGMA_M, SIGMA_M)[:, None]
    return rng.normal(size=true.shape) * sigma, 0.0


def scaled(rng: Rng, time: Values, true: Values, scale: float) -> Made:
    return rng.normal(size=true.shape) * SIGMA_M + scale * (true - true[0]), 0.0


def jumped(rng: Rng, time: Values, true: Values, size: float) -> Made:
    error = rng.normal(size=true.shape) * SIGMA_M
    error[2 * len(time) // 3 :, 0] += size
    return error, 0.0


def clock(rng: Rng, time: Values, true: Values, late: float) -> Made:
    return rng.normal(size=true.shape) * SIGMA_M, late


def clock_jump(rng: Rng, time: Values, true: Values, late: float) -> Made:
    return rng.normal(size=true.shape) * SIGMA_M, np.where(time > time[len(time) // 2], late, 0.0)


MODELS: dict[str, tuple[Model, str]] = {
    "white 0.1 m": (white, ""),
    "white 0.05, 0.2 m north, east": (
        partial(white, sigma=np.array([0.05, 0.2, 0.1])), "source_noise_unequal_axes"),
    "AR(1) 0.2 s": (partial(coloured, tau_s=0.2), "source_noise_time_correlated"),
    "AR(1) 1 s": (partial(coloured, tau_s=1.0), "source_noise_time_correlated"),
    "AR(1) 5 s": (partial(coloured, tau_s=5.0), "source_noise_time_correlated"),
    "AR(1) 20 s": (partial(coloured, tau_s=20.0), "source_noise_time_correlated"),
    "held 30 %": (partial(held, share=0.3), "source_samples_repeated"),
    "held 60 %": (partial(held, share=0.6), "source_samples_repeated"),
    "low pass 0.3 s": (partial(low_pass, tau_s=0.3), "source_low_pass_filtered"),
    "low pass 0.6 s": (partial(low_pass, tau_s=0.6), "source_low_pass_filtered"),
    "outliers 5 %": (partial(with_outliers, share=0.05), "source_outliers"),
    "three times as noisy": (partial(two_levels, factor=3.0), "source_noise_varies"),
    "scale 20 %": (partial(scaled, scale=0.2), "source_scale_error"),
    "jump 1 m": (partial(jumped, size=1.0), "source_position_jump"),
    "clock 0.3 s late": (partial(clock, late=0.3), "source_time_offset"),
    "clock jumps 0.3 s": (partial(clock_jump, late=0.3), "source_time_offset_changes"),
}  # fmt: skip


# Two models at once: errors of both, with the white noise of both
PAIRS = (
    ("outliers 5 %", "clock 0.3 s late"), ("outliers 5 %", "scale 20 %"),
    ("outliers 5 %", "jump 1 m"), ("clock 0.3 s late", "scale 20 %"),
    ("clock 0.3 s late", "jump 1 m"), ("scale 20 %", "jump 1 m"),
    ("AR(1) 1 s", "outliers 5 %"),
)  # fmt: skip
BOTH = " + "


def model_of(name: str) -> Model:
    """Return the model of this name, or the sum of two models."""
    models = [MODELS[each][0] for each in name.split(BOTH)]

    def added(rng: Rng, time: Values, true: Values) -> Made:
        made = [model(rng, time, true) for model in models]
        return sum(error for error, _ in made), sum(late for _, late in made)

    return added


def truth_of(log: Path, flight: Flight) -> CubicSpline:
    """Return true positions (m, NED) as a function of flight time, from the tag positions."""
    rows = json.loads(log.with_suffix(".json").read_text())["uwb"]
    rows = [row for row in rows if row.get("t_px4_us")]
    time = np.array([row["t_px4_us"] * 1e-6 for row in rows]) - flight.log.boot_time_s
    return CubicSpline(time, np.array([row["truth"] for row in rows]))


def laid_over(
    flight: Flight, known: CubicSpline, model: Model, rate_hz: float, seed: int,
    sigma_m: float = SIGMA_M,
) -> Flight:  # fmt: skip
    """Return the flight with simulated position errors, and without EKF2."""
    rng = np.random.default_rng(seed)
    first = next(track for track in flight.positions if track.origin.is_selectable_by_default)
    start, end = max(known.x[0], 0.0), known.x[-1]
    count = int((end - start) * rate_hz)
    # time slots of a tag, with jitter
    time = start + (np.arange(count) + rng.uniform(0.1, 0.3, count)) / rate_hz
    time = time[time < end]
    true = known(time)
    error, late = model(rng, time, true)
    sent = np.round((true + error) * 1e3) / 1e3  # millimetres
    samples = pd.DataFrame(sent, pd.Index(time + late, name="time_s"), Columns.POSITION)
    samples[Columns.POSITION_VARIANCE] = sigma_m**2
    samples = samples[~samples.index.duplicated()].sort_index()
    return replace(
        flight,
        positions=(replace(first, samples=samples, orientation=None),),
        ekf2=Unavailable("EKF2", "it fused other positions", "Not in this study."),
    )


def told(job: tuple[str, str, float, int], *, truth: bool = True) -> tuple[str, tuple[str, ...]]:
    """Return findings above information on one flight, causes only, most severe first."""
    log, name, rate_hz, seed = job
    flight = read_log(Path(log))
    sigma_z_m = float(SIGMA_M * np.sqrt(len(name.split(BOTH))))
    known = truth_of(Path(log), flight)
    flight = laid_over(flight, known, model_of(name), rate_hz, seed, sigma_z_m)
    if not truth:
        flight = replace(flight, truth=Unavailable("truth", "left out", "Not in this study."))
    analysis = diagnose_comparison(
        compare(flight, Settings(0.27, sigma_z_m), axes=("north", "east"))
    )
    return name, tuple(
        f"{one.id}{'!' if one.severity == 'error' else ''}"
        for one in find(analysis)
        if one.severity != "note" and one.caused_by is None
    )


def right(name: str, ids: tuple[str, ...]) -> bool:
    """Return True if the first finding is that of the model; for a pair, if both are reported."""
    wanted = {MODELS[each][1] for each in name.split(BOTH)} - {""}
    causes = [one.strip("!") for one in ids if not one.startswith(("since", "ekf2_not_logged"))]
    return wanted <= set(causes if len(wanted) > 1 else causes[:1]) and bool(wanted) >= bool(causes)


def jobs(
    logs: list[str], flights: int, only: str, *, pairs: bool, first: int = 0
) -> Iterator[tuple[str, str, float, int]]:
    rates = (5.0, 10.0, 20.0, 2.0)
    for name in map(BOTH.join, PAIRS) if pairs else MODELS:
        if only in name:
            for seed in range(first, first + flights):
                yield logs[seed % len(logs)], name, rates[seed // len(logs) % len(rates)], seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+")
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="")
    parser.add_argument("--no-truth", action="store_true", help="as on a flight without one")
    parser.add_argument("--pairs", action="store_true", help="two models at once")
    given = parser.parse_args()
    found: dict[str, Counter[str]] = {}
    counts: Counter[str] = Counter()
    good: Counter[str] = Counter()
    with ProcessPoolExecutor() as pool:
        flown = jobs(given.logs, given.flights, given.only, pairs=given.pairs, first=given.first)
        for name, ids in pool.map(partial(told, truth=not given.no_truth), flown):
            counts[name] += 1
            good[name] += right(name, ids)
            found.setdefault(name, Counter()).update(ids or ["nothing"])
    for name, ids in found.items():
        wanted = " and ".join(MODELS[each][1] or "nothing" for each in name.split(BOTH))
        print(f"{name} ({good[name]} of {counts[name]} flights right; {wanted} expected)")
        for finding, count in ids.most_common():
            print(f"    {count:3d}  {finding}")
    print(f"{sum(good.values())} of {sum(counts.values())} right")


if __name__ == "__main__":
    main()
