"""Flights with known faults: expected findings, actions and differences KF - EKF2."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from flights import with_noises

from px4fuse.card.build import build_card
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.diagnose import diagnose_comparison
from px4fuse.filter.time_offset import MAX_P_VALUE_OF_CHANGED_OFFSET
from px4fuse.findings import find, source_clock
from px4fuse.readers import read_log
from px4fuse.report.clock import make_time_offset_advice
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.reallogs


def about(value: float, rel: float = 0.1) -> Any:
    return pytest.approx(value, rel=rel)


class Flown(NamedTuple):
    """Expected findings (id, severity, evidence, action) and explanation of KF - EKF2.

    ``reruns`` are those of the first cause on the card: label, position RMSE (m) before and after,
    √(mean NIS) before and after. ``console`` are the lines that set EKF2's parameters.
    ``offset_s`` is the expected time offset; None: not checked.
    """

    findings: tuple[tuple[str, str | None, dict[str, Any], tuple[str, ...]], ...] = ()
    first: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()
    offset_s: float | None = None
    reruns: tuple[tuple[str, tuple[Any, Any], tuple[Any, Any]], ...] = ()
    console: tuple[str, ...] = ()


FLIGHTS = {
    "v1.16.1_aisle_overconfident": Flown(
        (("ekf2_overconfident", "error",
          {"nis_mean": about(22.0, 0.2)},
          ("EKF2_EVP_NOISE to 0.098 m",)),
         ("ekf2_noise_too_small", "error",
          {"flown_m": about(0.02), "estimate_m": about(0.098), "factor": about(4.9)},
          ("EKF2_EVP_NOISE to 0.098 m",))),
        ("gate", "54.9"),
        reruns=(
            ("EKF2 (replay), EKF2_EVP_NOISE 0.098", (about(0.22), about(0.071)),
             (about(4.8), about(1.0))),
        ),
        console=("param set EKF2_EVP_NOISE 0.098",),
    ),
    # outliers are rejected by the gate; EKF2 did not fuse for 15 s
    "v1.16.1_aisle_nlos": Flown(
        (("source_gap", "warning", {"longest_s": about(8.0, 0.04)}, ()),
         ("kf_overconfident", None, {}, ("outliers",)),
         ("ekf2_overconfident", None, {}, ("outliers",))),
        elsewhere=("rejections and resets", "4.0 m", "64 s"),
    ),
    "v1.16.1_aisle_clock_late": Flown(
        (("ekf2_ev_delay_wrong", "error", {"ekf2_ev_delay_ms": 0.0, "asked_ms": about(264.0)},
          ("EKF2_EV_DELAY to 264 ms",)),
         ("source_time_offset", "error", {}, ("Subtract 0.264 s", "timestamp"))),
        offset_s=-0.25,
        # correct timestamps at the sender or set the delay: either corrects the error
        reruns=(
            ("KF, time offset corrected", (about(0.24), about(0.070)), (about(0.99), about(0.93))),
            ("EKF2 (replay), EKF2_EV_DELAY 264, EKF2_DELAY_MAX 300", (about(0.33), about(0.080)),
             (about(1.22), about(0.95))),
            ("EKF2 (replay), time offset corrected", (about(0.33), about(0.074)),
             (about(1.22), about(0.95))),
        ),
        console=("param set EKF2_EV_DELAY 264", "param set EKF2_DELAY_MAX 300", "reboot"),
    ),
    "v1.13.3_aisle_evdelay175": Flown(
        (("ekf2_ev_delay_wrong", "warning", {"ekf2_ev_delay_ms": 175.0},
          ("EKF2_EV_DELAY to 0 ms",)),),
        ("timestamps and delay", "175 ms", "EKF2_EV_DELAY"),
        ("timestamps and delay",), 0.0,
        (("EKF2 (replay), EKF2_EV_DELAY 0", (about(0.14), about(0.063)),
          (about(1.01), about(0.96))),),
        ("param set EKF2_EV_DELAY 0", "reboot"),
    ),
    "v1.16.1_aisle_hwlog": Flown(
        (("source_not_logged", "warning", {"rate_hz": about(2.0), "sdlog_profile": 1},
          ("SDLOG_PROFILE to 129",)),),
        offset_s=0.0,
    ),
    "v1.16.1_aisle_2hz_stock": Flown(
        (("ekf2_not_fusing", "error",
          {"fused_fraction": 0.0, "source_interval_s": about(0.5, 0.05)}, ("10 Hz",)),),
    ),
    "v1.14.4_aisle_nominal": Flown(),
    "v1.16.1_aisle_nominal": Flown(),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIGHTS)
def test_recorded_flight_with_known_fault_reports_this_fault(shared_logs, name):
    log = shared_logs / "simulated" / f"{name}.ulg"
    analysis, flown = diagnose_comparison(compare(read_log(log))), FLIGHTS[name]
    found = find(analysis)
    for wanted, severity, evidence, remedy in flown.findings:
        (first, *_) = [
            item
            for item in found
            if item.id == wanted and all(text in item.remedy for text in remedy)
        ]
        assert severity in (None, first.severity)
        assert {key: first.evidence[key] for key in evidence} == evidence
    if name.endswith("hwlog"):
        assert {analysis.main.filters[owner].verdict for owner in FILTER_NAMES} == {"consistent"}
    if name.endswith("nominal"):
        assert {item.severity for item in found} <= {"note"}
    if flown.first or flown.elsewhere or name.endswith("clock_late"):
        explanation = analysis.difference_steps["aisle"]
        assert all(words in explanation.sentences[0] for words in flown.first)
        assert all(words in " ".join(explanation.sentences) for words in flown.elsewhere)
        assert explanation.unexplained_fraction < 0.03
    # with late timestamps the delay parameter is not the largest step
    if name.endswith("clock_late"):
        by_name = {step.name: step for step in explanation.steps}
        stamps = by_name["timestamps and delay"].position_mean_square_m2
        assert abs(stamps) < 0.05 * explanation.position_mean_square_m2
        # equal measurement noise: a step without effect is not listed
        assert "measurement noise" not in by_name
    if flown.offset_s is not None:
        clock = analysis.time_offset
        assert clock.is_determinable
        assert clock.offset_s == pytest.approx(flown.offset_s, abs=0.05)
        low, high = clock.interval_s
        assert low <= flown.offset_s <= high
        assert clock.change_p_value > MAX_P_VALUE_OF_CHANGED_OFFSET
        assert abs(clock.drift_ppm) < 4.0 * clock.drift_sigma_ppm
    if name.endswith("evdelay175"):
        assert not low <= -0.175 <= high
        advice = make_time_offset_advice(analysis, clock)["PX4"]
        assert "EKF2_EV_DELAY" in advice
        assert "175 ms" in advice
    if name.endswith("nlos"):
        noise = analysis.tuning["horizontal"]
        assert noise.sigma_z.value == about(0.10)
        assert noise.sigma_z.low <= 0.10 <= noise.sigma_z.high
        made = json.loads(log.with_suffix(".json").read_text(encoding="utf-8"))
        wrong = [each for each in made["uwb"] if each.get("outlier") and not each.get("dropped")]
        # times from the first data
        boot_s = analysis.flight.log.boot_time_s
        time = np.array([each["t_px4_us"] for each in wrong]) * 1e-6 - boot_s
        segment = analysis.segment
        expected_s = time[(time > segment.start_s) & (time < segment.end_s)]
        right = np.abs(noise.outlier_time_s[:, None] - expected_s).min(axis=1) < 0.02
        assert right.sum() > 0.9 * max(len(right), len(expected_s)) > 13


@pytest.mark.parametrize("name", [name for name, flown in FLIGHTS.items() if flown.reruns])
def test_diagnosis_of_faulty_flight_shows_filter_reruns(shared_logs, name):
    log = shared_logs / "simulated" / f"{name}.ulg"
    analysis, flown = diagnose_comparison(compare(read_log(log))), FLIGHTS[name]
    cause = build_card(analysis, ComparisonRequest(log=log.name)).causes[0]
    assert flown.reruns == tuple(
        (rerun.label, rerun.position_rmse_m, rerun.source_ratio) for rerun in cause.reruns
    )
    assert {rerun.improves for rerun in cause.reruns} == {"position and σ"}
    actions = (*cause.actions, *(action for each in cause.alternatives for action in each))
    commands = {
        command for action in actions if action.where == "console" for command in action.commands
    }
    assert set(flown.console) <= commands


# Factor between reported and actual horizontal innovation variance in real motion-capture flights
OVERSTATED = {
    "vladimireganov_ROS_PX4_MOCAP_log_3_2022-6-9-13-01-36": 92.0,
    "vladimireganov_ROS_PX4_MOCAP_min_snap_01": 22.0,
    "vladimireganov_ROS_PX4_MOCAP_square2": 16.0,
    "PX4_flight-review-rs_battery_brownout": 109.0,
}


@pytest.mark.parametrize(("name", "factor"), OVERSTATED.items())
def test_ekf2_on_motion_capture_flights_is_underconfident(shared_logs, name, factor):
    """Sent with an orientation, as odometry is; all noises are defaults."""
    flight = read_log(shared_logs / "real" / f"{name}.ulg")
    whole = compare(flight, start_s=0.0, end_s=flight.log.duration_s)
    assert whole.horizontal["ekf2"].sigma_ratio == pytest.approx(factor**-0.5, rel=0.05)
    comparison = compare(flight)
    assert comparison.horizontal["ekf2"].verdict == "underconfident"
    findings = find(with_noises(comparison))
    drift = next(at for at, finding in enumerate(findings) if finding.id == "source_may_drift")
    behind = findings[drift + 1 : drift + 5]
    behind_it = ["kf_underconfident"] * 2 + ["ekf2_underconfident"] * 2
    assert [finding.id for finding in behind] == behind_it
    assert behind[2].evidence["sigma_ratio"] < 0.5
    assert not [f for f in findings if f.severity == "error" and f.caused_by is None]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # a flight without a fault, with the usual short flags for a bad vertical acceleration
        ("g1_base", {"ekf2_acceleration_bad": "note"}),
        ("g1_v01", {"ekf2_acceleration_bad": "warning", "aid_overconfident": "warning"}),
        # vision beside GNSS: an offset origin and EKF2_GPS_P_NOISE as minimum noise are no faults
        ("eg1_base", {"ekf2_underconfident": "note"}),
        ("eg1_evp20", {"ekf2_underconfident": "error"}),
        ("eg1_d0", {"ekf2_gps_delay_wrong": "warning"}),
    ],
)
def test_recorded_flights_have_listed_faults_and_severities(
    shared_logs: Path, name: str, expected: dict[str, str]
) -> None:
    analysis = diagnose_comparison(compare(read_log(shared_logs / f"flown/{name}.ulg")))
    found = {item.id: item for item in find(analysis)}
    severities = {name: item.severity for name, item in found.items()}
    assert severities | expected == severities
    if "base" in name:
        of_kf = ("kf_", "sigma_")  # SIGMA_Z is not set for GNSS here
        assert {found[i].severity for i in found if not i.startswith(of_kf)} == {"note"}
    if name == "g1_v01":
        assert "EKF2_GPS_V_NOISE" in found["ekf2_acceleration_bad"].remedy
    assert ("ekf2_gps_delay_wrong" in found) == (name == "eg1_d0")
    if name == "eg1_d0":  # the true delay is 110 ms
        assert found["ekf2_gps_delay_wrong"].evidence["estimate_ms"] == pytest.approx(110.0, abs=15)
        # vision with a wrong unit or time offset is no reference for GNSS
        wrong_unit = replace(analysis.convention, unit="cm", verdict="determined")
        late = replace(analysis.time_offset, offset_s=-0.2)
        for wrong in replace(analysis, convention=wrong_unit), replace(analysis, time_offset=late):
            assert "ekf2_gps_delay_wrong" not in {item.id for item in source_clock.detect(wrong)}
    if name == "eg1_evp20":
        assert "EKF2_EVP_NOISE to 0.1 m" in found["ekf2_underconfident"].remedy
