"""Pose graphs in g2o's text format, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import TrajectoryError
from px4fuse.readers.text_table import at_line, is_number, quote, text_of
from px4fuse.reading import read_whole, shown
from px4fuse.trajectory.graph.initialisation import initialise
from px4fuse.trajectory.graph.model import FROM_FILE, PoseGraph

MAX_FILE_BYTES = 500_000_000
# Tag: dimension, vertices that it names, numbers that follow them
_TAGS = {
    "VERTEX_SE2": (2, 1, 3),
    "VERTEX_SE3:QUAT": (3, 1, 7),
    "EDGE_SE2": (2, 2, 3 + 6),
    "EDGE_SE3:QUAT": (3, 2, 7 + 21),
}
# Lines of g2o's own tools that add nothing to poses and edges between them
_IGNORED = ("PARAMS", "ROBOTLASER", "RAWLASER", "FLASER", "RLASER")
_TORO = ("VERTEX2", "VERTEX3", "EDGE2", "EDGE3")
# Files are printed with few digits: a matrix this far from semidefinite is meant as one
_ROUNDING = 1e-9
# Of a squared norm: what normalising again would not improve
_UNIT = 1e-15
_BIGGEST_ID = 2**63
# In 1/m² or 1/rad². Far beyond any measurement, and far from where squares and inverses overflow
_LEAST_INFORMATION, _MOST_INFORMATION = 1e-50, 1e50


@dataclass
class _Lines:
    """Lines of one tag of a file: which ones, the vertices that they name, their numbers."""

    file: str
    line: list[int] = field(default_factory=list)
    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)

    def refuse(self, row: int, what: str, remedy: str) -> TrajectoryError:
        """Error that names the line of a row."""
        return TrajectoryError(at_line(self.file, self.line[row], what, remedy))


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a pose graph.

    VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX are read; blank lines, comments
    (``#``), repeated blanks and Windows line ends are no matter. Vertices are put in the order of
    their numbers. One FIX is accepted and changes nothing but the frame: the first pose is what is
    held here. Where the file has no vertices, poses are made from the edges.

    Raises
    ------
    TrajectoryError
        One line with the file, the line and what to do, for what is not such a file, has a number
        that is not finite, an edge to a vertex that is not there, a vertex twice, a matrix that is
        no information matrix, or both kinds of pose.
    """
    file = Path(path)
    text = text_of(read_whole(file, TrajectoryError, MAX_FILE_BYTES))
    if text is None:
        raise TrajectoryError(
            f"{shown(file)}: not a text file", "Give a g2o file: VERTEX and EDGE lines."
        )
    return parse_g2o(text, shown(file))


def parse_g2o(text: str, name: str) -> PoseGraph:
    """Read a pose graph from its text.

    Parameters
    ----------
    name : str
        Of the file, for messages.

    Raises
    ------
    TrajectoryError
        As :func:`read_g2o`.
    """
    found = _split(text, name)
    in_space = [found[tag] for tag in _TAGS if _TAGS[tag][0] == 3 and found[tag].line]
    is_plane = bool(found["VERTEX_SE2"].line or found["EDGE_SE2"].line)
    if in_space and is_plane:
        first = min(in_space, key=lambda lines: lines.line[0])
        raise first.refuse(
            0, "poses in space (SE3) beside poses in the plane (SE2)", "Give one kind per file."
        )
    kind, dimension = ("SE2", 2) if is_plane else ("SE3:QUAT", 3)
    vertices, edges = found[f"VERTEX_{kind}"], found[f"EDGE_{kind}"]
    if not edges.line:
        raise TrajectoryError(
            f"{name}: no edges", "Give a g2o file with EDGE_SE2 or EDGE_SE3:QUAT lines."
        )
    width = 3 if is_plane else 7
    numbers, ends = _finite(edges), np.array(edges.ids, dtype=np.intp)
    if vertices.line:
        poses = _poses(vertices, _finite(vertices))
        numbered = np.array(vertices.ids, dtype=np.intp)[:, 0]
        order = np.argsort(numbered, kind="stable")
        ids, poses = numbered[order], poses[order]
        twice = np.flatnonzero(ids[1:] == ids[:-1])
        if len(twice):
            before, again = order[twice[0]], order[twice[0] + 1]
            first_line = vertices.line[before]
            what = f"vertex {ids[twice[0]]} for the second time (first on line {first_line})"
            raise vertices.refuse(again, what, "Take one of them out.")
    else:
        ids = np.unique(ends)
        poses = np.zeros((len(ids), width))
        poses[:, -1] = 0.0 if is_plane else 1.0
    index = _indices(edges, ids, ends)
    _require_fixed(found["FIX"], ids)
    graph = PoseGraph(
        dimension=dimension,
        ids=ids,
        poses=poses,
        first=index[:, 0],
        second=index[:, 1],
        measurements=_poses(edges, numbers[:, :width]),
        information=_information(edges, numbers[:, width:], 3 if is_plane else 6),
        initialised=FROM_FILE,
    )
    try:
        return graph if vertices.line else initialise(graph)
    except TrajectoryError as error:
        raise TrajectoryError(f"{name}: {error}") from None


def g2o_text(graph: PoseGraph) -> str:
    """A pose graph in g2o's format, which :func:`read_g2o` turns into the same numbers.

    Returns
    -------
    str
        Vertices, a FIX of the first one, edges; every number with all its digits.
    """
    kind = "SE2" if graph.dimension == 2 else "SE3:QUAT"
    ids = graph.ids.tolist()
    upper = np.triu_indices(graph.freedom)
    lines = [
        f"VERTEX_{kind} {number} {' '.join(map(repr, pose))}"
        for number, pose in zip(ids, graph.poses.tolist(), strict=True)
    ]
    lines.append(f"FIX {ids[0]}")
    numbers = np.hstack([graph.measurements, graph.information[:, upper[0], upper[1]]]).tolist()
    lines += [
        f"EDGE_{kind} {ids[i]} {ids[j]} {' '.join(map(repr, row))}"
        for i, j, row in zip(graph.first.tolist(), graph.second.tolist(), numbers, strict=True)
    ]
    return "\n".join(lines) + "\n"


def _split(text: str, name: str) -> dict[str, _Lines]:
    """Lines by tag; of FIX each vertex stands on a line of its own."""
    found = {tag: _Lines(name) for tag in (*_TAGS, "FIX")}
    for number, raw in enumerate(text.split("\n"), start=1):
        line = raw.partition("#")[0] if "#" in raw else raw
        parts = line.split()
        if not parts:
            continue
        tag = parts[0]
        if tag not in found:
            if tag.startswith(_IGNORED):
                continue
            raise TrajectoryError(f"{name}, line {number}: {_unknown(tag)}")
        into = found[tag]
        if tag == "FIX":
            into.line += [number] * len(parts[1:])
            into.ids += [[_id(each, name, number)] for each in parts[1:]]
            continue
        _, named, numbers = _TAGS[tag]
        if len(parts) != 1 + named + numbers:
            what = f"{tag} has {len(parts) - 1} numbers, not {named + numbers}"
            remedy = "Write the file again; it may be cut off."
            raise TrajectoryError(at_line(name, number, what, remedy))
        try:
            values = list(map(float, parts[1 + named :]))
        except ValueError:
            bad = next(each for each in parts[1 + named :] if not is_number(each))
            what = f"{quote(bad)} is not a number"
            raise TrajectoryError(at_line(name, number, what, "Correct it.")) from None
        into.line.append(number)
        into.ids.append([_id(each, name, number) for each in parts[1 : 1 + named]])
        into.numbers.append(values)
    return found


def _finite(lines: _Lines) -> Array:
    numbers = np.array(lines.numbers)
    bad = _first(~np.all(np.isfinite(numbers), axis=1))
    if bad is not None:
        raise lines.refuse(bad, "a number that is not finite", "Correct it, or take the line out.")
    return numbers


def _poses(lines: _Lines, numbers: Array) -> Array:
    """Poses with unit quaternions."""
    if numbers.shape[1] == 3:
        return numbers
    poses = numbers.copy()
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(poses[:, 3:], axis=1)
    bad = _first((norm < 1e-6) | ~(norm < 1e6))
    if bad is not None:
        raise lines.refuse(
            bad,
            f"a quaternion of length {norm[bad]:.3g} is not a rotation",
            "Give qx qy qz qw, of length 1, behind the position.",
        )
    # What is a unit quaternion already stays as it is, so that writing and reading changes nothing
    off = np.abs(norm - 1.0) > _UNIT
    poses[off, 3:] /= norm[off, None]
    return poses


def _information(lines: _Lines, numbers: Array, size: int) -> Array:
    """Symmetric matrices from their upper triangles, row by row."""
    row, column = np.triu_indices(size)
    made = np.empty((len(numbers), size, size))
    made[:, row, column] = made[:, column, row] = numbers
    entry = np.abs(numbers)
    tiny = (row == column) & (entry > 0.0) & (entry < _LEAST_INFORMATION)
    beyond = tiny | (entry > _MOST_INFORMATION)
    bad = _first(np.any(beyond, axis=1))
    if bad is not None:
        raise lines.refuse(
            bad,
            f"the information matrix has the entry {numbers[bad][beyond[bad]][0]:.3g}, which "
            "cannot be computed with",
            f"Give 0 for what the edge does not tell, else {_LEAST_INFORMATION:g} to "
            f"{_MOST_INFORMATION:g}.",
        )
    try:
        np.linalg.cholesky(made)
    except np.linalg.LinAlgError:
        values = np.linalg.eigvalsh(made)
        bad = _first(values[:, 0] < -_ROUNDING * np.maximum(values[:, -1], 0.0))
        if bad is not None:
            raise lines.refuse(
                bad,
                f"the information matrix has a negative eigenvalue ({values[bad, 0]:.3g})",
                "Give the upper triangle of an inverse covariance, row by row.",
            ) from None
    return made


def _indices(edges: _Lines, ids: IntArray, ends: IntArray) -> IntArray:
    """Places of the edges' vertices."""
    index = np.minimum(np.searchsorted(ids, ends), len(ids) - 1)
    missing = _first(np.any(ids[index] != ends, axis=1))
    if missing is not None:
        vertex = ends[missing][ids[index[missing]] != ends[missing]][0]
        raise edges.refuse(
            missing,
            f"an edge to vertex {vertex}, which the file does not have",
            "Add its VERTEX line, or take all of them out.",
        )
    same = _first(ends[:, 0] == ends[:, 1])
    if same is not None:
        raise edges.refuse(same, f"an edge from vertex {ends[same, 0]} to itself", "Take it out.")
    return index


def _require_fixed(fixed: _Lines, ids: IntArray) -> None:
    known = {*ids.tolist()}
    for row, (vertex,) in enumerate(fixed.ids):
        if vertex not in known:
            what = f"FIX of vertex {vertex}, which the file does not have"
            raise fixed.refuse(row, what, "Take the line out.")
        if [vertex] != fixed.ids[0]:
            raise fixed.refuse(
                row,
                f"FIX of a second vertex ({vertex} beside {fixed.ids[0][0]})",
                "One pose is held here: take the line out, or join the two by an edge.",
            )


def _first(bad: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> int | None:
    """Where the first one is."""
    return int(np.argmax(bad)) if np.any(bad) else None


def _id(text: str, name: str, line: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = _BIGGEST_ID
    if not -_BIGGEST_ID <= number < _BIGGEST_ID or "_" in text:
        what = f"{quote(text)} is not the number of a vertex"
        raise TrajectoryError(at_line(name, line, what, "Give an integer."))
    return number


def _unknown(tag: str) -> str:
    if tag in _TORO:
        return (
            f"{tag} is TORO's format. Convert it to g2o: the rotation is written otherwise, and the"
            " information matrix in another order."
        )
    return (
        f"{quote(tag)} is not read here. Poses (VERTEX_SE2 or VERTEX_SE3:QUAT) and edges between "
        "them (EDGE_SE2 or EDGE_SE3:QUAT) are; take other lines out."
    )
