"""Findings on clean, faulty, incomplete and short flights, on real logs, and px4fuse explain."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from cli_tools import run_main
from comparisons import compare, compare_prepared
from exchange import replace
from flights import Estimator, Imu, Uwb, aisle_flight, given_placement, unexplained, with_noises
from golden_tools import assert_matches_golden, rounded, value

from px4fuse.comparison.model import Comparison
from px4fuse.diagnose import prepare_comparison, read_flight
from px4fuse.ekf2.inputs import SIMULATED_EKF2_NOTE
from px4fuse.filter.consistency import MIN_INNOVATIONS
from px4fuse.filter.settings import Settings
from px4fuse.finding import Finding
from px4fuse.findings import find
from px4fuse.findings.model import (
    FINDING_CATALOGUE,
    FINDING_GROUPS,
    FINDING_TITLES,
    load_finding_examples,
    split_cause_groups,
)
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    AXIS_NAMES,
    AidLog,
    ClockConversion,
    Columns,
    Dropout,
    Ekf2,
    Flight,
    Reset,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.request import ComparisonRequest, PositionFile

ALIGNED_TOPIC = "estimator_visual_odometry_aligned"
NO_VISION = {"EKF2_EVP_NOISE": 0.1, "SDLOG_PROFILE": 1.0}
SIDESTEP = Reset(60.0, "position", (3.0, 0.0, 0.0))
STEP_UP = Reset(60.0, "position", (0.0, 0.0, -0.4))
NOT_A_NUMBER = re.compile(r"\b(nan|inf|none)\b", re.IGNORECASE)
Change = Callable[[Flight], Flight]


@dataclass(frozen=True)
class Fault:
    """Simulated fault, with the expected finding and its evidence.

    The other fields define the flight: options of aisle_flight, KF settings, and a change of it.
    """

    id: str
    severity: str
    evidence: Mapping[str, Any] = field(default_factory=dict)
    flight: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    change: Change = lambda flight: flight

    def fly(self, **other: Any) -> Flight:
        """Make the flight with the fault."""
        return self.change(aisle_flight(**{**self.flight, **other}))


def with_source(**changes: Any) -> Change:
    """Change the position track."""
    return lambda flight: replace(flight, positions=(replace(flight.positions[0], **changes),))


def with_log(**changes: Any) -> Change:
    """Change the description of the log."""
    return lambda flight: replace(flight, log=replace(flight.log, **changes))


def without_every(nth: int) -> Change:
    """Drop every nth position, as a recorded link does."""

    def change(flight: Flight) -> Flight:
        samples = flight.positions[0].samples
        kept = samples[np.arange(len(samples)) % nth > 0]
        return with_source(samples=kept, clock_map=mapped("TIMESYNC"))(flight)

    return change


def mapped(method: str, distinct: int | None = None, jitter_s: float = 0.02) -> ClockConversion:
    return ClockConversion("UNIX time of system 1", method, 600, -1e9, 0.1, jitter_s, "", distinct)


def with_ekf2(**changes: Any) -> Change:
    def change(flight: Flight) -> Flight:
        return replace(flight, ekf2=replace(flight.ekf2, **changes))

    return change


def as_recording(flight: Flight) -> Flight:
    """Make a MAVLink recording, which has no innovations."""
    none = Unavailable("EKF2 innovations", "MAVLink does not carry them", "")
    recorded = with_ekf2(innovations=dict.fromkeys(AXIS_NAMES, none))(flight)
    return with_log(format="MAVLink tlog")(recorded)


def with_fused(flight: Flight, end_s: float) -> Flight:
    """Log that EKF2 fused a position each 0.5 s until some time."""
    values = {
        "fused": 1.0, "rejected": 0.0, "innovation_north": 0.1, "variance_north": 0.02,
        "noise_north": 0.01, "ratio_north": 0.02,
    }  # fmt: skip
    samples = pd.DataFrame(values, index=np.arange(0.0, end_s, 0.5))
    return with_ekf2(aids={"ev_pos": AidLog(("a_topic",), ("north",), samples, None)})(flight)


def with_ekf2_bias(flight: Flight) -> Flight:
    """Add an accelerometer bias (forward, right, down) to the EKF2 log."""
    zero = flight.ekf2.state.iloc[:, :3].set_axis(Columns.SPECIFIC_FORCE, axis=1) * 0.0
    return with_ekf2(accelerometer_bias=zero + np.array([0.2, -0.1, 0.2]))(flight)


def with_imu_oscillation(flight: Flight) -> Flight:
    """Add 1 m/s² at 0.5 Hz to the forward axis of the accelerometer."""
    imu = flight.imu.copy()
    imu[Columns.SPECIFIC_FORCE[0]] += np.sin(np.pi * imu.index.to_numpy())
    return replace(flight, imu=imu)


def with_invalid_position(flight: Flight) -> Flight:
    """Let EKF2 drift to the north by 1 m/s, with xy_valid 0, from 80 s on."""
    state = flight.ekf2.state.copy()
    state["north_m"] += np.clip(state.index - 80.0, 0.0, None)
    valid = pd.Series([1.0, 0.0], index=[0.0, 80.0])
    return with_ekf2(state=state, status_flags={"xy_valid": valid})(flight)


def as_odometry(flight: Flight) -> Flight:
    """Give the source an orientation that rotates, as VIO does."""
    (track,) = flight.positions
    turn = np.linspace(0.0, 0.5, len(track.samples))
    quaternions = np.column_stack([np.cos(turn), 0.0 * turn, 0.0 * turn, np.sin(turn)])
    orientation = pd.DataFrame(quaternions, index=track.samples.index, columns=Columns.QUATERNION)
    return with_source(orientation=orientation, origin=replace(track.origin, kind="vio"))(flight)


def with_offset_truth(flight: Flight, *, grows: bool) -> Flight:
    """Move ground truth 1 m north, or by a growing distance of 1 m RMS."""
    samples = flight.truth.samples.copy()
    samples["north_m"] += np.linspace(0.0, np.sqrt(3.0), len(samples)) if grows else 1.0
    return replace(flight, truth=replace(flight.truth, samples=samples))


def with_errors(
    errors: Callable[[pd.Index, pd.DataFrame], Any], late: Callable[[pd.Index], Any] = np.zeros_like
) -> Change:
    """Add errors (m), a function of time and velocity, and delays (s) of the timestamps."""

    def change(flight: Flight) -> Flight:
        samples = flight.positions[0].samples.copy()
        time_s, true = samples.index, flight.truth.samples
        velocity = pd.DataFrame(
            {name: np.interp(time_s, true.index, np.gradient(true[name], true.index))
             for name in Columns.POSITION[:2]}, index=time_s,
        )  # fmt: skip
        samples[Columns.POSITION[:2]] += errors(time_s, velocity)
        return with_source(samples=samples.set_axis(time_s + (time_s > 1.0) * late(time_s)))(flight)

    return change


def no_errors(time_s: pd.Index, velocity: pd.DataFrame) -> Any:
    return 0.0 * velocity


def noise(count: int) -> Any:
    return np.random.default_rng(4).normal(size=(count, 2))


def jitter_s(time_s: pd.Index) -> Any:
    return np.clip(0.03 * noise(len(time_s))[:, 0], -0.045, 0.045)


def about(value: float, rel: float = 0.1) -> Any:
    return pytest.approx(value, rel=rel)


def ekf2(**parts: Any) -> dict[str, Any]:
    return {"ekf2": Estimator(**parts)}


# Findings whose messages need the maximum-likelihood noises
TUNED_IDS = ("kf_overconfident", "kf_underconfident", "ekf2_underconfident", "ekf2_overconfident",
             "process_noise_near_zero")  # fmt: skip
FAULTS = [
    # recordings of a link
    Fault("source_timestamps_constant", "error", {"stamps": 600, "distinct": 2},
          change=with_source(clock_map=mapped("receive time", distinct=2))),
    Fault("source_timestamp_jitter", "warning", {"jitter_s": 0.02},
          change=with_source(clock_map=mapped("receive time", distinct=2))),
    Fault("companion_not_synchronised", "warning", {"jitter_s": 0.02},
          change=with_source(clock_map=mapped("receive time"))),
    Fault("source_samples_lost", "note", {"lost_fraction": about(0.1, 0.05)},
          change=without_every(10)),
    Fault("innovations_need_ulog", "note", change=as_recording),
    Fault("not_px4", "note", {"autopilot": "ArduPilot"}, change=with_log(autopilot="ArduPilot")),
    Fault("autopilot_restarted", "warning", change=with_log(restarts=1)),
    Fault("receive_time_went_back", "note", change=with_log(receive_time_reversals=3)),
    Fault("position_file_alignment", "warning",
          change=with_source(alignment=given_placement("yaw is known to 5° only"))),
    # settings of KF
    Fault("kf_overconfident", "error", settings={"sigma_z_m": 0.01}),
    Fault("kf_underconfident", "error", settings={"sigma_z_m": 1.0}),
    Fault("process_noise_near_zero", "error", {"response_s": about(21.0, 0.1)},
          settings={"sigma_a_m_s2": 1e-4}),
    # EKF2
    Fault("accelerometer_bias", "warning", {"bias_m_s2": about(0.3, 0.01)}, change=with_ekf2_bias),
    Fault("ekf2_underconfident", "error", {"sigma_ratio": about(0.14, 0.15)},
          ekf2(nis=0.02, noise_m=0.7)),
    Fault("ekf2_underconfident", "warning", {"sigma_ratio": about(0.62, 0.15)},
          ekf2(nis=0.4, noise_m=0.15)),
    Fault("ekf2_overconfident", "error", {"nis_mean": about(22, 0.2)},
          ekf2(nis=22.0, noise_m=0.02)),
    Fault("ekf2_not_fusing", "error", {"fused_fraction": 0.0, "source_interval_s": about(0.5)},
          {**ekf2(fusing=((0.0, 0.0),)), "uwb": Uwb(rate_hz=2.0),
           "parameters": {**NO_VISION, "EKF2_EV_CTRL": 15}}),
    Fault("ekf2_not_fusing", "error", {"fused_fraction": about(0.25, 0.01)},
          ekf2(fusing=((0.0, 0.0), (90.0, 1.0)))),
    Fault("ekf2_fusion_interrupted", "warning", {"fused_fraction": about(0.90, 0.01)},
          ekf2(fusing=((0.0, 1.0), (60.0, 0.0), (72.0, 1.0)))),
    Fault("ekf2_position_invalid", "error", {"invalid_fraction": about(0.333, 0.01)},
          change=with_invalid_position),
    Fault("ekf2_rejects_positions", "error",
          {"rejected_fraction": about(0.5, 0.2), "axis": "aisle"},
          ekf2(rejected_fraction=0.5)),
    Fault("ekf2_rejects_positions", "warning", {"rejected_fraction": about(0.05, 0.4)},
          ekf2(rejected_fraction=0.05)),
    Fault("ekf2_resets", "warning", {"count": 1, "largest_m": 3.0, "at_s": 60.0},
          ekf2(resets=(SIDESTEP,))),
    Fault("ekf2_resets", "note", {"largest_m": about(0.4, 1e-9), "at_s": 60.0},
          ekf2(resets=(STEP_UP,))),
    Fault("ekf2_instance_switch", "warning", {"count": 2, "at_s": 30.0},
          ekf2(primary_instances=((-math.inf, 0), (30.0, 1), (80.0, 0)))),
    Fault("ekf2_simulated", "note", change=with_log(notes=(SIMULATED_EKF2_NOTE,))),
    Fault("ekf2_not_logged", "warning", flight={"ekf2": None}),
    # the position source
    Fault("source_not_logged", "warning", {"rate_hz": about(4.0), "sdlog_profile": 1},
          {"uwb": Uwb(name=ALIGNED_TOPIC, origin=ALIGNED_BY_EKF2_ORIGIN, rate_hz=4.0),
           "parameters": NO_VISION}),
    Fault("source_rate_at_limit", "note", {"rate_hz": about(4.0), "longest_s": about(1.0, 1e-6)},
          {"uwb": Uwb(rate_hz=4.0, gap_s=(40.0, 48.0)),
           "parameters": {**NO_VISION, "EKF2_EV_CTRL": 15},
           **ekf2(fusing=((0.0, 1.0), (40.4, 0.0), (49.0, 1.0)))}),
    Fault("source_frame_frd", "warning",
          flight={"uwb": Uwb(frame="FRD"), **ekf2(fusing_yaw=0.0)}),
    Fault("source_frame_frd", "note", flight={"uwb": Uwb(frame="FRD")}),
    Fault("source_gap", "warning", {"longest_s": about(8.0, 1e-9), "at_s": about(40.0, 1e-9)},
          {"uwb": Uwb(gap_s=(40.0, 48.0))}),
    Fault("source_stops", "warning",
          {"at_s": about(80.0, 1e-9), "duration_s": about(40.0, 1e-9)},
          {"uwb": Uwb(gap_s=(80.0, 130.0))}),
    Fault("source_stops", "error", {"at_s": about(80.0, 1e-9), "sigma_m": about(0.07, 0.1)},
          {"uwb": Uwb(gap_s=(80.0, 130.0)), "truth": False}, change=lambda f: with_fused(f, 80.0)),
    Fault("source_begins", "warning", {"at_s": about(40.0, 1e-9), "duration_s": about(40.0, 1e-9)},
          {"uwb": Uwb(gap_s=(-1.0, 40.0))}),
    Fault("source_gap_in_log", "warning", {"count": 1, "longest_s": about(8.0, 1e-9)},
          {"uwb": Uwb(gap_s=(40.0, 48.0))}, change=lambda f: with_fused(f, 120.0)),
    Fault("source_drift", "error",
          {"filter": "ekf2", "ekf2_nees_position_mean": about(300, 0.2)},
          change=lambda f: as_odometry(with_offset_truth(f, grows=True))),
    Fault("error_exceeds_reported_sigma", "error",
          change=lambda f: with_offset_truth(f, grows=False)),
    Fault("source_may_drift", "note", {"source": "vehicle_visual_odometry"}, {"truth": False},
          change=as_odometry),
    Fault("no_motion", "warning", {"range_m": about(0.33, 0.15)}, {"length_m": 0.0}),
    # the log
    Fault("imu_samples_missing", "warning", {"lost_fraction": about(0.2, 0.01)},
          change=lambda f: replace(f, imu=f.imu.drop(f.imu.index[::5]))),
    Fault("imu_gap", "warning", {"total_s": about(2.0, 1e-6)}, {"imu": Imu(gap_s=(40.0, 42.0))}),
    Fault("imu_values_impossible", "error", {"count": 1000},
          change=lambda f: replace(f, imu=f.imu * (1.0 + 199.0 * (f.imu.index > 110.0))[:, None])),
    Fault("attitude_failure", "error", {"total_s": 4.0},
          {"excessive_tilt_spans_s": ((100.0, 104.0),)}),
    Fault("accelerometer_clipping", "warning", {"count": 30, "total_s": about(0.3, 0.01)},
          {"imu": Imu(clipped_s=(50.0, 50.295))}),
    Fault("accelerometer_oscillation", "warning", {"frequency_hz": about(0.5, 0.02),
          "amplitude_m_s2": about(1.0, 0.06)}, change=with_imu_oscillation),
    Fault("logger_dropouts", "warning", {"count": 2, "total_s": about(0.5, 1e-9)},
          {"dropouts": (Dropout(20.0, 0.3), Dropout(50.0, 0.2), Dropout(500.0, 9.0))}),
    Fault("imu_rate_too_low", "warning", {"rate_hz": about(20.0), "topic": "sensor_combined"},
          {"imu": Imu(rate_hz=20.0)}),
    Fault("imu_rate_too_low", "warning", {"rate_hz": about(5.0), "topic": "vehicle_attitude"},
          {"attitude_hz": 5.0}),
    Fault("acceleration_not_logged", "warning", flight={"imu": None}),
    Fault("acceleration_not_logged", "warning", flight={"attitude_hz": None}),
    Fault("log_damaged", "warning", {"ends_in_flight": 0.0},
          {"damage": ("128 bytes are not part of a complete MAVLink frame",)}),
    Fault("samples_out_of_order", "note", {"notes": 2},
          change=with_log(dropped={"vehicle_imu": 2, "vehicle_attitude": 1})),
    Fault("too_few_innovations", "warning", {"count": 7}, {"duration_s": 1.5}),
    Fault("source_timestamp_jitter", "warning", {"jitter_s": about(0.0287, 0.01)},
          {"uwb": Uwb(rate_hz=10.0, sigma_m=0.01)}, change=with_errors(no_errors, jitter_s)),
    Fault("source_noise_grows_with_speed", "error", {"slow_m": about(0.139, 0.01)},
          {"uwb": Uwb(rate_hz=10.0, sigma_m=0.05)},
          change=with_errors(lambda t, v: np.hypot(*v.T.values)[:, None] * 0.4 * noise(len(t)))),
    Fault("source_error_periodic", "error", {"period_s": about(7.0), "amplitude_m": about(0.3)},
          change=with_errors(lambda t, _: 0.3 * np.sin(2.0 * np.pi * np.outer(t, [1, 0]) / 7.0))),
    Fault("source_time_offset_changes", "error", {"most_s": about(0.12, 0.2)},
          {"uwb": Uwb(rate_hz=20.0, sigma_m=0.02)},
          change=with_errors(no_errors, lambda t: 0.12 * np.sin(2.0 * np.pi * t / 40.0))),
    Fault("source_scale_error", "error", {"scale": about(1.25, 0.01)},
          change=lambda f: with_source(samples=1.25 * f.positions[0].samples)(as_odometry(f))),
]  # fmt: skip
# Findings tested in other files, with the estimates that they need
TESTED_ELSEWHERE = {
    "accelerometer_bias", "aid_innovation_bias", "aid_innovation_shift", "aid_not_fused",
    "aid_overconfident", "ekf2_acceleration_bad", "ekf2_ev_delay_wrong", "ekf2_gate_too_small",
    "ekf2_gps_delay_wrong", "ekf2_heading_error", "ekf2_noise_too_large", "ekf2_noise_too_small",
    "false_loop_closure", "loop_closure_inconsistent", "loop_drift_too_small",
    "loop_landing_assumed", "loop_on_absolute_positions", "sigma_a_too_large", "sigma_a_too_small",
    "sigma_z_too_large", "sigma_z_too_small", "source_axes_wrong", "source_convention_ambiguous",
    "source_downsampled", "source_height_constant",
    "source_frame_misaligned", "source_low_pass_filtered", "source_noise_time_correlated",
    "source_noise_unequal_axes", "source_noise_varies", "source_orientation_copied",
    "source_orientation_wrong", "source_outliers", "source_position_jump",
    "source_reported_variance_wrong", "source_samples_repeated",
    "source_time_offset", "source_timestamps_are_arrival_times",
    "attitude_late", "source_latency_varies",
    "source_unit_wrong", "source_is_ekf2_estimate", "source_two_senders",
    "source_positions_rounded", "source_lever_arm", "source_timestamp_unit",
    "source_timestamps_shared", "source_position_held", "source_zero_positions",
    "source_without_position", "ekf2_bias_at_limit", "ekf2_not_aligned", "gyroscope_bias",
    "parameter_changed", "source_coordinate_constant", "source_relocalises",
}  # fmt: skip
# Second finding of severity error that the fault causes
ALSO_ERROR = {
    "kf_overconfident": "sigma_z_too_small",
    "kf_underconfident": "sigma_z_too_large",
    "source_timestamp_jitter": "source_timestamps_constant",
    "process_noise_near_zero": "kf_overconfident",
    "ekf2_rejects_positions": "ekf2_overconfident",
}
# Finding that must not appear on an incomplete flight, the flight, and a finding that must
MISSING_FIELD: list[tuple[str, dict[str, Any], str | None]] = [
    ("ekf2_not_fusing", ekf2(fusing=None), None),
    ("ekf2_not_fusing", {"ekf2": None}, "ekf2_not_logged"),
    ("ekf2_fusion_interrupted", ekf2(fusing=None), None),
    ("ekf2_rejects_positions", ekf2(innovations_logged=False), None),
    ("ekf2_rejects_positions", ekf2(rejected_fraction=0.5, rejected_logged=False), None),
    ("ekf2_underconfident", ekf2(innovations_logged=False), None),
    ("ekf2_resets", {"ekf2": None}, "ekf2_not_logged"),
    ("imu_gap", {"imu": None}, "acceleration_not_logged"),
    ("imu_rate_too_low", {"imu": None}, "acceleration_not_logged"),
    ("imu_rate_too_low", {"attitude_hz": None}, "acceleration_not_logged"),
    ("source_not_logged", {"parameters": {}}, None),
    ("ekf2_underconfident", {"parameters": {}, **ekf2(noise_logged=False)}, None),
    # an unknown EKF2 noise is not printed as a number
    ("no_finding", {"parameters": {}, **ekf2(nis=0.02, noise_logged=False)},
     "ekf2_underconfident"),
]  # fmt: skip


# Condition in the log for each action with these words
PRECONDITIONS: list[tuple[str, Callable[[Comparison, Finding], bool]]] = [
    ("anchor|line of sight|the tag", lambda made, _: made.source.origin.kind == "uwb"),
    ("texture|marker|camera", lambda made, _: made.source.origin.kind in ("vio", "mocap")),
    ("--source-kind mocap", lambda made, _: made.source.origin.kind == "vio"),
    ("Calibrate the magnetometer", lambda made, _: parameter(made, "EKF2_MAG_TYPE") != 5.0),
    ("[Aa]ntenna|receiver|sky|RTK", lambda made, _: made.source.origin.is_gnss),
    ("EKF2_DELAY_MAX", lambda made, _: "EKF2_DELAY_MAX" in made.flight.log.parameters),
    ("EKF2_EV_CTRL bit 3", lambda made, _: made.source.origin.is_vision),
    ("EKF2_EV_NOISE_MD", lambda made, _: made.source.origin.is_vision),
    (
        "sent|sending|[Ss]end (the|each|a|one|raw|nothing|NaN)",
        lambda made, _: not made.source.origin.is_gnss,
    ),
    ("SD card", lambda made, one: bool(made.flight.log.dropouts) or one.id in CORRUPT_LOG),
    (
        "let EKF2 fuse the yaw",
        lambda made, one: made.source.orientation is not None or "send the orient" in one.remedy,
    ),
    ("--position-yaw|--position-frame", lambda made, _: made.source.alignment is not None),
    ("TIMESYNC", lambda made, _: made.source.origin.route == "as received"),
]
# Findings about a log that the SD card damaged
CORRUPT_LOG = ("log_damaged", "imu_samples_missing")


def parameter(comparison: Comparison, name: str) -> float:
    if name == "EKF2_EVP_GATE" and isinstance(comparison.flight.ekf2, Ekf2):
        return comparison.flight.ekf2.gate
    return comparison.flight.log.parameters.get(name, math.nan)


def check_action(comparison: Comparison, finding: Finding) -> None:
    """Check that the log does not contradict the action of a finding."""
    for words, is_met in PRECONDITIONS:
        if re.search(words, finding.remedy):
            assert is_met(comparison, finding), (words, finding.remedy)
    for name, number in re.findall(
        r"Set (EKF2_\w+|SDLOG_PROFILE) to ([\d.]+)(?!\d)", finding.remedy
    ):
        assert parameter(comparison, name) != float(number.rstrip(".")), finding.remedy


def found(comparison: Comparison, *, tuned: bool = False) -> tuple[Finding, ...]:
    """Find all faults of a comparison without re-runs, and check the form of each finding."""
    findings = find(with_noises(comparison) if tuned else unexplained(comparison))
    earlier_ids: set[str | None] = {None}
    for finding in findings:
        assert finding.id in FINDING_TITLES
        assert finding.caused_by in earlier_ids
        earlier_ids.add(finding.id)
        assert re.fullmatch(r"[A-Z0-9a-z].*[^.: ;]", finding.title)
        assert finding.message.startswith(finding.title)
        check_action(comparison, finding)
        for text in filter(None, (finding.message, finding.remedy)):
            assert "\n" not in text
            assert text.endswith(".")
            assert not NOT_A_NUMBER.search(text), text
        for one in finding.evidence.values():
            assert isinstance(one, str) or math.isfinite(one)
    return findings


def ids(findings: tuple[Finding, ...]) -> set[str]:
    return {finding.id for finding in findings}


@pytest.mark.parametrize("seed", range(2, 8))
def test_clean_flight_has_no_reported_faults(seed: int) -> None:
    assert found(compare(aisle_flight(seed=seed))) == ()


@pytest.mark.reallogs
def test_report_on_crash_flight_lists_tumbling_first(shared_logs: Path) -> None:
    """Flight Review log "ekf_failure": accelerometer clipping, then roll and pitch at 68 s."""
    flight = read_log(shared_logs / "real" / "PX4_flight-review-rs_ekf_failure.ulg")
    first, second = found(compare(flight))[:2]
    assert (first.id, second.id) == ("attitude_failure", "accelerometer_clipping")
    assert first.spans_s == (pytest.approx((68.04, 68.67), abs=0.01),)
    assert "--end 67.0" in first.remedy
    assert second.evidence["count"] == 202
    assert second.spans_s[0][0] == pytest.approx(24.9, abs=0.1)


@pytest.mark.reallogs
@pytest.mark.parametrize(("log", "file", "finding", "at_s", "error_m"), [
    ("conventions/stops_in_flight", None, "source_stops", 33.4, 12.2),
    ("simulated/v1.16.1_aisle_nominal", "case17.csv", "source_stops", 50.9, 0.12),
    ("simulated/v1.16.1_aisle_10hz", "case18.csv", "source_begins", 63.3, 0.05),
])  # fmt: skip
def test_positions_missing_for_part_of_flight_are_reported_first(
    log: str, file: str | None, finding: str, at_s: float, error_m: float, shared_logs: Path
) -> None:
    cases = shared_logs.parent / "cases"
    position = file and PositionFile(path=str(cases / file), frame="enu")
    request = ComparisonRequest(log=str(shared_logs / f"{log}.ulg"), position=position or None)
    first, *_ = found(compare_prepared(prepare_comparison(read_flight(request), request)))
    # EKF2 fused its own source besides the file
    assert (first.id, first.severity) == (finding, "warning" if file else "error")
    assert f"in flight at {at_s} s, " in first.title
    assert "EKF2's position error at " in first.message
    assert first.evidence["error_m"] == pytest.approx(error_m, rel=0.05)
    assert ("dead reckoning" in first.message) == (file is None)


@pytest.mark.parametrize(("gap_s", "reset_s", "cause"), [
    ((-1.0, 40.0), 40.4, "source_begins"), ((80.0, 130.0), 90.0, "source_stops"),
])  # fmt: skip
def test_ekf2_reset_is_attributed_to_missing_position_source(
    gap_s: tuple[float, float], reset_s: float, cause: str
) -> None:
    resets = (Reset(reset_s, "position", (16.0, 0.0, 0.0)),)
    flight = aisle_flight(uwb=Uwb(gap_s=gap_s), ekf2=Estimator(resets=resets))
    first, reset = found(compare(flight))[:2]
    assert (first.id, reset.id, reset.caused_by) == (cause, "ekf2_resets", cause)
    assert "largest reset: 16.00 m" in reset.message


def test_positions_lost_by_logger_are_not_reported_as_source_gap(sample_flight: Flight) -> None:
    samples = sample_flight.positions[0].samples
    lost = with_source(samples=samples.drop(samples.loc[40.0:60.0].index))(sample_flight)
    lost = replace(lost, positions=(*lost.positions, *sample_flight.positions[1:]))
    (finding,) = (one for one in found(compare(lost)) if "source" in one.id)
    assert (finding.id, finding.evidence["count"]) == ("source_gap_in_log", 1)
    assert finding.spans_s == (pytest.approx((40.0, 60.0), abs=0.2),)


def test_position_jump_is_not_reported_as_time_offset_change() -> None:
    step = with_errors(lambda t, _: np.outer(t > 60.0, [0.87, 0.5]))
    assert "source_time_offset_changes" not in ids(found(compare(step(aisle_flight()))))


@pytest.mark.parametrize("late_s", [0.1, -0.24])
def test_delay_of_attitude_relative_to_gyro_is_reported(
    late_s: float, sample_flight: Flight
) -> None:
    attitude = sample_flight.attitude
    shifted = replace(sample_flight, attitude=attitude.set_axis(attitude.index + late_s))
    (finding,) = (one for one in found(compare(shifted)) if one.id == "attitude_late")
    assert finding.evidence["delay_s"] == pytest.approx(late_s, abs=0.021)
    assert "attitude_late" not in ids(found(compare(sample_flight)))


def test_each_reportable_fault_has_a_simulated_test_flight() -> None:
    assert set(FINDING_TITLES) == {fault.id for fault in FAULTS} | TESTED_ELSEWHERE


@pytest.mark.parametrize(
    ("at", "fault"),
    list(enumerate(FAULTS)),
    ids=[f"{fault.id}-{fault.severity}" for fault in FAULTS],
)
def test_simulated_fault_is_the_only_reported_error(at: int, fault: Fault) -> None:
    """Messages and actions are compared with tests/golden/findings.txt (see test_golden)."""
    comparison = compare(fault.fly(), Settings(**fault.settings))
    findings = found(comparison, tuned=fault.id in TUNED_IDS)
    first = next((each for each in findings if each.id == fault.id), None)
    assert first, f"{fault.id} is not among {sorted(ids(findings))}"
    assert first.severity == fault.severity
    assert {name: first.evidence.get(name) for name in fault.evidence} == fault.evidence
    lines = [f"{first.id} {first.severity} {value(first.evidence)}", first.message, first.remedy]
    assert_matches_golden("findings", [rounded(line) for line in lines if line], paragraph=at)
    errors = {f.id for f in findings if f.severity == "error" and f.caused_by is None}
    assert errors <= {fault.id, ALSO_ERROR.get(fault.id)}


@pytest.mark.parametrize(
    ("gate", "expected"), [(1.0, 0.5340), (1.5, 0.2494), (2.0, 0.0889), (2.8, 0.0102), (3.0, None)]
)
def test_narrow_gate_is_listed_above_the_rejections_it_causes(gate, expected) -> None:
    """Expected shares: tables of the normal distribution, two axes."""
    flown = with_ekf2(gate=gate)(aisle_flight(**ekf2(rejected_fraction=0.3)))
    first, *others = found(compare(flown))
    if expected is None:
        assert "ekf2_gate_too_small" not in ids((first, *others))
        return
    assert (first.id, first.severity) == ("ekf2_gate_too_small", "error")
    assert first.evidence == {"gate": gate, "rejected_by_gate": pytest.approx(expected, abs=1e-4)}
    assert re.search(r"EKF2 rejects [23]\d %", first.message)
    group = split_cause_groups((first, *others))[0]
    assert {"ekf2_rejects_positions", "ekf2_overconfident"} <= {one.id for one in group}
    # a gate without rejections is not reported
    assert not found(compare(with_ekf2(gate=gate)(aisle_flight())))


@pytest.mark.parametrize(
    ("absent", "flight", "present"), MISSING_FIELD, ids=lambda value: str(value)[:40]
)
def test_fault_is_not_reported_if_the_log_lacks_needed_data(
    absent: str, flight: Any, present: str | None
) -> None:
    found_ids = ids(found(compare(aisle_flight(duration_s=60.0, **flight))))
    assert absent not in found_ids
    assert present is None or present in found_ids


@pytest.mark.parametrize("duration_s", [0.4, 2.0])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.id}-{fault.severity}")
def test_fault_detection_on_very_short_flight_does_not_raise(
    fault: Fault, duration_s: float
) -> None:
    # one in ten of these is lost
    rate_hz = 10.0 if fault.id == "source_samples_lost" else 5.0
    uwb = replace(fault.flight.get("uwb", Uwb()), rate_hz=rate_hz, gap_s=None)
    short: dict[str, Any] = {"duration_s": duration_s, "uwb": uwb}
    if isinstance(imu := fault.flight.get("imu"), Imu):
        short["imu"] = replace(imu, gap_s=None)
    comparison = compare(fault.fly(**short), Settings(**fault.settings))
    few = len(next(iter(comparison.axes.values())).kf_run.updates) < MIN_INNOVATIONS
    assert ("too_few_innovations" in ids(found(comparison))) == few


def test_each_reportable_fault_belongs_to_a_known_group() -> None:
    for entry in FINDING_CATALOGUE.values():
        assert entry.group in FINDING_GROUPS
        assert not entry.title.endswith(".")
        assert entry.meaning.endswith(".")


def test_explain_command_examples_show_measured_detection_rates() -> None:
    examples = load_finding_examples()
    assert list(examples) == list(FINDING_CATALOGUE)
    rows = pd.read_csv(Path(__file__).parent / "studies" / "rates.csv")
    for name, example in examples.items():
        clean = rows[(rows["finding"] == name) & (rows["condition"] == "none")]
        assert example.fault_free_flight_count == clean["flights"].sum()
        assert example.false_alarm_count == pytest.approx((clean["flights"] * clean["rate"]).sum())
        faulty = rows[(rows["finding"] == name) & (rows["condition"] != "none")]
        assert example.detection_rate_by_fault == dict(
            zip(faulty["condition"], faulty["rate"], strict=True)
        )


@pytest.mark.parametrize(
    "typed",
    ["source_scale_error", "Source-Scale-Error"],
)
def test_explain_command_prints_meaning_and_example_of_fault(typed, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "2000")  # no line breaks
    code, out, err = run_main(monkeypatch, capsys, "explain", typed)
    assert (code, err) == (0, "")
    example = load_finding_examples()["source_scale_error"]
    for text in (
        FINDING_TITLES["source_scale_error"],
        FINDING_CATALOGUE["source_scale_error"].meaning,
        example.message,
        example.remedy,
        "source_samples_repeated",  # a possible cause
        "error_exceeds_reported_sigma",  # a possible effect
        "1 of 450 simulated flights",
        "scale=15%: 75 %",
    ):
        assert text in out


def test_explain_command_states_if_detection_rate_is_unmeasured(monkeypatch, capsys) -> None:
    _, out, _ = run_main(monkeypatch, capsys, "explain", "not_px4")
    assert "detection have not been measured" in out


def test_explain_command_without_argument_lists_all_faults(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "2000")  # no line breaks
    code, out, _ = run_main(monkeypatch, capsys, "explain")
    assert code == 0
    lines = out.splitlines()
    places = [lines.index(group[0].upper() + group[1:]) for group in FINDING_GROUPS]
    assert places == sorted(places)
    for name, title in FINDING_TITLES.items():
        assert re.search(rf"^{name} +{re.escape(title)} *$", out, re.MULTILINE)


@pytest.mark.parametrize(
    ("typed", "suggestion"), [("source_gapp", "Did you mean source_gap? "), ("xyz", "")]
)
def test_explain_command_with_unknown_fault_exits_with_2(
    typed, suggestion, monkeypatch, capsys
) -> None:
    code, out, err = run_main(monkeypatch, capsys, "explain", typed)
    assert (code, out) == (2, "")
    assert err == (
        f"px4fuse: unknown finding id '{typed}'. {suggestion}"
        "For a list of findings, run px4fuse explain.\n"
    )
