"""Comparisons of flights that are made in memory, with settings of KF and choices as arguments."""

from typing import Any

from px4fuse.comparison import comparison, preparation
from px4fuse.comparison.model import Comparison, PreparedComparison
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Flight
from px4fuse.request import ComparisonRequest


def request_of(settings: Settings | None = None, **choices: Any) -> ComparisonRequest:
    """Return the request with these settings; an ``input`` that is not given may become zero."""
    parts = vars(settings or Settings())
    if parts["input"] == "imu":
        parts = {**parts, "input": None}
    return ComparisonRequest(log="made.ulg", **{**parts, **choices})


def prepare(
    flight: Flight,
    settings: Settings | None = None,
    *,
    keep_positions_as_sent: bool = False,
    **choices: Any,
) -> PreparedComparison:
    return preparation.prepare_comparison_inputs(
        flight, request_of(settings, **choices), keep_positions_as_sent=keep_positions_as_sent
    )


def compare(flight: Flight, settings: Settings | None = None, **choices: Any) -> Comparison:
    return compare_prepared(prepare(flight, settings, **choices))


def compare_prepared(prepared: PreparedComparison) -> Comparison:
    return comparison.compare(prepared)
