"""ATE, RPE, alignment and clocks against evo, closed forms and simulated values."""

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import shared
from exchange import replace
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import asdict
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from trajectory_tools import NAMES, PUBLISHED, SHIFT, TURN, flight, read_public, transformed

from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.flight.model import Unavailable
from px4fuse.trajectory.alignment import AlignmentKind, fit_alignment
from px4fuse.trajectory.association import AssociationMethod, associate
from px4fuse.trajectory.evaluation import choose_alignment, evaluate
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import (
    MIN_BOOTSTRAP_BLOCKS,
    RmseInterval,
    RpePairDistance,
    compute_autocorrelation_time,
    compute_relative_pose_error,
    compute_statistics,
    estimate_rmse_interval,
    find_pose_pairs,
)
from px4fuse.trajectory.time_offset import compute_clock_offset_s, estimate_time_offset

# -- evo -------------------------------------------------------------------------------------------


@cache
def evo_matched(estimate: str, reference: str) -> tuple[Any, Any]:
    pytest.importorskip("evo")
    from evo.core import sync
    from evo.tools import file_interface

    paths = (shared("trajectories") / name for name in (reference, estimate))
    both = map(file_interface.read_tum_trajectory_file, paths)
    matched: tuple[Any, Any] = sync.associate_trajectories(*both)
    return matched


def evo_aligned(estimate: str, reference: str, kind: AlignmentKind) -> tuple[Any, Any]:
    true, made = evo_matched(estimate, reference)
    made = copy.deepcopy(made)
    if kind != "none":
        made.align(true, correct_scale=kind == "sim3")
    return true, made


@pytest.mark.reallogs
@pytest.mark.parametrize("pair", PUBLISHED, ids=NAMES)
@pytest.mark.parametrize("kind", ["none", "se3", "sim3"])
def test_trajectory_ate_equals_that_of_the_evo_package(
    pair: tuple[str, str], kind: AlignmentKind
) -> None:
    pytest.importorskip("evo")
    from evo.core.metrics import APE, PoseRelation

    true, made = evo_aligned(*pair, kind)
    got = evaluate(*map(read_public, pair), alignment=kind, association="nearest", rpe_deltas=())
    np.testing.assert_array_equal(got.reference_position_m, true.positions_xyz)
    np.testing.assert_allclose(got.aligned_position_m, made.positions_xyz, rtol=0, atol=1e-9)
    for relation, ours in (
        (PoseRelation.translation_part, got.ate.translation_m),
        (PoseRelation.rotation_angle_deg, got.ate.rotation_deg),
    ):
        metric = APE(relation)
        metric.process_data((true, made))
        theirs = metric.get_all_statistics()
        for name in ("rmse", "mean", "median", "std", "min", "max"):
            assert getattr(ours, name) == pytest.approx(theirs[name], rel=0, abs=1e-9)


DELTAS = (
    RpePairDistance(1, "frames"),
    RpePairDistance(10, "frames"),
    RpePairDistance(0.5, "m"),
    RpePairDistance(5.0, "m"),
)


@pytest.mark.reallogs
@pytest.mark.parametrize("pair", PUBLISHED, ids=NAMES)
@pytest.mark.parametrize("kind", ["none", "se3", "sim3"])
def test_trajectory_rpe_equals_that_of_the_evo_package(
    pair: tuple[str, str], kind: AlignmentKind
) -> None:
    pytest.importorskip("evo")
    from evo.core.filters import FilterException
    from evo.core.metrics import RPE, PoseRelation
    from evo.core.units import Unit

    true, made = evo_aligned(*pair, kind)
    for all_pairs in (True, False):
        how = {"rpe_deltas": DELTAS, "all_pairs": all_pairs}
        got = evaluate(*map(read_public, pair), alignment=kind, association="nearest", **how)
        for ours in got.rpe:
            if kind != "se3" and ours.unit == "frames":
                continue  # scale and rotation do not change these pairs, and evo is slow
            unit = Unit.frames if ours.unit == "frames" else Unit.meters
            metric = RPE(
                PoseRelation.translation_part, ours.delta, unit, all_pairs=all_pairs,
                pairs_from_reference=True,
            )  # fmt: skip
            try:
                metric.process_data((true, made))
            except FilterException:
                assert isinstance(ours.translation_m, Unavailable)
                continue
            turns = np.degrees(Rotation.from_matrix(np.array(metric.E)[:, :3, :3]).magnitude())
            for found, errors in ((ours.translation_m, metric.error), (ours.rotation_deg, turns)):
                assert asdict(found) == pytest.approx(
                    asdict(compute_statistics(errors)), rel=0, abs=1e-9
                )


# -- alignment -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "unknowns"), [("yaw", 4), ("se3", 6), ("sim3", 7)])
def test_trajectory_alignment_minimises_squared_distances(
    kind: AlignmentKind, unknowns: int
) -> None:
    random = np.random.default_rng(5)
    x = random.normal(0.0, 2.0, (40, 3))
    y = 1.2 * TURN.apply(x) + SHIFT + random.normal(0.0, 0.5, (40, 3))

    def cost(p: np.ndarray) -> float:
        turn = Rotation.from_euler("z", p[3]) if unknowns == 4 else Rotation.from_rotvec(p[3:6])
        scale = np.exp(p[6]) if unknowns == 7 else 1.0
        return float(((y - scale * turn.apply(x) - p[:3]) ** 2).sum())

    got = fit_alignment(x, y, kind)
    assert got.degrees_of_freedom == unknowns
    ours = float(((y - got.apply(x)) ** 2).sum())
    turns = random.uniform(-3, 3, (8, unknowns - 3))
    best = min(minimize(cost, np.concatenate((y.mean(axis=0), turn))).fun for turn in turns)
    assert ours == pytest.approx(best, rel=1e-7)
    np.testing.assert_allclose(got.apply(x[0]), got.apply(x)[0])


def line(noise_m: float) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(2)
    along = np.linspace(0.0, 12.0, 200)[:, None] * np.array([0.8, 0.6, 0.0])
    return tuple(along + random.normal(0.0, noise_m, along.shape) for _ in range(2))  # type: ignore[return-value]


@pytest.mark.parametrize("noise_m", [0.0, 1e-9, 1e-3, 0.1])
def test_alignment_of_straight_line_allows_only_yaw(noise_m: float) -> None:
    x, y = line(noise_m)
    for kind in ("se3", "sim3"):
        with pytest.raises(TrajectoryError, match=r"perpendicular.*`alignment` to yaw"):
            fit_alignment(x, y, kind)  # type: ignore[arg-type]
    assert fit_alignment(x, y, "yaw").to_rotation().magnitude() < 0.02


def test_trajectory_alignment_without_motion_is_rejected() -> None:
    random = np.random.default_rng(3)
    still = random.normal(0.0, 0.01, (200, 3))
    up = np.linspace(0.0, 3.0, 200)[:, None] * [0.0, 0.0, 1.0]
    around = np.column_stack([np.sin(up[:, 2]), np.cos(up[:, 2]), up[:, 2]])
    for x, y in ((up, up), (up + 0.01 * random.normal(size=up.shape), up + still), (up, around)):
        with pytest.raises(TrajectoryError, match=r"yaw cannot be estimated.*`alignment` to none"):
            fit_alignment(x, y, "yaw")
    for x, y in ((np.ones((9, 3)), up[:9]), (still, still[::-1].copy() + up)):
        with pytest.raises(TrajectoryError, match="sim3 cannot be estimated"):
            fit_alignment(x, y, "sim3")
    with pytest.raises(TrajectoryError, match="2 poses"):
        fit_alignment(up[:2], up[:2], "none")
    assert fit_alignment(up[:9], up[:9] + 1.0, "none").translation_m == (0.0, 0.0, 0.0)


# -- association -----------------------------------------------------------------------------------


def test_pose_association_interpolates_motion_but_not_gaps() -> None:
    time = np.arange(0.0, 10.0, 0.1)
    turns = Rotation.from_rotvec(time[:, None] * [0.1, 0.5, 0.2])
    reference = Trajectory("r", "truth", time, time[:, None] * [1.0, 2.0, 3.0], turns)
    at = np.sort(np.random.default_rng(1).uniform(-1.0, 11.0, 300))
    estimate = Trajectory("e", "vio", at - 5.0, np.zeros((300, 3)), None)
    _, matched, got = associate(estimate, reference, time_offset_s=5.0)
    inside = (at >= 0.0) & (at <= time[-1])
    assert (got.poses, got.outside, got.in_gaps) == (inside.sum(), (~inside).sum(), 0)
    np.testing.assert_allclose(matched.position_m, at[inside, None] * [1, 2, 3], atol=1e-12)
    expected = Rotation.from_rotvec(at[inside, None] * [0.1, 0.5, 0.2])
    assert (matched.rotation.inv() * expected).magnitude().max() < 1e-12
    assert got.coverage_estimate == pytest.approx(inside.mean())
    assert got.coverage_reference == pytest.approx(np.ptp(at[inside]) / time[-1])
    whole = flight(20.0)
    torn = whole[(whole.time_s < 5.0) | (whole.time_s >= 10.0)]
    *_, got = associate(whole, torn)
    assert got.max_gap_s == pytest.approx(0.15)
    assert (got.poses, got.in_gaps, got.outside) == (300, 100, 0)
    assert associate(whole, torn, max_gap_s=6.0)[2].poses == 400
    *_, lost = associate(torn, whole)  # exchanged: the reference is not covered
    assert lost.coverage_estimate == 1.0
    assert lost.coverage_reference == pytest.approx(0.75, abs=0.01)


def test_associate_with_sparse_reference_uses_nearest_poses() -> None:
    reference, estimate = flight(80.0, 0.1), flight(80.0, 5.0)
    estimate_poses, reference_poses, got = associate(estimate, reference)
    assert (got.method, got.poses) == ("nearest", len(reference))
    np.testing.assert_allclose(estimate_poses.time_s, reference_poses.time_s, atol=0.2)


@pytest.mark.parametrize("denser", [False, True], ids=["estimate sparser", "estimate denser"])
def test_nearest_pose_association_equals_exhaustive_search(denser: bool) -> None:
    """Poses before, after and in a gap of the reference."""
    reference = flight(20.0, 10.0)
    reference = reference[(reference.time_s < 8.0) | (reference.time_s > 12.0)]
    rate_hz = 33.0 if denser else 4.0
    limit, offset_s = 0.04, 3.0
    time = np.arange(-1.0, 21.0, 1.0 / rate_hz) + 0.002
    # at both ends one pose just within the limit and one just outside
    edges = reference.time_s[[0, 0, -1, -1]] + np.array([-1.1, -0.9, 0.9, 1.1]) * limit
    time = np.union1d(time, edges)
    estimate = Trajectory("e", "vio", time - offset_s, np.zeros((len(time), 3)), None)
    how = {"method": "nearest", "max_gap_s": limit, "time_offset_s": offset_s}
    x, y, got = associate(estimate, reference, **how)
    apart = np.abs(time[:, None] - reference.time_s)
    if denser:
        kept = np.flatnonzero(apart.min(axis=0) <= limit)
        used, matched = apart.argmin(axis=0)[kept], kept
    else:
        used = np.flatnonzero(apart.min(axis=1) <= limit)
        matched = apart.argmin(axis=1)[used]
    np.testing.assert_array_equal(x.time_s, estimate.time_s[used])
    np.testing.assert_array_equal(y.time_s, reference.time_s[matched])
    first, last = reference.time_s[[0, -1]]
    outside = np.count_nonzero((time < first - limit) | (time > last + limit))
    poses = len(np.unique(used))
    assert (got.outside, got.in_gaps) == (outside, len(time) - outside - poses)
    assert got.coverage_estimate == pytest.approx(poses / len(time))
    assert (got.max_gap_s, got.poses) == (limit, len(used))


@pytest.mark.parametrize("method", ["interpolate", "nearest"])
def test_evaluate_without_overlap_reports_both_time_spans(method: AssociationMethod) -> None:
    reference = flight()
    estimate = replace(reference, name="boot.tum", time_s=reference.time_s + 500.0)
    said = r"0 poses match.*500.000 to 559.950 s.*0.000 to 59.950 s.*`time_offset_s` to auto"
    with pytest.raises(TrajectoryError, match=said):
        evaluate(estimate, reference, association=method, time_offset_s=0.0)
    assert evaluate(estimate, reference, time_offset_s=-500.0).ate.translation_m.rmse < 1e-9


# -- scores ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["yaw", "se3", "sim3"])
def test_evaluate_transformed_copy_gives_zero_ate_and_rpe(kind: AlignmentKind) -> None:
    reference = flight()
    turn = Rotation.from_euler("z", 2.0) if kind == "yaw" else TURN
    copied = transformed(reference, turn, SHIFT, 0.3 if kind == "sim3" else 1.0, kind="vio")
    got = evaluate(copied, reference, alignment=kind)
    assert got.ate.translation_m.max < 1e-9
    assert got.ate.rotation_deg.max < 1e-9
    assert [one.delta_text for one in got.rpe] == ["1 m", "5 m", "10 m", "1 s", "10 s"]
    for one in got.rpe:
        assert one.translation_m.max < 1e-9
        assert one.rotation_deg.max < 1e-9
    assert not got.warnings


def test_ate_of_tilted_track_remains_after_yaw_alignment() -> None:
    reference = flight()
    tilted = transformed(reference, Rotation.from_euler("x", 5.0, degrees=True), SHIFT, kind="vio")
    got = evaluate(tilted, reference)
    assert got.alignment == "yaw"
    assert got.ate.rotation_deg.rmse == pytest.approx(5.0, abs=0.1)
    assert got.ate.translation_m.rmse > 0.1
    assert evaluate(tilted, reference, alignment="se3").ate.translation_m.rmse < 1e-9


def test_rpe_of_scaled_track_is_proportional_to_distance() -> None:
    reference = flight(200.0, 50.0)
    got = evaluate(
        transformed(reference, TURN, SHIFT, 1.02, kind="vio"), reference, alignment="se3"
    )
    for one in got.rpe:
        start, end = find_pose_pairs(
            got.reference_position_m, got.time_s, RpePairDistance(one.delta, one.unit)
        )
        chord = np.linalg.norm(
            got.reference_position_m[end] - got.reference_position_m[start], axis=1
        )
        assert asdict(one.translation_m) == pytest.approx(asdict(compute_statistics(0.02 * chord)))


@settings(max_examples=60)
@given(
    steps=st.lists(st.sampled_from([0.0, 0.1, 0.25, 1.0, 3.0]), min_size=3, max_size=40),
    value=st.sampled_from([0.1, 0.3, 0.5, 1.0, 2.0]),
)
def test_rpe_pose_pairs_have_the_requested_distance(steps: list[float], value: float) -> None:
    along = np.concatenate(([0.0], np.cumsum(steps)))
    position, time = along[:, None] * [1.0, 0.0, 0.0], np.arange(len(along), dtype=float)
    expected = []
    for i in range(len(along) - 1):
        miss = np.abs(along[i + 1 :] - along[i] - value)
        j = int(np.argmin(miss))
        if miss[j] <= 0.1 * value:
            expected.append((i, i + 1 + j))
    start, end = find_pose_pairs(position, time, RpePairDistance(value, "m"))
    assert list(zip(start.tolist(), end.tolist(), strict=True)) == expected
    start, end = find_pose_pairs(position, time, RpePairDistance(2.0, "s"), all_pairs=False)
    np.testing.assert_array_equal(start, np.arange(0, len(along) - 2, 2))
    np.testing.assert_array_equal(end, start + 2)


def test_rpe_pairs_are_chosen_by_reference_distance() -> None:
    """Also if the path of the estimate is twice as long."""
    reference = flight(30.0)
    double = transformed(reference, TURN, SHIFT, 2.0, kind="vio")
    same, other = (
        compute_relative_pose_error(one, reference, RpePairDistance(1.0, "m"))
        for one in (reference, double)
    )
    assert other.pairs_from == "reference"
    assert other.translation_m.count == same.translation_m.count


def test_rpe_without_orientation_or_pose_pairs_is_unavailable() -> None:
    reference = flight()
    got = evaluate(replace(reference, rotation=None, kind="vio"), reference)
    assert isinstance(got.ate.rotation_deg, Unavailable)
    for one in got.rpe:
        assert not isinstance(one.translation_m, Unavailable)
        assert isinstance(one.rotation_deg, Unavailable)
        assert "the estimate has no orientation" in str(one.rotation_deg)
    far = evaluate(reference, reference, rpe_deltas=[RpePairDistance(1e4, "m")]).rpe[0]
    assert isinstance(far.translation_m, Unavailable)
    assert "no pair of poses with a distance of 10000 m" in str(far.translation_m)
    for delta in (
        RpePairDistance(0.0, "m"),
        RpePairDistance(-1.0, "s"),
        RpePairDistance(1.5, "frames"),
    ):
        with pytest.raises(SettingsError, match="RPE delta"):
            evaluate(reference, reference, rpe_deltas=[delta])


# -- choice of alignment, warnings -----------------------------------------------------------------


@pytest.mark.parametrize(("estimate", "reference", "name", "scale", "expected", "why"), [
    (("vio", "FRD"), ("truth", "NED"), "a", 1.0, "yaw", "z is vertical"),
    (("kf", "NED"), ("truth", "NED"), "a", 1.3, "yaw", "z is vertical"),
    (("ekf2", "NED"), ("truth", "ENU"), "a", 1.0, "se3", "have no common vertical"),
    (("vio", "NED"), ("slam", "camera"), "a", 1.0, "se3", "first key frame"),
    (("slam", "camera"), ("vio", "NED"), "a", 1.05, "se3", "first key frame"),
    (("slam", "camera"), ("truth", "NED"), "a", 2.0, "sim3", "the scale factor 0.5"),
    (("slam", "unknown"), ("truth", "NED"), "kf_mono", 1.0, "sim3", "monocular"),
    (("slam", "unknown"), ("truth", "NED"), "harmony", 1.0, "se3", "first key frame"),
    (("unknown", "unknown"), ("truth", "unknown"), "a", 1.0, "se3", "source of this"),
    (("truth", "NED"), ("truth", "NED"), "a", 1.0, "none", "ground truth"),
])  # fmt: skip
def test_default_alignment_scales_only_slam_of_unknown_scale(
    estimate, reference, name, scale, expected, why
):
    y = replace(flight(), kind=reference[0], frame=reference[1])
    x = transformed(y, TURN, SHIFT, scale, kind=estimate[0], frame=estimate[1], name=name)
    kind, reason = choose_alignment(x, y)
    assert kind == expected
    assert why in reason


def test_straight_track_with_known_vertical_is_aligned_in_yaw() -> None:
    x, y = line(0.02)
    aisle = Trajectory("aisle", "truth", np.arange(len(x)) * 0.1, y, None, "NED")
    got = evaluate(replace(aisle, kind="unknown", position_m=x), aisle)
    assert got.alignment == "yaw"
    assert "along a line" in got.alignment_reason
    straight = replace(aisle, kind="slam", frame="camera", position_m=x)
    with pytest.raises(TrajectoryError, match="`alignment` to yaw"):
        evaluate(straight, aisle, alignment="se3")
    assert "perpendicular" in evaluate(straight, aisle).warnings[0]


def test_evaluate_camera_track_removes_mounting_rotation() -> None:
    reference = flight()
    mounted = Rotation.from_euler("ZYX", [90.0, 0.0, 90.0], degrees=True)
    camera = transformed(reference, TURN, SHIFT, kind="slam", frame="camera")
    noise = Rotation.from_rotvec(np.random.default_rng(1).normal(0.0, 0.01, (len(camera), 3)))
    camera = replace(camera, rotation=camera.rotation * mounted * noise)
    got = evaluate(camera, reference)
    assert got.ate.rotation_deg.rmse == pytest.approx(np.degrees(0.01 * np.sqrt(3)), rel=0.05)
    assert "vehicle and camera axes, 120" in got.notes[0]
    assert got.rpe[0].translation_m.rmse < 0.03
    for one, other in ((replace(camera, rotation=None), reference),
                       (camera, replace(reference, rotation=None))):  # fmt: skip
        assert not evaluate(one, other).notes
    for same in (replace(camera, frame="unknown", kind="unknown"), replace(camera, frame="NED")):
        assert "a constant rotation of 120" in evaluate(same, reference, alignment="se3").notes[0]


def test_evaluate_estimate_of_camera_pose_removes_lever_arm() -> None:
    reference, arm_m = flight(), np.array([0.4, -0.1, 0.0])
    mounted = Rotation.from_euler("ZYX", [90.0, 0.0, 90.0], degrees=True)
    position_m = reference.position_m + reference.rotation.apply(arm_m)
    camera = replace(reference, position_m=position_m, rotation=reference.rotation * mounted)
    got = evaluate(replace(camera, kind="unknown", frame="unknown"), reference)
    assert "+0.40 m along x, -0.10 m along y" in got.notes[0]
    assert got.rpe[0].translation_m.rmse < 0.01


def test_rotation_ate_is_unavailable_if_reference_never_rotates() -> None:
    reference = flight()
    identity = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(reference), 1)))
    got = evaluate(reference, replace(reference, rotation=identity))
    assert "is constant, so rotation errors are not computed" in got.notes[0]
    assert isinstance(got.ate.rotation_deg, Unavailable)
    assert got.rpe[-1].translation_m.rmse < 1e-6


def test_evaluation_excludes_poses_after_estimate_stops_changing() -> None:
    reference = flight()
    middle, position_m = len(reference) // 2, reference.position_m.copy()
    position_m[middle:] = position_m[middle]
    got = evaluate(replace(reference, position_m=position_m), reference)
    assert "does not change from" in got.warnings[0]
    assert got.ate.translation_m.count == middle + 1
    assert got.ate.translation_m.rmse < 1e-6


@pytest.mark.parametrize(("restarts", "cause"), [(True, "restarted its map"), (False, "lost")])
def test_evaluate_reports_cause_and_time_of_estimate_jump(restarts: bool, cause: str) -> None:
    reference = flight()
    middle, position_m = len(reference) // 2, reference.position_m.copy()
    position_m[middle:] += position_m[0] - position_m[middle] if restarts else [3.0, 0.0, 0.0]
    got = evaluate(replace(reference, position_m=position_m), reference)
    assert cause in got.warnings[0]
    jump_s = reference.time_s[middle] - reference.time_s[0]
    assert f" m, {jump_s:.1f} s after its start" in got.warnings[0]
    assert not any("scale factor" in warning for warning in got.warnings)


@pytest.mark.parametrize(("axis", "column"), [("y", 1), ("z", 2)])
@pytest.mark.parametrize("alignment", [None, "se3", "sim3"])
def test_evaluate_mirrored_track_warning_names_reversed_axis(
    axis: str, column: int, alignment: AlignmentKind | None
) -> None:
    reference = flight()
    estimate = transformed(reference, Rotation.from_euler("z", 0.4), SHIFT, kind="vio")
    assert not evaluate(estimate, reference, alignment=alignment).warnings
    mirrored_m = estimate.position_m.copy()
    mirrored_m[:, column] *= -1.0
    mirrored = replace(estimate, position_m=mirrored_m)
    warnings = evaluate(mirrored, reference, alignment=alignment).warnings
    (warning,) = (text for text in warnings if "mirrored" in text)
    # with a free rotation (se3, sim3), every reversed axis is equivalent
    assert f"the sign of {'y' if alignment else axis} reversed" in warning


def test_evaluate_with_implausible_arguments_gives_warnings() -> None:
    truth = flight()
    vio = transformed(truth, Rotation.from_euler("z", 1.0), SHIFT, kind="vio", name="log:vio")
    slam = replace(vio, kind="slam", name="slam")
    large = transformed(truth, TURN, SHIFT, 1.5, kind="vio")
    assert not evaluate(vio, truth).warnings
    # an offset below 0.1 s may be the lag of the filter
    lag, late = (replace(slam, time_s=slam.time_s - offset_s) for offset_s in (0.08, 0.12))
    flown = replace(truth, name="log:truth")
    assert not evaluate(lag, flown).warnings
    for said, estimate, reference, how in (
        ("With +0.120 s added to the timestamps of the estimate, the ATE decr", late, flown, {}),
        ("With +0.120 s added", late, replace(flown, name="truth.tum"), {}),
        ("is ground truth, but log:vio is not", truth, vio, {}),
        ("Only 33%", vio, truth[:400], {}),
        ("covers only 33%", vio[:400], truth, {}),
        ("is 0.667 instead of 1", large, truth, {"alignment": "se3"}),
    ):
        assert said in evaluate(estimate, reference, **how).warnings[0]


def test_evaluate_straight_track_0_5_s_late_warns_of_time_offset() -> None:
    reference = flight()
    line_m = np.cumsum(1.0 + np.sin(0.3 * (reference.time_s - reference.time_s[0])) ** 2)
    line_m = line_m[:, None] * np.array([0.02, 0.0, 0.0])
    reference = replace(reference, position_m=line_m)
    late = replace(reference, time_s=reference.time_s + 0.5, kind="slam", frame="camera")
    got = evaluate(late, reference)
    assert any("With -0.5" in warning for warning in got.warnings)
    assert any("The ATE may be too small" in warning for warning in got.warnings)


# -- clocks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_s", [0.0, 0.0371, -2.5, 17.0, 1_795_253_724.3])
@pytest.mark.parametrize("rate_hz", [7.0, 50.0])
def test_trajectory_time_offset_is_recovered_at_each_sample_rate(
    offset_s: float, rate_hz: float
) -> None:
    reference = flight()
    random = np.random.default_rng(4)
    estimate = transformed(flight(40.0, rate_hz), TURN, SHIFT, 1.7, kind="slam", frame="camera")
    noise = random.normal(0.0, 0.02, (len(estimate), 3))
    position_m = estimate.position_m + noise
    estimate = replace(estimate, time_s=estimate.time_s - offset_s, position_m=position_m)
    got = estimate_time_offset(estimate, reference)
    assert got.is_determinable
    assert got.offset_s == pytest.approx(offset_s, abs=2e-3)
    assert got.interval_s[0] - 1e-3 < offset_s < got.interval_s[1] + 1e-3
    back = estimate_time_offset(reference, estimate)
    assert back.offset_s == pytest.approx(-offset_s, abs=2e-3)


@pytest.mark.slow
def test_trajectory_time_offset_interval_contains_true_offset() -> None:
    reference, held = flight(40.0, 100.0), 0
    random = np.random.default_rng(8)
    for _ in range(25):
        estimate = flight(40.0, 10.0)
        noise = lfilter([0.05], [1.0, -0.9], random.normal(size=(len(estimate), 3)), axis=0)
        estimate = replace(estimate, position_m=estimate.position_m + noise)
        got = estimate_time_offset(estimate, reference)
        held += got.interval_s[0] <= 0.0 <= got.interval_s[1]
    assert held >= 22


def test_time_offset_search_starts_at_difference_of_unix_times() -> None:
    reference = replace(flight(), unix_offset_s=1.5e9)
    estimate = replace(flight(), unix_offset_s=0.0, time_s=flight().time_s + 1.5e9 - 0.2)
    assert compute_clock_offset_s(estimate, reference) == -1.5e9
    got = evaluate(estimate, reference, time_offset_s="auto")
    assert got.time_offset.offset_s == pytest.approx(0.2 - 1.5e9, abs=1e-3)
    again = evaluate(estimate, reference, time_offset_s=got.time_offset.offset_s)
    assert again.time_offset.offset_s == got.time_offset.offset_s
    assert again.ate == got.ate
    assert evaluate(estimate, reference).time_offset.offset_s == -1.5e9
    alone = replace(reference, unix_offset_s=None)
    found = evaluate(estimate, alone).time_offset
    assert found.offset_s == pytest.approx(0.2 - 1.5e9, abs=1e-3)


@pytest.mark.parametrize("kind", ["still", "line", "circle"])
@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.05])
def test_trajectory_time_offset_needs_varying_motion(kind: str, noise_m: float) -> None:
    time = np.arange(0.0, 60.0, 0.05)
    position = {
        "still": np.zeros((len(time), 3)),
        "line": time[:, None] * [1.0, 0.5, 0.0],
        "circle": np.column_stack((np.cos(time / 3), np.sin(time / 3), 0.0 * time)) * 5.0,
    }[kind]
    noise = np.random.default_rng(6).normal(0.0, noise_m, (2, *position.shape))
    estimate, reference = (Trajectory(kind, "kf", time, position + e, None, "NED") for e in noise)
    got = estimate_time_offset(estimate, reference)
    assert (got.is_determinable, got.offset_s, got.interval_s) == (False, None, None)
    assert "cannot be estimated" in got.reason
    used = evaluate(estimate, reference, alignment="none", time_offset_s="auto")
    assert used.time_offset.offset_s == 0.0
    assert "Poses are matched by the timestamps in the files." in used.warnings[0]


def test_time_offset_of_periodic_motion_is_undetermined() -> None:
    one = flight(20.0)
    lap = np.tile(np.arange(len(one)), 4)
    time = np.arange(len(lap)) * 0.05
    # four equal laps of 20 s
    closed = one.position_m * np.sin(np.pi * one.time_s / 20.0)[:, None] ** 2
    laps = Trajectory("laps", "vio", time, closed[lap], None)
    got = estimate_time_offset(replace(laps[:800], unix_offset_s=None), laps)
    assert not got.is_determinable
    assert "is periodic" in got.reason


@pytest.mark.reallogs
@pytest.mark.parametrize("pair", PUBLISHED, ids=NAMES)
def test_time_offset_of_shifted_public_trajectory_is_recovered(pair: tuple[str, str]) -> None:
    estimate, reference = map(read_public, pair)
    base = estimate_time_offset(estimate, reference).offset_s
    assert abs(base) < 0.06  # the published clocks have small offsets
    for shift_s in (0.137, 30.0, 12.5 - estimate.time_s[0]):
        shifted = replace(estimate, time_s=estimate.time_s + shift_s, unix_offset_s=None)
        got = estimate_time_offset(shifted, reference)
        assert got.offset_s == pytest.approx(base - shift_s, abs=1e-3)


# -- intervals -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("phi", [0.0, 0.9, 0.97])
def test_rmse_confidence_interval_contains_true_rmse(phi: float) -> None:
    random = np.random.default_rng(9)
    flights, n = 200, 2000
    white = random.normal(size=(n + 500, flights, 3)) * np.sqrt(1.0 - phi**2)
    errors = np.linalg.norm(lfilter([1.0], [1.0, -phi], white, axis=0)[500:], axis=2)
    got = [estimate_rmse_interval(errors[:, i], "ATE") for i in range(flights)]
    known = [one for one in got if isinstance(one, RmseInterval)]
    assert len(known) == flights
    assert np.median([one.blocks for one in known]) > 20.0
    held = np.mean([one.low <= np.sqrt(3.0) <= one.high for one in known])
    assert 0.85 < held <= 1.0


def test_autocorrelation_time_of_ar1_series_equals_closed_form() -> None:
    white = np.random.default_rng(10).normal(size=200_000)
    for phi in (0.0, 0.5, 0.9):
        values = lfilter([1.0], [1.0, -phi], white)
        assert compute_autocorrelation_time(values) == pytest.approx((1 + phi) / (1 - phi), rel=0.1)
    assert compute_autocorrelation_time(np.ones(50)) == 1.0


def test_rmse_interval_needs_minimum_count_of_bootstrap_blocks() -> None:
    drift = np.linspace(0.0, 1.0, 500)
    got = estimate_rmse_interval(drift, "ATE")
    assert isinstance(got, Unavailable)
    assert f"fewer than {MIN_BOOTSTRAP_BLOCKS:.0f} independent blocks" in str(got)
    assert isinstance(estimate_rmse_interval(np.ones(100), "ATE", min_block_length=30), Unavailable)
    same = estimate_rmse_interval(np.full(100, 0.5), "ATE")
    assert (same.low, same.high) == (pytest.approx(0.5), pytest.approx(0.5))
    assert estimate_rmse_interval(np.sin(drift * 99), "ATE") == estimate_rmse_interval(
        np.sin(drift * 99), "ATE"
    )
