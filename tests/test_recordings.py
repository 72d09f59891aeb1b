"""Recordings of other systems: each equals the original positions, or is refused by its name."""

import gzip
import json
import re
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY, shared
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from px4fuse.core.reading import zstd
from px4fuse.errors import Px4FuseError
from px4fuse.readers import read_log
from px4fuse.readers.position_file import PositionRecording, read_position_file
from px4fuse.readers.trajectory import read_trajectory

# Index and sign of each direction in (north, east, down)
DIRECTIONS = {
    "north": (0, 1), "south": (0, -1), "east": (1, 1), "west": (1, -1),
    "down": (2, 1), "up": (2, -1),
}  # fmt: skip
SHARED_FILES = [
    "motive.csv", "vicon_nexus.csv", "ros2_fields.csv", "tum.txt", "euroc.csv", "kitti.txt",
    "dwm1001_lec.txt", "dwm1001_les.txt", "pozyx.jsonl", "marvelmind.csv", "qorvo.csv",
    "iso_times.csv", "german.csv", "no_header.csv", "two_tags.csv", "quaternion_and_euler.csv",
    "bag.mcap", "rosbag2", "ros1.bag",
]  # fmt: skip
MAX_ERROR_M, MAX_ERROR_S = 1e-3, 1e-3


def read_original(folder: Path, name: str) -> np.ndarray:
    """Return time (UNIX, s), north, east and down (m) of each sample."""
    return np.loadtxt(folder / f"original_{name}.csv", delimiter=",", skiprows=1)[:, :4]


def largest_errors(
    recording: PositionRecording, original: np.ndarray, frame: str
) -> tuple[float, float]:
    """Return the largest errors of position (m) and time (s) against the original recording.

    Times on a local clock may differ by a constant offset.
    """
    time_s = recording.samples.index.to_numpy()
    assert len(time_s) == len(original)
    order, signs = np.transpose([
        DIRECTIONS[re.search(rf"\b{axis}[^,]*?\b({'|'.join(DIRECTIONS)})\b", frame)[1]]
        for axis in "xyz"
    ])  # fmt: skip
    xyz = original[:, 1:][:, order] * signs
    error_s = time_s - original[:, 0]
    if recording.clock_kind == "local":
        error_s = error_s - np.median(error_s)
    error_m = recording.samples[["x_m", "y_m", "z_m"]].to_numpy() - xyz
    return float(np.abs(error_m).max()), float(np.abs(error_s).max())


@pytest.mark.reallogs
@pytest.mark.parametrize("name", SHARED_FILES)
def test_read_position_file_equals_true_positions_of_example(name: str) -> None:
    folder = shared("cases/position_files")
    expected = json.loads((folder / "EXPECTED.json").read_text())["files"][name]
    options = expected["options"]
    body = {"body": options[options.index("--body") + 1]} if "--body" in options else {}
    recording = read_position_file(folder / expected.get("argument", name), **body)
    original = read_original(folder, expected["original"])
    error_m, error_s = largest_errors(recording, original, expected["frame"])
    assert error_m <= expected.get("within_m", MAX_ERROR_M)
    assert error_s <= MAX_ERROR_S


@pytest.mark.reallogs
def test_read_position_file_of_git_lfs_pointer_names_git_lfs() -> None:
    with pytest.raises(Px4FuseError, match=r"Git LFS.*git lfs pull"):
        read_position_file(shared("cases/position_files") / "lfs_pointer.csv")


# -- small files of each format --------------------------------------------------------------------

ROWS = 40
TIME_US = 1_795_253_650_937_000 + 100_000 * np.arange(ROWS)
TRACK_M = np.column_stack([
    3.0 * np.sin(np.arange(ROWS) / 9), np.linspace(-1.0, 4.0, ROWS), 1.2 + np.arange(ROWS) % 3 / 10
]).round(3)  # fmt: skip
ROTATION = Rotation.from_rotvec(np.linspace([0.0, 0.0, 0.0], [0.1, 0.0, 2.0], ROWS))
TIMES = [f"{t // 10**6}.{t % 10**6:06d}" for t in TIME_US.tolist()]
DATES = [datetime.fromtimestamp(t // 10**6, UTC) + timedelta(microseconds=t % 10**6)
         for t in TIME_US.tolist()]  # fmt: skip
XYZ = [",".join(f"{value:.3f}" for value in row) for row in TRACK_M.tolist()]
MM = [",".join(f"{1000 * value:.0f}" for value in row) for row in TRACK_M.tolist()]


def lines(rows, *header: str) -> str:
    return "".join(f"{row}\n" for row in (*header, *rows))


def rows(pattern: str, **columns) -> list[str]:
    """Format one row per sample; ``columns`` are lists of values of the samples."""
    columns = {"t": TIMES, "xyz": XYZ, "mm": MM, "i": range(ROWS)} | columns
    return [pattern.format(**{name: column[i] for name, column in columns.items()})
            for i in range(ROWS)]  # fmt: skip


MOTIVE = lines(
    rows("{i},{i}e-1,0,0,0,9,9,9,0,0,0,{mm}"),
    "Format Version,1.23,Take Name,a,Length Units,Millimeters,Rotation Type,XYZ",
    "",
    ",Type" + ",Rigid Body" * 12,
    ",Name" + ",wand" * 6 + ",drone" * 6,
    ",ID" + ",1" * 6 + ",2" * 6,
    "," + ",Rotation,Rotation,Rotation,Position,Position,Position" * 2,
    "Frame,Time (Seconds)" + ",X,Y,Z" * 4,
)
VICON_HEADER = ("10", ",,wand:wand,,,drone:drone,,", "Frame,Sub Frame" + ",TX,TY,TZ" * 2)
VICON = lines(rows("{i},0,1,2,3,{mm}"), "Segments", *VICON_HEADER, "," + ",mm" * 6)
VICON_MARKERS = lines(
    [*rows("{i},0,{mm}"), "", "Devices", "1000"],
    "Trajectories", "10", ",,drone:top,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm",
)  # fmt: skip
LEC = "{t} DIST,1,AN0,1151,-1.50,-2.00,2.40,3.60"
POZYX = (
    '{{"tagId":"A","timestamp":{t},"success":true,"data":{{"coordinates":'
    '{{"x":{x},"y":{y},"z":{z}}}}}}}'
)
X_MM, Y_MM, Z_MM = ([row.split(",")[axis] for row in MM] for axis in range(3))
CEST = timezone(timedelta(hours=2))
# name: file name, content, body, clock
FORMATS = {
    "Motive": ("m.csv", MOTIVE, "drone", "local"),
    "Vicon Nexus segments": ("v.csv", VICON, "drone", "local"),
    "Vicon Nexus trajectories": ("v.csv", VICON_MARKERS, None, "local"),
    "seconds and nanoseconds": ("r.csv", lines(
        rows("{n},{s},map,{xyz}", s=(TIME_US // 10**6).tolist(),
             n=(TIME_US % 10**6 * 1000).tolist()),
        "header.stamp.nanosec,header.stamp.sec,frame_id,x,y,z"), None, "UNIX"),
    "TUM": ("t.txt", lines(rows("{t} {p} 0 0 0 1", p=[row.replace(",", " ") for row in XYZ])),
            None, "UNIX"),
    "EuRoC": ("data.csv", lines(rows("{ns},{xyz},1,0,0,0", ns=(TIME_US * 1000).tolist()),
              "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
              "q_RS_y [], q_RS_z []"), None, "UNIX"),
    "lec with lost positions": ("d.txt", lines(
        [*rows(LEC + ",POS,{xyz},97"), LEC.format(t=TIMES[3])]), None, "UNIX"),
    "lec with dates": ("d.txt", lines(
        rows("{d} DIST,0,POS,{xyz},97", d=[d.isoformat() for d in DATES])), None, "UNIX"),
    "les": ("d.log", lines(rows(
        "[{d}] 1151[-1.50,-2.00,2.40]=3.46 le_us=2408 est[{xyz},74]",
        d=[d.strftime("%Y-%m-%d %H:%M:%S.%f") for d in DATES]), "dwm> les"), None, "local"),
    "Pozyx": ("p.jsonl", lines(
        [*rows(POZYX, x=X_MM, y=Y_MM, z=Z_MM),
         '{"tagId":"A","timestamp":1.0,"success":false,"data":{"code":2}}']), None, "UNIX"),
    "JSON lines": ("p.jsonl", lines(rows(
        '{{"time":{t},"position":{{"x":{x}e-3,"y":{y}e-3,"z":{z}e-3}}}}', x=X_MM, y=Y_MM, z=Z_MM)),
        None, "UNIX"),
    "Marvelmind with two beacons": ("m.csv", lines(rows(
        "{ms},100,8123,7,{xyz},2,3.536,3,12.287\n{ms},100,8123,8,9,9,9",
        ms=(TIME_US // 1000).tolist())), "7", "UNIX"),
    "Qorvo": ("q.csv", lines(rows("{ms},DECA,{xyz},72,3.5", ms=(TIME_US // 1000).tolist()),
              "timestamp_ms,node_id,pos_x,pos_y,pos_z,est_qual,d0"), None, "UNIX"),
    "ISO 8601 with zone": ("i.csv", lines(
        rows("{d},{xyz}", d=[d.astimezone(CEST).isoformat() for d in DATES]), "time,x,y,z"),
        None, "UNIX"),
    "ISO 8601 without zone": ("i.csv", lines(
        rows("{d},{xyz}", d=[d.strftime("%Y-%m-%d %H:%M:%S.%f") for d in DATES]), "time,x,y,z"),
        None, "local"),
    "decimal commas": ("g.csv", lines(
        [row.replace(",", ";").replace(".", ",") for row in rows("{t},{xyz}")],
        "Zeit [s];x [m];y [m];z [m]"), None, "UNIX"),
    "two tags": ("t.csv", lines(rows("{t},B,{xyz}\n{t},A,1,2,3"), "time,tag,x,y,z"), "B", "UNIX"),
    "quaternion x y z w": ("q.csv", lines(
        rows("{t},1,2,3,0,0,0,1,{xyz}"), "time,roll,pitch,yaw,x,y,z,w,pos_x,pos_y,pos_z"),
        None, "UNIX"),
}  # fmt: skip


def check_track(recording: PositionRecording, clock: str) -> None:
    original = np.column_stack([TIME_US * 1e-6, TRACK_M])
    error_m, error_s = largest_errors(recording, original, "x north, y east, z down")
    assert error_m <= 1e-9
    assert error_s <= 2e-6
    assert recording.clock_kind == clock


@pytest.mark.parametrize("name", FORMATS)
def test_read_position_file_in_each_format_equals_original(name: str, tmp_path: Path) -> None:
    file_name, content, body, clock = FORMATS[name]
    path = tmp_path / file_name
    path.write_text(content)
    check_track(read_position_file(path, body=body), clock)


@pytest.mark.parametrize("name", ["Motive", "Vicon Nexus segments", "Marvelmind with two beacons"])
def test_read_position_file_with_two_bodies_lists_their_names(name: str, tmp_path: Path) -> None:
    file_name, content, body, _ = FORMATS[name]
    path = tmp_path / file_name
    path.write_text(content)
    with pytest.raises(Px4FuseError, match=rf"bodies or tags .*{body}.*--body"):
        read_position_file(path)
    check_track(read_position_file(f"{path}:{body}"), FORMATS[name][3])


def test_read_kitti_poses_takes_timestamps_from_times_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    matrices = np.concatenate([ROTATION.as_matrix(), TRACK_M[:, :, None]], axis=2)
    np.savetxt(path, matrices.reshape(ROWS, 12))
    with pytest.raises(Px4FuseError, match=r"KITTI poses, which have no times.*poses_times\.txt"):
        read_position_file(path)
    (tmp_path / "poses_times.txt").write_text(lines(TIMES))
    check_track(read_position_file(path), "UNIX")
    trajectory = read_trajectory(path)
    assert trajectory.frame == "camera"
    assert (trajectory.rotation.inv() * ROTATION).magnitude().max() < 1e-9


# -- ROS bags --------------------------------------------------------------------------------------

ODOMETRY = "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\n" + (
    "float32[3] position\nfloat32[4] q\n"
)
MESSAGES = ["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "PointStamped",
            "Odometry", "Path", "VehicleOdometry"]  # fmt: skip


def make_messages(store, kind: str) -> list:
    """Return the messages of the track; a path contains all poses of the track."""
    types = {name.rpartition("/")[2]: made for name, made in store.types.items()}
    messages = []
    for t, xyz, q in zip(TIME_US.tolist(), TRACK_M.tolist(), ROTATION.as_quat(), strict=True):
        stamp = store.types["builtin_interfaces/msg/Time"](sec=t // 10**6, nanosec=t % 10**6 * 1000)
        more = {"seq": 0} if "seq" in types["Header"].__dataclass_fields__ else {}
        header = types["Header"](stamp=stamp, frame_id="map", **more)
        point, quaternion = types["Point"](*xyz), types["Quaternion"](*q)
        pose = types["Pose"](position=point, orientation=quaternion)
        covariance = np.diag([0.01, 0.04, 0.09, 1, 1, 1]).ravel()
        with_covariance = types["PoseWithCovariance"](pose=pose, covariance=covariance)
        stamped = types["PoseStamped"](header=header, pose=pose)
        if kind == "PointStamped":
            stamped = types[kind](header=header, point=point)
        elif kind == "TransformStamped":
            moved = types["Transform"](translation=types["Vector3"](*xyz), rotation=quaternion)
            stamped = types[kind](header=header, child_frame_id="a", transform=moved)
        elif kind == "PoseWithCovarianceStamped":
            stamped = types[kind](header=header, pose=with_covariance)
        elif kind == "Odometry":
            zero = types["Vector3"](0.0, 0.0, 0.0)
            twist = types["Twist"](linear=zero, angular=zero)
            twist = types["TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
            stamped = types[kind](header, "base", with_covariance, twist)
        elif kind == "VehicleOdometry":
            q_px4 = np.roll(q, 1).astype(np.float32)
            stamped = types[kind](0, t, 1, np.float32(xyz), q_px4)
        messages.append(stamped)
    return [types["Path"](header=header, poses=messages)] if kind == "Path" else messages


def write_bag(folder: Path, kind: str, plugin: StoragePlugin | None) -> Path:
    """Write the track and a topic of text to a bag of ROS 2, or of ROS 1 without plugin."""
    store = get_typestore(Stores.ROS2_HUMBLE if plugin else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(ODOMETRY, "px4_msgs/msg/VehicleOdometry"))
    message_type = next(name for name in store.types if name.endswith(f"/{kind}"))
    path = folder / ("bag" if plugin else "track.bag")
    serialize = store.serialize_cdr if plugin else store.serialize_ros1
    with Writer2(path, version=9, storage_plugin=plugin) if plugin else Writer1(path) as bag:
        text = bag.add_connection("/text", "std_msgs/msg/String", typestore=store)
        note = store.types["std_msgs/msg/String"](data="a")
        bag.write(text, int(TIME_US[0]) * 1000, serialize(note, "std_msgs/msg/String"))
        connection = bag.add_connection("/drone/pose", message_type, typestore=store)
        for i, message in enumerate(make_messages(store, kind)):
            receive_ns = int(TIME_US[i] + 5000 + 4000 * (i % 2)) * 1000
            bag.write(connection, receive_ns, serialize(message, message_type))
    return path


@pytest.mark.parametrize("kind", MESSAGES)
def test_read_position_file_of_each_ros_message_equals_original(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, kind, StoragePlugin.MCAP)
    recording = read_position_file(path)
    if kind == "VehicleOdometry":
        assert recording.frames == ("ned",)
        np.testing.assert_allclose(recording.samples[["x_m", "y_m", "z_m"]], TRACK_M, atol=1e-6)
        return
    check_track(recording, "UNIX")
    if kind in ("PoseWithCovarianceStamped", "Odometry"):
        sigmas = recording.samples[["sigma_x_m", "sigma_y_m", "sigma_z_m"]]
        np.testing.assert_allclose(sigmas, np.tile([0.1, 0.2, 0.3], (ROWS, 1)))


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP, None])
def test_read_trajectory_from_each_rosbag_format_equals_original(plugin, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "PoseStamped", plugin)
    files = [path, next(path.iterdir())] if plugin else [path]
    for file in files:
        if file.suffix == ".yaml":
            continue
        trajectory = read_trajectory(file, "/drone/pose")
        np.testing.assert_array_equal(trajectory.position_m, TRACK_M)
        assert (trajectory.rotation.inv() * ROTATION).magnitude().max() < 1e-9
    with pytest.raises(
        Px4FuseError, match=r"topics with positions: /drone/pose\. Give the topic as .*:TOPIC"
    ):
        read_trajectory(path, "/text")


# -- refused and compressed files ------------------------------------------------------------------


@pytest.mark.parametrize(("content", "words"), [
    (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer.*git lfs pull"),
    (b"\xa3\x95\x80\x80", "ArduPilot DataFlash log"),
    (b"FMT, 128, 89, FMT, BBnNZ, Type\n", "ArduPilot DataFlash log"),
    (b"# Onboard parameters for Vehicle 1\n", "QGroundControl parameter file"),
    (b"PK\x03\x04abc", "zip archive or an Excel workbook"),
    (b"ULog\x01\x125\x01", "PX4 ULog"),
])  # fmt: skip
@pytest.mark.parametrize("read", [read_position_file, read_trajectory])
def test_error_on_unsupported_file_names_its_format(read, content, words, tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    path.write_bytes(content)
    with pytest.raises(Px4FuseError, match=words):
        read(path)


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.bag"])
def test_read_damaged_rosbag_is_rejected(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"no bag" * 99)
    with pytest.raises(Px4FuseError, match=f"{name}: the ROS bag cannot be read"):
        read_position_file(path)


@pytest.mark.parametrize("compress", [gzip.compress, zstd.compress])
def test_read_log_opens_compressed_ulog(compress, tmp_path: Path) -> None:
    log = REPOSITORY / "sample_logs" / "aisle_uwb.ulg"
    path = tmp_path / "log.ulg"
    path.write_bytes(compress(log.read_bytes()))
    flight = read_log(path)
    assert flight.log.sha256 == read_log(log).log.sha256
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(Px4FuseError, match="cannot be read"):
        read_log(path)


# -- evo -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["TUM", "EuRoC", "KITTI", "ROS 1", "ROS 2"])
def test_read_trajectory_returns_same_poses_as_evo(name: str, tmp_path: Path) -> None:
    """ATE and RPE of equal poses are equal to those of evo, see test_evaluation."""
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path = tmp_path / "poses.txt"
    if name.startswith("ROS"):
        plugin = StoragePlugin.SQLITE3 if name == "ROS 2" else None
        path = write_bag(tmp_path, "PoseStamped", plugin)
        with Reader2(path) if plugin else Reader1(path) as reader:
            theirs = file_interface.read_bag_trajectory(reader, "/drone/pose")
    elif name == "KITTI":
        matrices = np.concatenate([ROTATION.as_matrix(), TRACK_M[:, :, None]], axis=2)
        np.savetxt(path, matrices.reshape(ROWS, 12))
        (tmp_path / "times.txt").write_text(lines(TIMES))
        theirs = file_interface.read_kitti_poses_file(path)
    else:
        path.write_text(FORMATS[name][1])
        read = {
            "TUM": file_interface.read_tum_trajectory_file,
            "EuRoC": file_interface.read_euroc_csv_trajectory,
        }[name]
        theirs = read(path)
    ours = read_trajectory(path)
    np.testing.assert_allclose(ours.position_m, theirs.positions_xyz, rtol=0, atol=1e-12)
    turns = Rotation.from_quat(theirs.orientations_quat_wxyz, scalar_first=True)
    assert (ours.rotation.inv() * turns).magnitude().max() < 1e-9
    if name != "KITTI":
        np.testing.assert_allclose(ours.time_s, theirs.timestamps, rtol=0, atol=5e-7)
