"""What is worse in a fleet's table than in an earlier one, its baseline.

A log that the baseline has (another px4fuse or other settings) is compared with itself: every
number that is worse counts, since nothing is left to chance. Any other log is held against the
flights that its vehicle made with the same settings, axis by axis: worse is what lies outside the
range in which the next such flight is expected.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

from px4fuse.arrays import Array
from px4fuse.errors import SettingsError
from px4fuse.fleet.measures import Aim, Scale
from px4fuse.fleet.rows import COLUMNS, DONE, FAILED
from px4fuse.fleet.significance import (
    FALSE_DISCOVERY_RATE,
    LEAST_DIFFERENCE,
    LEAST_RATIO,
    corrected,
)
from px4fuse.plain import number_words
from px4fuse.reading import size_of

#: A vehicle's flights tell a range from so many on
MIN_FLIGHTS = 5
BETWEEN_CHANGES = "; "


@dataclass(frozen=True)
class _Column:
    label: str
    unit: str
    aim: Aim
    scale: Scale = "ratio"

    def scaled(self, values: pd.Series) -> Array:
        """Values on the scale on which they are compared; NaN where they have no logarithm."""
        found = values.to_numpy(dtype=np.float64, na_value=np.nan)
        if self.scale == "difference":
            return found
        logs: Array = np.log(found, out=np.full(len(found), np.nan), where=found > 0.0)
        return logs

    def words(self, scaled: float) -> str:
        """A number on that scale as it is read."""
        value = float(np.exp(scaled)) if self.scale == "ratio" else scaled
        sign = "-" if value < 0.0 else ""
        return f"{sign}{number_words(abs(value))}" + (f" {self.unit}" if self.unit else "")

    @property
    def least(self) -> float:
        """A smaller difference is none."""
        if self.scale == "ratio":
            return float(np.log1p(LEAST_RATIO))
        return LEAST_DIFFERENCE[self.unit]

    def farther(self, now: Array, before: Array) -> Array:
        """By how much numbers are farther from what is best."""
        return now - before if self.aim == "low" else np.abs(now) - np.abs(before)


_TRUTH = "ekf2_position_rmse_to_truth_m"
_APART = "position_rmse_m"
_COLUMNS = {
    "ekf2_nis_mean": _Column("NIS of EKF2", "", "one"),
    "kf_nis_mean": _Column("NIS of ours", "", "one"),
    _TRUTH: _Column("error of EKF2", "m", "low"),
    "kf_position_rmse_to_truth_m": _Column("error of ours", "m", "low"),
    _APART: _Column("ours - EKF2", "m", "low"),
    "sigma_z_m": _Column("SIGMA_Z found", "m", "low"),
    "sigma_a_m_s2": _Column("SIGMA_A found", "m/s²", "low"),
    "clock_offset_s": _Column("clock offset", "s", "zero", "difference"),
    "rejected_share": _Column("share that EKF2 rejected", "", "low", "difference"),
}
Test = tuple[int, float, str]


@dataclass(frozen=True)
class Marked:
    """A table with what is worse than in its baseline.

    Attributes
    ----------
    table : DataFrame
        Its column ``change`` says what is worse, empty where nothing is.
    same, by_vehicle, neither : int
        How many logs were held against themselves, against their vehicle's flights, and not at
        all.
    """

    table: pd.DataFrame
    same: int
    by_vehicle: int
    neither: int

    @property
    def words(self) -> str:
        """Against what the logs were held."""
        return (
            f"Baseline: {self.same} logs are in it, {self.by_vehicle} were held against "
            f"{MIN_FLIGHTS} or more flights of their vehicle, {self.neither} could not be held "
            "against anything."
        )


def read_baseline(path: Path) -> pd.DataFrame:
    """Read the table of an earlier run, Parquet or CSV.

    Raises
    ------
    SettingsError
        It cannot be read, or is not the table of ``px4fuse batch``.
    """
    size_of(path, SettingsError)
    try:
        if path.suffix.lower() == ".csv":
            found = pd.read_csv(path, encoding="utf-8-sig")
        else:
            found = pd.read_parquet(path)
    except (OSError, ValueError) as error:  # pyarrow's and pandas' own are ValueErrors
        raise SettingsError(f"{path.name}: cannot be read as a table ({error}).") from error
    needed = {"log", "log_sha256", "settings", "status", "vehicle", "axis", *_COLUMNS}
    if lacking := sorted(needed - set(found.columns)):
        raise SettingsError(
            f"{path.name}: has no column {lacking[0]}. Give the fleet.parquet of px4fuse batch."
        )
    texts = {name: "" for name, kind in COLUMNS.items() if kind == "str" and name in found}
    return found.fillna(texts)


def marked(table: pd.DataFrame, baseline: pd.DataFrame) -> Marked:
    """Say in the column ``change`` what is worse than in the baseline.

    Parameters
    ----------
    table, baseline : DataFrame
        As :func:`px4fuse.batch` gives them.
    """
    known = baseline[baseline["status"] == DONE]
    by_log = dict(iter(known.groupby(["log_sha256", "axis"])))
    by_vehicle = dict(iter(known.groupby(["vehicle", "settings", "axis"])))
    worse: dict[int, list[str]] = {}
    tests: list[Test] = []
    held: dict[str, str] = {}
    for at, row in enumerate(table.to_dict("records")):
        if row["status"] == FAILED and _was_done(row, known):
            worse[at] = ["fails, and was compared before"]
        if row["status"] != DONE:
            continue
        log = str(row["log"])
        now = table.iloc[[at]]
        before = by_log.get((row["log_sha256"], row["axis"]))
        flights = by_vehicle.get((row["vehicle"], row["settings"], row["axis"]))
        if before is not None:
            held[log] = "same"
            worse[at] = list(_than_itself(now, before.tail(1)))
        elif row["vehicle"] and flights is not None and len(flights) >= MIN_FLIGHTS:
            held[log] = "vehicle"
            tests += _than_expected(at, now, flights)
        else:
            held.setdefault(log, "neither")
    for (at, _, text), q in zip(tests, corrected([p for _, p, _ in tests]), strict=True):
        if q < FALSE_DISCOVERY_RATE and text:
            worse.setdefault(at, []).append(text)
    change = [BETWEEN_CHANGES.join(worse.get(at, ())) for at in range(len(table))]
    how = list(held.values())
    return Marked(
        table.assign(change=pd.Series(change, index=table.index, dtype=COLUMNS["change"])),
        *(how.count(one) for one in ("same", "vehicle", "neither")),
    )


def _was_done(row: Mapping[Hashable, object], known: pd.DataFrame) -> bool:
    sha256 = row["log_sha256"]
    return bool(((known["log_sha256"] == sha256) if sha256 else (known["log"] == row["log"])).any())


def _judged(now: pd.DataFrame) -> Iterator[tuple[str, _Column]]:
    """The columns that say better or worse: how far two filters are apart only without a truth."""
    for name, column in _COLUMNS.items():
        if name != _APART or now[_TRUTH].isna().all():
            yield name, column


def _than_itself(now: pd.DataFrame, before: pd.DataFrame) -> Iterator[str]:
    for name, column in _judged(now):
        x, y = column.scaled(now[name]), column.scaled(before[name])
        if column.farther(x, y)[0] >= column.least:
            yield f"{column.label} {column.words(x[0])}, was {column.words(y[0])}"


def _than_expected(at: int, now: pd.DataFrame, flights: pd.DataFrame) -> Iterator[Test]:
    """Row, two-sided p-value of each number among its vehicle's, and what to say of a worse one.

    The next of n normal numbers lies about their mean as Student's t with n - 1 degrees of freedom,
    times s √(1 + 1/n).
    """
    for name, column in _judged(now):
        x = column.scaled(now[name])
        values = column.scaled(flights[name])
        values = values[np.isfinite(values)]
        n = len(values)
        if n < MIN_FLIGHTS or not np.isfinite(x[0]):
            continue
        mean = values.mean()
        sigma = max(float(values.std(ddof=1)), column.least) * np.sqrt(1.0 + 1.0 / n)
        p = float(2.0 * student_t.sf(abs(x[0] - mean) / sigma, n - 1))
        half = float(student_t.isf(0.025, n - 1)) * sigma
        low, high = column.words(mean - half), column.words(mean + half)
        is_worse = column.farther(x, mean)[0] > 0.0
        text = (
            f"{column.label} {column.words(x[0])}, {low} to {high} expected from {n} flights of "
            "the vehicle"
        )
        yield at, p, text if is_worse else ""
