"""False-alarm rates and power of the detectors, measured on simulated flights.

``python -m px4fuse.simulation.detector_rates`` measures them again and rewrites
``findings/rates.csv``, which ships with the package: about a quarter of an hour on two cores.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import binomtest

from px4fuse.analysis import explain
from px4fuse.comparison.comparison import compare
from px4fuse.filter.kalman import Settings
from px4fuse.findings import DETECTORS, find, find_loop
from px4fuse.loop.analysis import analyse
from px4fuse.loop.sources import Source
from px4fuse.loop.tracks import trajectory_of
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Kind, Scenario

TABLE = "rates.csv"
CLEAN = "none"
CLEAN_FLIGHTS, FAULTY_FLIGHTS = 200, 30
# What simulated flights ask for: the IMU's white noise with what bias and attitude errors add
RIGHT = Settings(sigma_a_m_s2=0.27, sigma_z_m=0.10)
ALWAYS = ("ekf2_unavailable", "ekf2_is_a_model", "loop_end_assumed")


@dataclass(frozen=True)
class Condition:
    """A mistake of a stated size, and the finding that must name it.

    ``typed`` is as the finding's file declares it (``measured_on``).
    """

    finding: str
    typed: str

    @property
    def kind(self) -> Kind:
        """That of the flight."""
        return "loop" if "--kind loop" in self.typed else "aisle"

    @property
    def mistakes(self) -> tuple[str, ...]:
        """As ``px4fuse simulate --mistake`` takes them."""
        return tuple(re.findall(r"--mistake (\S+)", self.typed))

    @property
    def ekf2(self) -> bool:
        """Whether EKF2 flies along: not where a mistake is about something else, for speed."""
        return not self.typed or self.finding.startswith("ekf2_")

    @property
    def settings(self) -> Settings:
        """The right ones, with those of this condition in their place."""
        words = re.sub(r"--\w+ \S+", "", self.typed).split()
        given: dict[str, Any] = {
            name: float(value) for name, value in (word.split("=") for word in words)
        }
        return replace(RIGHT, **given)


CONDITIONS = tuple(
    Condition(finding, typed)
    for detector in DETECTORS
    for finding, conditions in detector.measured_on.items()
    for typed in conditions
)
# Clean flights: without a mistake
AISLE, LOOP = Condition("", ""), Condition("", "--kind loop")


def found(seed: int, condition: Condition | None = None) -> tuple[str, ...]:
    """Findings on one simulated flight, most severe first, each before what it brings with it.

    Those that always are there are left out.

    Parameters
    ----------
    seed : int
    condition : Condition, optional
        None for a clean flight.
    """
    condition = condition or AISLE
    mistakes = parse(condition.mistakes)
    if condition.kind == "loop":
        # without the truth, which would tell where it landed
        flight = simulate_flight(
            Scenario(kind="loop", passes=1, truth=False, ekf2=condition.ekf2, seed=seed), mistakes
        )
        loop = analyse(Source(trajectory_of(flight, "vio"), flight))
        return tuple(i for f in find_loop(loop) for i in f.ids if i not in ALWAYS)
    flight = simulate_flight(Scenario(ekf2=condition.ekf2, seed=seed), mistakes)
    analysis = explain(compare(flight, condition.settings, axes=("north", "east")))
    return tuple(i for f in find(analysis) for i in f.ids if i not in ALWAYS)


def _job(job: tuple[int, Condition]) -> tuple[str, ...]:
    return found(*job)


def measure(
    clean_flights: int = CLEAN_FLIGHTS, faulty_flights: int = FAULTY_FLIGHTS
) -> pd.DataFrame:
    """Run every condition, on all cores.

    Returns
    -------
    DataFrame
        ``finding``, ``condition`` ("none" for a clean flight: the rate is that of false alarms),
        ``flights``, ``rate``, its 95 % interval ``low``, ``high`` (Clopper and Pearson 1934), and
        ``first``, the share in which that finding came first.
    """
    jobs = [(seed, clean) for clean in (AISLE, LOOP) for seed in range(clean_flights)]
    # other seeds than the clean flights have
    jobs += [(10_000 + seed, c) for c in CONDITIONS for seed in range(faulty_flights)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(_job, jobs, chunksize=2))
    return pd.DataFrame(_rows(jobs, results))


def _rows(
    jobs: list[tuple[int, Condition]], results: list[tuple[str, ...]]
) -> Iterator[dict[str, object]]:
    clean = {
        kind.kind: [result for (_, c), result in zip(jobs, results, strict=True) if c == kind]
        for kind in (AISLE, LOOP)
    }
    kinds = {name: kind for kind, flights in clean.items() for result in flights for name in result}
    kinds |= {condition.finding: condition.kind for condition in CONDITIONS}
    for name, kind in sorted(kinds.items()):
        own = clean[kind]
        yield _row(name, CLEAN, [name in r for r in own], [r[:1] == (name,) for r in own])
    for condition in CONDITIONS:
        own = [r for (_, c), r in zip(jobs, results, strict=True) if c == condition]
        name = condition.finding
        yield _row(name, condition.typed, [name in r for r in own], [r[:1] == (name,) for r in own])


def _row(name: str, condition: str, hits: list[bool], first: list[bool]) -> dict[str, object]:
    interval = binomtest(sum(hits), len(hits)).proportion_ci()
    return {
        "finding": name,
        "condition": condition,
        "flights": len(hits),
        "rate": round(sum(hits) / len(hits), 4),
        "low": round(float(interval.low), 4),
        "high": round(float(interval.high), 4),
        "first": round(sum(first) / len(first), 4),
    }


def rates() -> pd.DataFrame:
    """The table that ships with the package."""
    with files("px4fuse.findings").joinpath(TABLE).open(encoding="utf-8") as file:
        return pd.read_csv(file, keep_default_na=False)


if __name__ == "__main__":
    target = Path(str(files("px4fuse.findings").joinpath(TABLE)))
    measure().to_csv(target, index=False, lineterminator="\n")
