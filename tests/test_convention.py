"""Checks of axes, unit, clock and orientation of a position source with known errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache

import numpy as np
import pandas as pd
import pytest
from comparisons import prepare
from conftest import shared
from exchange import replace
from flights import given_placement

from px4fuse.comparison.model import Comparison
from px4fuse.convention.axes import CLOCKWISE_DIRECTIONS, METRES_PER_UNIT, SIGNED_AXIS_PERMUTATIONS
from px4fuse.convention.check import determine_source_convention
from px4fuse.convention.correction import ConventionFaults, find_convention_faults
from px4fuse.convention.model import AxisDirections, Convention, OrientationConvention
from px4fuse.diagnose import prepare_comparison, refine_delay
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.finding import Finding
from px4fuse.findings import source_convention
from px4fuse.findings.model import WRONG_CONVENTION_KEY, finding
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    GNSS_ORIGIN,
    Columns,
    Flight,
    PositionTrack,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario
from px4fuse.trajectory.rotation import from_rotation_vector, interpolate, multiply

UNIT_VECTORS = {
    "north": (1, 0, 0), "south": (-1, 0, 0), "east": (0, 1, 0), "west": (0, -1, 0),
    "down": (0, 0, 1), "up": (0, 0, -1),
}  # fmt: skip
ALL_AXES = [
    assignment.compute_axis_directions(quarter)
    for assignment in SIGNED_AXIS_PERMUTATIONS
    for quarter in range(4)
]
ENU, NWU = ("east", "north", "up"), ("north", "west", "up")
# Rotations of NED to ENU and NWU, and of FRD to FLU
NED_TO = {"ENU": (0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0), "NWU": (0.0, 1.0, 0.0, 0.0)}
CASES = {
    "frame_turned": ("case03.ulg", {"rotation_deg": 30.0}),
    "yaw_90_off": ("case04.ulg", {"heading_error_deg": 90.0}),
    "quaternion_order": ("case05.ulg", {"order": "x y z w"}),
    "orientation_copied": ("case06.ulg", {"verdict": "copied"}),
}
FLOWN = {
    "clean_uwb": {},
    "clean_mocap": {},
    "enu_uwb": {"x": "east", "y": "north", "z": "up"},
    "enu_beside_gnss": {"x": "east", "y": "north", "z": "up"},
    "nwu_vio": {"y": "west", "z": "up"},
    "z_up": {"z": "up", "is_mirrored": True},
    "centimetres": {"unit": "cm"},
    "late_400": {"late_s": 0.4},
    "yaw_90_off": {"heading_error_deg": 90.0},
    "quaternion_xyzw": {"order": "x y z w"},
    "orientation_copied": {"verdict": "copied"},
    "frozen_10s": {},
    "relocalised": {},
    "stops_in_flight": {},
}
TOLERANCES = {"rotation_deg": 4.0, "heading_error_deg": 4.0, "late_s": 0.06, "clock_drift": 0.002}


@cache
def flown(seed: int = 3, *mistakes: str) -> Flight:
    return simulate_flight(Scenario(seed=seed, kind="loop", passes=2), parse_faults(mistakes))


def sent(
    flight: Flight,
    axes: AxisDirections = ("north", "east", "down"),
    unit: str = "m",
    rotation_deg: float = 0.0,
    late_s: float = 0.0,
    clock_drift: float = 0.0,
    sigma_m: float = 0.05,
    seed: int = 1,
) -> PositionTrack:
    """Return positions made of ground truth: other axes, rotated, scaled, with wrong timestamps."""
    truth = flight.truth.samples[Columns.POSITION]
    time = np.arange(truth.index[0] + 0.3, truth.index[-1] - 0.3, 0.1)
    true = np.column_stack([np.interp(time, truth.index, column) for column in truth.to_numpy().T])
    true += np.random.default_rng(seed).normal(0.0, sigma_m, true.shape)
    cosine, sine = np.cos(np.radians(rotation_deg)), np.sin(np.radians(rotation_deg))
    true = true @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    position = true @ np.array([UNIT_VECTORS[name] for name in axes]).T / METRES_PER_UNIT[unit]
    stamps = time + late_s + clock_drift * (time - time.mean())
    samples = pd.DataFrame(position, pd.Index(stamps, name="time_s"), Columns.POSITION)
    samples = samples.reindex(columns=Columns.POSITION + Columns.POSITION_VARIANCE)
    return PositionTrack("made", AS_RECEIVED_ORIGIN, "", samples, "NED", "", ())


def reclassify_as_vio(track: PositionTrack, quaternion: np.ndarray, time: np.ndarray):
    table = pd.DataFrame(quaternion, pd.Index(time, name="time_s"), Columns.QUATERNION)
    return replace(track, orientation=table)


def oriented(flight: Flight, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return times and attitudes, FRD to NED, with noise of 0.3°."""
    attitude = flight.attitude[Columns.QUATERNION].iloc[::5]
    rng = np.random.default_rng(seed)
    noise = from_rotation_vector(np.radians(rng.normal(0.0, 0.3, (len(attitude), 3))))
    return attitude.index.to_numpy(), multiply(attitude.to_numpy(), noise)


def yaw(degrees: float) -> np.ndarray:
    return from_rotation_vector(np.array([0.0, 0.0, np.radians(degrees)]))


def assert_found(convention: Convention, **expected: object) -> None:
    """Compare fields of a convention and of its orientation; other fields are as PX4 expects."""
    assert convention.verdict == "determined", convention
    usual = {"x": "north", "y": "east", "z": "down", "unit": "m", "clock_drift": 0.0}
    orientation = convention.orientation or OrientationConvention(verdict="determined")
    for name, value in {**usual, **expected}.items():
        owner = convention if hasattr(convention, name) and name != "verdict" else orientation
        found = getattr(owner, name)
        is_number = isinstance(value, float)
        assert found == (pytest.approx(value, abs=TOLERANCES[name]) if is_number else value), name


@pytest.mark.parametrize("index", range(0, len(ALL_AXES), 5))
def test_frame_detection_finds_axes_unit_and_time_offset(index):
    rng = np.random.default_rng(index)
    axes, unit = ALL_AXES[index], [*METRES_PER_UNIT][index % 4]
    late_s = float(rng.uniform(-8.0, 8.0))
    found = determine_source_convention(
        flown(), sent(flown(), axes, unit, late_s=late_s, seed=index)
    )
    assert_found(found, **dict(zip("xyz", axes, strict=True)), unit=unit, late_s=late_s)


@pytest.mark.parametrize("rotation_deg", [-170.0, -60.0, 25.0, 45.0, 100.0])
def test_frame_detection_finds_yaw_rotation_of_positions(rotation_deg):
    found = determine_source_convention(flown(), sent(flown(), rotation_deg=rotation_deg))
    quarter = CLOCKWISE_DIRECTIONS.index(found.x)
    assert not found.is_mirrored
    total = found.rotation_deg - 90.0 * quarter
    assert (total - rotation_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=4.0)


def test_vision_rotation_is_relative_to_gnss_at_wrong_ekf2_yaw():
    attitude = flown().attitude.copy()
    attitude[Columns.QUATERNION] = multiply(yaw(-14.0), attitude[Columns.QUATERNION].to_numpy())
    gnss = replace(sent(flown(), late_s=0.2, sigma_m=0.3, seed=2), origin=GNSS_ORIGIN)
    no_ekf2 = Unavailable("EKF2", "not logged", "")
    flight = replace(flown(), attitude=attitude, positions=(gnss,), ekf2=no_ekf2)
    found = determine_source_convention(flight, sent(flown(), rotation_deg=60.0))
    assert find_convention_faults(found, flight, "NED").rotation_deg == pytest.approx(60.0, abs=2.0)


@pytest.mark.parametrize("clock_drift", [-0.04, -0.01, 0.02])
def test_frame_detection_also_estimates_position_clock_drift(clock_drift):
    found = determine_source_convention(flown(), sent(flown(), clock_drift=clock_drift, late_s=1.0))
    assert_found(found, clock_drift=clock_drift)


def test_frame_detection_of_ned_positions_gives_ned_and_metres():
    track = flown().positions[0]
    found = determine_source_convention(flown(), track)
    assert_found(found)
    assert abs(found.late_s) < 0.05
    assert found.rotation_deg == 0.0
    assert found.scale == pytest.approx(1.0, abs=0.1)  # odometry drifts


def test_frame_detection_on_pure_noise_is_undetermined():
    track = sent(flown())
    noise = np.random.default_rng(2).normal(0.0, 0.3, (len(track.samples), 3))
    samples = track.samples.assign(**dict(zip(Columns.POSITION, noise.T, strict=True)))
    assert (
        determine_source_convention(flown(), replace(track, samples=samples)).verdict
        == "not determinable"
    )


def test_frame_detection_ignores_repeated_positions():
    track = sent(flown())
    samples = track.samples.copy()
    samples.iloc[200:260] = samples.iloc[199].to_numpy()
    assert_found(determine_source_convention(flown(), replace(track, samples=samples)))


def test_frame_detection_without_height_finds_horizontal_axes():
    track = sent(flown())
    samples = track.samples.assign(down_m=np.nan)
    assert_found(determine_source_convention(flown(), replace(track, samples=samples)))


@pytest.mark.parametrize("frames", ["ENU", "NWU"])
def test_frame_detection_finds_orientation_sent_as_flu_to_enu(frames):
    time, attitude = oriented(flown())
    quaternion = multiply(multiply(np.array(NED_TO[frames]), attitude), np.array(NED_TO["NWU"]))
    track = reclassify_as_vio(sent(flown(), ENU if frames == "ENU" else NWU), quaternion, time)
    found = determine_source_convention(flown(), track).orientation
    assert found.frames == f"FLU to {frames}"
    assert abs(found.heading_error_deg) < 3.0


@pytest.mark.parametrize("error_deg", [-90.0, 45.0, 180.0])
def test_frame_detection_finds_heading_error_of_orientation(error_deg):
    time, attitude = oriented(flown())
    track = reclassify_as_vio(sent(flown()), multiply(yaw(error_deg), attitude), time)
    found = determine_source_convention(flown(), track).orientation
    assert found.frames == "FRD to NED"
    difference = (found.heading_error_deg - error_deg + 180.0) % 360.0 - 180.0
    assert difference == pytest.approx(0.0, abs=3.0)


def test_frame_detection_finds_quaternion_order_x_y_z_w():
    found = determine_source_convention(flown(), w_last(flown())).orientation
    assert (found.verdict, found.order) == ("determined", "x y z w")


def test_orientation_copied_from_ekf2_is_detected():
    assert determine_source_convention(flown(), copied(flown())).orientation.verdict == "copied"


def copied(flight: Flight) -> PositionTrack:
    """Return positions with the attitude of the autopilot, 0.03 s later."""
    attitude = flight.attitude
    time = np.arange(attitude.index[0] + 1.0, attitude.index[-1], 0.1)
    quaternions = attitude[Columns.QUATERNION].to_numpy()
    sent_back = interpolate(time - 0.03, attitude.index.to_numpy(), quaternions)
    return reclassify_as_vio(sent(flight), sent_back, time)


def w_last(flight: Flight) -> PositionTrack:
    time, attitude = oriented(flight)
    return reclassify_as_vio(sent(flight), np.roll(attitude, -1, axis=1), time)


def turned(flight: Flight) -> PositionTrack:
    time, attitude = oriented(flight)
    return reclassify_as_vio(sent(flight), multiply(yaw(90.0), attitude), time)


# By id of the finding, and kind of the fault
CONVENTION_FAULTS = {
    ("source_axes_wrong", "axes"): lambda flight: sent(flight, ENU),
    ("source_unit_wrong", "unit"): lambda flight: sent(flight, unit="cm"),
    ("source_frame_misaligned", "rotation"): lambda flight: sent(flight, rotation_deg=60.0),
    ("source_time_offset", "time offset"): lambda flight: sent(flight, late_s=1.5),
    ("source_time_offset_changes", "clock drift"): lambda flight: sent(flight, clock_drift=0.02),
    ("source_orientation_wrong", "order"): w_last,
    ("source_orientation_wrong", "heading"): turned,
    ("source_orientation_copied", "copied"): copied,
}


def compared(track: PositionTrack) -> Comparison:
    """Return the prepared comparison of a flight that EKF2 flew with other positions."""
    usual = [one for one in flown().positions if not one.origin.is_selectable_by_default]
    return prepare(replace(flown(), positions=(track, *usual)))


def examples() -> Iterator[Finding]:
    """Return examples of the findings about the convention, for their pages."""
    for change in CONVENTION_FAULTS.values():
        yield from source_convention.detect(compared(change(flown())))
    unclear = replace(compared(sent(flown())), convention=AMBIGUOUS)
    yield from source_convention.detect(unclear)


AMBIGUOUS = Convention(
    verdict="ambiguous", x="east", y="north", z="up", log_odds=1.2, log_likelihood_gain=30.0,
    alternatives=("x south, y west, z up (metres), axes rotated by +12°",),
)  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), CONVENTION_FAULTS)
def test_wrong_position_convention_is_the_only_reported_fault(name, kind):
    found = list(source_convention.detect(compared(CONVENTION_FAULTS[name, kind](flown()))))
    assert [(one.id, one.evidence[WRONG_CONVENTION_KEY]) for one in found] == [(name, kind)]


@pytest.mark.parametrize(
    "name", [name for name, _ in CONVENTION_FAULTS if "orientation" not in name]
)
def test_compare_converts_positions_in_wrong_frame_to_ned(name):
    track = next(CONVENTION_FAULTS[one](flown()) for one in CONVENTION_FAULTS if one[0] == name)
    samples, truth = compared(track).source.samples, flown().truth.samples
    error = [
        samples[column] - np.interp(samples.index, truth.index, truth[column])
        for column in Columns.POSITION
    ]
    assert np.std(error, axis=1).max() < 0.25


def test_compare_ignores_orientation_copied_from_ekf2():
    source = compared(copied(flown())).source
    assert source.orientation is None
    assert source.origin.kind == "uwb"


def test_positions_in_correct_ned_frame_give_no_frame_fault():
    assert not list(source_convention.detect(prepare(flown())))
    assert not list(source_convention.detect(compared(sent(flown()))))


def test_report_on_enu_orientation_contains_conversion_to_ned():
    time, attitude = oriented(flown())
    quaternion = multiply(multiply(np.array(NED_TO["ENU"]), attitude), np.array(NED_TO["NWU"]))
    (found,) = source_convention.detect(
        compared(reclassify_as_vio(sent(flown()), quaternion, time))
    )
    assert found.evidence[WRONG_CONVENTION_KEY] == "frames"
    assert "q_NED = (0, √½, √½, 0) ⊗ q ⊗ (0, 1, 0, 0)" in found.remedy


def fused(flight: Flight) -> Flight:
    """Return a flight in which EKF2 fused the position and the yaw of the source."""
    fusing = pd.DataFrame({"horizontal": [1.0], "vertical": [0.0], "yaw": [1.0]}, index=[0.0])
    return replace(flight, ekf2=replace(flight.ekf2, fusion_flags=fusing))


@pytest.mark.parametrize(("axes", "rotation_deg", "expected"), [
    (
        ("west", "south", "up"), 20.0,
        ConventionFaults(has_wrong_axes=True, affects_ekf2=True, is_north_unknown=True),
    ),
    (("west", "north", "down"), -32.0, ConventionFaults()),
])  # fmt: skip
def test_vision_rotation_is_no_fault_if_ekf2_fuses_vision_yaw(axes, rotation_deg, expected):
    convention = Convention(
        verdict="determined", **dict(zip("xyz", axes, strict=True)), rotation_deg=rotation_deg,
        heading_from="gyroscopes", orientation=OrientationConvention(verdict="determined",
        frames="FLU to ENU" if axes[2] == "up" else "FRD to NED"),
    )  # fmt: skip
    assert find_convention_faults(convention, fused(flown()), "NED") == expected


def test_yaw_rotation_of_positions_in_frd_is_not_a_fault():
    convention = Convention(verdict="determined", x="west", y="north", rotation_deg=-32.0)
    assert not find_convention_faults(convention, flown(), "FRD")
    assert find_convention_faults(convention, flown(), "NED").rotation_deg == pytest.approx(58.0)


@pytest.mark.parametrize(("estimate_s", "reported_s"), [(-0.55, 0.55), (-0.48, 0.52)])
def test_late_timestamps_report_states_maximum_likelihood_delay(estimate_s, reported_s):
    late = Convention(verdict="determined", late_s=0.52)
    comparison = replace(compared(sent(flown())), convention=late)
    clock = SourceTimeOffset(
        offset_s=estimate_s, interval_s=(estimate_s - 0.01, estimate_s + 0.01), sigma_s=0.005,
        applied_s=-0.52, is_determinable=True, parts=(), count=100,
    )  # fmt: skip
    (found,) = source_convention.detect(refine_delay(comparison, clock))
    assert found.id == "source_time_offset"
    assert f"are {reported_s:.2f} s late" in found.message
    unclear = replace(clock, is_determinable=False)
    assert refine_delay(comparison, unclear) is comparison


@pytest.mark.parametrize(
    ("late_s", "expected"), [(0.003, "correct"), (-0.3, "0.30 s early"), (0.3, "0.30 s late")]
)
def test_report_on_clock_drift_states_if_timestamps_are_late(late_s: float, expected: str) -> None:
    drifting = Convention(verdict="determined", late_s=late_s, clock_drift=0.02)
    comparison = replace(compared(sent(flown())), convention=drifting)
    (found,) = source_convention.detect(comparison)
    assert f"In the middle of the flight the timestamps are {expected}. " in found.message


@pytest.mark.parametrize("time_constant_s", [0.7, 1.5])
def test_low_pass_filtered_positions_are_not_reported_as_late(time_constant_s: float) -> None:
    track = sent(flown())
    position_m = track.samples[Columns.POSITION].to_numpy(copy=True)
    for row in range(1, len(position_m)):
        position_m[row] += np.exp(-0.1 / time_constant_s) * (position_m[row - 1] - position_m[row])
    filtered = track.samples.assign(**dict(zip(Columns.POSITION, position_m.T, strict=True)))
    convention = determine_source_convention(flown(), replace(track, samples=filtered))
    assert convention.verdict == "determined"
    assert abs(convention.late_s) < 0.3 * time_constant_s
    delayed = determine_source_convention(flown(), sent(flown(), late_s=time_constant_s))
    assert delayed.late_s == pytest.approx(time_constant_s, abs=0.1)


def test_compare_note_on_automatic_clock_offset_states_its_value():
    late = replace(flown(), positions=(sent(flown(), late_s=0.7),))
    request = ComparisonRequest(log="made", clock_offset_s="auto", axes=("north", "east"))
    prepared = prepare_comparison(late, request)
    assert prepared.settings.clock_offset_s == pytest.approx(-0.7, abs=0.02)
    notes = " ".join(prepared.notes[-2:])
    remaining_s, applied_s = map(float, re.findall(r"([+-]\d\.\d+) s(?: \(95|$)", notes))
    assert abs(remaining_s) < 0.1
    assert applied_s == pytest.approx(prepared.settings.clock_offset_s, abs=0.001)


def test_report_on_ambiguous_position_axes_lists_possible_axes():
    (found,) = source_convention.detect(replace(compared(sent(flown())), convention=AMBIGUOUS))
    assert found.id == "source_convention_ambiguous"
    assert "rotated by +12°" in found.message


@pytest.mark.parametrize(("axes", "message", "remedy"), [
    (("north", "east", "up"), "The position axes are not ENU: x is east, y north, z down",
     "north = y, east = x, down = z"),
    (("west", "north", "down"), "NWU positions read as ENU: x is north, y west, z up",
     "frame nwu."),
])  # fmt: skip
def test_report_on_wrong_position_file_frame_names_true_frame(axes, message, remedy):
    """The axes are those of positions that were converted from ENU."""
    alignment = replace(given_placement(), frame="enu")
    (found,) = source_convention.detect(compared(replace(sent(flown(), axes), alignment=alignment)))
    assert found.message.startswith(message)
    assert remedy in found.remedy


def test_ekf2_rejection_report_names_wrong_axes_as_cause():
    comparison = compared(sent(flown(), ENU))
    roots = list(source_convention.detect(comparison))
    other = finding("error", "ekf2_rejects_positions", "EKF2 rejects 9 %. Why.", "Set a gate.")
    false = finding("error", "ekf2_noise_too_small", "Too small.", "Set EKF2_EVP_NOISE to 1.")
    root, effect = source_convention.remove_convention_effects(comparison, [false, other, *roots])
    assert root.id == "source_axes_wrong"
    assert (effect.caused_by, effect.message) == ("source_axes_wrong", "EKF2 rejects 9 %.")


def test_time_offset_is_not_reported_if_clock_drift_is_reported():
    comparison = compared(sent(flown(), clock_drift=0.02))
    roots = list(source_convention.detect(comparison))
    rest = finding("warning", "source_time_offset", "Late.", "Run again.")
    assert source_convention.remove_convention_effects(comparison, [rest, *roots]) == roots


@pytest.mark.reallogs
@pytest.mark.parametrize("name", FLOWN)
def test_frame_detection_on_sitl_log_finds_known_frame(name):
    flight = read_log(shared("logs/conventions") / f"{name}.ulg")
    found = determine_source_convention(flight, flight.positions[0])
    expected = dict(FLOWN[name])
    if name in ("yaw_90_off", "quaternion_xyzw"):  # the frame refers to EKF2's wrong heading
        expected |= {"x": found.x, "y": found.y}
    assert_found(found, **expected)


@pytest.mark.reallogs
@pytest.mark.parametrize("name", CASES)
def test_frame_detection_on_recorded_logs_finds_known_frame(name):
    file, expected = CASES[name]
    flight = read_log(shared("cases") / file)
    track = next(one for one in flight.positions if one.name == "vehicle_visual_odometry")
    assert_found(determine_source_convention(flight, track), **expected)


def test_frame_detection_without_heights_keeps_north_and_east() -> None:
    flight = simulate_flight(Scenario(seed=5), parse_faults(["no-vvo"]))
    prepared = prepare(flight)
    assert prepared.source.samples[Columns.POSITION[:2]].notna().all(axis=None)
    assert prepared.source.samples["down_m"].isna().all()
    convention = prepared.convention
    assert convention is None or convention.z in ("down", "up")
