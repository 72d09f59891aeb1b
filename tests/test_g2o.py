"""Reading and writing of g2o files, and every refusal."""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_tools import run_main
from hypothesis import given
from hypothesis import strategies as st

from px4fuse.errors import TrajectoryError
from px4fuse.readers.g2o import g2o_text, parse_g2o, read_g2o
from px4fuse.trajectory.graph import lie
from px4fuse.trajectory.graph.model import FROM_FILE, PoseGraph

UNIT_2 = "1 0 0 1 0 1"
UNIT_3 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
PLANE = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {UNIT_2}\n"
SPACE = (
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
    f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {UNIT_3}\n"
)


def equal(a: PoseGraph, b: PoseGraph) -> None:
    for name in ("ids", "poses", "first", "second", "measurements", "information"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


def test_plane() -> None:
    graph = parse_g2o(PLANE.replace(UNIT_2, "1 2 3 40 5 60"), "a.g2o")
    assert graph.dimension == 2
    assert graph.initialised == FROM_FILE
    assert graph.information[0].tolist() == [[1, 2, 3], [2, 40, 5], [3, 5, 60]]


def test_space() -> None:
    numbers = " ".join(str(100 if k in {0, 6, 11, 15, 18, 20} else k) for k in range(21))
    graph = parse_g2o(SPACE.replace(UNIT_3, numbers), "a.g2o")
    assert graph.dimension == 3
    assert graph.information[0, 0].tolist() == [100, 1, 2, 3, 4, 5]
    assert graph.information[0, :, 5].tolist() == [5, 10, 14, 17, 19, 100]


def test_layout_is_no_matter() -> None:
    messy = (
        "\ufeff# made by hand\r\n\r\n" + PLANE.replace("\n", "  \r\n").replace(" ", "   ")
        + "FIX 0\r\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\r\n  # end"
    )  # fmt: skip
    equal(parse_g2o(messy.removeprefix("\ufeff"), "a.g2o"), parse_g2o(PLANE, "a.g2o"))


def test_marks_comments_and_order_are_no_matter(tmp_path: Path) -> None:
    file = tmp_path / "a.g2o"
    lines = PLANE.replace("0 0 0\n", "0 0 0 # start\n")
    file.write_text("\ufeff" + lines, encoding="utf-8")
    equal(read_g2o(file), parse_g2o(PLANE, "a.g2o"))
    vertices_last = "\n".join(PLANE.splitlines()[::-1])
    equal(parse_g2o(vertices_last, "a"), parse_g2o(PLANE, "a"))


def test_quaternions_are_normalised() -> None:
    graph = parse_g2o(SPACE.replace("0 0 0 1\nE", "0 0 0 -2\nE"), "a.g2o")
    assert graph.poses[1].tolist() == [1, 0, 0, 0, 0, 0, -1]


def test_without_vertices() -> None:
    graph = parse_g2o(f"EDGE_SE2 7 9 1 0 0 {UNIT_2}\nEDGE_SE2 9 12 1 0 1 {UNIT_2}", "a.g2o")
    assert graph.ids.tolist() == [7, 9, 12]
    np.testing.assert_allclose(graph.poses, [[0, 0, 0], [1, 0, 0], [2, 0, 1]], atol=1e-12)
    assert graph.initialised in {"odometry edges composed", "chordal initialisation"}


EDGE = f"EDGE_SE2 0 1 1 0 0 {UNIT_2}"
REFUSED = {
    "no edges": ("VERTEX_SE2 0 0 0 0\n", "no edges"),
    "empty": ("", "no edges"),
    "mixed": (PLANE + SPACE, "line 4: poses in space (SE3) beside poses in the plane (SE2)"),
    "unknown edge": (PLANE + f"EDGE_SE2_XY 0 1 1 0 {UNIT_2}", "line 4: 'EDGE_SE2_XY' is not"),
    "unknown vertex": ("VERTEX_XY 5 1 2\n" + PLANE, "line 1: 'VERTEX_XY' is not read here"),
    "TORO": (f"EDGE2 0 1 1 0 0 {UNIT_2}", "line 1: EDGE2 is TORO's format. Convert it"),
    "misspelt": (PLANE + "EGDE_SE2 0 1", "line 4: 'EGDE_SE2' is not read here"),
    "cut off": (PLANE + "EDGE_SE2 0 1 1 0", "line 4: EDGE_SE2 has 4 numbers, not 11"),
    "too long": (PLANE.replace("1 0 0\n", "1 0 0 0\n"), "line 2: VERTEX_SE2 has 5 numbers, not 4"),
    "word": (PLANE.replace("1 1 0 0\n", "1 1 x 0\n"), "line 2: 'x' is not a number"),
    "NaN": (PLANE.replace("1 1 0 0\n", "1 1 nan 0\n"), "line 2: a number that is not finite"),
    "infinite": (PLANE.replace(UNIT_2, "1 0 0 inf 0 1"), "line 3: a number that is not finite"),
    "fraction": (PLANE.replace("SE2 0 1", "SE2 0 1.5"), "line 3: '1.5' is not the number of a"),
    "underscore": (PLANE.replace("SE2 0 1", "SE2 0 1_0"), "line 3: '1_0' is not the number of a"),
    "huge": (PLANE.replace("SE2 0 1", "SE2 0 " + "9" * 30), "line 3: '999999999999999999999999"),
    "missing": (PLANE + EDGE.replace("0 1", "1 5", 1), "line 4: an edge to vertex 5, which"),
    "twice": (PLANE + "\nVERTEX_SE2 1 0 0 0", "line 5: vertex 1 for the second time (first on "),
    "self": (PLANE + EDGE.replace("0 1", "1 1", 1), "line 4: an edge from vertex 1 to itself"),
    "negative": (PLANE.replace(UNIT_2, "1 0 0 1 0 -1"), "line 3: the information matrix has a neg"),
    "indefinite": (PLANE.replace(UNIT_2, "1 2 0 1 0 1"), "line 3: the information matrix has a n"),
    "no rotation": (SPACE.replace("0 0 0 1\nE", "0 0 0 0\nE"), "line 2: a quaternion of length 0"),
    "endless rotation": (
        SPACE.replace("0 0 0 1\nE", "0 0 0 1.8e308\nE"),
        "line 2",
    ),
    "long rotation": (
        SPACE.replace("0 0 0 1\nE", "0 0 0 1.7e308\nE"),
        "line 2: a quaternion of length",
    ),
    "FIX of none": (PLANE + "FIX 8", "line 4: FIX of vertex 8, which the file does not have"),
    "two FIX": (PLANE + "FIX 0\nFIX 1", "line 5: FIX of a second vertex (1 beside 0)"),
    "parts": (f"{EDGE}\n{EDGE.replace('0 1', '5 6', 1)}", "falls into 2 parts: vertex 5 is not"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case: str) -> None:
    text, expected = REFUSED[case]
    with pytest.raises(TrajectoryError) as refused:
        parse_g2o(text, "made.g2o")
    message = str(refused.value)
    assert message.startswith("made.g2o")
    assert expected in message
    assert "\n" not in message
    assert message.endswith(".")


def test_files_that_are_none(tmp_path: Path) -> None:
    binary = tmp_path / "log.g2o"
    binary.write_bytes(b"ULog\x01\x12\x35\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match=r"^log\.g2o: not a text file"):
        read_g2o(binary)
    with pytest.raises(TrajectoryError, match=r"^none\.g2o: cannot be read \(No such file"):
        read_g2o(tmp_path / "none.g2o")


def test_rank_deficient_information_is_read() -> None:
    told = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 0 0 0 0 0 0"
    graph = parse_g2o(SPACE.replace(UNIT_3, told), "a.g2o")
    assert np.linalg.matrix_rank(graph.information[0]) == 3


@given(st.text(alphabet="VERTEXSDG_23:QUAFI 0159.-einf#\n\r", max_size=200))
def test_any_text_is_read_or_refused(text: str) -> None:
    for whole in (text, PLANE + text, SPACE + text):
        with contextlib.suppress(TrajectoryError):
            parse_g2o(whole, "a.g2o")


def made(dimension: int, count: int, seed: int = 0) -> PoseGraph:
    rng = np.random.default_rng(seed)
    free = 3 if dimension == 2 else 6
    root = rng.normal(size=(count - 1, free, free))
    return PoseGraph(
        dimension,
        np.sort(rng.choice(10 * count, count, replace=False)),
        lie.exp(rng.normal(size=(count, free))),
        np.arange(count - 1),
        np.arange(1, count),
        lie.exp(rng.normal(size=(count - 1, free))),
        root @ root.transpose(0, 2, 1),
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_round_trip_is_exact(dimension: int, seed: int) -> None:
    once = parse_g2o(g2o_text(made(dimension, 200, seed)), "a.g2o")
    text = g2o_text(once)
    again = parse_g2o(text, "a.g2o")
    equal(once, again)
    assert g2o_text(again) == text


@pytest.mark.parametrize("count", [1_001, 4_001])
def test_the_work_per_line_is_little_and_does_not_grow(count: int) -> None:
    """Calls are counted, which take the same number on every machine."""
    text = g2o_text(made(3, count))
    calls = 0

    def counted(_frame: object, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(counted)
    try:
        parse_g2o(text, "a.g2o")
    finally:
        sys.setprofile(before)
    assert calls < 12 * len(text.splitlines())


@pytest.mark.reallogs
def test_public_graphs_come_back_the_same() -> None:
    folder = Path(__file__).resolve().parents[2] / "shared" / "pose_graphs"
    if not folder.is_dir():
        pytest.skip("the public pose graphs (../shared/pose_graphs) are not beside the repository")
    for file in sorted(folder.glob("*.g2o")):
        once = read_g2o(file)
        equal(once, parse_g2o(g2o_text(once), file.name))


# --- numbers that cannot be computed with ---

SQUARE = "".join(f"EDGE_SE2 {i} {i + 1} 1 0 1.57 {{}}\n" for i in range(4))


def square(information: str, edge: int) -> str:
    """A path around a square that closes twice, with another information in one edge."""
    text = SQUARE + "EDGE_SE2 0 4 0.1 0.1 6.2 {}\nEDGE_SE2 0 3 0.1 1.1 4.7 {}\n"
    return text.format(*[information if edge == one else UNIT_2 for one in range(6)])


@pytest.mark.parametrize("edge", [1, 4])
@pytest.mark.parametrize("entry", ["5e-324", "1e-300", "1e-51", "1e51", "1e300"])
def test_information_that_overflows_is_refused_with_its_line(
    tmp_path, monkeypatch, capsys, entry, edge
) -> None:
    path = tmp_path / "g.g2o"
    path.write_text(square(f"{entry} 0 0 1 0 1", edge))
    code, out, err = run_main(monkeypatch, capsys, "loop", path)
    assert (code, out) == (2, "")
    said = f"g.g2o, line {edge + 1}: the information matrix has the entry {float(entry):.3g}, which"
    assert said in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("edge", [1, 4])
@pytest.mark.parametrize("row", [0, 5])
@pytest.mark.parametrize("entry", ["1e-50", "1e-30", "1e-12", "1e12", "1e30", "1e50", "0"])
def test_information_of_any_size_that_is_read_gives_numbers(
    tmp_path, monkeypatch, capsys, entry, row, edge
) -> None:
    """Warnings are errors in these tests, and JSON holds neither NaN nor infinity."""
    numbers = UNIT_2.split()
    numbers[row] = entry
    path = tmp_path / "g.g2o"
    path.write_text(square(" ".join(numbers), edge))
    code, out, err = run_main(monkeypatch, capsys, "loop", path, "--json", "-", "--robust")
    assert (code, err) == (0, "")
    assert json.loads(out, parse_constant=pytest.fail)["graph"]["solutions"]
