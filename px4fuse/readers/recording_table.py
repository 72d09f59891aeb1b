"""Detection of the format of a text file, and of the table of positions in it.

Supported are tables with or without header, exports of Motive and Vicon Nexus, JSON lines, KITTI
poses, and text formats of UWB systems.
"""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from px4fuse.core.reading import UTF_16_BYTE_ORDER_MARKS, display_name, read_text
from px4fuse.core.record import read_toml
from px4fuse.core.text import join_first_names
from px4fuse.errors import LogError, Px4FuseError

from .position_names import find_position_columns, read_column_name

# Maximum size (bytes) of a position file
MAX_FILE_BYTES = 500_000_000
# Number of lines in which the header is searched
MAX_HEADER_LINES = 1000
# Number of characters in which the header is searched
MAX_HEADER_CHARS = 200_000
MAX_COLUMNS = 200
COLUMNS_OPTION = "`columns` TIME,X,Y,Z"
SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}
HEADERLESS_TABLE_FORMAT = "table without header"
# Valid UNIX times (s): years 2000 to 2100
MIN_VALID_UNIX_TIME_S, MAX_VALID_UNIX_TIME_S = 946_684_800.0, 4_102_444_800.0
# Number of characters that are searched for signs of a binary file
_CHECKED_CHAR_COUNT = 100_000
_CONTROL_CHARACTER_PATTERN = re.compile("[\x00-\x08\x0e-\x1b]")
_NUMBER_PATTERN = re.compile(
    r"[+-]?(?:(?:[0-9]+\.?|[0-9]*\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf)", re.IGNORECASE
)
_TEXT_FORMATS = read_toml(__file__, dict[str, list[dict[str, Any]]], "formats.toml")
_ISO_DATE_PATTERN = re.compile(r"\d{4}-\d\d-\d\d")


@dataclass(frozen=True)
class PositionTable:
    """Table of positions in a file, as text with named columns."""

    file_name: str
    # Name of the file format; "" for a table with a header
    format: str
    column_names: list[str]
    # Text of the rows, without the header
    rows_text: str
    separator: str = ","
    # Line number of the header, 0 without header; None for formats without lines
    header_line_number: int | None = None
    # Possible coordinate frames; empty if all are possible
    frames: tuple[str, ...] = ()
    # Frame rate, if the time column contains frame numbers
    rate_hz: float | None = None
    # True if the table contains only one rigid body, tag or topic
    has_only_chosen_body: bool = False
    notes: tuple[str, ...] = ()

    def describe_format(self) -> str:
        """Describe the file format; for a table with a header, separator and header line."""
        if self.format:
            return f"the file format is {self.format}"
        separator_name = SEPARATORS[self.separator]
        return f"the separator is {separator_name}, the header is line {self.header_line_number}"

    def format_labels(self, *columns: int | None) -> str:
        """Join the names of columns for a message to the user."""
        labels = dict.fromkeys(
            quote(self.column_names[index]) if self.column_names[index] else f"column {index + 1}"
            for index in columns
            if index is not None
        )
        return join_first_names([*labels], 12)

    def format_first_line_number(self, rows: pd.Index) -> str:
        """Return the line number of the first row as text, such as " (first: line 7)"."""
        return (
            ""
            if self.header_line_number is None
            else f" (first: line {self.header_line_number + 1 + rows[0]})"
        )

    def check_row_width(self) -> None:
        """Raise LogError if the first row has more columns than the header."""
        first_row = self.rows_text[:MAX_HEADER_CHARS].lstrip("\n").partition("\n")[0]
        row_width = len(_split_line(first_row.rstrip(f"{self.separator} "), self.separator))
        if row_width > len(self.column_names):
            raise LogError(
                f"{self.file_name}: the header has {len(self.column_names)} columns, but the rows "
                f"have {row_width}.",
                "Write numbers with decimal points, and give each column a name.",
            )

    def read_cells(self, columns: Iterable[int]) -> pd.DataFrame:
        """Return the text of the given columns, without empty rows."""
        column_indices = sorted({*columns})
        try:
            texts = pd.read_csv(
                io.StringIO(self.rows_text),
                sep=r"\s+" if self.separator == " " else self.separator,
                header=None,
                index_col=False,
                names=range(column_indices[-1] + 1),
                usecols=column_indices,
                dtype=str,
                skipinitialspace=True,
                quoting=csv.QUOTE_NONE,
                skip_blank_lines=False,  # so that the index gives the line number
            )
        except ValueError as error:
            raise LogError(
                f"{self.file_name} contains no table of numbers",
                "Export the positions as CSV again.",
            ) from error
        return texts.dropna(how="all")


def refuse_foreign_format(path: Path, first_bytes: bytes, error_type: type[Px4FuseError]) -> None:
    """Raise an error if px4fuse does not support the file format."""
    name = display_name(path)
    for foreign_format in _TEXT_FORMATS["foreign"]:
        starts = tuple(start.encode("latin-1") for start in foreign_format["starts"])
        if first_bytes.startswith(starts):
            raise error_type(
                f"{name}: the file is {foreign_format['name']}",
                foreign_format["remedy"].format(name=name),
            )


def decode_text(content: bytes) -> str | None:
    """Decode a text in UTF-8, UTF-16 or Latin-1, with line feeds as line ends; None if binary."""
    if content.startswith(UTF_16_BYTE_ORDER_MARKS):
        text = content[: len(content) // 2 * 2].decode("utf-16", errors="replace")
    else:
        content = content.rstrip(b"\0\x1a")  # NUL at the end after a power loss, 0x1a from DOS
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text or _CONTROL_CHARACTER_PATTERN.search(text, 0, _CHECKED_CHAR_COUNT):
        return None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_number(text: str) -> bool:
    """Return True if the text is a number, NaN or infinity."""
    return _NUMBER_PATTERN.fullmatch(text) is not None


def quote(text: str) -> str:
    """Put a text in quotation marks, and shorten it to 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def choose_body(file_name: str, body_names: Iterable[str], wanted_body: str | None) -> str:
    """Return the name of the selected rigid body.

    ``drone`` also selects ``drone:drone``, because Vicon Nexus repeats the name of a body.

    Raises
    ------
    LogError
        The file does not contain the body, or contains several and none is selected.
    """
    names = [*dict.fromkeys(body_names)]
    matches = [name for name in names if wanted_body in (None, name)] or [
        name for name in names if name.partition(":")[0] == wanted_body
    ]
    if len(matches) == 1:
        return matches[0]
    raise LogError(
        f"none of the rigid bodies or tags in {file_name} is selected: "
        f"{join_first_names(names, 12)}",
        "Choose a rigid body or tag with --body NAME.",
    )


def find_position_table(
    path: Path, content: bytes, columns: tuple[str, ...] | None, body: str | None
) -> PositionTable:
    """Find the table of positions in a file.

    Parameters
    ----------
    path : Path
        Path of the file; the times of KITTI poses are in the same folder.
    columns : tuple of str or None
        Names or numbers of required columns.
    body : str or None
        Name of the rigid body, if the file contains several.

    Raises
    ------
    LogError
        The file is not a text file, or contains no table of positions.
    """
    file_name = display_name(path)
    text = decode_text(content)
    if text is None:
        raise LogError(f"{file_name} is a binary file, not a text table", "Give a CSV file.")
    text, notes = _drop_incomplete_last_line(text)
    # The header is searched in the first lines only
    unquoted_text = text.replace('"', "")
    header_text = unquoted_text[: unquoted_text.rfind("\n", 0, MAX_HEADER_CHARS) + 1]
    lines = header_text.split("\n")[:MAX_HEADER_LINES]
    wanted_names = {column.strip().casefold() for column in columns or () if not column.isdecimal()}
    table = None
    # Columns chosen by the user refer to tables with named or numbered columns, not to other
    # formats
    if columns is None:
        table = (
            _find_json_table(file_name, text)
            or _find_body_table(file_name, unquoted_text, lines, body)
            or _find_stream_table(file_name, unquoted_text, lines)
        )
    table = table or _find_header_table(file_name, unquoted_text, lines, wanted_names)
    if table is None and not wanted_names:
        table = _find_headerless_table(path, unquoted_text, lines)
    # The column names must indicate time and position, unless the user named the columns
    if table is None or not (columns or _has_time_and_position(table.column_names)):
        column_list = ", ".join(map(quote, sorted(wanted_names))) or "time, x, y, z"
        raise LogError(
            f"{file_name}: the first {len(lines)} lines contain no header with the columns "
            f"{column_list}. The first line is {quote(lines[0])}.",
            f"Add the header time,x,y,z. Alternatively, name the columns with {COLUMNS_OPTION}.",
        )
    table.check_row_width()
    return replace(table, notes=(*table.notes, *notes))


def _drop_incomplete_last_line(text: str) -> tuple[str, tuple[str, ...]]:
    """Return a text that ends with a line feed, and a note if its last line was dropped.

    A last line without line feed may be incomplete.
    """
    whole_lines, _, last_line = text.rpartition("\n")
    line_before = whole_lines.rpartition("\n")[2]
    cells, cells_before = (re.split(r"[\s,;]+", line.strip()) for line in (last_line, line_before))
    decimals, decimals_before = (
        row_cells[-1].partition(".")[2] for row_cells in (cells, cells_before)
    )
    # A complete line has as many columns and decimals as the line before it
    if (
        "." in last_line
        and len(cells) == len(cells_before)
        and len(decimals) >= len(decimals_before)
    ):
        return f"{text}\n", ()
    note = "the last line of the position file was dropped, because it is incomplete"
    return f"{whole_lines}\n", (note,) if last_line.strip() else ()


def _split_line(line: str, separator: str) -> list[str]:
    if separator == " ":  # a name with unit, such as "x [mm]", is one field
        return re.sub(r" +(?=[\[(])", "", line.strip()).split()
    return [field.strip() for field in line.split(separator)]


def _find_header_table(
    file_name: str, text: str, lines: Sequence[str], wanted_names: set[str]
) -> PositionTable | None:
    """Find a table whose header contains ``wanted_names``, by default time and position."""
    for index, line in enumerate(lines):
        for separator in SEPARATORS:
            column_names = _split_line(line.strip("#% "), separator)
            is_header = len(column_names) <= MAX_COLUMNS and (
                wanted_names <= {name.casefold() for name in column_names}
                if wanted_names
                else _has_time_and_position(column_names)
            )
            if is_header:
                rows_text = _remove_comments(text.split("\n", index + 1)[index + 1])
                return PositionTable(file_name, "", column_names, rows_text, separator, index + 1)
    return None


def _has_time_and_position(column_names: list[str]) -> bool:
    meanings = [read_column_name(name) for name in column_names]
    has_time = any(column.kind == "time" for column in meanings)
    return has_time and find_position_columns(meanings) is not None


def _find_body_table(
    file_name: str, text: str, lines: Sequence[str], wanted_body: str | None
) -> PositionTable | None:
    """Find the columns of one rigid body in a CSV export of Motive or Vicon Nexus.

    The header of Motive begins with pairs of name and value (Format Version, Length Units). Then
    follow lines with a title in the second column: Type, Name, ID, Rotation or Position, and the
    axes. The header of Vicon Nexus has the frame rate in line 2, and the bodies in line 3, each
    above its first column. Then follow the axes (RX, RY, RZ, TX, TY, TZ) and the units.
    """
    axes_row = next((i for i, line in enumerate(lines[:12]) if line.startswith("Frame,")), 0)
    if axes_row < 3:
        return None
    rows = [_split_line(line, ",") for line in lines[: axes_row + 2]]
    is_motive = rows[0][0] == "Format Version"
    if not is_motive and not is_number(rows[1][0]):
        return None
    # One row for each column of the file, one column for each line of the header
    header = pd.DataFrame(zip_longest(*rows, fillvalue=""))[: len(rows[axes_row])]
    axes, rows_text = header[axes_row], text.split("\n", axes_row + 1)[axes_row + 1]
    if is_motive:
        format_name, first_columns, rate_hz = (
            "OptiTrack Motive CSV export",
            rows[axes_row][:2],
            None,
        )
        # Motive exports y up by default, or z up; the file does not state which
        frames: tuple[str, ...] = ("eus", "enu")
        unit = dict(zip(rows[0][::2], rows[0][1::2], strict=False)).get("Length Units", "")
        values_by_title = {header.loc[1, row]: header[row] for row in range(2, axes_row)}
        body_names = values_by_title.get("Name", axes)
        # Rotations are not read, because the axes of a rigid body are not FRD
        is_position = header[axes_row - 1] == "Position"
        # If the header line Type is missing or names no rigid body, the user can choose any column
        # group as the tracked body
        is_rigid_body = values_by_title.get("Type", axes) == "Rigid Body"
        if is_rigid_body.any():
            is_position &= is_rigid_body
        column_names = axes + f"_{unit}"
    else:
        format_name, first_columns = "Vicon Nexus CSV export", ["time", ""]
        frames, rate_hz = (), float(rows[1][0])
        # A body name stands only above the first column of the body
        body_names = header[2].replace("", None).ffill().fillna("")
        axes = axes.str.removeprefix("T")
        is_position = axes.isin([*"XYZ"])
        column_names = axes + "_" + header[axes_row + 1]
        # The rows begin after the units, and end at an empty line
        rows_text = re.split(r"\n[, ]*\n", rows_text.partition("\n")[2], maxsplit=1)[0] + "\n"
    chosen_body_name = choose_body(file_name, body_names[is_position], wanted_body)
    is_chosen = is_position & (body_names == chosen_body_name)
    return PositionTable(
        file_name,
        format_name,
        [*first_columns, *column_names.where(is_chosen, "")[2:]],
        rows_text,
        header_line_number=axes_row + 1,
        frames=frames,
        rate_hz=rate_hz,
        has_only_chosen_body=True,
        notes=(f"the positions are those of body {quote(chosen_body_name)}",),
    )


def _find_stream_table(file_name: str, text: str, lines: Sequence[str]) -> PositionTable | None:
    """Find the positions in a text format of a UWB system (``formats.toml``)."""
    for stream_format in _TEXT_FORMATS["streams"]:
        pattern = re.compile(stream_format["row"], re.MULTILINE)
        # Search the first lines only: a long file of another format takes much time
        if not any(map(pattern.match, lines)):
            continue
        rows = pattern.findall(text)
        lost_count = text.count("\n") - len(rows)
        return PositionTable(
            file_name,
            stream_format["name"],
            [*pattern.groupindex],
            "".join(f"{','.join(row)}\n" for row in rows),
            notes=(f"lines without a position: {lost_count}",) if lost_count else (),
        )
    return None


def _find_json_table(file_name: str, text: str) -> PositionTable | None:
    """Convert JSON lines to a table with column names such as ``data.coordinates.x``."""
    if not text.lstrip().startswith(("{", "[{")):
        return None
    try:
        values = msgspec.json.Decoder().decode_lines(text)
    except msgspec.DecodeError as error:
        raise LogError(
            f"{file_name} contains invalid JSON ({error})", "Record the positions again."
        ) from None
    records = [
        record for value in values for record in (value if isinstance(value, list) else [value])
    ]
    columns = pd.json_normalize(records)
    column_paths = [path for path in map(str, columns) if read_column_name(path).kind]
    is_pozyx = "data.coordinates.x" in column_paths
    return PositionTable(
        file_name,
        "Pozyx JSON stream" if is_pozyx else "JSON lines",
        [path + "_mm" * (is_pozyx and ".coordinates." in path) for path in column_paths],
        columns[column_paths].to_csv(index=False, header=False),
    )


def _find_headerless_table(path: Path, text: str, lines: Sequence[str]) -> PositionTable | None:
    """Find a table without header: columns time, x, y, z, or KITTI poses."""
    first_row = _remove_comments("\n".join(lines)).strip().partition("\n")[0]
    for separator in SEPARATORS:
        fields = _split_line(first_row, separator)
        # With another separator, a comma may be the decimal point
        decimal_fields = [field.replace(",", ".") for field in fields]
        if not 4 <= len(fields) <= MAX_COLUMNS or not all(map(is_number, decimal_fields[1:])):
            continue
        if separator == " " and len(fields) == 12:  # matrix of 3 rows and 4 columns
            return _read_kitti_table(path, text)
        if is_number(decimal_fields[0]) or _ISO_DATE_PATTERN.match(fields[0]):
            name, quaternion_order = HEADERLESS_TABLE_FORMAT, ""
            if separator in " \t" and len(fields) == 8:
                name, quaternion_order = "TUM trajectory", "xyzw"
            # Times in ns have 19 digits. Velocity and biases follow in the full format
            elif separator == "," and len(fields) in (8, 17) and len(fields[0]) == 19:
                name, quaternion_order = "EuRoC ground truth", "wxyz"
            column_names = ["time", "x", "y", "z", *(f"q{axis}" for axis in quaternion_order)]
            # The other columns have no name and are not read
            column_names += [""] * (len(fields) - len(column_names))
            note = "the file has no header: columns 1 to 4 are read as time, x, y, z"
            rows_text = _remove_comments(text)
            return PositionTable(
                display_name(path),
                name,
                column_names,
                rows_text,
                separator,
                header_line_number=0,
                notes=(note,),
            )
    return None


def _remove_comments(text: str) -> str:
    return re.sub(r"(?m)[ \t]*#.*|^[ \t]*%.*", "", text)


def _read_kitti_table(path: Path, text: str) -> PositionTable:
    """Read KITTI poses (3x4 matrices), and their times from a file in the same folder."""
    # imported here, because most recordings need no rotations
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    name, times_file_name = display_name(path), f"{path.stem}_times.txt"
    candidate_paths = (path.with_name(times_file_name), path.with_name("times.txt"))
    times_path = next(filter(Path.is_file, candidate_paths), None)
    if times_path is None:
        raise LogError(
            f"{name}: the file contains KITTI poses, which have no times",
            f"Save the times (s), one per line, as {times_file_name} in the same folder.",
        )
    time_texts = read_text(times_path, LogError, MAX_FILE_BYTES).split()
    try:
        matrices = np.loadtxt(io.StringIO(text), ndmin=2)
        quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 4)[:, :, :3]).as_quat()
        poses = np.column_stack([np.array(time_texts, float), matrices[:, 3::4], quaternions])
    except ValueError as error:
        raise LogError(
            f"{name}: the KITTI poses or the times in {display_name(times_path)} are not valid",
            "Export poses and times again.",
        ) from error
    return PositionTable(
        name,
        "KITTI poses",
        ["time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"],
        pd.DataFrame(poses).to_csv(index=False, header=False),
        frames=("edn",),
        notes=(f"the pose times are from {display_name(times_path)}",),
    )
