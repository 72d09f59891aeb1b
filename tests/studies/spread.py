"""How much flights of one vehicle differ, and how often ``diff`` is right, on simulated flights.

``python tests/studies/spread.py`` measures both again and rewrites ``spread.csv``, which ships with
the package, and ``change_rates.csv`` beside this file. ``--flights`` and ``--pairs`` give other
numbers of flights.

An interval says how well one flight tells its number. Two flights of the same vehicle differ by
more: each has biases and an attitude error of its own. The part beyond the intervals is the spread,
a standard deviation on the scale on which the number is compared (of a ratio that of its
logarithm), of the axis that has the largest.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
from detector_rates import RIGHT, rate

from px4fuse.analysis import explain
from px4fuse.comparison.comparison import compare
from px4fuse.fleet.changes import number_changes
from px4fuse.fleet.measures import SPREAD_TABLE, Z95, Number, numbers
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import results
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

RATES_TABLE = Path(__file__).with_name("change_rates.csv")
FLIGHTS, PAIRS = 60, 40
# Seeds of the flights that the spread is measured on, that pairs are of, and that are changed
SPREAD_SEED, PAIR_SEED, CHANGED_SEED = 0, 20_000, 30_000

Numbers = dict[str, Number]


@dataclass(frozen=True)
class Change:
    """What is other in B than in A, as ``px4fuse simulate`` takes it."""

    words: str
    passes: int = 6
    sigma_uwb_m: float = 0.10
    mistakes: tuple[str, ...] = ()


NOTHING = Change("none")
CHANGES = (
    NOTHING,
    Change("--sigma-uwb 0.2", sigma_uwb_m=0.2),
    Change("--mistake clock-offset=0.1", mistakes=("clock-offset=0.1",)),
    Change("--mistake ekf2-noise=0.3", mistakes=("ekf2-noise=0.3",)),
    Change("--mistake nlos=5%", mistakes=("nlos=5%",)),
    Change("--mistake vibration=0.6", mistakes=("vibration=0.6",)),
)


def fly(change: Change, seed: int) -> tuple[Numbers, Numbers]:
    """Numbers of one simulated flight: with the log at hand, and from its results alone."""
    scenario = Scenario(passes=change.passes, sigma_uwb_m=change.sigma_uwb_m, seed=seed)
    flight = simulate_flight(scenario, parse(change.mistakes))
    analysis = explain(compare(flight, RIGHT))
    request = ComparisonRequest(
        log=flight.log.name, sigma_a_m_s2=RIGHT.sigma_a_m_s2, sigma_z_m=RIGHT.sigma_z_m
    )
    found = results(request, analysis)
    return numbers(found, analysis), numbers(found)


def spread(flown: Iterable[Numbers]) -> pd.DataFrame:
    """By how much each kind of number varies between flights beyond its interval.

    Returns
    -------
    DataFrame
        ``kind``, ``numbers`` (how many it is from) and ``spread``, of the axis with the largest.
    """
    values: Mapping[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for one in flown:
        for path, number in one.items():
            if number.interval is not None and np.isfinite(number.measure.scaled(number.value)):
                values[number.measure.path, path].append(_value_and_sigma(number))
    beyond: Mapping[str, list[float]] = defaultdict(list)
    count: Mapping[str, list[int]] = defaultdict(list)
    for (kind, _), pairs in values.items():
        if len(pairs) > 1:
            value, sigma = np.array(pairs).T
            beyond[kind].append(float(np.var(value, ddof=1) - np.mean(sigma**2)))
            count[kind].append(len(pairs))
    rows = [
        (kind, sum(count[kind]), round(max(0.0, *parts, 0.0) ** 0.5, 4))
        for kind, parts in sorted(beyond.items())
    ]
    return pd.DataFrame(rows, columns=["kind", "numbers", "spread"])


def _value_and_sigma(number: Number) -> tuple[float, float]:
    assert number.interval is not None
    low, high = number.interval
    low, value, high = number.measure.scaled((low, number.value, high)).tolist()
    below = value - low if np.isfinite(low) else high - value
    return value, (high - value + below) / (2.0 * Z95)


def rates(
    first: list[tuple[Numbers, Numbers]], other: list[tuple[Numbers, Numbers]]
) -> list[dict[str, object]]:
    """How often pairs of flights show a significant change, with their logs and without.

    Returns
    -------
    list of dict
        ``given``, ``pairs``, ``rate`` of pairs with any significant change and its 95 % interval
        ``low``, ``high`` (Clopper and Pearson 1934), ``changes`` (mean number of them) and
        ``first`` (what most often came first).
    """
    rows: list[dict[str, object]] = []
    for at, given in enumerate(("logs", "results")):
        shown: list[list[str]] = []
        for a, b in zip(first, other, strict=True):
            made = number_changes(a[at], b[at], paired=False)
            shown.append([change.path for change in made if change.status == "significant"])
        hits = sum(map(bool, shown))
        leads = pd.Series([paths[0] for paths in shown if paths], dtype=str)
        rows.append(
            {"given": given, "pairs": len(shown), **rate(hits, len(shown)),
             "changes": round(float(np.mean([len(paths) for paths in shown])), 2),
             "first": leads.mode()[0] if len(leads) else ""}
        )  # fmt: skip
    return rows


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=FLIGHTS)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--rates-only", action="store_true", help="with the spread that is there")
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        if not given.rates_only:
            seeds = range(SPREAD_SEED, SPREAD_SEED + given.flights)
            flown = pool.map(fly, [NOTHING] * given.flights, seeds)
            table = spread(with_log for with_log, _ in flown)
            target = Path(str(files("px4fuse.fleet").joinpath(SPREAD_TABLE)))
            table.to_csv(target, index=False, lineterminator="\n")
            print(table.to_string(index=False), flush=True)
        count = given.pairs
        first = list(pool.map(fly, [NOTHING] * count, range(PAIR_SEED, PAIR_SEED + count)))
        rows = []
        for change in CHANGES:
            seeds = range(CHANGED_SEED, CHANGED_SEED + count)
            other = list(pool.map(fly, [change] * count, seeds))
            rows += [{"change": change.words} | row for row in rates(first, other)]
            print(rows[-2:], flush=True)
    pd.DataFrame(rows).to_csv(RATES_TABLE, index=False, lineterminator="\n")


if __name__ == "__main__":
    _main()
