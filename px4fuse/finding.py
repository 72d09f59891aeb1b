"""Data class for a fault of a flight."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from msgspec import Meta

from .core.record import Record, Span

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, Severity, Severity] = ("error", "warning", "note")
MAX_LISTED_SPANS = 3  # maximum number of time spans in a text
MIN_SPAN_S = 0.05  # shorter time spans (s) are printed as one time


class Finding(Record, omit_defaults=False):
    """Fault or remark about a flight, detected in its log.

    Attributes
    ----------
    id : str
        Identifier, for example "source_outliers"; it does not change between versions.
    severity : {"error", "warning", "note"}
        error: the results are not usable; warning: a result is wrong or missing; note: remark.
    message : str
        Fault and its effect, with numbers.
    remedy : str
        Recommended action: a command, a parameter with its value, or a check.
    evidence : dict
        Measured numbers that show the fault; the names contain the units.
    title : str
        First sentence of the message: the fault with its numbers.
    caused_by : str or None
        Id of the finding that causes this finding.
    spans_s : tuple of (float, float)
        Start and end of each occurrence (s from the first sample); empty for the whole flight.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Severity
    message: str
    remedy: str
    evidence: Mapping[str, int | float | str] = {}
    title: str = ""
    caused_by: str | None = None
    spans_s: tuple[Span, ...] = ()

    def __repr__(self) -> str:
        return f"<{self.severity} {self.id}: {self.message} {self.remedy}>"


def format_spans(spans_s: Sequence[Span]) -> str:
    """Format the times of a fault; many spans as one from the first start to the last end."""
    if len(spans_s) > MAX_LISTED_SPANS:
        spans_s = [(spans_s[0][0], spans_s[-1][1])]
    return ", ".join(
        f"{start:.1f} s to {end:.1f} s" if end - start > MIN_SPAN_S else f"{start:.1f} s"
        for start, end in spans_s
    )
