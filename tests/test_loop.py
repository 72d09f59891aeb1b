"""Loops: the sample flight against ground truth, and laps with known drift and closures."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from exchange import replace
from pyulog import ULog
from scipy.spatial.transform import Rotation, Slerp
from trajectory_tools import noisy_odometry, square

from px4fuse.diagnose import analyse_loop_closure, prepare_comparison
from px4fuse.errors import SettingsError, TrajectoryError
from px4fuse.findings import find_loop_findings, source_convention
from px4fuse.flight.model import Columns, Unavailable
from px4fuse.lesson import ODOMETRY_CORNERS_M, format_loop_example_lines
from px4fuse.loop import tracks
from px4fuse.loop.analysis import analyse, analyse_flight_loop
from px4fuse.loop.corrections import (
    CORRECTION_LABELS,
    compute_odometry_variances,
)
from px4fuse.loop.model import Loop, OdometryNoise
from px4fuse.loop.tracks import LoopSource, read_trajectory_source, split_path_and_part
from px4fuse.request import ComparisonRequest, GivenClosure, Landing, LoopRequest
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.model import Trajectory, TrajectoryKind
from px4fuse.trajectory.rotation import multiply
from px4fuse.trajectory.scores import Statistics

SAMPLE = REPOSITORY / "sample_logs" / "loop_vio.ulg"
SLAM = REPOSITORY / "sample_logs" / "loop_slam.tum"
RATE_HZ = 10.0
SPEED_M_S = 1.0
SIDE_M = 10.0


@pytest.fixture(scope="module")
def sample() -> LoopSource:
    return read_trajectory_source(str(SAMPLE))


@pytest.fixture(scope="module")
def sample_loop(sample: LoopSource) -> Loop:
    return analyse(sample, reference=read_trajectory_source(str(SLAM)).trajectory)


def analyse_loop(source: LoopSource, reference: Trajectory | None = None, **how: Any) -> Loop:
    return analyse(source, LoopRequest(source="", **how), reference)


def close_loop(trajectory: Trajectory, **how: Any) -> Loop:
    return analyse_loop(LoopSource(trajectory, None), **how)


def path(loop: Loop, way: Any) -> Any:
    """Return the corrected path by the name of the correction or of the pose graph solution."""
    return loop.corrections.get(way) or loop.corrections[f"pose_graph_{way}"]  # type: ignore[index]


def score(loop: Loop, way: str, index: int = 0) -> Evaluation:
    return list(path(loop, way).scores.values())[index]


def rmse(loop: Loop, way: str, index: int = 0) -> float:
    return score(loop, way, index).ate.translation_m.rmse


def closure_error_vector_m(loop: Loop) -> np.ndarray:
    return np.array(list(loop.closure_error_axes_m.values()))


# ------------------------------------------------------------------ the sample flight


def true_closure_error_m() -> float:
    """Return the odometry error at landing, computed from the topics of the log."""
    topics = {topic.name: topic.data for topic in ULog(str(SAMPLE)).data_list}
    landed = topics["vehicle_land_detected"]
    changes = np.diff(landed["landed"].astype(int))
    up = landed["timestamp"][np.flatnonzero(changes == -1)[0] + 1] - 1e6
    down = landed["timestamp"][np.flatnonzero(changes == 1)[-1] + 1]
    moved = []
    for topic, columns in (
        ("vehicle_visual_odometry", ("position[0]", "position[1]", "position[2]")),
        ("vehicle_local_position_groundtruth", ("x", "y", "z")),
    ):
        time = topics[topic]["timestamp_sample"].astype(float)
        start, end = (
            [topics[topic][c][(time >= low) & (time <= low + 1e6)].mean() for c in columns]
            for low in (up, down)
        )
        moved.append(np.subtract(end, start))
    return float(np.linalg.norm(moved[0] - moved[1]))


def test_loop_closure_error_of_sample_flight_equals_ground_truth(sample_loop: Loop) -> None:
    assert sample_loop.closure_error_m == pytest.approx(true_closure_error_m(), abs=0.02)
    assert sample_loop.closure_error_m == pytest.approx(1.42, abs=0.05)  # sample_logs/README.md
    assert sample_loop.path_length_m == pytest.approx(87.7, abs=1.5)
    assert sample_loop.heading_error_deg == pytest.approx(5.09, abs=0.3)
    assert sample_loop.closures[0].distance_m == pytest.approx(sample_loop.closure_error_m)
    assert sample_loop.part_reason == "from take-off to landing, by the land detector"


def test_loop_corrections_of_sample_flight_reduce_ate(sample_loop):
    for reference in (0, 1):  # ground truth and SLAM
        before = rmse(sample_loop, "uncorrected", reference)
        for way in ("by_distance", "gated"):
            assert rmse(sample_loop, way, reference) < 0.8 * before
    end = sample_loop.true_end.displacement_vector_m
    for way, within in (("by_distance_plain", 1e-9), ("by_distance", 1e-9), ("gated", 0.02)):
        position = path(sample_loop, way).trajectory.position_m
        assert np.linalg.norm(position[-1] - position[0] - end) < within
    robust = sample_loop.corrections["pose_graph_gnc"]
    assert isinstance(robust, Unavailable)
    assert "the path has only one loop closure" in robust.reason


def test_loop_command_on_lesson_example_2_equals_lesson_output() -> None:
    corners = np.column_stack([np.array(ODOMETRY_CORNERS_M), np.zeros(len(ODOMETRY_CORNERS_M))])
    found = close_loop(Trajectory("corners", "vio", np.arange(5.0), corners, None, "FRD"))
    error, total = closure_error_vector_m(found), found.path_length_m
    corrected = path(found, "by_distance_plain").trajectory.position_m
    assert list(format_loop_example_lines()) == [
        f"loop closure error ({error[0]:.1f}, {error[1]:.1f}) m over {total:.1f} m = "
        f"{found.closure_error_m / total:.1%}",
        *(
            f"({x:5.1f}, {y:5.1f}) -> ({a:5.2f}, {b:5.2f})"
            for (x, y), (a, b, _) in zip(ODOMETRY_CORNERS_M, corrected, strict=True)
        ),
    ]


def test_loop_correction_grows_linearly_with_distance_flown(sample_loop) -> None:
    plain, odometry = path(sample_loop, "by_distance_plain"), sample_loop.odometry.trajectory
    share = sample_loop.distance_m / sample_loop.distance_m[-1]
    moved = odometry.position_m - plain.trajectory.position_m
    np.testing.assert_allclose(
        moved, np.outer(share, closure_error_vector_m(sample_loop)), atol=1e-12
    )
    assert plain.trajectory.rotation is odometry.rotation


def test_loop_correction_with_heading_does_not_increase_rpe(sample_loop: Loop) -> None:
    """The sample's heading drifts, so a correction of positions only increases the RPE."""
    over = [
        next(e.translation_m for e in score(sample_loop, way).rpe if e.delta_text == "10 m")
        for way in ("uncorrected", "by_distance", "by_distance_plain")
    ]
    before, turned, plain = (e.rmse for e in over if isinstance(e, Statistics))
    assert turned < 1.05 * before
    assert plain > 1.1 * before


def test_loop_correction_methods_agree_without_heading_error(sample, sample_loop) -> None:
    assert [part.name for part in sample_loop.select_reported_paths()[1:3]] == [
        CORRECTION_LABELS["by_distance_plain"],
        CORRECTION_LABELS["by_distance"],
    ]
    found = analyse_loop(sample, landed_at=Landing(0.0, 0.0))
    assert isinstance(found.heading_error_deg, Unavailable)
    names = [part.name for part in found.select_reported_paths()]
    assert CORRECTION_LABELS["by_distance_plain"] in names
    assert CORRECTION_LABELS["by_distance"] not in names
    plain, turned = (path(found, way).trajectory for way in ("by_distance_plain", "by_distance"))
    np.testing.assert_allclose(plain.position_m, turned.position_m, atol=1e-9)


def test_loop_closure_error_with_landing_position_equals_truth(
    sample: LoopSource, sample_loop: Loop
) -> None:
    forward, right, _ = sample_loop.true_end.displacement_vector_m  # the vehicle heads along x
    heading = sample_loop.true_end.heading_change_deg
    taped = analyse_loop(sample, landed_at=Landing(forward, right, heading))
    # --landed-at has no height; ground truth is 0.16 m lower
    assert taped.closure_error_m == pytest.approx(sample_loop.closure_error_m, abs=0.03)
    assert taped.heading_error_deg == pytest.approx(sample_loop.heading_error_deg, abs=1e-6)


@pytest.mark.reallogs
def test_loop_closure_error_from_tlog_equals_ground_truth(shared_logs: Path) -> None:
    found = analyse(read_trajectory_source(str(shared_logs / "mavlink" / "v1.16.1_loop_vio.tlog")))
    assert found.closure_error_m == pytest.approx(true_closure_error_m(), abs=0.05)


def test_loop_command_on_absolute_positions_gives_warning() -> None:
    source = read_trajectory_source(str(REPOSITORY / "sample_logs" / "aisle_uwb.ulg"))
    assert source.trajectory.kind == "ekf2"
    found = analyse(source)
    assert found.is_absolute_track
    assert "loop_on_absolute_positions" in {finding.id for finding in find_loop_findings(found)}
    assert isinstance(analyse_flight_loop(source.flight), Unavailable)


# ------------------------------------------------------------------ laps with known drift


def laps(count: int, seed: int, noise: OdometryNoise) -> tuple[Trajectory, Trajectory]:
    """Return ground truth and odometry of laps around a square, with drift by the noise."""
    position, rotation = square(int(SIDE_M / SPEED_M_S * RATE_HZ), SIDE_M, count)
    truth = np.column_stack([position, rotation.as_quat()])
    length, duration = SPEED_M_S / RATE_HZ, 1.0 / RATE_HZ
    moved = noise.position_m**2 / 100 * length + noise.position_m_per_root_s**2 * duration
    turned = noise.heading_deg**2 / 100 * length + noise.heading_deg_per_root_s**2 * duration
    heading = np.radians(np.sqrt(turned))
    tilt = noise.tilt_share * heading
    sigma = np.array([np.sqrt(moved)] * 3 + [tilt, tilt, heading])
    odometry = noisy_odometry(truth, sigma, np.random.default_rng(seed))
    time = np.arange(len(truth)) / RATE_HZ

    def flown(name: str, kind: TrajectoryKind, poses: np.ndarray) -> Trajectory:
        return Trajectory(name, kind, time, poses[:, :3], Rotation.from_quat(poses[:, 3:]), "NED")

    return flown("truth", "truth", truth), flown("laps", "vio", odometry)


LAP_S = 4 * SIDE_M / SPEED_M_S
# the second and third lap pass the positions of the first
TRUE = tuple(
    GivenClosure(t, t + lap * LAP_S, 0.05) for lap in (1, 2) for t in (5.0, 14.0, 23.0, 32.0)
)
# opposite sides of the square
FALSE = GivenClosure(12.0, 2 * LAP_S + 35.0, 0.05)


def test_false_loop_closure_is_rejected_among_true_ones() -> None:
    truth, odometry = laps(3, 0, OdometryNoise())
    clean = close_loop(odometry, closures=TRUE, reference=truth)
    fooled = close_loop(odometry, closures=(*TRUE, FALSE), reference=truth)
    assert all(judged.accepted for judged in clean.closures)
    *true, false = fooled.closures
    assert false.p < 0.001
    assert not false.accepted
    assert all(judged.accepted for judged in true)
    without = rmse(clean, "gated")
    assert without < 0.6 * rmse(clean, "uncorrected")
    for name in ("gated", "gnc"):
        assert rmse(fooled, name) == pytest.approx(without, rel=0.05), name
    assert false.weight_gnc < 0.05
    assert min(judged.weight_gnc for judged in true) > 0.5
    named = [finding.id for finding in find_loop_findings(fooled)]
    assert named[0] == "false_loop_closure"
    assert "loop_closure_inconsistent" not in named


def test_p_value_of_correct_loop_closure_is_uniform() -> None:
    """The gate assumes the noise with which the laps are simulated."""
    p = []
    for seed in range(60):
        _, odometry = laps(1, 100 + seed, OdometryNoise())
        p.append(close_loop(odometry).closures[0].p)
    assert min(p) > 0.001
    for share in (0.25, 0.5, 0.75):
        assert np.mean(np.array(p) < share) == pytest.approx(share, abs=0.2)


def test_loop_that_does_not_return_to_start_is_not_corrected() -> None:
    _, odometry = laps(1, 3, OdometryNoise())
    half = odometry[: len(odometry) // 2]
    found = close_loop(half)
    judged = found.closures[0]
    assert not judged.accepted
    assert judged.distance_m == pytest.approx(SIDE_M * np.sqrt(2.0), rel=0.2)
    for part in (found.corrections["by_distance"], found.corrections["pose_graph_gated"]):
        assert isinstance(part, Unavailable)
        assert "χ² gate rejects the loop closure" in part.reason
        assert "χ² gate rejects the loop closure" in part.reason
    finding = find_loop_findings(found)[0]
    assert (finding.id, finding.severity) == ("false_loop_closure", "error")
    assert finding.evidence["p"] < 0.001
    opened = close_loop(half, closed_loop=False)
    assert opened.closure_error_m is None
    assert opened.closure_error_axes_m is None
    assert opened.closures == ()
    assert find_loop_findings(opened) == ()


def test_loop_closure_at_other_heading_uses_position_only() -> None:
    _, odometry = laps(1, 4, OdometryNoise())
    turned = close_loop(odometry)  # the vehicle lands with another heading
    assert isinstance(turned.heading_error_deg, Unavailable)
    assert turned.closures[0].degrees_of_freedom == 3
    quaternions = odometry.rotation.as_quat()
    quaternions[-1] = odometry.rotation[0].as_quat()
    same = replace(odometry, rotation=Rotation.from_quat(quaternions))
    found = close_loop(same)
    assert found.heading_error_deg == pytest.approx(0.0, abs=1e-9)
    assert found.closures[0].degrees_of_freedom == 4


def test_contradicting_loop_closure_is_reported_as_inconsistent() -> None:
    """The error is within the drift, but contradicts the other closures."""
    _, odometry = laps(3, 5, OdometryNoise())
    wrong = GivenClosure(20.0, 21.5 + LAP_S, 0.05)  # 1.5 m further along the side
    found = close_loop(odometry, closures=(*TRUE, wrong))
    assert found.closures[-1].accepted
    doubtful = [f for f in find_loop_findings(found) if f.id == "loop_closure_inconsistent"]
    assert len(doubtful) == 1
    assert doubtful[0].evidence["time_1_s"] == 20.0


def test_loop_command_drift_option_below_true_drift_is_reported() -> None:
    """The odometry has a heading error in every step; the stated drift is small."""
    _, odometry = laps(3, 7, OdometryNoise())
    turn = Rotation.from_rotvec(np.outer(np.linspace(0.0, 0.7, len(odometry)), [0, 0, 1]))
    steps = turn[:-1].apply(np.diff(odometry.position_m, axis=0))
    position = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    biased = replace(odometry, position_m=position, rotation=turn * odometry.rotation)
    found = close_loop(biased, closures=TRUE, heading_drift_deg=1.0)
    assert "loop_drift_too_small" in {finding.id for finding in find_loop_findings(found)}


def test_loop_without_ground_truth_assumes_landing_at_take_off(
    sample: LoopSource, sample_loop: Loop
) -> None:
    assert find_loop_findings(sample_loop) == ()  # the log contains ground truth
    blind = Unavailable("ground truth", "left out", "")
    found = analyse(LoopSource(sample.trajectory, replace(sample.flight, truth=blind)))
    (finding,) = find_loop_findings(found)
    assert (finding.id, finding.severity) == ("loop_landing_assumed", "note")
    assert "px4fuse loop --landed-at" in finding.remedy
    assert find_loop_findings(analyse_loop(sample, landed_at=Landing(0.0, 0.0))) == ()


def test_loop_and_compare_commands_report_same_orientation_fault(
    sample: LoopSource, monkeypatch: Any
) -> None:
    track = next(one for one in sample.flight.positions if one.orientation is not None)
    quaternions = track.orientation[Columns.QUATERNION].to_numpy()
    turned = track.orientation.copy()
    turned[Columns.QUATERNION] = multiply(np.sqrt([0.5, 0.0, 0.0, 0.5]), quaternions)
    flight = replace(sample.flight, positions=(replace(track, orientation=turned),))
    for flown, expected in ((sample.flight, []), (flight, ["source_orientation_wrong"])):
        source = LoopSource(sample.trajectory, flown)
        monkeypatch.setattr(tracks, "read_trajectory_source", lambda *_, one=source, **_more: one)
        loop = analyse_loop_closure(LoopRequest(source=""))
        found = find_loop_findings(loop)
        assert [one.id for one in found] == expected
    prepared = prepare_comparison(flight, ComparisonRequest(log=flight.log.name))
    assert found[0] in list(source_convention.detect(prepared))


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_loop_closure_for_part_of_a_flight_is_unavailable(sample: LoopSource, share: float) -> None:
    take_off_s, landing_s = sample.flight.airborne[0]
    span_s = (take_off_s, take_off_s + share * (landing_s - take_off_s))
    found = analyse_flight_loop(sample.flight, analysed_span_s=span_s)
    assert isinstance(found, Unavailable) is (share < 1.0)


def test_odometry_that_stops_in_flight_gets_no_loop_closure(sample: LoopSource) -> None:
    """Without ground truth; the place at which the odometry stops is not the landing place."""
    flight = replace(sample.flight, truth=Unavailable("ground truth", "not logged", "Log it."))
    (start_s, landing_s), trajectory = flight.airborne[0], sample.trajectory
    early = trajectory[trajectory.time_s < landing_s - 10.0]
    loop = analyse(replace(sample, flight=flight, trajectory=early))
    assert isinstance(loop.true_end, Unavailable)
    assert (loop.closure_error_m, loop.closures) == (None, ())
    chosen = LoopRequest(source="", start_s=start_s, end_s=landing_s - 11.0)
    assert analyse(
        replace(sample, flight=flight, trajectory=early), chosen
    ).is_landing_place_assumed


def test_odometry_edge_variance_is_increase_of_logged_variance() -> None:
    _, odometry = laps(1, 6, OdometryNoise())
    nodes = np.arange(0, len(odometry), 10)
    constant = replace(odometry, position_variance_m2=np.full((len(odometry), 3), 0.0025))
    default, _, _ = compute_odometry_variances(odometry, nodes, OdometryNoise())
    same, _, words = compute_odometry_variances(constant, nodes, OdometryNoise())
    np.testing.assert_array_equal(same, default)
    assert "do not increase" in words
    growing = np.linspace(0.001, 0.4, len(odometry))[:, None].repeat(3, axis=1)
    with_growing = replace(odometry, position_variance_m2=growing)
    grown, _, words = compute_odometry_variances(with_growing, nodes, OdometryNoise())
    np.testing.assert_allclose(grown.sum(), 0.4 - 0.001, rtol=0.05)
    assert "increase of the logged position variance" in words


def test_pose_graph_correction_interpolates_between_key_frames(sample_loop: Loop) -> None:
    solved, before = path(sample_loop, "gated"), sample_loop.odometry.trajectory
    after, poses = solved.trajectory, solved.solution.poses
    distances_m = np.linalg.norm(after.position_m - poses[:, None, :3], axis=2)
    nodes = distances_m.argmin(axis=1)
    np.testing.assert_allclose(after.position_m[nodes], poses[:, :3], atol=1e-9)
    # no additional jumps between them
    jumps = [np.linalg.norm(np.diff(one.position_m, axis=0), axis=1) for one in (after, before)]
    assert np.max(np.abs(jumps[0] - jumps[1])) < 0.02
    # orientations are corrected along the geodesic of their neighbours' corrections
    turn, (a, b) = after.rotation * before.rotation.inv(), nodes[40:42]
    expected = Slerp(before.time_s[[a, b]], turn[[a, b]])(before.time_s[a:b])
    assert np.max((turn[a:b] * expected.inv()).magnitude()) < 1e-9


# ------------------------------------------------------------------ options and files


def test_loop_closure_times_may_be_unix_or_from_first_pose() -> None:
    source = read_trajectory_source(str(SLAM))
    relative = analyse_loop(source, closures=(GivenClosure(3.0, 80.0, 0.3),))
    start = float(source.trajectory.time_s[0])
    stamped = analyse_loop(source, closures=(GivenClosure(start + 3.0, start + 80.0, 0.3),))
    assert relative.closures[1] == stamped.closures[1]


def test_loop_command_rotates_slam_camera_frame_to_z_down() -> None:
    source = read_trajectory_source(str(SLAM))
    found = analyse_loop(source, landed_at=Landing(0.0, 0.0))
    assert found.odometry.trajectory.frame == "FRD"
    assert found.closure_error_m < 0.7  # the vehicle landed 0.4 m from its start
    height = found.odometry.trajectory.position_m[:, 2]
    assert np.ptp(height) < 2.5
    assert found.path_length_m == pytest.approx(86.0, abs=5.0)


@pytest.mark.parametrize(("how", "says"), [
    ({"closures": (GivenClosure(-5.0, 50.0),)}, "closure -5,50: the times"),
    ({"closures": (GivenClosure(20.0, 50.0, 200.0),)}, "SIGMA 200 is out of range"),
    ({"start_s": 500.0, "end_s": 600.0}, "has no poses between"),
    ({"start_s": 96.0, "end_s": 98.0}, "is too short for key frames"),
    ({"key_frames_m": 101.0}, "`key_frames_m` 101 is out of range"),
])  # fmt: skip
def test_loop_analysis_with_invalid_times_is_rejected(sample, how, says) -> None:
    with pytest.raises((TrajectoryError, SettingsError), match=says):
        analyse_loop(sample, **how)


def test_trajectory_argument_is_split_into_file_and_track_name(tmp_path: Path) -> None:
    assert split_path_and_part(f"{SAMPLE}:ekf2") == (SAMPLE, "ekf2")
    assert split_path_and_part(str(SAMPLE)) == (SAMPLE, None)
    odd = tmp_path / "a:vio"
    odd.write_bytes(b"")
    assert split_path_and_part(str(odd)) == (odd, None)
