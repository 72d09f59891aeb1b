"""EKF2 along an axis: every column against its formula, sample by sample."""

import math

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from flights import Estimator, Uwb, aisle_flight, given_placement, table

from px4fuse.comparison.projection import find_observation_variance, project_innovations
from px4fuse.filter.signals import Axis, Segment, make_axes
from px4fuse.flight.model import MOTION_CAPTURE_ORIGIN, Columns, Flight, Unavailable

WHOLE = Segment(0.0, 40.0, "")
HEADING_DEG = 30.0
COSINE, SINE = math.cos(math.radians(HEADING_DEG)), math.sin(math.radians(HEADING_DEG))
COLUMNS = [
    "innovation_m", "innovation_variance_m2", "observation_variance_m2", "test_ratio", "fused",
    "rejected",
]  # fmt: skip


def flight(**changes: object) -> Flight:
    return aisle_flight(duration_s=40.0, **changes)


def axes_of(made: Flight) -> dict[str, Axis]:
    (track,) = made.positions
    return {axis.name: axis for axis in make_axes(made, track, WHOLE, heading_deg=HEADING_DEG)}


def with_innovations(made: Flight, **frames: pd.DataFrame) -> Flight:
    return replace(made, ekf2=replace(made.ekf2, innovations={**made.ekf2.innovations, **frames}))


def rows(*values: tuple[float, ...], start_s: float = 1.0) -> pd.DataFrame:
    """Innovations at 5 Hz; each row as ``COLUMNS``."""
    return table(start_s + 0.2 * np.arange(len(values)), np.array(values), COLUMNS)


NORTH = rows(
    (0.30, 0.05, 0.01, 0.40, 1.0, 0.0),
    (-0.20, 0.06, 0.02, 0.10, 1.0, 0.0),
    (0.10, 0.07, 0.01, 0.30, 0.0, 1.0),
    (0.50, 0.08, 0.03, 0.20, 1.0, 0.0),
)
# without NORTH's first time, and with one more at the end
EAST = rows(
    (0.40, 0.09, 0.04, 0.20, 1.0, 0.0),
    (0.25, 0.05, 0.02, 0.70, 0.0, 1.0),
    (-0.35, 0.06, 0.01, 0.10, 1.0, 0.0),
    (0.15, 0.07, 0.02, 0.10, 1.0, 0.0),
    start_s=1.2,
)


def innovations(made: Flight, axis: str, segment: Segment = WHOLE) -> pd.DataFrame:
    return project_innovations(made, made.ekf2, made.positions[0], axes_of(made)[axis], segment)


def test_innovations_on_rotated_axis_combine_north_and_east() -> None:
    got = innovations(with_innovations(flight(), north=NORTH, east=EAST), "aisle")
    assert got.index.tolist() == pytest.approx([1.2, 1.4, 1.6])
    for k, time in enumerate(got.index):
        n, e = NORTH.iloc[k + 1], EAST.iloc[k]
        row = got.loc[time]
        along = COSINE * n["innovation_m"] + SINE * e["innovation_m"]
        assert row["innovation_m"] == pytest.approx(along)
        for column in ("innovation_variance_m2", "observation_variance_m2"):
            assert row[column] == pytest.approx(COSINE**2 * n[column] + SINE**2 * e[column])
        for column in ("test_ratio", "fused", "rejected"):
            assert row[column] == max(n[column], e[column])


@pytest.mark.parametrize("axis", ["north", "east", "aisle"])
def test_position_variances_follow_from_s_and_r_of_innovations(axis: str) -> None:
    """P⁻ = S - R and 1/P⁺ = 1/P⁻ + 1/R; a rejected sample leaves P⁻ unchanged."""
    got = innovations(with_innovations(flight(), north=NORTH, east=EAST), axis)
    s, r = got["innovation_variance_m2"], got["observation_variance_m2"]
    np.testing.assert_allclose(got["prior_variance_m2"], s - r)
    rejected = got["rejected"] > 0
    assert rejected.any()
    assert not rejected.all()
    expected = np.where(rejected, s - r, 1.0 / (1.0 / (s - r) + 1.0 / r))
    np.testing.assert_allclose(got["posterior_variance_m2"], expected)


def test_position_variance_is_nan_if_s_is_not_larger_than_r() -> None:
    """S equal to R or smaller gives NaN instead of P⁻ ≤ 0."""
    north = NORTH.assign(innovation_variance_m2=[0.05, 0.02, 0.005, 0.08])
    got = innovations(with_innovations(flight(), north=north), "north")
    assert got["prior_variance_m2"].isna().tolist() == [False, True, True, False]
    assert got["posterior_variance_m2"].isna().tolist() == [False, True, True, False]


GONE = Unavailable("innovations", "none logged", "Log them.")


@pytest.mark.parametrize(("made", "axis", "segment", "says"), [
    (with_innovations(flight(), north=NORTH), "north", Segment(20.0, 30.0, ""),
     "the log contains no EKF2 innovations in the analysed time span"),
    # the aisle needs both horizontal axes
    (with_innovations(flight(), north=GONE), "aisle", WHOLE, "none logged"),
    (with_innovations(flight(), east=GONE), "aisle", WHOLE, "none logged"),
    # motion capture is never fused
    (flight(uwb=Uwb(name="vehicle_mocap_odometry", origin=MOTION_CAPTURE_ORIGIN)), "north", WHOLE,
     "never fuses vehicle_mocap_odometry"),
], ids=["segment", "north", "east", "mocap"])  # fmt: skip
def test_ekf2_innovations_of_unlogged_axis_are_unavailable(made, axis, segment, says) -> None:
    (track,) = made.positions
    got = project_innovations(made, made.ekf2, track, axes_of(made)[axis], segment)
    assert isinstance(got, Unavailable)
    assert says in str(got)


def test_unlogged_measurement_noise_is_read_from_parameters() -> None:
    made = flight(ekf2=Estimator(noise_logged=False), parameters={"EKF2_EVP_NOISE": 0.05})
    got = innovations(made, "north")
    np.testing.assert_allclose(got["observation_variance_m2"], 0.05**2)
    unknown = innovations(flight(ekf2=Estimator(noise_logged=False), parameters={}), "north")
    assert unknown["observation_variance_m2"].isna().all()
    assert unknown["prior_variance_m2"].isna().all()


@pytest.mark.parametrize(("parameters", "reported_m", "expected_m2"), [
    ({"EKF2_EVP_NOISE": 0.2}, None, 0.2**2),
    ({"EKF2_EVP_NOISE": 0.001}, None, 0.01**2),  # EKF2's lower limit is 0.01 m
    # the sender's variance if larger, projected onto the axis
    ({"EKF2_EVP_NOISE": 0.2}, (0.3, 0.5, 1.0), COSINE**2 * 0.3**2 + SINE**2 * 0.5**2),
    ({"EKF2_EVP_NOISE": 0.2}, (0.1, 0.1, 1.0), 0.2**2),
    ({"EKF2_EVP_NOISE": 0.2, "EKF2_EV_NOISE_MD": 0.0}, (0.3, 0.3, 1.0), 0.3**2),
    ({"EKF2_EVP_NOISE": 0.2, "EKF2_EV_NOISE_MD": 1.0}, (0.3, 0.3, 1.0), 0.2**2),
])  # fmt: skip
def test_ekf2_measurement_variance_is_square_of_noise_parameter(
    parameters, reported_m, expected_m2
) -> None:
    made = flight(parameters=parameters)
    (track,) = made.positions
    if reported_m is not None:
        variances = dict(zip(Columns.POSITION_VARIANCE, np.square(reported_m), strict=True))
        # a single different sample does not change the median
        samples = track.samples.assign(**variances)
        samples.iloc[10, samples.columns.get_indexer(Columns.POSITION_VARIANCE)] = 100.0
        track = replace(track, samples=samples)
    aisle = axes_of(made)["aisle"]
    assert find_observation_variance(made, track, aisle, WHOLE) == pytest.approx(expected_m2)
    own_file = replace(track, alignment=given_placement())
    least = max(parameters["EKF2_EVP_NOISE"], 0.01) ** 2
    assert find_observation_variance(made, own_file, aisle, WHOLE) == pytest.approx(least)
