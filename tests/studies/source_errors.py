"""What px4fuse says of positions whose errors are known: models of errors over real motion.

``python tests/studies/source_errors.py LOG … --flights 8`` takes IMU and attitude of logs (flown by
the real EKF2) and the truth of the JSON file beside each, lays simulated errors of a positioning
system over the truth, at several rates, and prints for each model of errors how often each finding
was told, and each "since" of the story. ``--pairs`` lays two models over the truth at once. It is
independent of ``px4fuse.simulation``: it shares no line with it. EKF2's own record is left out,
since it fused other positions. Logs without the positions as they arrived (no
``vehicle_visual_odometry``) are no use: theirs were made of EKF2's output, of which less is said.

The truth stays in the flight, as it is in the log; ``--no-truth`` takes it out, as on a flight
outdoors. Right is a flight whose first finding, EKF2's absence left out, is the model's own, and
for white noise none; no other statement counts. The stamps are right: the truth of the JSON files
agrees with the logs' own ground truth at 0.000 s. The clock offset that is found, 10 to 20 ms late
on average at 0.1 m, is the estimate's: half its σ, as late with an IMU made of the truth and fresh
noise, and within 5 ms of zero with one without noise. Several logs of PX4's simulation share one
sequence of IMU noise (it is seeded), so that what the IMU adds is no fresh chance in each. At 2 Hz
errors of 0.2 s are white to all purposes: 92 % of them is forgotten from one position to the next.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from px4fuse.analysis import explain
from px4fuse.comparison.comparison import compare
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.findings.summary import summarise_flight
from px4fuse.flight import Columns, Flight, Unavailable
from px4fuse.readers import read_log

Values = NDArray[np.float64]
SIGMA_M = 0.10
Rng = np.random.Generator
# Errors (m), and what is added to the stamps (s); of a model, from true positions at the times
Made = tuple[Values, Values | float]
Model = Callable[[Rng, Values, Values], Made]


def white(rng: Rng, time: Values, true: Values, sigma: Values | float = SIGMA_M) -> Made:
    return rng.normal(size=true.shape) * sigma, 0.0


def coloured(rng: Rng, time: Values, true: Values, tau_s: float, share: float = 0.5) -> Made:
    """White, and a first-order process of time constant tau that has this share of the variance."""
    slow = np.zeros_like(true)
    keep = np.exp(-np.diff(time) / tau_s)
    slow[0] = rng.normal(size=3)
    for i, rho in enumerate(keep):
        slow[i + 1] = rho * slow[i] + np.sqrt(1.0 - rho**2) * rng.normal(size=3)
    fast = rng.normal(size=true.shape)
    return SIGMA_M * (np.sqrt(share) * slow + np.sqrt(1.0 - share) * fast), 0.0


def held(rng: Rng, time: Values, true: Values, share: float) -> Made:
    """Some positions are the one before, sent again."""
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
    """Three times as noisy in the middle third."""
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
        partial(white, sigma=np.array([0.05, 0.2, 0.1])), "source_axes_unequal"),
    "AR(1) 0.2 s": (partial(coloured, tau_s=0.2), "source_coloured"),
    "AR(1) 1 s": (partial(coloured, tau_s=1.0), "source_coloured"),
    "AR(1) 5 s": (partial(coloured, tau_s=5.0), "source_coloured"),
    "AR(1) 20 s": (partial(coloured, tau_s=20.0), "source_coloured"),
    "held 30 %": (partial(held, share=0.3), "source_repeats"),
    "held 60 %": (partial(held, share=0.6), "source_repeats"),
    "low pass 0.3 s": (partial(low_pass, tau_s=0.3), "source_smoothed"),
    "low pass 0.6 s": (partial(low_pass, tau_s=0.6), "source_smoothed"),
    "outliers 5 %": (partial(with_outliers, share=0.05), "source_outliers"),
    "three times as noisy": (partial(two_levels, factor=3.0), "source_noise_changes"),
    "scale 20 %": (partial(scaled, scale=0.2), "source_scale_wrong"),
    "jump 1 m": (partial(jumped, size=1.0), "source_jumps"),
    "clock 0.3 s late": (partial(clock, late=0.3), "source_clock_offset"),
    "clock jumps 0.3 s": (partial(clock_jump, late=0.3), "source_clock_changes"),
}  # fmt: skip


# Two at once: errors of both, with the white noise of both
PAIRS = (
    ("outliers 5 %", "clock 0.3 s late"), ("outliers 5 %", "scale 20 %"),
    ("outliers 5 %", "jump 1 m"), ("clock 0.3 s late", "scale 20 %"),
    ("clock 0.3 s late", "jump 1 m"), ("scale 20 %", "jump 1 m"),
    ("AR(1) 1 s", "outliers 5 %"),
)  # fmt: skip
BOTH = " + "


def model_of(name: str) -> Model:
    """The model of that name, or of two."""
    models = [MODELS[each][0] for each in name.split(BOTH)]

    def added(rng: Rng, time: Values, true: Values) -> Made:
        made = [model(rng, time, true) for model in models]
        return sum(error for error, _ in made), sum(late for _, late in made)

    return added


def truth_of(log: Path, flight: Flight) -> CubicSpline:
    """True positions (m, NED) over the flight's time, from where the tag was at each sample."""
    rows = json.loads(log.with_suffix(".json").read_text())["uwb"]
    rows = [row for row in rows if row.get("t_px4_us")]
    time = np.array([row["t_px4_us"] * 1e-6 for row in rows]) - flight.log.boot_time_s
    return CubicSpline(time, np.array([row["truth"] for row in rows]))


def laid_over(
    flight: Flight, known: CubicSpline, model: Model, rate_hz: float, seed: int,
    sigma_m: float = SIGMA_M,
) -> Flight:  # fmt: skip
    """The flight with a source of such errors, and without EKF2."""
    rng = np.random.default_rng(seed)
    first = next(track for track in flight.positions if track.origin.is_automatic)
    start, end = max(known.x[0], 0.0), known.x[-1]
    count = int((end - start) * rate_hz)
    # measured near a regular time, as a tag that takes turns
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
    """Findings of one flight that are no information, causes only, most severe first."""
    log, name, rate_hz, seed = job
    flight = read_log(Path(log))
    sigma_z_m = float(SIGMA_M * np.sqrt(len(name.split(BOTH))))
    known = truth_of(Path(log), flight)
    flight = laid_over(flight, known, model_of(name), rate_hz, seed, sigma_z_m)
    if not truth:
        flight = replace(flight, truth=Unavailable("truth", "left out", "Not in this study."))
    analysis = explain(compare(flight, Settings(0.27, sigma_z_m), axes=("north", "east")))
    told = summarise_flight(analysis, find(analysis))[0].partition(", since ")[2]
    since = (f"since: {re.sub(r'[-+0-9.]+', '#', told.partition(' (')[0])}",) if told else ()
    return name, since + tuple(
        f"{one.id}{'!' if one.severity == 'error' else ''}"
        for one in find(analysis)
        if one.severity != "info" and one.caused_by is None
    )


def right(name: str, ids: tuple[str, ...]) -> bool:
    """Whether the first finding is the model's own; of a pair, whether both are told."""
    wanted = {MODELS[each][1] for each in name.split(BOTH)} - {""}
    causes = [one.strip("!") for one in ids if not one.startswith(("since", "ekf2_unavailable"))]
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
