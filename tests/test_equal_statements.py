"""Statements of one fact about a flight in results, card, findings, tune, sync and whatif."""

from pathlib import Path

import pytest
from equal_statements import Statement, contradictions, flight_outputs, printed

from px4fuse.request import ComparisonRequest

LOGS = (
    "conventions/late_400.ulg", "gps/v1.16.1_gps_delay0.ulg", "flown/v1_evp003.ulg",
    "simulated/v1.16.1_aisle_nominal.ulg", "simulated/v1.16.1_aisle_overconfident.ulg",
)  # fmt: skip


@pytest.mark.reallogs
@pytest.mark.parametrize("name", LOGS)
def test_report_terminal_and_json_show_equal_numbers(shared_logs: Path, name: str) -> None:
    outputs = flight_outputs(ComparisonRequest(log=str(shared_logs / name)))
    assert contradictions(outputs) == []


def test_rounded_number_does_not_contradict_exact_number() -> None:
    exact = Statement("offset", "results", -0.4038)
    assert not printed("offset", "sync", "−0.404").contradicts(exact)
    assert printed("offset", "sync", "−0.405").contradicts(exact)
    assert printed("rejected", "card", "29", 0.01).contradicts(Statement("rejected", "", 0.3))
    assert Statement("verdict", "card", "consistent").contradicts(
        Statement("verdict", "results", "overconfident")
    )
