"""Findings for situations from public reports (``../shared/cases/reports``)."""

from pathlib import Path

import pytest

from px4fuse.analysis import Analysis
from px4fuse.diagnose import diagnose
from px4fuse.flight.model import join_flights
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.reallogs


def analyse(shared_logs: Path, name: str) -> Analysis:
    log = shared_logs.parent / "cases" / "reports" / "flights" / f"{name}.ulg"
    return diagnose(ComparisonRequest(log=str(log)))


@pytest.mark.parametrize(("name", "finding", "texts"), [
    ("gyro_bias_large", "gyroscope_bias", ("+0.12 rad/s", "Calibrate the gyroscopes")),
    ("height_10_m_off", "ekf2_bias_at_limit", ("EKF2_ABL_LIM 0.4", "8.90 m/s²", "9.62 m")),
    ("only_height_sent", "source_coordinate_constant", ("constant: 0, 0 m", "EKF2_EV_CTRL at 2")),
    ("vio_relocalises", "source_relocalises", ("jumps 5 times", "every 12 s", "1.2 s later")),
    ("height_10_m_off", "ekf2_bias_at_limit", ("measures 8.90 m/s²", "a mean of 8.8 m")),
    ("camera_ahead_of_the_imu", "source_lever_arm", ("+0.12 m forward", "EKF2_EV_POS_X to 0.12")),
])  # fmt: skip
def test_fault_of_public_bug_report_is_reported_first(
    name: str, finding: str, texts: tuple[str, ...], shared_logs: Path
) -> None:
    first, *others = analyse(shared_logs, name).findings
    assert first.id == finding
    for text in texts:
        assert text in f"{first.message} {first.remedy}"
    assert all(other.caused_by == finding for other in others if other.severity != "note")


def test_parameter_change_in_flight_is_replayed_and_reported(shared_logs: Path) -> None:
    analysis = analyse(shared_logs, "noise_changed_in_flight")
    first = analysis.findings[0]
    assert first.id == "parameter_changed"
    assert (
        "changed from 0.1 to 0.6 m at 27.0 s. EKF2 is consistent before the change" in first.message
    )
    assert analysis.ekf2_model.agreement.good


def test_longest_of_two_flights_is_analysed(shared_logs: Path) -> None:
    segment = analyse(shared_logs, "two_flights_in_one_log").segment
    assert (segment.start_s, segment.end_s) == pytest.approx((38.0, 65.5), abs=0.1)
    assert "the others: 6.0 to 24.0 s (--start 6.0 --end 24.0)" in segment.reason


def test_aiding_source_whose_innovations_are_0_counts_as_fused(shared_logs: Path) -> None:
    analysis = analyse(shared_logs, "baro_and_compass_fused_all_the_time")
    assert "aid_not_fused" not in {finding.id for finding in analysis.findings}


def test_height_nees_uses_local_height_instead_of_altitude(shared_logs: Path) -> None:
    analysis = diagnose(ComparisonRequest(log=str(shared_logs / "flown" / "eg1_base.ulg")))
    truth = analysis.axes["down"].filters["ekf2"].truth
    assert truth.nees_position_horizon_mean == pytest.approx(2.87, rel=0.05)


def test_join_flights_with_short_landing_returns_one_flight() -> None:
    assert join_flights(((1.0, 4.0), (6.0, 9.0), (20.0, 30.0))) == ((1.0, 9.0), (20.0, 30.0))
