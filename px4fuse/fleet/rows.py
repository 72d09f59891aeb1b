"""Results of a comparison → rows of the fleet's table, and how that table is written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import pandas as pd

from px4fuse.comparison.model import AgainstTruth, AxisResult, Difference, FilterSummary
from px4fuse.ekf2.replay import AxisAgreement, Replayed
from px4fuse.filter.clock import Clock
from px4fuse.filter.tuning import Tuned
from px4fuse.record import Unavailable
from px4fuse.results.comparison import ASKED, Log
from px4fuse.results.contract import ComparisonResults
from px4fuse.spreadsheet import neutral

DONE, NOT_JUDGED, FAILED = "done", "not judged", "failed"
# Which tuning speaks for an axis
_TUNED_AS = {"north": "horizontal", "east": "horizontal"}
#: Columns of the fleet's table and their types; absent numbers are NA, absent texts are empty
COLUMNS: dict[str, str] = dict.fromkeys(
    (
        "log", "name", "log_sha256", "px4fuse", "settings", "status", "reason", "remedy", "vehicle",
        "firmware", "firmware_hash", "airframe", "hardware", "date",
    ), "str",
) | {
    "duration_s": "float64",
    "source": "str",
    "source_rate_hz": "float64",
    "axis": "str",
    "updates": "Int64",
    "kf_nis_mean": "float64",
    "kf_factor": "float64",
    "kf_verdict": "str",
    "ekf2_nis_mean": "float64",
    "ekf2_factor": "float64",
    "ekf2_verdict": "str",
} | dict.fromkeys(
    (
        "position_rmse_m", "velocity_rmse_m_s", "kf_position_rmse_to_truth_m",
        "ekf2_position_rmse_to_truth_m", "sigma_z_m", "sigma_z_low_m", "sigma_z_high_m",
        "sigma_a_m_s2", "sigma_a_low_m_s2", "sigma_a_high_m_s2", "clock_offset_s",
        "clock_offset_low_s", "clock_offset_high_s", "rejected_share", "model_correlation",
    ), "float64",
) | dict.fromkeys(("story", "findings", "results", "report", "change"), "str")  # fmt: skip
BETWEEN_FINDINGS = ";"

Row = dict[str, Any]


def rows_of(found: ComparisonResults) -> list[Row]:
    """Rows of one log, an axis each; columns that are not in them are absent.

    A factor says how many times S is overstated (above 1) or understated (below 1), as
    ``variance_factor`` in the results. SIGMA_Z and SIGMA_A are what the data ask for, north and
    east together. The clock offset is there where it is determinable.
    """
    common = log_columns(found.log) | {
        "px4fuse": found.provenance.px4fuse,
        "source": found.source.name,
        "source_rate_hz": found.source.rate_hz,
        "story": "\n".join(found.story),
        "findings": BETWEEN_FINDINGS.join(
            one.id for one in found.findings if one.caused_by is None
        ),
    }
    if isinstance(found.clock, Clock) and found.clock.determinable:
        low, high = found.clock.interval_s
        common |= {
            "clock_offset_s": found.clock.offset_s,
            "clock_offset_low_s": low,
            "clock_offset_high_s": high,
        }
    return [
        common
        | {"axis": name}
        | _axis(axis)
        | _tuned(found.tuning.get(_TUNED_AS.get(name, name)))
        | _agreement(found, name)
        for name, axis in found.axes.items()
    ]


def log_columns(log: Log) -> Row:
    """What is known of a log once it is read."""
    start = log.start_unix_s
    return {
        "name": log.name,
        "log_sha256": log.sha256,
        "vehicle": log.vehicle,
        "firmware": log.firmware,
        "firmware_hash": log.firmware_hash,
        "airframe": f"{airframe:g}" if (airframe := log.parameters.get("SYS_AUTOSTART")) else "",
        "hardware": log.hardware,
        "date": "" if start is None else f"{datetime.fromtimestamp(start, UTC):%Y-%m-%dT%H:%M:%SZ}",
        "duration_s": log.duration_s,
    }


def _axis(axis: AxisResult) -> Row:
    lacking = [one for one in axis.filters.values() if isinstance(one, Unavailable)]
    row: Row = {
        "status": DONE if isinstance(axis.filters["kf"], FilterSummary) else NOT_JUDGED,
        "reason": f"{lacking[0].what}: {lacking[0].reason}" if lacking else "",
        "remedy": lacking[0].remedy if lacking else "",
        "updates": axis.updates.count,
        "rejected_share": axis.rejected_share,
    }
    for name, judged in axis.filters.items():
        if isinstance(judged.truth, AgainstTruth):
            row[f"{name}_position_rmse_to_truth_m"] = judged.truth.position_rmse_m
        if isinstance(judged, FilterSummary):
            row |= {
                f"{name}_nis_mean": judged.nis_mean,
                f"{name}_factor": judged.variance_factor,
                f"{name}_verdict": judged.verdict,
            }
    if isinstance(axis.difference, Difference):
        row |= {
            "position_rmse_m": axis.difference.position_rmse_m,
            "velocity_rmse_m_s": axis.difference.velocity_rmse_m_s,
        }
    return row


def _tuned(tuned: Tuned | Unavailable | None) -> Row:
    """What the filter's two settings should be; of a bound, the one end that is known."""
    row: Row = {}
    if isinstance(tuned, Tuned):
        for column, unit in (("sigma_z", "m"), ("sigma_a", "m_s2")):
            asked = ASKED[f"{column}_{unit}"]
            low, high = getattr(tuned, f"{asked}_interval") or (None, None)
            row |= {
                f"{column}_{unit}": getattr(tuned, asked),
                f"{column}_low_{unit}": low,
                f"{column}_high_{unit}": high,
            }
    return row


def _agreement(found: ComparisonResults, axis: str) -> Row:
    if not isinstance(found.ekf2_replay, Replayed):
        return {}
    agreement = getattr(found.ekf2_replay.agreement, axis, None)  # of north and east
    if not isinstance(agreement, AxisAgreement):
        return {}
    return {"model_correlation": agreement.innovation_correlation}


def table_of(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The fleet's table: all columns in their order, with their types.

    Parameters
    ----------
    rows : iterable of mapping
        Absent numbers and texts may be left out or None. What is not UTF-8 in a file's name, which
        no table can hold, is replaced.
    """
    texts = dict.fromkeys((name for name, kind in COLUMNS.items() if kind == "str"), "")
    known = [
        {name: _held(value) for name, value in row.items() if value is not None} for row in rows
    ]
    return pd.DataFrame([texts | row for row in known], columns=list(COLUMNS)).astype(COLUMNS)


def _held(value: Any) -> Any:
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def csv_bytes(table: pd.DataFrame) -> bytes:
    """The table for Excel and LibreOffice, in which no text of a log acts as a formula."""
    texts = {name: table[name].map(neutral) for name, kind in COLUMNS.items() if kind == "str"}
    text = table.assign(**texts).to_csv(index=False, lineterminator="\r\n", float_format="%.10g")
    return ("\ufeff" + text).encode()
