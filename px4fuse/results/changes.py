"""Results of ``px4fuse diff``: what changed from A to B, number by number."""

from __future__ import annotations

from typing import Literal

from px4fuse.record import Record, Sha256, Share, Span
from px4fuse.results.model import Version

Which = Literal["A", "B"]
Status = Literal[
    "significant", "within chance", "not tested", "differs", "same", "only in A", "only in B"
]
Judgement = Literal["better", "worse", "changed", ""]


class Compared(Record, frozen=True, kw_only=True):
    """One of the two: what was given, and the flight that it is of."""

    given: str
    kind: Literal["log", "report", "results"]
    log: str
    log_sha256: Sha256
    px4fuse: Version


class NumberChange(Record, frozen=True, kw_only=True):
    """One number of both.

    Attributes
    ----------
    path : str
        Where it stands in the results of both: ``axes.aisle.filters.ekf2.nis_mean``.
    label, unit : str
    a, b : float
        Absent where only the other one has it.
    a_interval, b_interval : (float, float)
        95 %; absent where there is none.
    scale : {"ratio", "difference"}
        What ``change`` is: b/a or b - a.
    change : float
        Absent where it is a ratio to zero.
    change_interval : (float, float)
        95 %, with what two flights with the same equipment are apart by.
    q : float
        p-value of "no change", corrected for the number of tests.
    status : str
        "significant", "within chance" or "not tested" between two flights; "differs" or "same"
        between two settings of one flight, where nothing is left to chance.
    judgement : {"better", "worse", "changed", ""}
        "changed" where B is neither; "" where the change is not significant.
    """

    path: str
    label: str
    unit: str
    a: float | None = None
    b: float | None = None
    a_interval: Span | None = None
    b_interval: Span | None = None
    scale: Literal["ratio", "difference"]
    change: float | None = None
    change_interval: Span | None = None
    q: Share | None = None
    status: Status
    judgement: Judgement = ""


class TextChange(Record, frozen=True):
    """A setting, a parameter of PX4 or a fact about the flight that is not the same."""

    kind: Literal["setting", "parameter", "flight"]
    what: str
    a: str
    b: str


class FindingChange(Record, frozen=True):
    """A finding that only one of the two has."""

    id: str
    severity: Literal["error", "warning", "info"]
    message: str
    only_in: Which
