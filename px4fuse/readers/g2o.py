"""Reader and writer of pose graphs in the g2o text format (SE2 and SE3)."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from px4fuse.core.arrays import Array, BoolArray, IntArray
from px4fuse.core.reading import display_name, read_bytes_limited
from px4fuse.errors import TrajectoryError
from px4fuse.trajectory.graph.model import (
    INITIAL_POSES_FROM_FILE,
    PoseGraph,
    compute_initial_poses,
)

from .recording_table import decode_text, is_number, quote
from .trajectory import MAX_COORDINATE_M, UNIT_NORM_TOLERANCE

MAX_FILE_BYTES = 500_000_000
_TAGS = ("VERTEX_SE2", "VERTEX_SE3:QUAT", "EDGE_SE2", "EDGE_SE3:QUAT")
# Ignored lines begin with these words: parameters and laser scans
_SKIPPED_TAGS = ("PARAMS", "ROBOTLASER", "RAWLASER", "FLASER", "RLASER")
_FORMAT_REMEDY = (
    "Give poses as VERTEX_SE2 or VERTEX_SE3:QUAT, and edges as EDGE_SE2 or EDGE_SE3:QUAT. Remove "
    "all other lines."
)
_LINE_REMEDY = "Correct or remove the invalid line."
_VERTEX_ID_PATTERN = re.compile("[+-]?[0-9]{1,19}")
# Maximum vertex id: GTSAM writes 64-bit symbols, such as 6989586621679009792 for a0
_MAX_VERTEX_ID = 2**63 - 1
# Negative eigenvalues below this fraction of the largest eigenvalue are rounding errors
_EIGENVALUE_TOLERANCE = 1e-9
# Valid range (1/m², 1/rad²) of information matrix elements, so that their products do not overflow
_MIN_INFORMATION_ELEMENT, _MAX_INFORMATION_ELEMENT = 1e-50, 1e50


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a pose graph from a g2o file.

    The file contains lines with VERTEX_SE2 and EDGE_SE2, or VERTEX_SE3:QUAT and EDGE_SE3:QUAT.
    Without vertices, the initial poses are computed from the edges.

    Raises
    ------
    TrajectoryError
        The file is not a g2o file, or a line is invalid.
    """
    path = Path(path)
    name = display_name(path)
    text = decode_text(read_bytes_limited(path, TrajectoryError, MAX_FILE_BYTES))
    if text is None:
        raise TrajectoryError(f"{name} is not a text file", _FORMAT_REMEDY)
    return parse_g2o(text, name)


@dataclass(frozen=True)
class _TaggedLines:
    """Lines of a g2o file that begin with the same tag, such as EDGE_SE2."""

    file_name: str
    # Line number and text of each line
    lines: list[tuple[int, str]]

    def raise_where(self, is_invalid: BoolArray, reason: str, remedy: str = _LINE_REMEDY) -> None:
        """Raise TrajectoryError for the first invalid line, if any."""
        for row in np.argwhere(is_invalid)[:1, 0].tolist():
            raise _make_line_error(self.file_name, self.lines[row][0], reason, remedy)

    def parse(self, id_count: int, value_count: int) -> tuple[IntArray, Array]:
        """Parse all lines: vertex ids, shape (n, id_count), and the other values.

        Raises
        ------
        TrajectoryError
            A line has the wrong number of columns, or a value is not valid.
        """
        texts = [text for _, text in self.lines]
        columns = [("tag", "U1"), ("ids", "U80", (id_count,)), ("values", "f8", (value_count,))]
        try:
            table = np.loadtxt(texts, dtype=columns, ndmin=1)
        except ValueError:
            column_count = 1 + id_count + value_count
            invalid_rows = (
                row
                for row, cells in enumerate(map(str.split, texts))
                if len(cells) != column_count or not all(map(is_number, cells[1 + id_count :]))
            )
            # If no invalid line is found, the first line is reported
            line_number, text = self.lines[next(invalid_rows, 0)]
            reason = f"{quote(text)} does not have {column_count} columns with numbers"
            raise _make_line_error(self.file_name, line_number, reason) from None
        ids, values = table["ids"], np.ascontiguousarray(table["values"])
        is_invalid_id = [
            _VERTEX_ID_PATTERN.fullmatch(id_text) is None or abs(int(id_text)) > _MAX_VERTEX_ID
            for id_text in ids.flat
        ]
        self.raise_where(
            np.reshape(is_invalid_id, ids.shape),
            "a vertex id is not a 64-bit integer",
            "Give an integer as vertex id.",
        )
        self.raise_where(~np.isfinite(values), "the line contains a number that is not finite")
        # The first three values are x, y, z (m), or x, y (m) and angle (rad)
        self.raise_where(
            np.abs(values[:, :3]) >= MAX_COORDINATE_M,
            f"a position (m) or angle (rad) is outside ±{MAX_COORDINATE_M:.0e}",
        )
        return ids.astype(np.int64), values


def _make_line_error(
    name: str, line_number: int, reason: str, remedy: str = _LINE_REMEDY
) -> TrajectoryError:
    """Return an error that names the file and the line."""
    return TrajectoryError(f"{name}, line {line_number}: {reason}", remedy)


def parse_g2o(text: str, name: str) -> PoseGraph:
    """Parse the text of a g2o file. ``name`` is the file name for error messages."""
    lines_by_tag = _group_lines_by_tag(text, name)
    is_2d = any(tagged.lines for tag, tagged in lines_by_tag.items() if tag.endswith("SE2"))
    dimension, pose_type, pose_value_count = (2, "SE2", 3) if is_2d else (3, "SE3:QUAT", 7)
    for tag, tagged in lines_by_tag.items():
        if not tag.endswith(pose_type):
            tagged.raise_where(
                np.ones(len(tagged.lines), bool),
                "the file contains 2D entries (SE2) and 3D entries (SE3)",
                "Keep only the 2D or only the 3D entries of the file.",
            )
    vertices, edges = lines_by_tag[f"VERTEX_{pose_type}"], lines_by_tag[f"EDGE_{pose_type}"]
    if not edges.lines:
        raise TrajectoryError(f"{name} contains no edges", _FORMAT_REMEDY)
    information_size = 3 * (dimension - 1)
    information_value_count = len(np.triu_indices(information_size)[0])
    edge_vertex_ids, edge_values = edges.parse(2, pose_value_count + information_value_count)
    if vertices.lines:
        vertex_ids, poses = vertices.parse(1, pose_value_count)
        poses = _normalise_quaternions(vertices, poses)
        ids, first_rows = np.unique(vertex_ids, return_index=True)
        vertices.raise_where(
            ~np.isin(np.arange(len(vertex_ids)), first_rows),
            "another line defines the vertex with this id",
            "Keep only one line for each vertex id.",
        )
        poses = poses[first_rows]
    else:
        ids = np.unique(edge_vertex_ids)
        poses = np.zeros((len(ids), pose_value_count))
        poses[:, 6:] = 1.0  # 3D: the identity quaternion has w = 1; 2D: no such column
    # Row of each edge's vertices in ids. An unknown id gives the row of another vertex
    vertex_indices = np.minimum(np.searchsorted(ids, edge_vertex_ids), len(ids) - 1)
    edges.raise_where(
        ids[vertex_indices] != edge_vertex_ids,
        "the edge refers to a vertex that is not in the file",
        "Add the VERTEX line of the missing vertex, or remove all VERTEX lines.",
    )
    edges.raise_where(
        edge_vertex_ids[:, 0] == edge_vertex_ids[:, 1],
        "the edge connects a vertex to itself",
        "Remove the invalid edge.",
    )
    graph = PoseGraph(
        dimension=dimension,
        ids=ids,
        poses=poses,
        first_nodes=vertex_indices[:, 0],
        second_nodes=vertex_indices[:, 1],
        measurements=_normalise_quaternions(edges, edge_values[:, :pose_value_count]),
        information=_make_information_matrices(
            edges, edge_values[:, pose_value_count:], information_size
        ),
        initial_pose_origin=INITIAL_POSES_FROM_FILE,
    )
    try:
        return graph if vertices.lines else compute_initial_poses(graph)
    except TrajectoryError as error:
        raise TrajectoryError(f"{name}: {error}") from None


def format_g2o(graph: PoseGraph) -> str:
    """Write a pose graph as the text of a g2o file, with all digits of float64."""
    pose_type = "SE2" if graph.dimension == 2 else "SE3:QUAT"
    ids = graph.ids.tolist()
    upper_triangle = np.triu_indices(graph.information.shape[-1])
    lines = [
        f"VERTEX_{pose_type} {vertex_id} {' '.join(map(repr, pose))}"
        for vertex_id, pose in zip(ids, graph.poses.tolist(), strict=True)
    ]
    lines.append(f"FIX {ids[0]}")
    edge_values = np.hstack(
        [graph.measurements, graph.information[:, upper_triangle[0], upper_triangle[1]]]
    ).tolist()
    edges = zip(graph.first_nodes.tolist(), graph.second_nodes.tolist(), edge_values, strict=True)
    lines += [
        f"EDGE_{pose_type} {ids[i]} {ids[j]} {' '.join(map(repr, values))}"
        for i, j, values in edges
    ]
    return "\n".join(lines) + "\n"


def _group_lines_by_tag(text: str, name: str) -> dict[str, _TaggedLines]:
    """Group the lines of a g2o file by tag, without comments, FIX and ignored lines."""
    lines_by_tag = {tag: _TaggedLines(name, []) for tag in _TAGS}
    fixed_ids: set[str] = set()
    for line_number, raw_line in enumerate(text.split("\n"), start=1):
        line = raw_line.partition("#")[0].strip()
        if not line:
            continue
        tag, *values = line.split()
        if tag in lines_by_tag:
            lines_by_tag[tag].lines.append((line_number, line))
        elif tag == "FIX":
            fixed_ids.update(values)
            if len(fixed_ids) > 1:
                raise _make_line_error(
                    name,
                    line_number,
                    "the file fixes a second vertex (tag FIX), but only one can be fixed",
                    "Fix only one vertex. To keep the relative pose of two vertices, add an edge.",
                )
        elif not tag.startswith(_SKIPPED_TAGS):
            raise _make_line_error(
                name,
                line_number,
                f"lines with the tag {quote(tag)} are not supported",
                _FORMAT_REMEDY,
            )
    return lines_by_tag


def _normalise_quaternions(lines: _TaggedLines, poses: Array) -> Array:
    """Return the poses with unit quaternions. 2D poses (3 columns) have no quaternion."""
    if poses.shape[1] == 3:
        return poses
    with np.errstate(over="ignore"):
        quaternion_norms = np.linalg.norm(poses[:, 3:], axis=1)
    lines.raise_where(
        (quaternion_norms < 1e-6) | ~(quaternion_norms < 1e6),
        "the quaternion does not have unit length",
        "Give the unit quaternion qx qy qz qw after the position.",
    )
    # Unit quaternions are not rescaled: rounding would change their last digits
    quaternion_norms[np.abs(quaternion_norms - 1.0) <= UNIT_NORM_TOLERANCE] = 1.0
    return np.hstack([poses[:, :3], poses[:, 3:] / quaternion_norms[:, None]])


def _make_information_matrices(edges: _TaggedLines, numbers: Array, dimension: int) -> Array:
    """Return the information matrices, shape (n, dimension, dimension).

    ``numbers`` contains the upper triangle of each matrix, row by row.
    """
    row, column = np.triu_indices(dimension)
    matrices = np.empty((len(numbers), dimension, dimension))
    matrices[:, row, column] = matrices[:, column, row] = numbers
    magnitudes = np.abs(numbers)
    is_too_small = (row == column) & (magnitudes > 0.0) & (magnitudes < _MIN_INFORMATION_ELEMENT)
    edges.raise_where(
        is_too_small | (magnitudes > _MAX_INFORMATION_ELEMENT),
        "an element of the information matrix is too large or too close to 0",
        "Each element of an information matrix must be 0, or have a magnitude of "
        f"{_MIN_INFORMATION_ELEMENT:g} to {_MAX_INFORMATION_ELEMENT:g}.",
    )
    eigenvalues = np.linalg.eigvalsh(matrices)
    edges.raise_where(
        eigenvalues[:, 0] < -_EIGENVALUE_TOLERANCE * np.maximum(eigenvalues[:, -1], 0.0),
        "the information matrix has a negative eigenvalue",
        "Write the upper triangle of the edge's inverse covariance matrix, row by row.",
    )
    return matrices
