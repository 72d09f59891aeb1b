"""Results of a comparison → rows of the fleet's table, and how that table is written."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import pandas as pd

from px4fuse.ekf2.aids import AidResult
from px4fuse.findings import Finding
from px4fuse.fleet.measures import at
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, Log
from px4fuse.spreadsheet import neutral

DONE, NOT_JUDGED, FAILED = "done", "not judged", "failed"
BETWEEN_FINDINGS = ";"
# Which tuning speaks for an axis
_TUNED_AS = {"north": "horizontal", "east": "horizontal"}
#: Columns of the table and where each stands in the results; empty where it is put together
PLACES = {
    **dict.fromkeys(("log", "name"), "log.name"),
    "log_sha256": "log.sha256",
    "px4fuse": "provenance.px4fuse",
    **dict.fromkeys(("settings", "status", "reason", "remedy"), ""),
    "vehicle": "log.vehicle",
    "firmware": "log.firmware",
    "firmware_hash": "log.firmware_hash",
    "airframe": "",
    "hardware": "log.hardware",
    "date": "",
    "duration_s": "log.duration_s",
    "source": "source.name",
    "source_rate_hz": "source.rate_hz",
    "axis": "",
    "updates": "axes.{axis}.updates.count",
    "kf_nis_mean": "axes.{axis}.filters.kf.nis_mean",
    "kf_factor": "axes.{axis}.filters.kf.sigma_factor",
    "kf_verdict": "axes.{axis}.filters.kf.verdict",
    "ekf2_nis_mean": "axes.{axis}.filters.ekf2.nis_mean",
    "ekf2_factor": "axes.{axis}.filters.ekf2.sigma_factor",
    "ekf2_verdict": "axes.{axis}.filters.ekf2.verdict",
    "position_rmse_m": "axes.{axis}.difference.position_rmse_m",
    "velocity_rmse_m_s": "axes.{axis}.difference.velocity_rmse_m_s",
    "kf_position_rmse_to_truth_m": "axes.{axis}.filters.kf.truth.position_rmse_m",
    "ekf2_position_rmse_to_truth_m": "axes.{axis}.filters.ekf2.truth.position_rmse_m",
    "sigma_z_m": "tuning.{tuned}.sigma_z_m",
    "sigma_z_low_m": "tuning.{tuned}.sigma_z_m_interval.0",
    "sigma_z_high_m": "tuning.{tuned}.sigma_z_m_interval.1",
    "sigma_a_m_s2": "tuning.{tuned}.filter_sigma_a_m_s2",
    "sigma_a_low_m_s2": "tuning.{tuned}.filter_sigma_a_m_s2_interval.0",
    "sigma_a_high_m_s2": "tuning.{tuned}.filter_sigma_a_m_s2_interval.1",
    "clock_offset_s": "clock.offset_s",
    "clock_offset_low_s": "clock.interval_s.0",
    "clock_offset_high_s": "clock.interval_s.1",
    "rejected_share": "axes.{axis}.rejected_share",
    "model_correlation": "ekf2_replay.agreement.{axis}.innovation_correlation",
    **dict.fromkeys(("aids", "story", "findings", "results", "report", "change"), ""),
}
_NUMBERS = ("_m", "_s", "_s2", "_hz", "_mean", "_factor", "_share", "_correlation")
#: Types of the columns; absent numbers are NA, absent texts are empty
COLUMNS = {name: "float64" if name.endswith(_NUMBERS) else "str" for name in PLACES}
COLUMNS["updates"] = "Int64"

Row = dict[str, Any]


def rows_of(found: ComparisonResults) -> list[Row]:
    """Rows of one log, an axis each; columns that are not in them are absent.

    A factor says how many times √S is overstated (above 1) or understated (below 1), as
    ``sigma_factor`` in the results. SIGMA_Z and SIGMA_A are what the data ask for, north and
    east together. The clock offset is there where it is determinable.
    """
    common = log_columns(found.log) | what_was_found(found.findings, found.aids)
    common["story"] = "\n".join(found.story)
    clock = bool(at(found, "clock.determinable"))
    rows = []
    for name, axis in found.axes.items():
        lacking = next((f for f in axis.filters.values() if isinstance(f, Unavailable)), None)
        row = common | {
            "axis": name,
            "status": NOT_JUDGED if isinstance(axis.filters["kf"], Unavailable) else DONE,
            "reason": f"{lacking.what}: {lacking.reason}" if lacking else "",
            "remedy": lacking.remedy if lacking else "",
        }
        for column, place in PLACES.items():
            if column not in row and place and (clock or not place.startswith("clock.")):
                tuned = _TUNED_AS.get(name, name)
                row[column] = at(found, place.format(axis=name, tuned=tuned))
        rows.append(row)
    return rows


def what_was_found(findings: Iterable[Finding], aids: Mapping[str, AidResult]) -> Row:
    """Causes among the findings, and the verdict on each aid that EKF2 fused."""
    causes = [one for one in findings if one.caused_by is None]
    fused = [f"{name} {aid.verdict}" for name, aid in aids.items() if aid.verdict != "idle"]
    return {
        "aids": BETWEEN_FINDINGS.join(fused),
        "findings": BETWEEN_FINDINGS.join(one.id for one in causes),
        "severities": sorted({one.severity for one in causes}),
    }


def log_columns(log: Log) -> Row:
    """What is known of a log once it is read."""
    start = log.start_unix_s
    found = {"log": log}
    places = {name: place for name, place in PLACES.items() if place.startswith("log.")}
    return {name: at(found, place) for name, place in places.items()} | {
        "airframe": f"{airframe:g}" if (airframe := log.parameters.get("SYS_AUTOSTART")) else "",
        "date": "" if start is None else f"{datetime.fromtimestamp(start, UTC):%Y-%m-%dT%H:%M:%SZ}",
    }


def table_of(rows: Iterable[Row]) -> pd.DataFrame:
    """The fleet's table: all columns in their order, with their types."""
    texts = dict.fromkeys((name for name, kind in COLUMNS.items() if kind == "str"), "")
    known = [texts | writable(row) for row in rows]
    return pd.DataFrame(known, columns=list(COLUMNS)).astype(COLUMNS)


def writable(row: Row) -> Row:
    """A row without what is absent, and what is not UTF-8 in a file's name replaced."""
    return {
        name: value.encode(errors="replace").decode() if isinstance(value, str) else value
        for name, value in row.items()
        if value is not None
    }


def csv_bytes(table: pd.DataFrame) -> bytes:
    """The table for Excel and LibreOffice, in which no text of a log acts as a formula."""
    texts = {name: table[name].map(neutral) for name, kind in COLUMNS.items() if kind == "str"}
    text = table.assign(**texts).to_csv(index=False, lineterminator="\r\n", float_format="%.10g")
    return ("\ufeff" + text).encode()
