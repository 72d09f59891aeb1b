"""The parts of a flight that the model of EKF2 replays: where they begin, and their steps.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from findings_tools import NONE, made

from px4fuse.ekf2.stretches import (
    _stretch,
    down_sampled,
    find_stretches,
    predict_s,
    step_ends,
)
from px4fuse.flight import (
    ACCELEROMETER_BIAS_COLUMNS,
    ANGULAR_RATE_COLUMNS,
    DELAYED_VARIANCE_COLUMNS,
    GYRO_BIAS_COLUMNS,
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
)
from px4fuse.trajectory.rotation import matrix


@pytest.mark.parametrize(
    ("interval_ms", "known", "ends"),
    [
        ([4] * 5, [], [2, 4]),
        ([4, 9, 4, 4], [], [2, 4]),  # longer than the target before its samples are there
        ([9, 4, 4], [], [1, 3]),
        ([4, 4, 9, 4, 4], [], [2, 3, 5]),
        ([4, 4, 1, 1.5, 4, 4, 4], [], [2, 5, 7]),  # by count when half of the target has passed
        ([4] * 9, [3], [2, 3, 5, 7, 9]),  # a known end sets the count again
        ([10] * 3, [], [1, 2, 3]),
        ([2.75] * 7, [0, 6], [3, 6]),
    ],
)
def test_a_step_ends_after_its_samples_or_when_it_is_long(
    interval_ms: list[float], known: list[int], ends: list[int]
) -> None:
    found = step_ends(np.array(interval_ms) * 1e-3, np.array(known, int), 0.008)
    assert found.tolist() == ends


def test_a_gain_is_seen_from_the_end_of_its_step() -> None:
    """A turn of 1 mrad each sample: what was gained before lies turned by what came after."""
    turn = np.tile([0.0, 0.0, 0.001], (3, 1))
    gain = np.tile([1.0, 0.0, 0.0], (3, 1))
    total, gained = down_sampled(turn, gain, np.array([2, 3]))
    np.testing.assert_allclose(total[:, 2], [0.002, 0.001])
    np.testing.assert_allclose(gained[:, 0], [2.0, 1.0])
    np.testing.assert_allclose(gained[:, 1], [-0.002, -0.0005], atol=1e-12)


def facing(at: Any, error: Any = 0.0) -> np.ndarray:
    angle = 0.5 * (np.asarray(at) - 10.5) + error
    return np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])


def turning(states: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame, Ekf2, FusionRecord]:
    """0.5 rad/s about the vertical; the gyro reads 0.01 rad/s too much, EKF2 knows."""
    time = 10.0 + 0.005 * np.arange(401)
    imu = pd.DataFrame(0.0, index=time, columns=ANGULAR_RATE_COLUMNS + SPECIFIC_FORCE_COLUMNS)
    imu[ANGULAR_RATE_COLUMNS[2]] = 0.51
    imu[SPECIFIC_FORCE_COLUMNS] = [1.0, 0.2, -9.8]
    attitude = pd.DataFrame(facing(time[::4]), index=time[::4], columns=QUATERNION_COLUMNS)
    delayed = pd.DataFrame(
        facing(states, 0.1 * (states - 10.0)), index=states, columns=QUATERNION_COLUMNS
    )
    delayed = delayed.assign(**dict.fromkeys(VELOCITY_COLUMNS, 2.0), **{
        **dict.fromkeys(POSITION_COLUMNS, np.nan), **dict.fromkeys(GYRO_BIAS_COLUMNS, 0.0),
        **dict.fromkeys(ACCELEROMETER_BIAS_COLUMNS, 0.2), GYRO_BIAS_COLUMNS[2]: 0.01,
        **{name: 1.0 + n for n, name in enumerate(DELAYED_VARIANCE_COLUMNS)},
    })  # fmt: skip
    delayed["attitude_down_rad2"] = states
    state = pd.DataFrame(7.0, index=time, columns=STATE_COLUMNS).assign(down_m=time)
    record = made(FusionRecord, delayed=delayed, parameters={})
    return imu, attitude, made(Ekf2, state=state), record


def test_a_stretch_of_a_vehicle_that_turns() -> None:
    flown = turning(10.0 + 0.1 * np.arange(21))
    found = _stretch(*flown, 5, 11.5)
    steps = 10.5 + 0.01 * np.arange(101)
    np.testing.assert_allclose(found.time_s, steps, atol=1e-9)
    np.testing.assert_allclose(found.step_s, 0.01, atol=1e-9)
    turned = matrix(facing(steps))
    np.testing.assert_allclose(found.rotation, turned, atol=1e-6)
    np.testing.assert_allclose(found.correction_rad, 0.0, atol=1e-6)
    # in the frame at the end of the step, without its bias
    np.testing.assert_allclose(found.force_m_s2, [[0.8, 0.0, -10.0]] * 100, atol=5e-3)
    np.testing.assert_allclose(found.state[:3], [0.0, 0.0, 0.05], atol=1e-6)
    np.testing.assert_allclose(found.state[3:9], [2.0, 2.0, 2.0, 7.0, 7.0, 10.5])
    np.testing.assert_allclose(found.state[9:], 0.0)
    expected = np.arange(1.0, 16.0)
    expected[DELAYED_VARIANCE_COLUMNS.index("attitude_down_rad2")] = 10.5
    np.testing.assert_allclose(found.variance, expected)
    np.testing.assert_allclose(found.heading_variance_rad2, steps)
    np.testing.assert_allclose(found.down_m, steps)
    np.testing.assert_allclose(
        found.attitude_error_rad[:, 2], 0.05 + 0.1 * (steps - 10.5), atol=1e-6
    )
    assert found.fusing
    flown[3].delayed[POSITION_COLUMNS] = 3.0
    np.testing.assert_allclose(_stretch(*flown, 5, 11.5).state[6:9], [3.0, 3.0, 10.5])


def test_an_end_that_the_log_shows_sets_the_count_of_samples_again() -> None:
    """States of 10.605 and 10.61 s, to half a microsecond; that of 10.705002 s is on no sample."""
    shown = [10.5, 10.6050004, 10.6099996, 10.705002, 11.5]
    found = _stretch(*turning(np.array(shown)), 0, 11.5)
    steps = np.sort(np.append(10.5 + 0.01 * np.arange(101), 10.605))
    np.testing.assert_allclose(found.time_s, steps, atol=1e-9)


def stretches(monkeypatch: pytest.MonkeyPatch, **parts: Any) -> list[tuple[float, float]]:
    """Start and end of each, of a flight of 60 s with everything every 0.01 or 0.1 s."""
    found: list[tuple[float, float]] = []
    usual = {
        "imu": np.arange(0.0, 60.0, 0.01), "vision": np.arange(0.0, 60.0, 0.1),
        "fused": np.arange(0.0, 60.0, 0.1), "airborne": NONE, "delayed": np.arange(0.0, 60.0, 0.5),
    }  # fmt: skip
    given = {**usual, **parts}

    def keep(_imu: Any, _attitude: Any, _ekf2: Any, record: Any, at: int, high: float) -> None:
        found.append((float(record.delayed.index[at]), round(float(high), 2)))

    monkeypatch.setattr("px4fuse.ekf2.stretches._stretch", keep)
    find_stretches(
        made(Flight, airborne=given["airborne"]),
        pd.DataFrame(index=given["imu"]),
        pd.DataFrame(index=given["imu"]),
        made(Ekf2, innovations={"north": pd.DataFrame(index=given["fused"])}),
        made(FusionRecord, delayed=pd.DataFrame(index=given["delayed"])),
        given["vision"],
    )
    return found


def without(times: np.ndarray, low: float, high: float) -> np.ndarray:
    return times[(times < low + 1e-6) | (times > high - 1e-6)]


def test_where_a_stretch_begins_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    imu, vision = np.arange(0.0, 60.0, 0.01), np.arange(0.0, 60.0, 0.1)
    assert stretches(monkeypatch) == [(1.0, 59.99)]
    # a second of fusion, four in the air
    late = np.arange(20.0, 60.0, 0.1)
    assert stretches(monkeypatch, fused=late) == [(21.0, 59.99)]
    assert stretches(monkeypatch, airborne=((10.0, 50.0), (52.0, 60.0))) == [(14.0, 59.99)]
    assert stretches(monkeypatch, airborne=((70.0, 90.0),)) == [(1.0, 59.99)]
    # gaps of vision beyond 2 s, and of the IMU beyond 0.05 s, part the flight
    assert len(stretches(monkeypatch, vision=without(vision, 30.0, 31.9))) == 1
    exactly = without(np.arange(0.0, 60.0, 0.125), 30.0, 32.0)
    assert len(stretches(monkeypatch, vision=exactly)) == 1
    parted = stretches(monkeypatch, vision=without(vision, 30.0, 32.2))
    assert parted == [(1.0, 30.0), (33.5, 59.99)]
    assert len(stretches(monkeypatch, imu=without(imu, 30.0, 30.04))) == 1
    parted = stretches(monkeypatch, imu=without(imu, 30.0, 30.07))
    assert [start for start, _ in parted] == [1.0, 31.5]
    # ten seconds at least, and a second after the last sample of vision
    assert stretches(monkeypatch, fused=np.arange(48.0, 60.0, 0.1))[0][0] == 49.0
    assert stretches(monkeypatch, fused=np.arange(49.3, 60.0, 0.1)) == []
    assert stretches(monkeypatch, fused=np.array([])) == []
    assert stretches(monkeypatch, vision=np.arange(5.0, 40.0, 0.1)) == [(6.0, 40.9)]
    assert predict_s(made(FusionRecord, parameters={})) == 0.01
