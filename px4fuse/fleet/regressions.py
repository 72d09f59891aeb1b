"""What is worse in a fleet's table than in an earlier one, its baseline.

A log that the baseline has (another px4fuse or other settings) is compared with itself: every
number that is worse counts, since nothing is left to chance. Any other log is held against the
flights that its vehicle made with the same settings, axis by axis: worse is what lies outside the
range in which the next such flight is expected.
"""

import math
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from px4fuse.errors import SettingsError
from px4fuse.fleet.measures import APART, FALSE_DISCOVERY_RATE, MEASURES, Measure, corrected
from px4fuse.fleet.rows import COLUMNS, DONE, FAILED, PLACES
from px4fuse.plain import number_words
from px4fuse.reading import size_of

#: A vehicle's flights tell a range from so many on
MIN_FLIGHTS = 5
BETWEEN_CHANGES = "; "
_TRUTH = "ekf2_position_rmse_to_truth_m"
_MEASURES = {
    column: MEASURES[PLACES[column].format(axis="*", tuned="*")]
    for column in (
        "ekf2_nis_mean", "kf_nis_mean", _TRUTH, "kf_position_rmse_to_truth_m", "position_rmse_m",
        "sigma_z_m", "sigma_a_m_s2", "clock_offset_s", "rejected_share",
    )
}  # fmt: skip
# By what a flight is known, and the flights that it is held against
_LOG, _VEHICLE = ["log_sha256", "axis"], ["vehicle", "settings", "axis"]


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
    needed = {"log", "log_sha256", "settings", "status", "vehicle", "axis", *_MEASURES}
    if lacking := sorted(needed - set(found.columns)):
        raise SettingsError.of("no_column_of_fleet", path=path, column=lacking[0])
    return found.fillna(dict.fromkeys(texts.keys() & set(found.columns), ""))


def marked(table: pd.DataFrame, baseline: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """Say in the column ``change`` what is worse than in the baseline, empty where nothing is.

    Parameters
    ----------
    table, baseline : DataFrame
        As :func:`px4fuse.batch` gives them.

    Returns
    -------
    table : DataFrame
    against : str
        What the logs were held against, in a sentence.
    """
    known = baseline[baseline["status"] == DONE]
    latest = known.drop_duplicates(_LOG, keep="last").set_index(_LOG)
    of_log, of_vehicle = (pd.MultiIndex.from_frame(table[keys]) for keys in (_LOG, _VEHICLE))
    done = table["status"].eq(DONE).to_numpy()
    is_same = done & of_log.isin(latest.index)
    others = done & ~is_same & table["vehicle"].ne("").to_numpy()
    worse: dict[int, list[str]] = defaultdict(list)
    tests: list[tuple[int, Measure, float, float, float, float]] = []
    ps: list[float] = []
    held = np.zeros(len(table), dtype=bool)
    for at in np.flatnonzero(table["status"].eq(FAILED) & _was_done(table, known)):
        worse[int(at)].append("fails, and was compared before")
    for name, measure in _MEASURES.items():
        now, was = measure.scaled(table[name]), measure.scaled(latest[name].reindex(of_log))
        if measure.path.startswith(APART):
            # where a truth judges both, how far they are apart is neither good nor bad
            now = np.where(table[_TRUTH].notna(), np.nan, now)
        for at in np.flatnonzero(is_same):
            if measure.farther(now[at], was[at]) >= measure.least:
                said = f"{_words(measure, now[at])}, was {_words(measure, was[at])}"
                worse[int(at)].append(f"{measure.label} {said}")
        flights = known[_VEHICLE].assign(value=measure.scaled(known[name])).groupby(_VEHICLE)
        found = flights["value"].agg(["count", "mean", "std"]).reindex(of_vehicle)
        n, mean, std = found.fillna(0.0).to_numpy().T
        tested = others & (n >= MIN_FLIGHTS) & np.isfinite(now)
        held |= tested
        # the next of n normal numbers lies about their mean as Student's t with n - 1 degrees of
        # freedom, times s √(1 + 1/n)
        for at in np.flatnonzero(tested):
            sigma = max(std[at], measure.least) * math.sqrt(1.0 + 1.0 / n[at])
            tests.append((int(at), measure, now[at], n[at], mean[at], sigma))
            ps.append(float(2.0 * stdtr(n[at] - 1, -abs(now[at] - mean[at]) / sigma)))
    for (row, measure, value, count, usual, sigma), q in zip(tests, corrected(ps), strict=True):
        if q < FALSE_DISCOVERY_RATE and measure.farther(value, usual) > 0.0:
            half = float(stdtrit(count - 1, 0.975)) * sigma
            said, low, high = (_words(measure, v) for v in (value, usual - half, usual + half))
            worse[row].append(
                f"{measure.label} {said}, {low} to {high} expected from {count:.0f} flights of the "
                "vehicle"
            )
    change = [BETWEEN_CHANGES.join(worse.get(at, ())) for at in range(len(table))]
    every, same, by_vehicle = (table["log"][rows].nunique() for rows in (done, is_same, held))
    against = (
        f"Held against the baseline: {same} by the same log, {by_vehicle} by {MIN_FLIGHTS} or more "
        f"flights of the vehicle; {every - same - by_vehicle} with neither there."
    )
    kind = COLUMNS["change"]
    return table.assign(change=pd.Series(change, index=table.index, dtype=kind)), against


def _words(measure: Measure, scaled: float) -> str:
    """A number on its scale as it is read."""
    value = measure.unscaled(scaled)
    unit = f" {measure.unit}" if measure.unit else ""
    return f"{'-' if value < 0.0 else ''}{number_words(abs(value))}{unit}"


def _was_done(table: pd.DataFrame, known: pd.DataFrame) -> pd.Series:
    """Whether the baseline has a log, by its hash or, where there is none, its name."""
    hashes = table["log_sha256"]
    return hashes.isin(known["log_sha256"]) | (hashes.eq("") & table["log"].isin(known["log"]))
