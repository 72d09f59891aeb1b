"""Each detector on a clean flight, a faulty one, one without the field, a short and a real one."""

from __future__ import annotations

import math
import pkgutil
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from flights import Estimator, Imu, Uwb, aisle_flight, unexplained, with_noises
from test_hypotheses import NAMED_HERE as NAMED_AS_CAUSES
from test_loop import NAMED_HERE as NAMED_IN_LOOPS
from test_noise_findings import NAMED_HERE

from px4fuse import findings as package
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.model import MODEL_NOTE
from px4fuse.filter.consistency import MIN_INNOVATIONS
from px4fuse.filter.settings import Settings
from px4fuse.findings import DETECTORS, SEVERITIES, Finding, find, names
from px4fuse.flight import (
    AXIS_NAMES,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    Alignment,
    Ekf2,
    Flight,
    Reset,
    Truth,
    Unavailable,
)
from px4fuse.origin import ALIGNED, KEPT, MOTION_CAPTURE
from px4fuse.readers import read_log
from px4fuse.recording import ClockMap, Dropout

ALIGNED_TOPIC = "estimator_visual_odometry_aligned"
NO_VISION = {"EKF2_EVP_NOISE": 0.1, "SDLOG_PROFILE": 1.0}
SIDESTEP = Reset(60.0, "position", (3.0, 0.0, 0.0))
STEP_UP = Reset(60.0, "position", (0.0, 0.0, -0.4))
NOT_A_NUMBER = re.compile(r"\b(nan|inf|none)\b", re.IGNORECASE)


def never(**parameters: float) -> dict[str, Any]:
    """EKF2 that never fuses, with these parameters set."""
    return {"ekf2": Estimator(fusing=((0.0, 0.0),)), "parameters": {**NO_VISION, **parameters}}


@dataclass(frozen=True)
class Fault:
    """A mistake, the finding that names it, and the evidence that must be in it."""

    id: str
    severity: str
    flight: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    evidence: Mapping[str, Any] = field(default_factory=dict)
    says: str = ""
    remedy: str = ""
    change: Callable[[Flight], Flight] = lambda flight: flight

    def fly(self, **other: Any) -> Flight:
        """The flight with the mistake in it."""
        return self.change(aisle_flight(**{**self.flight, **other}))


def with_source(**changes: Any) -> Callable[[Flight], Flight]:
    """Change the position track."""

    def change(flight: Flight) -> Flight:
        (track,) = flight.positions
        return replace(flight, positions=(replace(track, **changes),))

    return change


def with_log(**changes: Any) -> Callable[[Flight], Flight]:
    """Change what is said of the log."""
    return lambda flight: replace(flight, log=replace(flight.log, **changes))


def without_every(nth: int) -> Callable[[Flight], Flight]:
    """A recording of a link that lost every nth position."""

    def change(flight: Flight) -> Flight:
        (track,) = flight.positions
        keep = np.arange(len(track.samples)) % nth > 0
        lossy = replace(track, samples=track.samples[keep], clock_map=mapped("TIMESYNC"))
        return replace(flight, positions=(lossy,))

    return change


def mapped(method: str, distinct: int | None = None, jitter_s: float = 0.02) -> ClockMap:
    return ClockMap("UNIX time of system 1", method, 600, -1e9, 0.1, jitter_s, "", distinct)


def as_recording(flight: Flight) -> Flight:
    """Without innovations, as MAVLink carries it."""
    assert isinstance(flight.ekf2, Ekf2)
    none = Unavailable("EKF2 innovations", "MAVLink does not carry them", "")
    ekf2 = replace(flight.ekf2, innovations=dict.fromkeys(AXIS_NAMES, none))
    return with_log(format="MAVLink tlog")(replace(flight, ekf2=ekf2))


def biased(flight: Flight) -> Flight:
    """EKF2 that found a bias along the body's axes."""
    assert isinstance(flight.ekf2, Ekf2)
    bias = flight.ekf2.state.iloc[:, :3].set_axis(SPECIFIC_FORCE_COLUMNS, axis=1) * 0.0
    return replace(
        flight, ekf2=replace(flight.ekf2, accelerometer_bias=bias + np.array([0.2, -0.1, 0.2]))
    )


def as_odometry(flight: Flight) -> Flight:
    """The source comes with an orientation that turns."""
    (track,) = flight.positions
    turn = np.linspace(0.0, 0.5, len(track.samples))
    quaternions = np.column_stack([np.cos(turn), 0.0 * turn, 0.0 * turn, np.sin(turn)])
    orientation = pd.DataFrame(quaternions, index=track.samples.index, columns=QUATERNION_COLUMNS)
    return with_source(orientation=orientation, origin=replace(track.origin, kind="vio"))(flight)


def apart(flight: Flight, *, grows: bool) -> Flight:
    """The truth is a metre from where source and EKF2 are, on average where that grows."""
    assert isinstance(flight.truth, Truth)
    samples = flight.truth.samples.copy()
    samples["north_m"] += np.linspace(0.0, np.sqrt(3.0), len(samples)) if grows else 1.0
    return replace(flight, truth=replace(flight.truth, samples=samples))


def placed(*warnings: str) -> Alignment:
    return Alignment(
        frame="enu", frame_reason="given", yaw_deg=0.0, yaw_reason="given",
        origin_m=(0.0, 0.0, 0.0), clock_offset_s=0.0, clock_reason="given",
        reference="", warnings=warnings,
    )  # fmt: skip


def about(value: float, rel: float = 0.1) -> Any:
    return pytest.approx(value, rel=rel)


FAULTS = [
    # a recording of its own
    Fault(
        "source_stamps_constant",
        "error",
        evidence={"stamps": 600.0, "distinct": 2.0},
        says="take only 2 values",
        remedy="time of measurement",
        change=with_source(clock_map=mapped("receive time", distinct=2)),
    ),
    Fault(
        "source_receipt_jitter",
        "warning",
        evidence={"jitter_s": 0.02},
        says="jitters by 20 ms",
        change=with_source(clock_map=mapped("receive time", distinct=2)),
    ),
    Fault(
        "companion_not_synchronised",
        "warning",
        evidence={"jitter_s": 0.02},
        says="never synchronised",
        remedy="TIMESYNC",
        change=with_source(clock_map=mapped("receive time")),
    ),
    Fault(
        "source_samples_lost",
        "info",
        evidence={"lost_share": about(0.1, 0.05)},
        says="About 10%",
        change=without_every(10),
    ),
    Fault(
        "innovations_need_ulog",
        "info",
        says="states and variances but not its innovations",
        remedy="with --mavlink",
        change=as_recording,
    ),
    Fault("not_px4", "info", says="ArduPilot", change=with_log(autopilot="ArduPilot")),
    Fault(
        "autopilot_restarted",
        "warning",
        says="boot clock went back 1 time",
        change=with_log(notes=("the autopilot's boot clock went back 1 time (restart): x",)),
    ),
    Fault(
        "receipt_out_of_order",
        "info",
        says="went back 3 times",
        change=with_log(notes=("the time of receipt went back 3 times",)),
    ),
    Fault(
        "position_file_placement",
        "warning",
        says="Yaw is known to 5° only.",
        remedy="--position-yaw",
        change=with_source(alignment=placed("yaw is known to 5° only")),
    ),
    # the filter's own settings
    Fault(
        "kf_variance_understated",
        "error",
        settings={"sigma_z_m": 0.01},
        evidence={"sigma_z_asked_m": about(0.10, 0.2)},
        says="Our innovation variance is understated",
        remedy="--sigma-z",
    ),
    Fault(
        "kf_variance_overstated",
        "error",
        settings={"sigma_z_m": 1.0},
        evidence={"sigma_z_asked_m": about(0.10, 0.2)},
        says="Our innovation variance is overstated",
        remedy="--sigma-z",
    ),
    Fault(
        "process_noise_forgotten",
        "error",
        settings={"sigma_a_m_s2": 1e-4},
        evidence={"relative_growth": pytest.approx(0.01, abs=0.01)},
        says="hardly grows between updates",
        remedy="--sigma-a 0.",
    ),
    # EKF2's
    Fault(
        "accelerometer_bias",
        "warning",
        evidence={"bias_m_s2": about(0.3, 0.01)},
        says="+0.20 forward, -0.10 right, +0.20 down",
        remedy="Calibrate",
        change=biased,
    ),
    Fault(
        "ekf2_variance_overstated",
        "error",
        {"ekf2": Estimator(nis=0.02, noise_m=0.7)},
        evidence={"variance_factor": about(50, 0.3), "sigma_z_asked_m": about(0.10, 0.2)},
        says="EKF2's innovation variance is overstated",
        remedy="EKF2_EVP_NOISE",
    ),
    Fault(
        "ekf2_variance_overstated",
        "warning",
        {"ekf2": Estimator(nis=0.4, noise_m=0.15)},
        evidence={"variance_factor": about(2.5, 0.3)},
    ),
    Fault(
        "ekf2_variance_understated",
        "error",
        {"ekf2": Estimator(nis=22.0, noise_m=0.02)},
        evidence={"nis_mean": about(22, 0.2), "sigma_z_asked_m": about(0.10, 0.2)},
        says="EKF2's innovation variance is understated",
        remedy="EKF2_EVP_NOISE",
    ),
    Fault(
        "ekf2_not_fusing",
        "error",
        {**never(EKF2_EV_CTRL=15), "uwb": Uwb(rate_hz=2.0)},
        evidence={"fusing_share": 0.0, "source_interval_s": about(0.5)},
        says="less than 0.2 s apart",
        remedy="10 Hz",
    ),
    Fault(
        "ekf2_not_fusing", "error", never(EKF2_EV_CTRL=14), {}, {"fusing_share": 0.0},
        "EKF2_EV_CTRL is 14", "Set EKF2_EV_CTRL to 15",
    ),
    Fault(
        "ekf2_not_fusing", "error", never(EKF2_AID_MASK=1), {}, {"fusing_share": 0.0},
        "EKF2_AID_MASK is 1", "Set EKF2_AID_MASK to 9",
    ),
    Fault(
        "ekf2_not_fusing",
        "error",
        {"ekf2": Estimator(fusing=((0.0, 0.0), (90.0, 1.0)))},
        evidence={"fusing_share": about(0.25, 0.01)},
    ),
    Fault(
        "ekf2_fusion_interrupted",
        "warning",
        {"ekf2": Estimator(fusing=((0.0, 1.0), (60.0, 0.0), (72.0, 1.0)))},
        evidence={"fusing_share": about(0.90, 0.01)},
    ),
    Fault(
        "ekf2_rejecting",
        "error",
        {"ekf2": Estimator(rejected_share=0.5)},
        evidence={"rejected_share": about(0.5, 0.2), "axis": "north"},
        remedy="EKF2_EVP_NOISE",
    ),
    Fault(
        "ekf2_rejecting",
        "warning",
        {"ekf2": Estimator(rejected_share=0.05)},
        evidence={"rejected_share": about(0.05, 0.4), "axis": "north"},
    ),
    Fault(
        "ekf2_resets",
        "warning",
        {"ekf2": Estimator(resets=(SIDESTEP,))},
        evidence={"count": 1.0, "largest_m": 3.0, "at_s": 60.0},
        says="resets undone",
    ),
    Fault(
        "ekf2_resets",
        "info",
        {"ekf2": Estimator(resets=(STEP_UP,))},
        evidence={"count": 1.0, "largest_m": about(0.4, 1e-9), "at_s": 60.0},
        says="height",
    ),
    Fault(
        "ekf2_instance_switch",
        "warning",
        {"ekf2": Estimator(instances=((-math.inf, 0), (30.0, 1), (80.0, 0)))},
        evidence={"count": 2.0, "at_s": 30.0},
    ),
    Fault(
        "ekf2_innovations_decimated",
        "info",
        {"ekf2": Estimator(every=3)},
        evidence={"logged": 200.0, "measurements": 600.0},
        remedy="estimator_aid_src_ev_pos 0",
    ),
    Fault(
        "ekf2_is_a_model",
        "info",
        says="not PX4's EKF2",
        change=with_log(notes=(MODEL_NOTE,)),
    ),
    Fault("ekf2_unavailable", "warning", {"ekf2": None}, remedy="Log EKF2"),
    # the position source
    Fault(
        "source_not_logged",
        "warning",
        {"uwb": Uwb(name=ALIGNED_TOPIC, origin=ALIGNED, rate_hz=4.0), "parameters": NO_VISION},
        evidence={"rate_hz": about(4.0), "sdlog_profile": 1.0},
        says="The log lacks vehicle_visual_odometry, the position as it arrived",
        remedy="SDLOG_PROFILE to 129",
    ),
    Fault(
        "source_decimated",
        "warning",
        {"uwb": Uwb(name="estimator_aid_src_ev_pos", origin=KEPT, rate_hz=2.0)},
        evidence={"rate_hz": about(2.0), "logger_limit_hz": 2.0},
    ),
    Fault(
        "source_frame_not_north",
        "warning",
        {"uwb": Uwb(frame="FRD"), "ekf2": Estimator(fusing_yaw=0.0)},
        remedy="NED",
    ),
    Fault("source_frame_not_north", "info", {"uwb": Uwb(frame="FRD")}, says="EKF2 fused its yaw"),
    Fault(
        "source_gap",
        "warning",
        {"uwb": Uwb(gap_s=(40.0, 48.0))},
        evidence={"count": 1.0, "longest_s": about(8.0, 1e-9), "at_s": about(40.0, 1e-9)},
    ),
    Fault(
        "errors_larger_than_claimed",
        "error",
        evidence={"filter": "ekf2", "ekf2_nees_position_mean": about(400, 0.2)},
        says="Innovations consistent, errors not",
        remedy="give the filter a second, absolute source",
        change=lambda flight: as_odometry(apart(flight, grows=True)),
    ),
    Fault(
        "errors_larger_than_claimed",
        "error",
        says="Most of it is how the source's frame lies",
        remedy="Turn and shift",
        change=lambda flight: apart(flight, grows=False),
    ),
    Fault(
        "source_may_drift",
        "info",
        {"truth": False},
        evidence={"source": "vehicle_visual_odometry"},
        says="is not correctness",
        remedy="px4fuse loop",
        change=as_odometry,
    ),
    Fault("no_motion", "warning", {"length_m": 0.0}, evidence={"range_m": about(0.33, 0.15)}),
    # the log
    Fault(
        "imu_gap",
        "warning",
        {"imu": Imu(gap_s=(40.0, 42.0))},
        evidence={"total_s": about(2.0, 1e-6)},
    ),
    Fault(
        "logger_dropouts",
        "warning",
        {"dropouts": (Dropout(20.0, 0.3), Dropout(50.0, 0.2), Dropout(500.0, 9.0))},
        evidence={"count": 2.0, "total_s": about(0.5, 1e-9)},
    ),
    Fault(
        "logging_rate_low",
        "warning",
        {"imu": Imu(rate_hz=20.0)},
        evidence={"rate_hz": about(20.0), "needed_hz": 50.0, "topic": "sensor_combined"},
    ),
    Fault(
        "logging_rate_low",
        "warning",
        {"attitude_hz": 5.0},
        evidence={"rate_hz": about(5.0), "needed_hz": 10.0, "topic": "vehicle_attitude"},
    ),
    Fault("input_unavailable", "warning", {"imu": None}, says="constant velocity"),
    Fault("input_unavailable", "warning", {"attitude_hz": None}, says="constant velocity"),
    Fault(
        "log_damaged",
        "warning",
        {"damage": ("the file is damaged, what could be read was used",)},
        evidence={"ends_in_flight": 0.0},
        remedy="SD card",
    ),
    Fault(
        "samples_dropped",
        "info",
        {"notes": ("2 samples of x were dropped: their time stamps are zero or go back",)},
        evidence={"notes": 1.0},
        says="2 samples",
        remedy="The file is whole",
    ),
    Fault("too_few_innovations", "warning", {"duration_s": 1.5}, evidence={"count": 7.0}),
]  # fmt: skip

# An error that another fault brings with it
FOLLOWS = {
    "kf_variance_understated": "sigma_z_small",
    "kf_variance_overstated": "sigma_z_large",
    "source_receipt_jitter": "source_stamps_constant",
    "process_noise_forgotten": "kf_variance_understated",
    "ekf2_rejecting": "ekf2_variance_understated",
}

# What a flight without the field must (not) say: the detector's id and what stands instead
MISSING_FIELD: list[tuple[str, dict[str, Any], str | None]] = [
    ("ekf2_not_fusing", {"ekf2": Estimator(fusing=None)}, None),
    ("ekf2_not_fusing", {"ekf2": None}, "ekf2_unavailable"),
    ("ekf2_fusion_interrupted", {"ekf2": Estimator(fusing=None)}, None),
    ("ekf2_rejecting", {"ekf2": Estimator(innovations_logged=False)}, None),
    ("ekf2_variance_overstated", {"ekf2": Estimator(innovations_logged=False)}, None),
    ("ekf2_variance_understated", {"ekf2": Estimator(innovations_logged=False)}, None),
    ("ekf2_innovations_decimated", {"ekf2": Estimator(innovations_logged=False)}, None),
    ("ekf2_resets", {"ekf2": None}, "ekf2_unavailable"),
    ("ekf2_instance_switch", {"ekf2": None}, "ekf2_unavailable"),
    ("imu_gap", {"imu": None}, "input_unavailable"),
    ("logging_rate_low", {"imu": None}, "input_unavailable"),
    ("logging_rate_low", {"attitude_hz": None}, "input_unavailable"),
    ("source_not_logged", {"parameters": {}}, None),
    ("ekf2_variance_overstated", {"parameters": {}, "ekf2": Estimator(noise_logged=False)}, None),
]


@cache
def clean() -> Comparison:
    return compare(aisle_flight())


def found(comparison: Comparison, *, tuned: bool = False) -> tuple[Finding, ...]:
    """All findings on a comparison that is not explained, each checked for form."""
    analysis = with_noises(comparison) if tuned else unexplained(comparison)
    findings = find(analysis)
    for detector in DETECTORS:
        assert ids(tuple(detector.detect(analysis))) <= set(detector.names)
    for finding in told(findings):
        assert re.fullmatch(r"[a-z0-9_]+", finding.id)
        for text in (finding.message, finding.remedy):
            assert text.strip()
            assert "\n" not in text
            assert text.endswith(".")
            assert not NOT_A_NUMBER.search(text), text
        for value in finding.evidence.values():
            assert isinstance(value, str) or math.isfinite(value)
    return findings


def ids(findings: tuple[Finding, ...]) -> set[str]:
    return {name for finding in findings for name in finding.ids}


def told(findings: tuple[Finding, ...]) -> list[Finding]:
    """Findings, each followed by what it brings with it."""
    return [one for finding in findings for one in (finding, *finding.consequences)]


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_clean_flight_has_no_findings(seed: int) -> None:
    assert found(compare(aisle_flight(seed=seed))) == ()


def test_the_faults_below_cover_every_finding() -> None:
    tested = NAMED_HERE | NAMED_IN_LOOPS | NAMED_AS_CAUSES
    assert set(names()) == {fault.id for fault in FAULTS} | tested


def test_every_file_is_listed() -> None:
    """One that nobody lists would never find anything."""
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    files = modules - {"causes", "model", "story"}
    declared = [
        name for file in files for name in import_module(f"px4fuse.findings.{file}").DETECTOR.names
    ]
    assert len(files) == len(DETECTORS)
    assert sorted(declared) == sorted(names())


def test_what_is_measured_is_declared_well() -> None:
    for detector in DETECTORS:
        assert set(detector.measured_on) <= set(detector.names)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.id}-{fault.severity}")
def test_a_fault_is_named_with_its_evidence_and_no_unrelated_error(fault: Fault) -> None:
    of_noise = "sigma_z_asked_m" in fault.evidence or fault.id == "process_noise_forgotten"
    findings = found(compare(fault.fly(), Settings(**fault.settings)), tuned=of_noise)
    named = [each for each in told(findings) if each.id == fault.id]
    assert named, f"{fault.id} is not among {sorted(ids(findings))}"
    assert named[0].severity == fault.severity
    evidence = named[0].evidence
    assert {name: evidence.get(name) for name in fault.evidence} == fault.evidence
    assert fault.says in named[0].message
    assert fault.remedy in named[0].remedy
    errors = {each.id for each in findings if each.severity == "error"}
    assert errors <= {fault.id, FOLLOWS.get(fault.id)}


@pytest.mark.parametrize(
    ("silent", "flight", "instead"), MISSING_FIELD, ids=lambda value: str(value)[:40]
)
def test_a_missing_field_is_not_guessed(
    silent: str, flight: dict[str, Any], instead: str | None
) -> None:
    named = ids(found(compare(aisle_flight(**flight))))
    assert silent not in named
    assert instead is None or instead in named


@pytest.mark.parametrize("duration_s", [0.4, 2.0])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.id}-{fault.severity}")
def test_a_flight_of_a_moment_does_not_break_a_detector(fault: Fault, duration_s: float) -> None:
    uwb = replace(fault.flight.get("uwb", Uwb()), rate_hz=5.0, gap_s=None)
    short: dict[str, Any] = {"duration_s": duration_s, "uwb": uwb}
    if isinstance(imu := fault.flight.get("imu"), Imu):
        short["imu"] = replace(imu, gap_s=None)
    if fault.id == "source_samples_lost":
        uwb = replace(uwb, rate_hz=10.0)  # of which one in ten is lost
        short["uwb"] = uwb
    comparison = compare(fault.fly(**short), Settings(**fault.settings))
    few = len(next(iter(comparison.axes.values())).replay.updates) < MIN_INNOVATIONS
    assert ("too_few_innovations" in ids(found(comparison))) == few


@pytest.mark.parametrize("detector", DETECTORS, ids=lambda detector: next(iter(detector.names)))
def test_each_detector_alone_is_silent_on_a_clean_flight(detector: Any) -> None:
    assert list(detector.detect(unexplained(clean()))) == []


def test_rejections_that_nobody_knows_are_not_named() -> None:
    ekf2 = Estimator(rejected_share=0.5, rejected_logged=False)
    assert "ekf2_rejecting" not in ids(found(compare(aisle_flight(ekf2=ekf2))))


@pytest.mark.parametrize("axis", ["north", "east", "aisle"])
def test_rejections_are_named_whichever_axis_is_analysed(axis: str) -> None:
    """A rejection is of the whole horizontal vector."""
    flight = aisle_flight(ekf2=Estimator(rejected_share=0.5))
    assert "ekf2_rejecting" in ids(found(compare(flight, axes=(axis,))))


def test_resets_and_switches_outside_the_segment_do_not_count() -> None:
    ekf2 = Estimator(resets=(SIDESTEP,), instances=((-math.inf, 0), (30.0, 1)))
    flight = aisle_flight(ekf2=ekf2, dropouts=(Dropout(20.0, 0.5),))
    named = ids(found(compare(flight, start_s=70.0)))
    assert not named & {"ekf2_resets", "ekf2_instance_switch", "logger_dropouts"}


@pytest.mark.parametrize(("fusing", "named"), [(0.0, True), (1.0, False)])
def test_motion_capture_is_called_not_fused_where_nothing_else_is(
    fusing: float, named: bool
) -> None:
    """EKF2 never takes it; with external vision beside it, it is an independent reference."""
    flight = aisle_flight(
        ekf2=Estimator(fusing=((0.0, fusing),)),
        uwb=Uwb(name="vehicle_mocap_odometry", origin=MOTION_CAPTURE),
    )
    assert ("ekf2_not_fusing" in ids(found(compare(flight)))) is named


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_outliers_are_not_answered_by_raising_the_noise(share: float) -> None:
    flight = aisle_flight(uwb=Uwb(outlier_share=share))
    findings = told(found(compare(flight), tuned=True))
    finding = next(each for each in findings if each.id == "kf_variance_understated")
    assert finding.evidence["outside_gate"] > 0.005
    assert "remove the outliers" in finding.remedy


@pytest.mark.parametrize(
    ("nis", "noise_m", "direction"),
    [
        (3.0, 0.10, "understated"),
        (3.0, 0.20, "understated"),
        (0.3, 0.10, "overstated"),
        (0.3, 0.05, "overstated"),
    ],
)
def test_a_wrong_ekf2_variance_is_not_answered_by_a_noise_that_would_make_it_worse(
    nis: float, noise_m: float, direction: str
) -> None:
    """The source's noise is 0.10 m: where that is not the other side of R, R is not the cause."""
    findings = found(compare(aisle_flight(ekf2=Estimator(nis=nis, noise_m=noise_m))))
    assert ids(findings) == {f"ekf2_variance_{direction}"}
    for finding in findings:
        told = re.search(r"set EKF2_EVP_NOISE to ([0-9.]+\d)", finding.remedy)
        change = float(told[1]) / noise_m if told else None
        assert change is None or (change > 1.2 if nis > 1 else change < 0.8), finding.remedy


def test_an_unknown_ekf2_noise_is_not_printed_as_a_number() -> None:
    flight = aisle_flight(parameters={}, ekf2=Estimator(nis=0.02, noise_logged=False))
    assert "ekf2_variance_overstated" in ids(found(compare(flight)))


def test_process_noise_is_not_called_forgotten_where_it_is_the_lessons() -> None:
    flight = aisle_flight(uwb=Uwb(rate_hz=100.0), duration_s=30.0)
    findings = found(compare(flight, Settings(sigma_a_m_s2=0.5, sigma_z_m=1.0)))
    for finding in findings:
        if finding.id == "process_noise_forgotten":
            assert "--sigma-a 0.5" not in finding.remedy
    assert "kf_variance_overstated" in ids(findings)


def test_a_small_process_noise_that_still_lets_the_variance_grow_is_not_called_forgotten() -> None:
    comparison = compare(aisle_flight(), Settings(sigma_a_m_s2=0.02))
    assert next(iter(comparison.axes.values())).replay.updates["gain_position"].iloc[-1] > 0.05
    assert "process_noise_forgotten" not in ids(found(comparison))


def test_a_variance_is_named_on_the_axis_where_it_is_worst() -> None:
    flight = aisle_flight(ekf2=Estimator(nis=0.2))
    innovations = flight.ekf2.innovations
    worst = innovations["north"].assign(innovation_m=innovations["north"]["innovation_m"] / 5.0)
    ekf2 = replace(flight.ekf2, innovations={**innovations, "north": worst})
    named = told(found(compare(replace(flight, ekf2=ekf2))))
    assert [each.evidence["axis"] for each in named] == ["north", "down"]


def test_innovations_are_not_called_decimated_where_the_source_is_made_of_them() -> None:
    uwb = Uwb(name="estimator_aid_src_ev_pos", origin=KEPT)
    flight = aisle_flight(uwb=uwb, ekf2=Estimator(every=3))
    assert "ekf2_innovations_decimated" not in ids(found(compare(flight)))


class TestSampleLog:
    def test_default_settings_have_no_error_and_no_warning(self, sample_flight: Flight) -> None:
        assert {each.severity for each in found(compare(sample_flight))} <= {"info"}

    def test_process_noise_forgotten(self, sample_flight: Flight) -> None:
        comparison = compare(sample_flight, Settings(sigma_a_m_s2=1e-4))
        finding = next(e for e in found(comparison) if e.id == "process_noise_forgotten")
        assert finding.severity == "error"
        assert finding.evidence["relative_growth"] < 0.02
        assert finding.evidence["gain"] < 0.05

    @pytest.mark.parametrize(("sigma_z", "direction"), [(0.01, "understated"), (1.0, "overstated")])
    def test_wrong_measurement_noise_is_named_and_the_right_one_told(
        self, sample_flight: Flight, sigma_z: float, direction: str
    ) -> None:
        findings = found(compare(sample_flight, Settings(sigma_z_m=sigma_z)), tuned=True)
        named = [each for each in told(findings) if each.id == f"kf_variance_{direction}"]
        assert len(named) == 2  # horizontal, vertical
        for each in named:
            assert each.severity == "error"
            assert each.evidence["sigma_z_asked_m"] == pytest.approx(0.10, rel=0.2)
            typed = re.search(r"--sigma-z ([0-9.]+\d)", each.remedy)
            assert float(typed[1]) == pytest.approx(0.10, rel=0.2)

    def test_typing_the_remedy_removes_the_finding(self, sample_flight: Flight) -> None:
        findings = told(found(compare(sample_flight, Settings(sigma_z_m=0.01)), tuned=True))
        asked = next(e for e in findings if e.id == "kf_variance_understated").evidence
        cured = compare(sample_flight, Settings(sigma_z_m=asked["sigma_z_asked_m"]))
        assert not ids(found(cured)) & {"kf_variance_understated", "kf_variance_overstated"}


@pytest.mark.reallogs
class TestRealLogs:
    @staticmethod
    def findings(shared_logs: Path, pattern: str) -> dict[str, Finding]:
        (path,) = shared_logs.glob(pattern)
        return {
            each.id: each for each in reversed(told(found(compare(read_log(path)), tuned=True)))
        }

    def test_overconfident_ekf2_is_told_the_true_noise(self, shared_logs: Path) -> None:
        findings = self.findings(shared_logs, "simulated/*_aisle_overconfident.ulg")
        understated = findings["ekf2_variance_understated"]
        assert understated.severity == "error"
        assert understated.evidence["nis_mean"] == pytest.approx(22.0, rel=0.2)
        assert understated.evidence["sigma_z_asked_m"] == pytest.approx(0.10, rel=0.2)
        rejecting = findings["ekf2_rejecting"]
        assert rejecting.severity == "error"
        assert rejecting.evidence["rejected_share"] == pytest.approx(0.5, abs=0.1)

    def test_a_2_hz_source_is_never_fused_and_the_rule_is_told(self, shared_logs: Path) -> None:
        finding = self.findings(shared_logs, "simulated/*_aisle_2hz_stock.ulg")["ekf2_not_fusing"]
        assert finding.severity == "error"
        assert finding.evidence["fusing_share"] == 0.0
        assert finding.evidence["source_interval_s"] == pytest.approx(0.5, rel=0.05)
        assert "less than 0.2 s apart" in finding.message
        assert "10 Hz" in finding.remedy

    def test_a_gap_and_its_reset_are_named(self, shared_logs: Path) -> None:
        findings = self.findings(shared_logs, "simulated/*_aisle_nlos.ulg")
        assert findings["source_gap"].evidence["longest_s"] == pytest.approx(8.0, abs=0.3)
        assert findings["ekf2_resets"].severity == "warning"
        gap = findings["source_gap"].evidence
        end_of_gap = gap["at_s"] + gap["longest_s"]
        assert findings["ekf2_resets"].evidence["at_s"] == pytest.approx(end_of_gap, abs=2.0)
        assert "remove the outliers" in findings["kf_variance_understated"].remedy

    def test_the_default_logging_profile_is_named(self, shared_logs: Path) -> None:
        findings = self.findings(shared_logs, "simulated/*_aisle_hwlog.ulg")
        assert "SDLOG_PROFILE to 129" in findings["source_not_logged"].remedy
        assert findings["source_decimated"].evidence["logger_limit_hz"] == 2.0

    @pytest.mark.parametrize("version", ["v1.14.4", "v1.16.1"])
    def test_a_nominal_flight_has_no_error_and_no_warning(
        self, shared_logs: Path, version: str
    ) -> None:
        findings = self.findings(shared_logs, f"simulated/{version}_aisle_nominal.ulg")
        assert {finding.severity for finding in findings.values()} <= {"info"}

    @pytest.mark.parametrize("name", ["log_3", "min_snap_01", "square2", "battery_brownout"])
    def test_motion_capture_flights_overstate_the_variance_and_nobody_is_blamed(
        self, shared_logs: Path, name: str
    ) -> None:
        """Sent with an orientation, as odometry is; all noises are the programs' own."""
        findings = self.findings(shared_logs, f"real/*{name}*.ulg")
        assert findings["ekf2_variance_overstated"].evidence["variance_factor"] > 4.0
        assert "ekf2_variance_understated" not in findings
        assert findings["source_may_drift"].ids[1:] == (
            *["kf_variance_overstated"] * 2, *["ekf2_variance_overstated"] * 2,
        )  # fmt: skip
        assert not [name for name, each in findings.items() if each.severity == "error"]

    def test_dropouts_of_a_real_logger_are_named(self, shared_logs: Path) -> None:
        findings = self.findings(shared_logs, "real/mengchaoheng*test3.ulg")
        assert findings["logger_dropouts"].evidence["total_s"] == pytest.approx(0.82, abs=0.05)
        assert findings["imu_gap"].evidence["total_s"] == pytest.approx(0.82, abs=0.1)


def test_findings_are_ordered_by_severity_and_the_recording_before_noises() -> None:
    flight = aisle_flight(
        ekf2=Estimator(nis=0.02, noise_m=0.7, every=3), uwb=Uwb(gap_s=(40.0, 48.0))
    )
    findings = found(compare(flight))
    assert {finding.severity for finding in findings} == set(SEVERITIES)
    # what the recording lacks before an error of a noise
    assert [finding.id for finding in findings] == [
        "source_gap", "ekf2_variance_overstated", "ekf2_innovations_decimated",
    ]  # fmt: skip


@pytest.mark.parametrize("sigma_a", [0.02, 0.05, 0.1])
def test_process_noise_too_small_is_answered_by_more_of_it(sigma_a: float) -> None:
    """Q too small looks like R too small to the NIS; the correlation tells them apart."""
    compared = compare(aisle_flight(imu=Imu(sigma_a_m_s2=2.0)), Settings(sigma_a_m_s2=sigma_a))
    found = told(find(with_noises(compared)))
    (finding,) = [f for f in found if f.id == "kf_variance_understated" and "horiz" in f.message]
    assert "raise SIGMA_A" in finding.remedy
    assert "--sigma-z" not in finding.remedy
