"""Reading and writing of g2o files, and all error messages."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from cli_tools import run_main
from conftest import shared
from hypothesis import given
from hypothesis import strategies as st

from px4fuse.errors import TrajectoryError
from px4fuse.readers.g2o import format_g2o, parse_g2o, read_g2o
from px4fuse.trajectory.graph import lie, solver
from px4fuse.trajectory.graph.model import INITIAL_POSES_FROM_FILE, PoseGraph

UNIT_2 = "1 0 0 1 0 1"
UNIT_3 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
PLANE = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {UNIT_2}\n"
SPACE = (
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
    f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {UNIT_3}\n"
)


def assert_equal_graphs(a: PoseGraph, b: PoseGraph) -> None:
    for name in ("ids", "poses", "first_nodes", "second_nodes", "measurements", "information"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


@pytest.mark.parametrize(("whole", "unit"), [(PLANE, UNIT_2), (SPACE, UNIT_3)])
def test_parse_g2o_reads_information_as_upper_triangle_by_rows(whole: str, unit: str) -> None:
    size = 3 if whole == PLANE else 6
    upper = np.triu_indices(size)
    expected = np.zeros((size, size))
    expected[upper] = np.arange(len(upper[0])) + 100.0 * (upper[0] == upper[1])
    graph = parse_g2o(whole.replace(unit, " ".join(map(str, expected[upper]))), "a.g2o")
    assert (graph.dimension, graph.initial_pose_origin) == (size // 3 + 1, INITIAL_POSES_FROM_FILE)
    np.testing.assert_array_equal(np.triu(graph.information[0]), expected)
    np.testing.assert_array_equal(graph.information[0], graph.information[0].T)


def test_read_g2o_ignores_comments_and_line_order(tmp_path: Path) -> None:
    file = tmp_path / "a.g2o"
    messy = (
        "\ufeff# made by hand\r\n\r\n" + PLANE.replace("\n", " # remark \r\n").replace(" ", "   ")
        + "FIX 0\r\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\r\n  # end"
    )  # fmt: skip
    for text in (messy, "\n".join(PLANE.splitlines()[::-1])):
        file.write_text(text, encoding="utf-8")
        assert_equal_graphs(read_g2o(file), parse_g2o(PLANE, "a.g2o"))


def test_parse_g2o_normalises_quaternions() -> None:
    graph = parse_g2o(SPACE.replace("0 0 0 1\nE", "0 0 0 -2\nE"), "a.g2o")
    assert graph.poses[1].tolist() == [1, 0, 0, 0, 0, 0, -1]


def test_parse_g2o_without_vertices_initialises_poses_from_edges() -> None:
    graph = parse_g2o(f"EDGE_SE2 7 9 1 0 0 {UNIT_2}\nEDGE_SE2 9 12 1 0 1 {UNIT_2}", "a.g2o")
    assert graph.ids.tolist() == [7, 9, 12]
    np.testing.assert_allclose(graph.poses, [[0, 0, 0], [1, 0, 0], [2, 0, 1]], atol=1e-12)
    assert graph.initial_pose_origin in {
        "chained odometry edges",
        "chordal initialisation",
    }


EDGE = f"EDGE_SE2 0 1 1 0 0 {UNIT_2}"
NOT_READ, NO_TABLE, NO_VERTEX = (
    "are not supported",
    "columns with numbers",
    "a vertex id is not a 64-bit",
)
INVALID_TEXTS = {
    "no edges": ("VERTEX_SE2 0 0 0 0\n", "no edges"),
    "empty": ("", "no edges"),
    "mixed": (PLANE + SPACE, "line 4: the file contains 2D entries (SE2) and 3D"),
    "unknown edge": (
        PLANE + f"EDGE_SE2_XY 0 1 1 0 {UNIT_2}",
        f"line 4: lines with the tag 'EDGE_SE2_XY' {NOT_READ}",
    ),
    "TORO": (f"EDGE2 0 1 1 0 0 {UNIT_2}", f"line 1: lines with the tag 'EDGE2' {NOT_READ}"),
    "cut off": (
        PLANE + "EDGE_SE2 0 1 1 0",
        f"line 4: 'EDGE_SE2 0 1 1 0' does not have 12 {NO_TABLE}",
    ),
    "nothing": (PLANE + "EDGE_SE2", "line 4: 'EDGE_SE2' does not have 12"),
    "too long": (
        PLANE.replace("1 0 0\n", "1 0 0 0\n"),
        "line 2: 'VERTEX_SE2 1 1 0 0 0' does not have 5",
    ),
    "word": (
        PLANE.replace("1 1 0 0\n", "1 1 x 0\n"),
        "line 2: 'VERTEX_SE2 1 1 x 0' does not have 5",
    ),
    "NaN": (PLANE.replace("1 1 0 0\n", "1 1 nan 0\n"), "line 2: the line contains a number that"),
    "infinite": (PLANE.replace(UNIT_2, "1 0 0 inf 0 1"), "line 3: the line contains a number that"),
    "fraction": (PLANE.replace("SE2 0 1", "SE2 0 1.5"), f"line 3: {NO_VERTEX}"),
    "underscore": (PLANE.replace("SE2 0 1", "SE2 0 1_0"), f"line 3: {NO_VERTEX}"),
    "huge": (PLANE.replace("SE2 0 1", "SE2 0 " + "9" * 30), f"line 3: {NO_VERTEX}"),
    "missing": (
        PLANE + EDGE.replace("0 1", "1 5", 1),
        "line 4: the edge refers to a vertex that is not in",
    ),
    "twice": (PLANE + "\nVERTEX_SE2 1 0 0 0", "line 5: another line defines the vertex"),
    "self": (PLANE + EDGE.replace("0 1", "1 1", 1), "line 4: the edge connects a vertex to itself"),
    "negative": (PLANE.replace(UNIT_2, "1 0 0 1 0 -1"), "line 3: the information matrix has a neg"),
    "indefinite": (PLANE.replace(UNIT_2, "1 2 0 1 0 1"), "line 3: the information matrix has a n"),
    "no rotation": (SPACE.replace("0 0 0 1\nE", "0 0 0 0\nE"), "line 2: the quaternion does not"),
    "endless": (
        SPACE.replace("0 0 0 1\nE", "0 0 0 1.8e308\nE"),
        "line 2: the line contains a number that",
    ),
    "long": (SPACE.replace("0 0 0 1\nE", "0 0 0 1.7e308\nE"), "line 2: the quaternion does not"),
    "two FIX": (PLANE + "FIX 0\nFIX 1", "line 5: the file fixes a second vertex"),
    "parts": (
        f"{EDGE}\n{EDGE.replace('0 1', '5 6', 1)}",
        "2 disconnected parts: vertex 5 is not connected",
    ),
    "too small": (
        PLANE.replace(UNIT_2, "1e-51 0 0 1 0 1"),
        "line 3: an element of the information matrix",
    ),
    "smallest": (
        PLANE.replace(UNIT_2, "1 0 0 5e-324 0 1"),
        "line 3: an element of the information matrix",
    ),
    "far vertex": (
        PLANE.replace("1 1 0 0\n", "1 1e30 0 0\n"),
        "line 2: a position (m) or angle (rad) is outside",
    ),
    "far edge": (
        SPACE.replace("QUAT 0 1 1", "QUAT 0 1 -1e9"),
        "line 3: a position (m) or angle (rad) is outside",
    ),
    "too large": (
        PLANE.replace(UNIT_2, "1 0 0 1 0 1e51"),
        "line 3: an element of the information matrix",
    ),
}


@pytest.mark.parametrize("case", INVALID_TEXTS)
def test_parse_g2o_with_invalid_text_names_the_line(case: str) -> None:
    text, expected = INVALID_TEXTS[case]
    with pytest.raises(TrajectoryError) as refused:
        parse_g2o(text, "made.g2o")
    message = str(refused.value)
    assert message.startswith("made.g2o")
    assert expected in message
    assert "\n" not in message
    assert message.endswith(".")


def test_read_g2o_from_binary_or_missing_file_is_rejected(tmp_path: Path) -> None:
    binary = tmp_path / "log.g2o"
    binary.write_bytes(b"ULog\x01\x12\x35\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match=r"^log\.g2o is not a text file"):
        read_g2o(binary)
    with pytest.raises(
        TrajectoryError, match=r"^none\.g2o: the file cannot be read \(No such file"
    ):
        read_g2o(tmp_path / "none.g2o")


def test_parse_g2o_accepts_rank_deficient_information() -> None:
    rank_3 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 0 0 0 0 0 0"
    graph = parse_g2o(SPACE.replace(UNIT_3, rank_3), "a.g2o")
    assert np.linalg.matrix_rank(graph.information[0]) == 3


@given(st.text(alphabet="VERTEXSDG_23:QUAFI 0159.-einf#\n\r", max_size=200))
def test_parse_g2o_of_random_text_raises_only_its_own_error(text: str) -> None:
    for whole in (text, PLANE + text, SPACE + text):
        with contextlib.suppress(TrajectoryError):
            parse_g2o(whole, "a.g2o")


def random_graph(dimension: int, count: int, seed: int = 0) -> PoseGraph:
    rng = np.random.default_rng(seed)
    free = 3 if dimension == 2 else 6
    root = rng.normal(size=(count - 1, free, free))
    return PoseGraph(
        dimension, np.sort(rng.choice(10 * count, count, replace=False)),
        lie.exp(rng.normal(size=(count, free))), np.arange(count - 1), np.arange(1, count),
        lie.exp(rng.normal(size=(count - 1, free))), root @ root.transpose(0, 2, 1),
    )  # fmt: skip


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_graph_written_as_g2o_is_read_back_exactly(dimension: int, seed: int) -> None:
    once = parse_g2o(format_g2o(random_graph(dimension, 200, seed)), "a.g2o")
    text = format_g2o(once)
    again = parse_g2o(text, "a.g2o")
    assert_equal_graphs(once, again)
    assert format_g2o(again) == text


@pytest.mark.reallogs
def test_public_graph_written_as_g2o_is_read_back_exactly() -> None:
    for file in sorted(shared("pose_graphs").glob("*.g2o")):
        once = read_g2o(file)
        assert_equal_graphs(once, parse_g2o(format_g2o(once), file.name))


# --- extreme numbers ---

SQUARE = "".join(f"EDGE_SE2 {i} {i + 1} 1 0 1.57 {{}}\n" for i in range(4))


@pytest.mark.parametrize("edge", [1, 4])
@pytest.mark.parametrize("entry", ["1e-50", "1e-12", "1e12", "1e50", "0"])
def test_loop_command_on_extreme_g2o_weights_gives_finite_values(
    tmp_path, monkeypatch, capsys, entry, edge
):
    numbers = UNIT_2.split()
    numbers[0 if edge == 1 else 5] = entry  # information of a position or a heading
    text = SQUARE + "EDGE_SE2 0 4 0.1 0.1 6.2 {}\nEDGE_SE2 0 3 0.1 1.1 4.7 {}\n"
    path = tmp_path / "g.g2o"
    path.write_text(text.format(*[" ".join(numbers) if edge == i else UNIT_2 for i in range(6)]))
    code, out, err = run_main(monkeypatch, capsys, "loop", path, "--json", "-", "--robust")
    assert (code, err) == (0, "")
    assert json.loads(out, parse_constant=pytest.fail)["graph"]["solutions"]


def test_loop_command_on_g2o_reports_missing_convergence(tmp_path, monkeypatch, capsys):
    path = tmp_path / "g.g2o"
    far = "".join(f"VERTEX_SE2 {number} {number} 3 0\n" for number in range(5))
    path.write_text(far + SQUARE.format(*[UNIT_2] * 4) + f"EDGE_SE2 0 4 0.1 0.1 6.2 {UNIT_2}\n")
    assert "Solver" not in run_main(monkeypatch, capsys, "loop", path)[1]
    monkeypatch.setattr(solver, "_MAX_DAMPING", 0.0)
    monkeypatch.setattr(solver, "_MIN_COST_DECREASE_RATIO", 1e9)
    code, out, _ = run_main(monkeypatch, capsys, "loop", path, "--json", tmp_path / "g.json")
    assert code == 0
    assert "not converged: pose graph with all loop closures" in out
    solutions = json.loads((tmp_path / "g.json").read_text())["graph"]["solutions"]
    assert not solutions["all"]["converged"]
