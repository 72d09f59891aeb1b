"""False alarm and detection rates of the detectors, measured on simulated flights.

``python tests/studies/detector_rates.py`` measures them again and rewrites ``rates.csv`` in its
folder; it prints the expected duration. ``--clean`` and ``--faulty`` set the numbers of flights,
``--only TEXT`` prints the rows of scenarios and findings whose name contains TEXT, and writes
nothing.
"""

from __future__ import annotations

import argparse
import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd
from comparisons import compare
from scipy.stats import binomtest

from px4fuse.analysis import Analysis
from px4fuse.comparison.estimates import estimate
from px4fuse.comparison.flight_events import collect_events
from px4fuse.comparison.reruns import rerun_filters
from px4fuse.ekf2.aids import evaluate_aids
from px4fuse.ekf2.model import prepare_ekf2_model
from px4fuse.filter.settings import Settings
from px4fuse.findings import find, find_loop_findings
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.loop.analysis import analyse, analyse_flight_loop
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario, make_scenario

TABLE = Path(__file__).with_name("rates.csv")
CLEAN = "none"
CLEAN_FLIGHTS, FAULTY_FLIGHTS = 50, 20
# Faulty flights have other seeds than clean ones
FAULTY_SEED = 10_000
ALWAYS = ("ekf2_not_logged", "ekf2_simulated", "loop_landing_assumed")
NOT_ASKED = Unavailable("EKF2 replay", "the condition is not about EKF2", "Fly with EKF2.")
# Prefixes of findings that need the log of EKF2
OF_EKF2 = ("ekf2_", "source_timestamps_are_arrival_times")
# Options of ``px4fuse simulate`` for scenarios, and their fields
OPTIONS = {
    "--kind": "kind", "--passes": "passes", "--pause": "pause_s", "--yaw": "yaw",
    "--uwb-rate": "uwb_rate_hz", "--sigma-uwb": "sigma_uwb_m",
}  # fmt: skip


@dataclass(frozen=True)
class Flown:
    """Scenario: a type of flight without mistakes.

    Attributes
    ----------
    options : str
        Options of ``px4fuse simulate``.
    settings : Settings
        Best settings: IMU white noise plus the effect of bias and attitude errors.
    true : tuple of str
        Findings that are not false alarms on this flight.
    """

    options: str
    settings: Settings
    true: tuple[str, ...] = ()


DEFAULT = "5 Hz, 0.10 m"
SCENARIOS: Mapping[str, Flown] = MappingProxyType({
    DEFAULT: Flown("", Settings(0.27, 0.10)),
    "2 Hz": Flown("--uwb-rate 2", Settings(0.27, 0.10), ("ekf2_not_fusing",)),
    "10 Hz, 0.05 m, yaw follows": Flown(
        "--uwb-rate 10 --sigma-uwb 0.05 --yaw follow", Settings(0.27, 0.05)
    ),
    "30 Hz, 0.03 m": Flown("--uwb-rate 30 --sigma-uwb 0.03", Settings(0.27, 0.03)),
    "0.30 m": Flown("--sigma-uwb 0.3", Settings(0.27, 0.30)),
    "hover": Flown("--passes 2 --pause 30", Settings(0.27, 0.10)),
    "yaw follows": Flown("--yaw follow", Settings(0.27, 0.10)),
    "loop, VIO": Flown("--kind loop", Settings(0.27, 0.01), ("source_drift",)),
    # faster, so an attitude error has a larger effect
    "outdoors, GNSS": Flown("--kind outdoor", Settings(0.35, 0.40)),
})  # fmt: skip
RIGHT = SCENARIOS[DEFAULT].settings


@dataclass(frozen=True)
class Condition:
    """Mistake of a given size, and the finding that must report it.

    ``typed`` is the ``condition`` of the table: options of ``px4fuse simulate``, first those of
    the scenario if it is not the default, or a field of ``Settings`` with its value.
    """

    finding: str
    typed: str

    @property
    def scenario(self) -> str:
        """Name of the scenario with these options; without options, the default."""
        options = " ".join(self._options)
        return next(name for name, flown in SCENARIOS.items() if flown.options == options)

    @property
    def _words(self) -> list[str]:
        """Options and settings without the mistakes."""
        return re.sub(r"--mistake \S+", "", self.typed).split()

    @property
    def _options(self) -> list[str]:
        return [word for word in self._words if "=" not in word]

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Arguments of ``px4fuse simulate --mistake``."""
        return tuple(re.findall(r"--mistake (\S+)", self.typed))

    @property
    def ekf2(self) -> bool:
        """True if EKF2 is simulated, which is slow: only if the finding needs it."""
        outdoors = "outdoor" in self._options  # GNSS is a source only if EKF2 fuses it
        return outdoors or not self.finding or self.finding.startswith(OF_EKF2)

    @property
    def settings(self) -> Settings:
        """Best settings of the scenario, with those of this condition."""
        pairs = (word.split("=") for word in self._words if "=" in word)
        given: dict[str, Any] = {name: float(value) for name, value in pairs}
        return replace(SCENARIOS[self.scenario].settings, **given)

    def flight(self, seed: int) -> Scenario:
        """Scenario of the flight with this seed."""
        words = self._options
        given: dict[str, Any] = {}
        for option, value in zip(words[::2], words[1::2], strict=True):
            name = OPTIONS[option]
            kind = type(getattr(Scenario(), name))
            given[name] = kind(value) if kind in (int, float) else value
        kind_flown = given.pop("kind", "aisle")
        return make_scenario(kind_flown, **given, ekf2=self.ekf2, seed=seed)


def rates() -> pd.DataFrame:
    """Read the table of the last measurement."""
    return pd.read_csv(TABLE, keep_default_na=False)


# A new condition is a row of the table without numbers
CONDITIONS = tuple(
    Condition(row.finding, row.condition) for row in rates().itertuples() if row.condition != CLEAN
)


@dataclass(frozen=True)
class Job:
    """One flight, and its conditions, which differ in settings only."""

    seed: int
    conditions: tuple[Condition, ...]


def clean(scenario: str) -> Condition:
    """Return the condition of flights without a fault."""
    return Condition("", SCENARIOS[scenario].options)


def found(seed: int, condition: Condition | None = None) -> tuple[str, ...]:
    """Return the findings on one simulated flight, most severe first, causes before consequences.

    Findings that every flight has are left out.

    Parameters
    ----------
    condition : Condition, optional
        None for a clean flight of the default scenario.
    """
    return _fly(Job(seed, (condition or clean(DEFAULT),)))[0]


def _fly(job: Job) -> list[tuple[str, ...]]:
    """Return the findings for each condition of one flight."""
    first = job.conditions[0]
    scenario = first.flight(job.seed)
    mistakes = parse_faults(first.mistakes)
    named: list[tuple[str, ...]] = []
    of_loop: tuple[str, ...] = ()
    if scenario.kind == "loop":
        # the loop without ground truth, which would show the landing
        flight = simulate_flight(replace(scenario, truth=False), mistakes)
        loop = analyse(LoopSource(trajectory_of(flight, "vio"), flight))
        of_loop = tuple(found.id for found in find_loop_findings(loop))
        if first.finding:
            return [_named(first, of_loop)]
    flight = simulate_flight(scenario, mistakes)
    explained = _explain(flight, first)
    for condition in job.conditions:
        compared = explained
        if condition.settings != first.settings:
            # maximum-likelihood noises and time offset do not depend on the settings
            again = compare(flight, condition.settings, axes=("north", "east"))
            compared = replace(explained, **vars(again))
        ids = tuple(found.id for found in find(compared))
        named.append(_named(condition, (*ids, *(name for name in of_loop if name not in ids))))
    return named


def _explain(flight: Flight, condition: Condition) -> Analysis:
    """Make the analysis for the detectors, without the steps from KF to EKF2, which are slow."""
    comparison = compare(flight, condition.settings, axes=("north", "east"))
    estimates = estimate(comparison)
    model = prepare_ekf2_model(flight) if condition.ekf2 else NOT_ASKED
    trials = rerun_filters(comparison, estimates, model)
    return Analysis(
        **vars(comparison), **vars(estimates), ekf2_model=model, difference_steps={},
        reruns=trials, events=collect_events(comparison),
        aids=evaluate_aids(flight), loop=analyse_flight_loop(flight),
    )  # fmt: skip


def _named(condition: Condition, ids: Iterable[str]) -> tuple[str, ...]:
    expected = (*ALWAYS, *SCENARIOS[condition.scenario].true)
    return tuple(name for name in ids if name not in expected)


def jobs(
    clean_flights: int = CLEAN_FLIGHTS,
    faulty_flights: int = FAULTY_FLIGHTS,
    scenarios: Iterable[str] = tuple(SCENARIOS),
    conditions: Iterable[Condition] = CONDITIONS,
) -> list[Job]:
    """Return all flights: those without faults by scenario, and those of each fault.

    Conditions that differ in settings only share their flights.
    """
    made = [Job(seed, (clean(name),)) for name in scenarios for seed in range(clean_flights)]
    shared: dict[tuple[str, tuple[str, ...], bool], list[Condition]] = {}
    for condition in conditions:
        key = condition.scenario, condition.mistakes, condition.ekf2
        shared.setdefault(key, []).append(condition)
    seeds = range(FAULTY_SEED, FAULTY_SEED + faulty_flights)
    return made + [Job(seed, tuple(group)) for group in shared.values() for seed in seeds]


def measure(flown: list[Job]) -> pd.DataFrame:
    """Run every job, on all cores.

    Returns
    -------
    DataFrame
        ``finding``, ``scenario``, ``condition`` ("none" for flights without a fault: the rate is
        that of false alarms), ``flights``, ``rate``, its 95 % interval ``low``, ``high`` (Clopper
        and Pearson 1934), and ``first``, the share of flights with that finding first.
    """
    processes = os.cpu_count() or 1
    with ProcessPoolExecutor(processes) as pool:
        # one flight of each kind, to estimate the duration
        kinds = {job.conditions[0].scenario: job for job in flown}
        started = dict(zip(kinds, pool.map(_seconds, kinds.values()), strict=True))
        total = sum(started[job.conditions[0].scenario] for job in flown) / processes
        print(f"{len(flown)} flights, about {total / 60.0:.0f} min", flush=True)
        results = list(pool.map(_fly, flown, chunksize=2))
    return pd.DataFrame(_rows(flown, results))


def _seconds(job: Job) -> float:
    start = time.perf_counter()
    _fly(job)
    return time.perf_counter() - start


def _rows(flown: list[Job], results: list[list[tuple[str, ...]]]) -> Iterator[dict[str, object]]:
    by_condition: dict[Condition, list[tuple[str, ...]]] = {}
    for job, named in zip(flown, results, strict=True):
        for condition, ids in zip(job.conditions, named, strict=True):
            by_condition.setdefault(condition, []).append(ids)
    without = {c.scenario: own for c, own in by_condition.items() if not c.finding}
    names = {c.finding for c in CONDITIONS}
    names |= {name for own in without.values() for ids in own for name in ids}
    for name in sorted(names):
        for scenario, own in without.items():
            yield _row(name, scenario, CLEAN, own)
    for condition in CONDITIONS:
        if condition in by_condition:
            own = by_condition[condition]
            yield _row(condition.finding, condition.scenario, condition.typed, own)


def _row(name: str, scenario: str, condition: str, own: list[tuple[str, ...]]) -> dict[str, object]:
    hits, first = sum(name in ids for ids in own), sum(ids[:1] == (name,) for ids in own)
    what = {"finding": name, "scenario": scenario, "condition": condition, "flights": len(own)}
    return {**what, **rate(hits, len(own)), "first": round(first / len(own), 4)}


def rate(hits: int, of: int) -> dict[str, float]:
    """Return a share with its 95 % interval (Clopper and Pearson 1934)."""
    low, high = binomtest(hits, of).proportion_ci()
    return {"rate": round(hits / of, 4), "low": round(float(low), 4), "high": round(float(high), 4)}


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clean", type=int, default=CLEAN_FLIGHTS)
    parser.add_argument("--faulty", type=int, default=FAULTY_FLIGHTS)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    scenarios = [name for name in SCENARIOS if given.only in name]
    conditions = [c for c in CONDITIONS if given.only in f"{c.finding} {c.typed}"]
    table = measure(jobs(given.clean, given.faulty, scenarios, conditions))
    if given.only:
        shown = table[(table["condition"] != CLEAN) | (table["rate"] > 0.0)]
        print(shown.to_string(index=False))
        return
    table.to_csv(TABLE, index=False, lineterminator="\n")


if __name__ == "__main__":
    _main()
