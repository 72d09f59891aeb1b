"""What is worse in a fleet's table than in an earlier one, its baseline.

A log that the baseline has (another px4fuse or other settings) is compared with itself: every
number that is worse counts, since nothing is left to chance. Any other log is held against the
flights that its vehicle made with the same settings, axis by axis: worse is what lies outside the
range in which the next such flight is expected.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from px4fuse.arrays import Array
from px4fuse.errors import SettingsError
from px4fuse.fleet.measures import Aim, Scale
from px4fuse.fleet.rows import COLUMNS, DONE, FAILED
from px4fuse.fleet.significance import (
    FALSE_DISCOVERY_RATE,
    corrected,
    farther,
    least_difference,
)
from px4fuse.plain import number_words
from px4fuse.reading import size_of

#: A vehicle's flights tell a range from so many on
MIN_FLIGHTS = 5
BETWEEN_CHANGES = "; "


@dataclass(frozen=True)
class _Measure:
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
        return least_difference(self.scale, self.unit)


_TRUTH = "ekf2_position_rmse_to_truth_m"
_APART = "position_rmse_m"
_COLUMNS = {
    "ekf2_nis_mean": _Measure("NIS of EKF2", "", "one"),
    "kf_nis_mean": _Measure("NIS of ours", "", "one"),
    _TRUTH: _Measure("error of EKF2", "m", "low"),
    "kf_position_rmse_to_truth_m": _Measure("error of ours", "m", "low"),
    _APART: _Measure("ours - EKF2", "m", "low"),
    "sigma_z_m": _Measure("SIGMA_Z found", "m", "low"),
    "sigma_a_m_s2": _Measure("SIGMA_A found", "m/s²", "low"),
    "clock_offset_s": _Measure("clock offset", "s", "zero", "difference"),
    "rejected_share": _Measure("share that EKF2 rejected", "", "low", "difference"),
}
# By what a flight is known, and the flights that it is held against
_LOG, _VEHICLE = ["log_sha256", "axis"], ["vehicle", "settings", "axis"]


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
            f"Held against the baseline: {self.same} by the same log, {self.by_vehicle} by "
            f"{MIN_FLIGHTS} or more flights of the vehicle; {self.neither} with neither there."
        )


def read_baseline(path: Path) -> pd.DataFrame:
    """Read the table of an earlier run, Parquet or CSV.

    Raises
    ------
    SettingsError
        It cannot be read, or is not the table of ``px4fuse batch``.
    """
    size_of(path, SettingsError)
    texts = dict.fromkeys((name for name, kind in COLUMNS.items() if kind == "str"), str)
    try:
        if path.suffix.lower() == ".csv":
            found = pd.read_csv(path, encoding="utf-8-sig", dtype=texts)
        else:
            found = pd.read_parquet(path)
    except (OSError, ValueError) as error:  # pyarrow's and pandas' own are ValueErrors
        raise SettingsError(f"{path.name}: cannot be read as a table ({error}).") from error
    needed = {"log", "log_sha256", "settings", "status", "vehicle", "axis", *_COLUMNS}
    if lacking := sorted(needed - set(found.columns)):
        raise SettingsError(
            f"{path.name}: has no column {lacking[0]}. Give the fleet.parquet of px4fuse batch."
        )
    return found.fillna(dict.fromkeys(texts.keys() & set(found.columns), ""))


def marked(table: pd.DataFrame, baseline: pd.DataFrame) -> Marked:
    """Say in the column ``change`` what is worse than in the baseline.

    Parameters
    ----------
    table, baseline : DataFrame
        As :func:`px4fuse.batch` gives them.
    """
    known = baseline[baseline["status"] == DONE]
    latest = known.drop_duplicates(_LOG, keep="last").set_index(_LOG)
    of_log, of_vehicle = (pd.MultiIndex.from_frame(table[keys]) for keys in (_LOG, _VEHICLE))
    done = table["status"].eq(DONE).to_numpy()
    is_same = done & of_log.isin(latest.index)
    others = done & ~is_same & table["vehicle"].ne("").to_numpy()
    has_truth = table[_TRUTH].notna().to_numpy()
    worse: dict[int, list[str]] = defaultdict(list)
    tests: list[tuple[int, _Measure, float, float, float, float]] = []
    ps: list[float] = []
    held = np.zeros(len(table), dtype=bool)
    for at in np.flatnonzero(table["status"].eq(FAILED) & _was_done(table, known)):
        worse[int(at)].append("fails, and was compared before")
    for name, column in _COLUMNS.items():
        # where a truth judges both, how far they are apart is neither good nor bad
        judged = ~has_truth if name == _APART else np.ones(len(table), dtype=bool)
        now, was = column.scaled(table[name]), column.scaled(latest[name].reindex(of_log))
        for at in np.flatnonzero(judged & is_same):
            if farther(column.aim, now[at], was[at]) >= column.least:
                said = f"{column.label} {column.words(now[at])}, was {column.words(was[at])}"
                worse[int(at)].append(said)
        flights = known[_VEHICLE].assign(value=column.scaled(known[name])).groupby(_VEHICLE)
        found = flights["value"].agg(["count", "mean", "std"]).reindex(of_vehicle)
        n, mean, std = found.fillna(0.0).to_numpy().T
        tested = judged & others & (n >= MIN_FLIGHTS) & np.isfinite(now)
        held |= tested
        # the next of n normal numbers lies about their mean as Student's t with n - 1 degrees of
        # freedom, times s √(1 + 1/n)
        for at in np.flatnonzero(tested):
            sigma = max(std[at], column.least) * math.sqrt(1.0 + 1.0 / n[at])
            tests.append((int(at), column, now[at], n[at], mean[at], sigma))
            ps.append(float(2.0 * stdtr(n[at] - 1, -abs(now[at] - mean[at]) / sigma)))
    for (row, column, value, count, usual, sigma), q in zip(tests, corrected(ps), strict=True):
        if q < FALSE_DISCOVERY_RATE and farther(column.aim, value, usual) > 0.0:
            half = float(stdtrit(count - 1, 0.975)) * sigma
            said, low, high = map(column.words, (value, usual - half, usual + half))
            worse[row].append(
                f"{column.label} {said}, {low} to {high} expected from {count:.0f} flights of the "
                "vehicle"
            )
    change = [BETWEEN_CHANGES.join(worse.get(at, ())) for at in range(len(table))]
    same, by_vehicle = (table["log"][rows].nunique() for rows in (is_same, held))
    return Marked(
        table.assign(change=pd.Series(change, index=table.index, dtype=COLUMNS["change"])),
        same=same,
        by_vehicle=by_vehicle,
        neither=table["log"][done].nunique() - same - by_vehicle,
    )


def _was_done(table: pd.DataFrame, known: pd.DataFrame) -> pd.Series:
    """Whether the baseline has a log, by its hash or, where there is none, its name."""
    hashes = table["log_sha256"]
    return hashes.isin(known["log_sha256"]) | (hashes.eq("") & table["log"].isin(known["log"]))
