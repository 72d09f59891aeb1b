"""Trajectory files in many dialects: equal poses, or an error of one line."""

import hashlib
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from exchange import replace
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from px4fuse.errors import TrajectoryError
from px4fuse.readers import position_file
from px4fuse.readers.trajectory import format_tum, read_trajectory
from px4fuse.trajectory.model import Trajectory

# Track of all dialects
POSES = 50
NANOSECONDS = 1_403_636_579_763_555_584 + 50_000_000 * np.arange(POSES)
POSITION_M = np.random.default_rng(20261121).normal(0.0, 3.0, (POSES, 3)).round(6)
ROTATION = Rotation.random(POSES, random_state=1)
QUATERNION = ROTATION.as_quat().round(9)  # x y z w
EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
    "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
EUROC_MORE = (
    ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]"
)


def rows(
    separator: str = " ", stamps: str = "s", order: str = "xyzw", number: str = ".9f"
) -> list[str]:
    times = {
        "s": [f"{t // 10**9}.{t % 10**9:09d}" for t in NANOSECONDS.tolist()],
        "ns": [str(t) for t in NANOSECONDS.tolist()],
        "orb": [f"{t}.000000" for t in NANOSECONDS.tolist()],
        "exponent": [f"{Decimal(t) / 10**9:.18e}" for t in NANOSECONDS.tolist()],
    }[stamps]
    quaternion = QUATERNION[:, ["xyzw".index(axis) for axis in order]]
    values = np.column_stack((POSITION_M, quaternion)).tolist()
    return [
        separator.join((time, *(format(value, number) for value in row)))
        for time, row in zip(times, values, strict=True)
    ]


def text(lines: list[str], end: str = "\n") -> str:
    return end.join(lines) + end


COMMENTS = ["# estimated trajectory", "# timestamp tx ty tz qx qy qz qw"]
COMMAS = rows(",", "ns", "wxyz")
DIALECTS: dict[str, str | bytes] = {
    "TUM": text(rows()),
    "comments": text([*COMMENTS, *rows()[:9], "# a remark", "", *rows()[9:]]),
    "tabs": text(rows("\t")),
    "double spaces and a last one": text([f"  {row} " for row in rows("  ")]),
    "CRLF": text(rows(), "\r\n"),
    "BOM": b"\xef\xbb\xbf" + text([*COMMENTS, *rows()]).encode(),
    "UTF-16": text(rows()).encode("utf-16"),
    "latin-1 comment": b"# K\xf6ln\n" + text(rows()).encode(),
    "exponents": text(rows(stamps="exponent", number=".18e")),
    "header without #": text(["timestamp tx ty tz qx qy qz qw", *rows()]),
    "w first by its header": text(["# time x y z qw qx qy qz", *rows(order="wxyz")]),
    "remarks behind": text([f"{row} # keyframe" for row in rows()]),
    "EuRoC, 8": text([EUROC_HEADER, *COMMAS], "\r\n"),
    "EuRoC, 17": text([EUROC_HEADER + EUROC_MORE, *(row + ",0.1" * 9 for row in COMMAS)]),
    "EuRoC without header": text(COMMAS),
    "EuRoC, header without #": text([EUROC_HEADER[1:], *rows(", ", "ns", "wxyz")]),
    "TUM between commas": text(["#t,tx,ty,tz,qx,qy,qz,qw", *rows(",")]),
    "ORB-SLAM3's SaveTrajectoryEuRoC": text(rows(stamps="orb")),
    "no line feed at the end": text(rows())[:-1],
}


def write(folder: Path, content: str | bytes, name: str = "track.txt") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("dialect", DIALECTS)
def test_read_trajectory_of_every_file_format_gives_equal_poses(
    dialect: str, tmp_path: Path
) -> None:
    path = write(tmp_path, DIALECTS[dialect])
    got = read_trajectory(path)
    expected = np.array([float(Decimal(t) / 10**9) for t in NANOSECONDS.tolist()])
    # one unit in the last place of UNIX time in float64
    np.testing.assert_allclose(got.time_s, expected, rtol=0, atol=2.4e-7)
    np.testing.assert_array_equal(got.position_m, POSITION_M)
    assert (got.rotation.inv() * ROTATION).magnitude().max() < 1e-8
    assert got.kind == ("truth" if dialect == "EuRoC, 17" else "unknown")
    assert (got.name, got.frame, got.unix_offset_s) == ("track.txt", "unknown", 0.0)
    assert got.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert got.size_bytes == path.stat().st_size
    assert all(note.endswith(".") for note in got.notes)
    is_ns = dialect.startswith(("EuRoC", "ORB"))
    assert is_ns == any(", unit ns" in note for note in got.notes)


def test_read_trajectory_with_local_clock_has_no_unix_offset(tmp_path: Path) -> None:
    values = text(rows()[:4]).replace("14036365", "")
    assert read_trajectory(write(tmp_path, values)).unix_offset_s is None
    lines = [f"{12_000_000_000 + 33_000_000 * i}.000000 {i} 0 0 0 0 0 1" for i in range(9)]
    got = read_trajectory(write(tmp_path, text(lines)))
    np.testing.assert_allclose(got.time_s, 12.0 + 0.033 * np.arange(9), rtol=1e-15)
    assert got.unix_offset_s is None


@pytest.mark.parametrize("name", ["MH_04_groundtruth.txt", "truth/data.csv", "room_gt.txt", ""])
def test_read_trajectory_detects_ground_truth_by_file_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / (name or "track.txt")
    path.parent.mkdir(exist_ok=True)
    path.write_text(("" if name else "# Ground truth trajectory\n") + text(rows()))
    assert read_trajectory(path).kind == "truth"


@pytest.mark.parametrize(("axes", "tilt_deg", "frame"), [
    ("xzy", 15.0, "camera"), ("xzy", 30.0, "unknown"), ("xyz", 0.0, "unknown"),
])  # fmt: skip
def test_camera_frame_is_detected_from_horizontal_motion(axes, tilt_deg, frame, tmp_path) -> None:
    angle = np.linspace(0.0, 6.0, 200)
    level = np.column_stack((9 * np.sin(angle), 6 - 6 * np.cos(angle), 0.1 * np.sin(7 * angle)))
    position = level[:, ["xyz".index(axis) for axis in axes]]
    position = Rotation.from_euler("x", tilt_deg, degrees=True).apply(position)
    made = Trajectory("t", "slam", angle, position, Rotation.identity(200))
    got = read_trajectory(write(tmp_path, format_tum(made)))
    assert (got.kind, got.frame) == ("slam", frame)


def test_read_trajectory_reports_gaps_and_repeated_timestamps(tmp_path: Path) -> None:
    time = np.arange(1000) * 0.05
    keep = ((time < 10) | (time > 14)) & ((time < 30) | (time > 31))
    made = Trajectory("t", "unknown", time, np.tile(POSITION_M, (20, 1)), Rotation.identity(1000))
    notes = " ".join(read_trajectory(write(tmp_path, format_tum(made[keep]))).notes)
    gaps = "Poses are missing for 5.1 s in 2 gaps. The longest gap begins 10.0 s after the"
    assert gaps in notes
    irregular = made[np.flatnonzero(np.random.default_rng(1).random(1000) < 0.2)]
    assert "key frames" in " ".join(read_trajectory(write(tmp_path, format_tum(irregular))).notes)
    lines = format_tum(made).split("\n")
    lines.insert(500, lines[500])
    again = read_trajectory(write(tmp_path, "\n".join(lines)))
    assert len(again) == 1000
    assert any("or after the year 2100): 1." in note for note in again.notes)


def test_read_trajectory_drops_incomplete_last_line(tmp_path: Path) -> None:
    got = read_trajectory(write(tmp_path, text(rows())[:-50]))
    assert len(got) == POSES - 1
    assert "The last line of the position file was dropped, because it is incomplete." in got.notes


TUM_ROWS = rows()


def changed(line: int, new: str) -> str:
    return text([*COMMENTS, *TUM_ROWS[: line - 3], new, *TUM_ROWS[line - 2 :]])


def with_field(line: int, column: int, field: str) -> str:
    fields = TUM_ROWS[line - 3].split()
    fields[column] = field
    return changed(line, " ".join(fields))


STAMPS_S = range(1403636579, 1403636588)
INVALID_FILES: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "the file is empty"),
    "comments": ("# a\n# b\n\n  \n", "contain no header"),
    "text": ("Dear reader,\nthis is a letter.\n", "The first line is 'Dear reader"),
    "binary": (bytes(range(256)) * 9, "a binary file"),
    "ULog": (b"ULog\x01\x12\x35\x01" + bytes(99), "is a PX4 ULog, not a recording"),
    "KITTI": ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5, "KITTI poses, which have no times. Save the times"),
    "other columns": ("t,x,y,z\n" + "1,2,3,4\n" * 5, "1 usable rows, fewer than 3"),
    "commas, no header": (
        text(rows(",")),
        "has no header that names its columns",
    ),
    "two poses": (text(TUM_ROWS[:2]), "2 usable rows, fewer than 3"),
    "text within": (with_field(7, 2, "abc"), "1 of 50 rows are not valid poses"),
    "time that is text": (with_field(7, 0, "abc"), "1 of 50 rows are not valid poses"),
    "NaN": (with_field(8, 3, "nan"), "1 of 50 rows are not valid poses"),
    "infinite": (with_field(8, 5, "-inf"), "a quaternion does not have norm 1"),
    "NaN time": (with_field(9, 0, "nan"), "1 of 50 rows are not valid poses"),
    "too few columns": (changed(10, "1 2 3"), "1 of 50 rows are not valid poses"),
    "too many columns": (changed(11, TUM_ROWS[0] + " 1"), "1 of 50 rows are not valid poses"),
    "zero quaternion": (
        changed(12, TUM_ROWS[9].split()[0] + " 1 2 3 0 0 0 0"),
        "a quaternion does not have norm 1",
    ),
    "no quaternion": (
        text([f"{i} 1 2 3 4 5 6 7" for i in range(9)]),
        "a quaternion does not have norm 1",
    ),
    "back in time": (changed(13, TUM_ROWS[2]), "1 of 50 rows are not valid poses"),
    "equal timestamps": (
        text([f"{i // 2} 1 2 3 0 0 0 1" for i in range(99)]),
        "49 of 99 rows are not valid poses",
    ),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_read_trajectory_from_invalid_file_is_rejected(case: str, tmp_path: Path) -> None:
    content, words = INVALID_FILES[case]
    with pytest.raises(TrajectoryError) as caught:
        read_trajectory(write(tmp_path, content))
    message = str(caught.value)
    assert message.startswith("track.txt")
    assert words in message
    assert "\n" not in message
    assert message.endswith(".")


def test_read_trajectory_from_too_large_file_is_rejected(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(position_file, "MAX_FILE_BYTES", 10)
    with pytest.raises(TrajectoryError, match="more than the limit"):
        read_trajectory(write(tmp_path, text(rows())))


NUMBER = st.floats(-1e6, 1e6)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    steps=hnp.arrays(float, 8, elements=st.floats(1e-3, 10.0)),
    start=st.sampled_from([0.0, 17.25, 1_795_253_728.219561]),
    position=hnp.arrays(float, (8, 3), elements=NUMBER),
    quaternion=hnp.arrays(float, (8, 4), elements=st.floats(0.1, 1.0)),
)
def test_trajectory_written_as_tum_is_read_back_exactly(
    steps, start, position, quaternion, tmp_path
) -> None:
    time_s, rotation = start + np.cumsum(steps), Rotation.from_quat(quaternion)
    made = Trajectory("t", "unknown", time_s, position, rotation)
    once = read_trajectory(write(tmp_path, format_tum(made)))
    np.testing.assert_array_equal(once.time_s, made.time_s)
    np.testing.assert_array_equal(once.position_m, made.position_m)
    np.testing.assert_array_equal(once.rotation.as_quat(), made.rotation.as_quat())
    assert format_tum(once) == format_tum(made)


def test_tum_file_has_unix_time_and_requires_orientation(tmp_path: Path) -> None:
    made = Trajectory("t", "vio", np.arange(5.0), POSITION_M[:5], ROTATION[:5], unix_offset_s=1.5e9)
    assert read_trajectory(write(tmp_path, format_tum(made))).time_s[0] == 1.5e9
    with pytest.raises(TrajectoryError, match="has no orientations"):
        format_tum(replace(made, rotation=None))


@pytest.mark.parametrize("quaternion", ["0 0 0 0", "nan nan nan nan"])
def test_trajectory_without_quaternions_has_no_rotation(quaternion, tmp_path) -> None:
    path = tmp_path / "positions.tum"
    path.write_text("".join(f"{i} {i} 2 3 {quaternion}\n" for i in range(9)))
    assert read_trajectory(str(path)).rotation is None
