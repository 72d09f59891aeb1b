"""Alignment of external position files with flights, for known clocks, frames and yaws."""

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import flights
import numpy as np
import pandas as pd
import pytest
from exchange import replace
from flights import Estimator, Imu, Span, Uwb, aisle_flight, table, unavailable
from hypothesis import given, settings
from hypothesis import strategies as st

from px4fuse.alignment.placement import align_position_file
from px4fuse.alignment.tracks import EKF2_REFERENCE, IMU_REFERENCE
from px4fuse.core.arrays import Array
from px4fuse.diagnose import diagnose
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight.model import (
    POSITION_FILE_ORIGIN,
    Alignment,
    Columns,
    Flight,
    InputFile,
    PositionTrack,
    Reset,
)
from px4fuse.readers import read_log
from px4fuse.readers.position_file import SAMPLE_COLUMNS, PositionRecording, read_position_file
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

BOOT_S = 2416.25
OFFSET_S = -1795251250.2  # boot clock minus a UNIX clock
# x, y, z of the file from north, east, down; independent of the code under test
FROM_NED: dict[str, Any] = {
    "ned": lambda n, e, d: (n, e, d),
    "enu": lambda n, e, d: (e, n, -d),
    "nwu": lambda n, e, d: (n, -e, -d),
}


# Start time (s) of each pass along the aisle: share of the aisle's length at its end
PASSES = {6: 1.0, 18: 0.25, 27: 0.8, 41: 0, 52: 0.9, 66: 0.1, 75: 0.7, 90: 0.3, 104: 1, 112: 0.5}
PASS_S = 6.0


def smooth_step(time_s: Array) -> Array:
    """Minimum-jerk motion from 0 to 1."""
    u = np.clip(time_s / PASS_S, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def passes(time_s: Array, heading_deg: float, length_m: float, across_m: float = 0.2) -> Array:
    """Return positions of different passes along the aisle; shape (n, 3), NED."""
    along, lever_arm_m = 0.0 * time_s, 0.0
    for start_s, share in PASSES.items():
        along += (share * length_m - lever_arm_m) * smooth_step(time_s - start_s)
        lever_arm_m = share * length_m
    across = across_m * np.sin(time_s / 2.3)
    c, s = np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))
    down = -1.5 * smooth_step(time_s)
    return np.stack([c * along - s * across, s * along + c * across, down], axis=1)


def flight_along(path: Any = passes, *, boot_s: float = BOOT_S, **parts: Any) -> Flight:
    """Simulate a flight on this path; that of aisle_flight is periodic."""

    def motion(time_s: Array, heading_deg: float, length_m: float) -> tuple[Array, Array, Array]:
        h = 1e-3
        before, now, after = (path(time_s + dt, heading_deg, length_m) for dt in (-h, 0.0, h))
        return now, (after - before) / (2.0 * h), (after - 2.0 * now + before) / h**2

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "motion", motion)
        flight = aisle_flight(**parts)
    return replace(flight, log=replace(flight.log, boot_time_s=boot_s))


def position_file(
    time_s: Array, xyz_m: Array, *, sigma_m: Any = np.nan, frame: str | None = None
) -> PositionRecording:
    values = np.full((len(time_s), len(SAMPLE_COLUMNS)), np.nan)
    values[:, :3], values[:, 3:6] = xyz_m, sigma_m
    return PositionRecording(
        name="uwb.csv", sha256="f" * 64, size_bytes=1234, clock_kind="UNIX",
        frames=(frame,) if frame else (),
        samples=table(time_s, values, SAMPLE_COLUMNS), format_detection_notes=("time: column 1",),
        notes=("two rows dropped",),
    )  # fmt: skip


def uwb_file(
    flight: Flight, *, offset_s: float = OFFSET_S, frame: str = "enu", yaw_deg: float = 0.0,
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0), **made: Any,
) -> PositionRecording:  # fmt: skip
    """Write the flight's UWB positions with another clock and in another frame."""
    samples = flight.positions[0].samples
    n, e, d = (samples[Columns.POSITION].to_numpy() - origin_m).T
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    xyz = np.stack(FROM_NED[frame](c * n + s * e, c * e - s * n, d), axis=1)
    return position_file(samples.index.to_numpy() + flight.log.boot_time_s - offset_s, xyz, **made)


def align(
    flight: Flight, file: PositionRecording, **options: Any
) -> tuple[Alignment, PositionTrack]:
    track = align_position_file(flight, file, **options).positions[0]
    return track.alignment, track


def clock_error_s(
    alignment: Alignment, true_s: float = OFFSET_S, sigma_s: Span = (0.0, np.inf)
) -> float:
    """Return the error of the clock offset (s); check that its σ is between two bounds."""
    assert sigma_s[0] < alignment.clock_offset_sigma_s < sigma_s[1]
    return abs(alignment.clock_offset_s - true_s)


def yaw_difference_deg(one_deg: float, other_deg: float) -> float:
    """Return the absolute difference of two yaws."""
    return abs((one_deg - other_deg + 180.0) % 360.0 - 180.0)


def assert_same_track(track: PositionTrack, expected: PositionTrack, tolerance_m: float) -> None:
    difference = track.samples[Columns.POSITION].to_numpy() - expected.samples[Columns.POSITION]
    assert np.abs(difference.to_numpy()).max() < tolerance_m


@pytest.fixture(scope="module")
def flight() -> Flight:
    return flight_along()


@pytest.fixture(scope="module")
def external(sample_log: Path) -> PositionRecording:
    return read_position_file(sample_log.with_name("aisle_uwb_external.csv"))


@pytest.fixture(scope="module")
def true_offset_s(sample_flight: Flight, external: PositionRecording) -> float:
    """Boot clock minus the file's clock, from positions that both contain."""
    logged = sample_flight.positions[0].samples
    places = logged[["east_m", "north_m"]].round(3).itertuples(index=False, name=None)
    time_of = dict(zip(places, logged.index, strict=True))
    offsets = [
        time_of[x, y] + sample_flight.log.boot_time_s - stamp
        for stamp, x, y in external.samples[["x_m", "y_m"]].itertuples(name=None)
        if (x, y) in time_of
    ]
    assert len(offsets) > 500
    assert np.ptp(offsets) < 2e-3
    return float(np.median(offsets))


# -- the sample flight -----------------------------------------------------------------------------


def test_align_position_file_detects_frame_and_time_offset(
    sample_flight, external, true_offset_s
) -> None:
    alignment, track = align(sample_flight, external)
    assert alignment.frame == "enu"
    assert "smallest residual against the EKF2 position" in alignment.frame_reason
    assert alignment.reference == EKF2_REFERENCE
    assert alignment.yaw_deg == 0.0
    assert alignment.yaw_sigma_deg is None
    assert alignment.origin_m == (0.0, 0.0, 0.0)
    error = clock_error_s(alignment, true_offset_s, (0.003, 0.03))
    assert error < min(0.03, 3.0 * (alignment.clock_offset_sigma_s or 0.0))
    assert alignment.correlation == pytest.approx(0.9994, abs=3e-4)
    assert alignment.residual_rms_m == pytest.approx(0.115, abs=0.01)
    assert alignment.misplaced == alignment.warnings == ()
    assert len(track.samples) == len(external.samples)
    assert track.samples[Columns.POSITION_VARIANCE].isna().to_numpy().all()


# -- synthetic flights -----------------------------------------------------------------------------


@settings(max_examples=20)
@given(
    seed=st.integers(0, 3),
    frame=st.sampled_from(sorted(FROM_NED)),
    frame_given=st.booleans(),
    offset_s=st.floats(-2e9, 2e9),
    yaw_deg=st.floats(-179.0, 179.0),
    origin_m=st.tuples(*[st.floats(-8.0, 8.0)] * 3),
)
def test_align_position_file_recovers_time_offset_frame_and_yaw(
    seed, frame, frame_given, offset_s, yaw_deg, origin_m
):
    flight = flight_along(seed=seed)
    file = uwb_file(flight, offset_s=offset_s, frame=frame, yaw_deg=yaw_deg, origin_m=origin_m)
    alignment, track = align(flight, file, frame=frame if frame_given else None, yaw_deg="auto")
    if frame_given:
        assert yaw_difference_deg(alignment.yaw_deg, yaw_deg) < 0.5
        np.testing.assert_allclose(alignment.origin_m, origin_m, atol=0.05)
    else:
        assert alignment.frame == {"ned": "ned"}.get(frame, "enu")
        assert ("; nwu was not tested" in alignment.frame_reason) is (frame != "ned")
    assert_same_track(track, flight.positions[0], 0.1)
    assert clock_error_s(alignment, offset_s, (5e-4, 0.02)) < 0.03
    assert alignment.misplaced == alignment.warnings == ()


def test_position_file_time_and_yaw_errors_match_reported_sigma() -> None:
    clock, yaw = [], []
    for seed in range(24):
        flight = flight_along(seed=seed, duration_s=60.0)
        alignment, _ = align(flight, uwb_file(flight), frame="enu", yaw_deg="auto")
        clock.append((alignment.clock_offset_s - OFFSET_S) / (alignment.clock_offset_sigma_s or 0))
        yaw.append(alignment.yaw_deg / (alignment.yaw_sigma_deg or 0))
    # 95 % of the root mean squares of 24 normal variables lie between 0.72 and 1.28
    assert 0.65 < np.sqrt(np.mean(np.square(clock))) < 1.4
    assert 0.65 < np.sqrt(np.mean(np.square(yaw))) < 1.4


@pytest.mark.parametrize("frame", sorted(FROM_NED))
def test_align_position_file_takes_frame_from_column_names(flight: Flight, frame: str) -> None:
    file = uwb_file(flight, frame=frame)
    alignment, track = align(flight, file)
    assert alignment.frame == frame
    assert alignment.frame_reason.startswith(
        f"{frame} is the tested frame with the smallest residual against the EKF2 position "
        f"({frame} 0.1"
    )
    assert_same_track(track, flight.positions[0], 1e-9)
    alignment, _ = align(flight, replace(file, frames=(frame,) if frame else ()))
    assert alignment.frame == frame
    assert (
        alignment.frame_reason
        == "the column names of the position file contain the axis directions"
    )


def test_frame_of_position_file_on_45_degree_path_must_be_given() -> None:
    flight = flight_along(partial(passes, across_m=0.0), heading_deg=45.0)
    file = uwb_file(flight, frame="enu")
    file.samples["z_m"] = np.nan
    with pytest.raises(
        MissingDataError, match=r"the frame of .* cannot be estimated.*Give `frame`"
    ):
        align_position_file(flight, file)
    alignment, track = align(flight, file, frame="enu")
    assert clock_error_s(alignment) < 0.03
    assert track.samples["down_m"].isna().all()
    assert track.samples["north_m"].notna().all()


def test_align_position_file_rotates_its_variances(flight: Flight) -> None:
    file = uwb_file(flight, frame="enu", yaw_deg=90.0, sigma_m=[0.1, 0.2, 0.3])
    options: dict[str, Any] = {"frame": "enu", "clock_offset_s": OFFSET_S}
    variances = [
        align(flight, file, yaw_deg=yaw, **options)[1].samples[Columns.POSITION_VARIANCE].iloc[7]
        for yaw in (0.0, 90.0, 30.0)
    ]
    np.testing.assert_allclose(variances[0], [0.04, 0.01, 0.09])
    np.testing.assert_allclose(variances[1], [0.01, 0.04, 0.09])
    # cos² 30° = 3/4
    np.testing.assert_allclose(variances[2], [0.0325, 0.0175, 0.09])
    alignment, track = align(flight, file, yaw_deg=90.0, **options)
    assert (alignment.yaw_deg, alignment.yaw_reason) == (
        90.0,
        "the yaw was given with --position-yaw",
    )
    assert_same_track(track, flight.positions[0], 1e-9)


def test_align_position_file_adds_positions_to_flight_data(flight: Flight) -> None:
    result = align_position_file(flight, uwb_file(flight))
    track, *others = result.positions
    assert track.name == track.log == "uwb.csv"
    assert (track.origin, track.frame) == (POSITION_FILE_ORIGIN, "NED")
    assert track.clock.endswith(" s (matched with EKF2 position)")
    assert tuple(others) == flight.positions
    assert result.inputs == (InputFile("uwb.csv", "f" * 64, 1234, "position"),)
    assert result.log.notes == ("uwb.csv: time: column 1", "uwb.csv: two rows dropped")


# -- frames that are not EKF2's --------------------------------------------------------------------


@pytest.mark.parametrize(("yaw_deg", "origin_m"), [
    (90.0, (0.0, 0.0, 0.0)), (-12.0, (1.0, 2.0, 0.0)), (180.0, (5.0, 0.0, 0.0)),
    (0.0, (2.0, 0.0, 0.0)),
])  # fmt: skip
def test_align_position_file_with_rotated_frame_gives_warning(flight, yaw_deg, origin_m):
    file = uwb_file(flight, yaw_deg=yaw_deg, origin_m=origin_m)
    alignment, _ = align(flight, file, frame="enu")
    assert alignment.yaw_deg == 0.0
    assert clock_error_s(alignment) < 0.03
    (warning,) = alignment.misplaced
    seen = re.search(r"(rotated by [-0-9.]+° relative to .*)?its origin ([0-9.]+) m from", warning)
    assert seen
    turned = float(seen[1].split()[2].rstrip("°")) if yaw_deg else 0.0
    shifted = float(seen[2])
    assert yaw_difference_deg(turned, yaw_deg) < 0.5
    assert shifted == pytest.approx(np.hypot(*origin_m[:2]), abs=0.1)
    assert warning.endswith("Give --position-yaw auto to estimate yaw and origin.")
    alignment, _ = align(flight, file, frame="enu", yaw_deg="auto")
    assert alignment.misplaced == alignment.warnings == ()


@pytest.mark.parametrize(("unit_m", "message", "remedy"), [
    (0.01, "in centimetres, not in metres", "Run again with --position-unit cm."),
    (0.3048, "in feet, not in metres", "Multiply x, y and z in the file by 0.3048."),
])  # fmt: skip
def test_align_position_file_in_wrong_unit_reports_the_unit(
    sample_flight: Flight, unit_m: float, message: str, remedy: str
) -> None:
    file = uwb_file(sample_flight)
    file.samples[["x_m", "y_m", "z_m"]] /= unit_m
    with pytest.raises(MissingDataError) as refusal:
        align(sample_flight, file, frame="enu")
    assert message in str(refusal.value)
    assert remedy in str(refusal.value)


def test_align_position_file_applies_clock_offset_option(flight: Flight) -> None:
    wrong, _ = align(flight, uwb_file(flight), frame="enu", clock_offset_s=OFFSET_S + 11.0)
    (warning,) = wrong.warnings
    assert warning.startswith("The position file does not match the EKF2 position (correlation ")
    assert wrong.correlation < 0.7
    file = uwb_file(flight, yaw_deg=40.0)
    alignment, track = align(flight, file, yaw_deg="auto", clock_offset_s=OFFSET_S)
    assert alignment.yaw_deg == pytest.approx(40.0, abs=0.5)
    assert alignment.clock_offset_sigma_s is None
    assert_same_track(track, flight.positions[0], 0.1)


def test_align_position_file_of_another_day_gives_warning(flight: Flight) -> None:
    other = replace(flight, log=replace(flight.log, start_unix_s=BOOT_S - OFFSET_S - 100.0))
    (day,) = align(other, uwb_file(flight), frame="enu")[0].warnings
    assert "file and log differ by 100 s" in day


# -- outliers, gaps and resets ---------------------------------------------------------------------


def test_align_position_file_with_outliers_finds_time_offset() -> None:
    flight = flight_along(uwb=Uwb(outlier_share=0.08, gap_s=(30.0, 48.0)))
    alignment, _ = align(flight, uwb_file(flight), frame="enu", yaw_deg="auto")
    assert clock_error_s(alignment) < 0.03
    assert abs(alignment.yaw_deg) < 0.5
    np.testing.assert_allclose(alignment.origin_m[:2], 0.0, atol=0.05)


@pytest.mark.parametrize("delta", [(3.0, -2.0, 0.5), (100.0, 40.0, 0.0)])
def test_align_position_file_ignores_ekf2_position_reset(delta: tuple[float, float, float]) -> None:
    flight = flight_along(ekf2=Estimator(resets=(Reset(70.0, "position", delta),)))
    for yaw in (None, "auto"):
        alignment, track = align(flight, uwb_file(flight), frame="enu", yaw_deg=yaw)
        assert clock_error_s(alignment) < 0.03
        assert alignment.residual_rms_m == pytest.approx(0.11, abs=0.02)
        assert_same_track(track, flight.positions[0], 0.1)
        assert alignment.misplaced == alignment.warnings == ()


# -- the IMU as the reference ----------------------------------------------------------------------

QUIET = Imu(sigma_a_m_s2=0.1)


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_position_file_is_aligned_by_imu_if_ekf2_is_missing(noise: float) -> None:
    flight = flight_along(imu=Imu(sigma_a_m_s2=noise), ekf2=None)
    file = uwb_file(flight, yaw_deg=25.0, origin_m=(4.0, 5.0, 0.0))
    alignment, _ = align(flight, file, frame="enu", yaw_deg="auto")
    assert alignment.reference == IMU_REFERENCE
    assert clock_error_s(alignment, sigma_s=(2e-3, 0.05)) < 0.05
    assert alignment.yaw_deg == pytest.approx(25.0, abs=3.0)
    assert alignment.origin_m == (0.0, 0.0, 0.0)
    assert alignment.residual_rms_m is None
    assert alignment.correlation > 0.7
    assert any("set to 0" in warning for warning in alignment.warnings)


def test_align_position_file_without_ekf2_finds_frame_and_yaw() -> None:
    flight = flight_along(imu=QUIET)
    blind = replace(flight, ekf2=unavailable("EKF2"))
    assert align(blind, uwb_file(flight, frame="nwu"))[0].frame == "nwu"
    alignment, _ = align(blind, uwb_file(flight, yaw_deg=120.0), frame="enu")
    assert clock_error_s(alignment) < 0.05
    assert "is rotated by 1" in alignment.misplaced[-1]
    assert "shifted" not in alignment.misplaced[-1]
    # with a constant EKF2 position the IMU is the reference
    still = replace(flight, ekf2=replace(flight.ekf2, state=flight.ekf2.state * 0.0))
    alignment, _ = align(still, uwb_file(flight), frame="enu")
    assert alignment.reference == IMU_REFERENCE
    assert clock_error_s(alignment) < 0.05


# -- files without alignment -----------------------------------------------------------------------

BOTH_SPANS = r"the log is from 2416\.25 s to 2536\.25 s on the boot clock, .* from 1795253666\.45 s"


def test_align_position_file_at_rest_requires_clock_offset() -> None:
    flight = flight_along(partial(passes, across_m=0.0), length_m=0.0)
    for parts in ({}, {"ekf2": unavailable("EKF2")}):
        said = (
            rf"^uwb\.csv: .*change by less than 0.5 m, .*; {BOTH_SPANS}.*Give `clock_offset_s`\.$"
        )
        with pytest.raises(MissingDataError, match=said):
            align_position_file(replace(flight, **parts), uwb_file(flight), frame="enu")
    alignment, track = align(flight, uwb_file(flight), frame="enu", clock_offset_s=OFFSET_S)
    assert alignment.misplaced == alignment.warnings == ()
    assert alignment.correlation is None
    assert alignment.residual_rms_m == pytest.approx(0.11, abs=0.02)
    assert_same_track(track, flight.positions[0], 1e-9)


def test_align_position_file_without_imu_requires_clock_offset() -> None:
    flight = flight_along(imu=None, ekf2=None)
    file = uwb_file(flight)
    said = f"no EKF2 position; the log has no acceleration.*{BOTH_SPANS}.*"
    with pytest.raises(MissingDataError, match=said + r"Give `clock_offset_s` and `frame`\.$"):
        align_position_file(flight, file)
    with pytest.raises(MissingDataError, match=r"Give `yaw_deg`\.$"):
        align_position_file(flight, file, frame="enu", yaw_deg="auto", clock_offset_s=OFFSET_S)
    alignment, track = align(flight, file, frame="enu", clock_offset_s=OFFSET_S)
    assert alignment.reference == ""
    assert alignment.correlation is alignment.residual_rms_m is None
    assert_same_track(track, flight.positions[0], 1e-9)


def test_align_position_file_without_overlap_is_rejected(flight: Flight) -> None:
    """No overlap with the log, more than one day, or fewer than 10 positions."""
    file = uwb_file(flight)
    for offset in (0.0, OFFSET_S + 121.0, OFFSET_S - 121.0):
        with pytest.raises(MissingDataError, match="does not overlap the log ." + BOTH_SPANS):
            align_position_file(flight, file, frame="enu", clock_offset_s=offset)
    stamps = file.samples.index.to_numpy().copy()
    stamps[-1] += 2e5
    with pytest.raises(MissingDataError, match="covers more than one day"):
        align_position_file(
            flight, replace(file, samples=file.samples.set_axis(pd.Index(stamps))), frame="enu"
        )
    with pytest.raises(MissingDataError, match="contains 9 positions; 10 are needed"):
        align_position_file(flight, replace(file, samples=file.samples.iloc[:9]))


def test_align_position_file_of_other_flight_is_rejected(flight: Flight) -> None:
    def other(time_s: Array, heading_deg: float, length_m: float) -> Array:
        angle = 2.0 * np.pi * time_s / 55.0
        radius = 3.0 + np.sin(7.0 * angle)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)

    with pytest.raises(MissingDataError, match="does not match the EKF2 position"):
        align_position_file(flight, uwb_file(flight_along(other)), frame="enu")


@pytest.mark.parametrize("yaw", [None, "auto"])
def test_align_position_file_on_periodic_path_needs_clock_offset(yaw: Any) -> None:
    flight = replace(aisle_flight(), log=replace(aisle_flight().log, boot_time_s=BOOT_S))
    file = uwb_file(flight)
    said = r"cannot be estimated: two time offsets that differ by [1-6]0\.\d s fit.*"
    with pytest.raises(MissingDataError, match=said + BOTH_SPANS + r".*Give `clock_offset_s`\.$"):
        align_position_file(flight, file, frame="enu", yaw_deg=yaw)
    alignment, _ = align(flight, file, frame="enu", yaw_deg=yaw, clock_offset_s=OFFSET_S)
    assert alignment.residual_rms_m == pytest.approx(0.11, abs=0.02)


def test_align_position_file_warns_of_other_likely_time_offset() -> None:
    def accelerating_passes(time_s: Array, heading_deg: float, length_m: float) -> Array:
        along = 5.0 * (1.0 - np.cos(2.0 * np.pi * (time_s / 20.0 + time_s**2 / 2e5)))
        return np.stack([along, 0.0 * along, 0.0 * along], axis=1)

    flight = flight_along(accelerating_passes)
    alignment, _ = align(flight, uwb_file(flight), frame="enu")
    assert clock_error_s(alignment) < 0.03
    (warning,) = alignment.warnings
    assert re.match(
        r"A time offset that differs from the estimate by [-+]19\.\d s fits nearly as well", warning
    )


@pytest.mark.parametrize(("options", "message"), [
    ({"frame": "utm"},
     "`frame` utm is not a known coordinate frame. Use one of ned, enu, nwu, eus, edn."),
    ({"yaw_deg": float("nan")}, "`yaw_deg` nan is not a finite number."),
    ({"yaw_deg": "north"}, "`yaw_deg` north is neither a number (degrees) nor auto."),
    ({"clock_offset_s": float("inf")}, "`clock_offset_s` inf is not a finite number."),
])  # fmt: skip
def test_align_position_file_with_invalid_option_raises_error(
    flight: Flight, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingsError) as caught:
        align_position_file(flight, uwb_file(flight), **options)
    assert str(caught.value) == message


# -- simulated flights -----------------------------------------------------------------------------


@pytest.mark.reallogs
@pytest.mark.parametrize("name", ["v1.14.4_aisle_nominal", "v1.16.1_aisle_nlos"])
def test_align_position_file_of_sitl_log_recovers_clock_offset(
    shared_logs: Path, name: str
) -> None:
    log = shared_logs / "simulated" / f"{name}.ulg"
    record = json.loads(log.with_suffix(".json").read_text())
    stamps = np.array([sample["t_unix"] for sample in record["uwb"]])
    file = position_file(stamps, np.array([sample["z"] for sample in record["uwb"]]))
    flight = read_log(log)
    true_s = record["clock"]["px4_boot_minus_companion_unix_ns"] * 1e-9
    for options in ({"frame": "ned"}, {"yaw_deg": "auto"}):
        alignment, track = align(flight, file, **options)
        assert alignment.frame == "ned"
        # EKF2 lags by about 15 ms
        assert clock_error_s(alignment, true_s) < min(
            0.05, 3.0 * (alignment.clock_offset_sigma_s or 0.0)
        )
        assert abs(alignment.yaw_deg) < 0.5
        np.testing.assert_allclose(alignment.origin_m[:2], 0.0, atol=0.05)
        truth = np.array([sample["truth"] for sample in record["uwb"]])
        error_m = track.samples[Columns.POSITION[:2]].to_numpy() - truth[:, :2]
        assert np.median(np.abs(error_m)) < 0.08
    alignment, _ = align(replace(flight, ekf2=unavailable("EKF2")), file, frame="ned")
    assert clock_error_s(alignment, true_s) < 2.0 * (alignment.clock_offset_sigma_s or 0.0)


@pytest.mark.slow
def test_file_alignment_to_delayed_ekf2_is_corrected_by_imu():
    faults = parse_faults(["clock-offset=-0.25", "ekf2-delay=0.001"])
    late = simulate_flight(Scenario(seed=3, passes=4), faults)
    truth = late.truth.samples[Columns.POSITION]
    time_s = np.arange(truth.index[0] + 1.0, truth.index[-1] - 1.0, 0.1)
    n, e, d = (np.interp(time_s, truth.index, truth[name]) for name in truth)
    noise = np.random.default_rng(1).normal(0.0, 0.05, (len(time_s), 3))
    xyz = np.column_stack([e, n, -d]) + noise
    file = position_file(time_s + late.log.boot_time_s - OFFSET_S, xyz, frame="enu")
    aligned = align_position_file(late, file)
    assert clock_error_s(aligned.positions[0].alignment) > 0.1
    analysis = diagnose(ComparisonRequest(log="late.ulg"), flight=aligned)
    assert clock_error_s(analysis.source.alignment) < 0.03
    assert not {"source_time_offset"} & {found.id for found in analysis.findings}
