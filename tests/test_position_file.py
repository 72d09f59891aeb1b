"""Position files in many dialects: equal samples, or an error of one line."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import REPOSITORY, shared
from time_limit import time_limit

from px4fuse.errors import LogError, Px4FuseError, SettingsError
from px4fuse.readers import position_file
from px4fuse.readers.position_file import (
    METRES_BY_LENGTH_UNIT,
    SAMPLE_COLUMNS,
    SECONDS_BY_TIME_UNIT,
    PositionRecording,
    read_position_file,
)

AXES = ["x_m", "y_m", "z_m"]

# Track of all dialects: 5 Hz with jitter, resolution 0.1 mm and 1 µs
ROWS = 60
RANDOM = np.random.default_rng(20261121)
TIME_US = 200_000 * np.arange(ROWS) + RANDOM.integers(-40_000, 40_000, ROWS)
TIME_US += 50_000 - TIME_US[0]
UNIX_US = 1_795_253_650_000_000
TRACK_M = np.column_stack([
    np.linspace(-3.2, 9.1, ROWS) + RANDOM.normal(0, 0.1, ROWS),
    4.0 * np.sin(np.arange(ROWS) / 9.0) + RANDOM.normal(0, 0.1, ROWS),
    1.5 + RANDOM.normal(0, 0.1, ROWS),
]).round(4)  # fmt: skip
SIGMA_M = RANDOM.uniform(0.05, 0.3, ROWS).round(3)


def fixed(values: np.ndarray, decimals: int) -> list[str]:
    return [f"{value:.{decimals}f}" for value in values]


def exact(ticks: np.ndarray, decimals: int) -> list[str]:
    """Format integers divided by a power of ten without rounding."""
    if not decimals:
        return [str(tick) for tick in ticks]
    return [f"{tick // 10**decimals}.{tick % 10**decimals:0{decimals}d}" for tick in ticks.tolist()]


UNIX_S = exact(UNIX_US + TIME_US, 6)
X, Y, Z = (fixed(axis, 4) for axis in TRACK_M.T)
PLAIN_XYZ = {"x": X, "y": Y, "z": Z}
PLAIN = {"time": UNIX_S, **PLAIN_XYZ}


def table(
    columns: dict[str, list[str]], *, separator: str = ",", decimal: str = ".",
    header: bool = True, end: str = "\n", trailing: str = "", quote: str = "",
) -> str:  # fmt: skip
    """Write columns as a vendor would."""
    lines = [list(columns)] if header else []
    for row in zip(*columns.values(), strict=True):
        lines.append([field.replace(".", decimal) for field in row])
    quoted = (separator.join(f"{quote}{field}{quote}" for field in line) for line in lines)
    return "".join(line + trailing + end for line in quoted)


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., PositionRecording]:
    """Write text or bytes to a file and read it."""

    def read_(content: str | bytes, **options) -> PositionRecording:
        path = tmp_path / "uwb.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_position_file(path, **options)

    return read_


def error_message(read: Callable[..., PositionRecording], content: str | bytes, **options) -> str:
    """Return the error message (one line) of a rejected file."""
    with pytest.raises(Px4FuseError) as caught:
        read(content, **options)
    assert isinstance(caught.value, LogError)
    assert_one_line(caught.value)
    return str(caught.value)


def assert_one_line(error: Px4FuseError) -> None:
    assert len(str(error).splitlines()) == 1, str(error)
    assert str(error).endswith(".")


def assert_track(
    file: PositionRecording, *, start_us: int = UNIX_US, axes=(0, 1, 2), rows=slice(None)
):
    """Check that the samples equal the written track."""
    assert list(file.samples.columns) == SAMPLE_COLUMNS
    assert file.samples.index.name == "time_s"
    assert (file.samples.dtypes == np.float64).all()
    truth_us = (start_us + TIME_US)[rows]
    read_us = file.samples.index.to_numpy() * 1e6
    np.testing.assert_allclose(read_us - start_us, truth_us - start_us, rtol=0, atol=0.5)
    track = TRACK_M[rows][:, axes]
    np.testing.assert_allclose(file.samples[AXES].to_numpy(), track, rtol=0, atol=1e-9)


def assert_stated(file: PositionRecording, *words: str) -> None:
    """Check that one of the sentences contains all of these words."""
    sentences = (*file.format_detection_notes, *file.notes)
    assert any(all(word in sentence for word in words) for sentence in sentences), sentences


# -- the text --------------------------------------------------------------------------------------

PREAMBLE = "UWB Studio 4.2 export\nSite: Hall 3; Operator: A, B\n\nAnchors: 8\n"
DIALECTS: dict[str, str | bytes] = {
    "comma": table(PLAIN),
    "semicolon": table(PLAIN, separator=";"),
    "tab": table(PLAIN, separator="\t"),
    "space": table(PLAIN, separator=" "),
    "leading spaces": "  " + table(PLAIN, separator="  ", end="\n  "),
    "quotes": table(PLAIN, quote='"'),
    "decimal commas": table({"Zeit [s]": UNIX_S, **PLAIN_XYZ}, separator=";", decimal=","),
    "no header": table(PLAIN, header=False),
    "no header, decimal commas": table(PLAIN, header=False, separator=";", decimal=","),
    "byte order mark": b"\xef\xbb\xbf" + table(PLAIN).encode(),
    "Latin-1": table({"t [µs]": exact(UNIX_US + TIME_US, 0), "x": X, "y": Y, "z": Z}).encode(
        "latin-1"
    ),
    "CRLF": table(PLAIN, end="\r\n"),
    "CR": table(PLAIN, end="\r"),
    "UTF-16": table(PLAIN).encode("utf-16"),
    "trailing separators": table(PLAIN, trailing=",,"),
    "blank lines": "\n\n" + table(PLAIN, end="\n\n") + "\n  \n",
    "lines of separators": table(PLAIN) + ",,,\n,,,\n",
    "comments": "# made by uwbd\n% v2\n" + table(PLAIN).replace("\n", "\n# note, 1, 2, 3\n", 5),
    "preamble": PREAMBLE + table(PLAIN),
    "comment header": "# " + table(PLAIN),
    "NULs after a power cut": table(PLAIN).encode() + bytes(300),
    "columns without a name": table({"": [str(i) for i in range(ROWS)], **PLAIN}),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_read_position_file_of_every_format_gives_equal_samples(read, dialect):
    content = DIALECTS[dialect]
    content = content if isinstance(content, bytes) else content.encode()
    file = read(content)
    assert_track(file)
    assert (file.name, file.size_bytes) == ("uwb.csv", len(content))
    assert file.sha256 == hashlib.sha256(content).hexdigest()
    assert file.clock_kind == "UNIX"
    assert file.frames == ()
    assert file.samples[SAMPLE_COLUMNS[3:]].isna().all(axis=None)


# -- time ------------------------------------------------------------------------------------------

LOCAL_US = 5_000_000  # five seconds after the UWB computer started
TIMES: dict[str, tuple[str, list[str], int, str]] = {
    # name, texts, start in µs, clock
    "UNIX s": ("time", UNIX_S, UNIX_US, "UNIX"),
    "UNIX ms": ("time", exact(UNIX_US + TIME_US, 3), UNIX_US, "UNIX"),
    "UNIX us": ("time", exact(UNIX_US + TIME_US, 0), UNIX_US, "UNIX"),
    "UNIX ns": ("time", exact(1000 * (UNIX_US + TIME_US), 0), UNIX_US, "UNIX"),
    "timestamp_s": ("timestamp_s", UNIX_S, UNIX_US, "UNIX"),
    "time_ms": ("time_ms", exact(UNIX_US + TIME_US, 3), UNIX_US, "UNIX"),
    "t [us]": ("t [us]", exact(UNIX_US + TIME_US, 0), UNIX_US, "UNIX"),
    "field.header.stamp": (
        "field.header.stamp", exact(1000 * (UNIX_US + TIME_US), 0), UNIX_US, "UNIX",
    ),
    "timeMs": ("timeMs", exact(LOCAL_US + TIME_US, 3), LOCAL_US, "local"),
    "time_boot_ms": ("time_boot_ms", exact(LOCAL_US + TIME_US, 3), LOCAL_US, "local"),
    "local s": ("time", exact(TIME_US, 6), 0, "local"),
    "local ms": ("time", exact(LOCAL_US + TIME_US, 3), LOCAL_US, "local"),
    "local us": ("time", exact(TIME_US, 0), 0, "local"),
    "local ns": ("time", exact(1000 * TIME_US, 0), 0, "local"),
    "local us, magnitude of UNIX s": (
        "time", exact(1_795_253_650 + TIME_US, 0), 1_795_253_650, "local",
    ),
    "local us by name": ("time_us", exact(1_795_253_650 + TIME_US, 0), 1_795_253_650, "local"),
    "before zero": ("time", fixed((TIME_US - 5_000_000) / 1e6, 6), -5_000_000, "local"),
    "wrong unit in the name": ("time_s", exact(UNIX_US + TIME_US, 3), UNIX_US, "UNIX"),
}  # fmt: skip


@pytest.mark.parametrize("case", TIMES)
def test_read_position_file_detects_time_unit_and_clock(read, case):
    name, texts, start_us, clock = TIMES[case]
    file = read(table({name: texts, "x": X, "y": Y, "z": Z}))
    assert_track(file, start_us=start_us)
    assert file.clock_kind == clock


def test_read_position_file_keeps_microseconds_of_ns_timestamps(read):
    stamps = [1_795_253_650_123_456_789 + 1000 * i for i in range(5)]
    rows = "".join(f"{stamp},{i},0.5,1.5\n" for i, stamp in enumerate(stamps))
    file = read("t_ns,x,y,z\n" + rows)
    assert file.samples.index[0] == pytest.approx(stamps[0] / 10**9, rel=0, abs=5e-7)
    assert np.diff(file.samples.index) == pytest.approx(1e-6, abs=5e-7)


@pytest.mark.parametrize("rate", [0.2, 200])
def test_position_file_rate_between_0_2_and_200_hz_is_plausible(read, rate):
    stamps = [str(round(1e9 * (0.98 * i / rate + 1795253650))) for i in range(ROWS)]
    file = read(table({"t": stamps, "x": X, "y": Y, "z": Z}))
    assert np.diff(file.samples.index) == pytest.approx(0.98 / rate, abs=1e-6)
    assert file.notes == ()


@pytest.mark.parametrize("step", ["0.0001", "1e7"])
def test_position_file_of_implausible_sample_rate_adds_note(read, step):
    texts = [f"{float(step) * i:.6f}" for i in range(ROWS)]
    file = read(table({"time_s": texts, "x": X, "y": Y, "z": Z}))
    assert_stated(file, "s is unusual", "--position-time-unit")
    assert file.samples.index[-1] == pytest.approx(float(texts[-1]))


@pytest.mark.parametrize("unit", SECONDS_BY_TIME_UNIT)
def test_read_position_file_time_unit_overrides_column_name(read, unit):
    texts = [str(10 * i) for i in range(ROWS)]
    file = read(table({"time_us": texts, "x": X, "y": Y, "z": Z}), time_unit=unit)
    assert file.samples.index[1] == pytest.approx(10 * SECONDS_BY_TIME_UNIT[unit])
    assert_stated(file, f"{unit} (the unit was given with --position-time-unit)")


LATER_S = exact(UNIX_US + TIME_US + 30_000, 6)


@pytest.mark.parametrize(("columns", "words"), [
    ({"bag_time": LATER_S, "header_stamp": UNIX_S}, ("; not used: 'bag_time')",)),
    ({"bag_time": UNIX_S, "header_stamp": [""] * ROWS}, ("; not used: 'header_stamp')",)),
    ({"recv_time": LATER_S, "time": UNIX_S}, ("; not used: 'recv_time')",)),
])  # fmt: skip
def test_read_position_file_prefers_measurement_time(read, columns, words):
    file = read(table({**columns, "x": X, "y": Y, "z": Z}))
    assert_track(file)
    assert_stated(file, "time: ", *words)


# -- position --------------------------------------------------------------------------------------

MM, CM = (
    [fixed(axis * scale, 1 if scale == 1000 else 2) for axis in TRACK_M.T] for scale in (1e3, 1e2)
)
JUNK = ["0.1"] * ROWS
POSITIONS: dict[str, tuple[dict[str, list[str]], str | None]] = {
    "x_m": ({"x_m": X, "y_m": Y, "z_m": Z}, None),
    "position.x": ({"position.x": X, "position.y": Y, "position.z": Z}, None),
    "tum": ({"tx": X, "ty": Y, "tz": Z, "qx": JUNK, "qy": JUNK, "qz": JUNK, "qw": JUNK}, None),
    "rosbag": ({"v0": X, "v1": Y, "v2": Z, "v3": JUNK}, None),
    "velocity first": ({"vx": JUNK, "vel_y": JUNK, "x": X, "y": Y, "z": Z, "acc_x": JUNK}, None),
    "anchors": ({"anchor1_x": JUNK, "anchor1_y": JUNK, "x": X, "y": Y, "z": Z}, None),
    "two tracks": (
        {"raw_x": X, "filtered_x": JUNK, "filtered_y": JUNK, "raw_y": Y, "raw_z": Z}, None,
    ),
    "height": ({"x": X, "y": Y, "height": Z}, None),
    "X [mm]": ({"X [mm]": MM[0], "Y [mm]": MM[1], "Z [mm]": MM[2]}, None),
    "x(cm)": ({"x(cm)": CM[0], "y(cm)": CM[1], "z(cm)": CM[2]}, None),
    "mixed units": ({"x_m": X, "y_m": Y, "z_cm": CM[2]}, None),
    "mm unsaid": ({"x": MM[0], "y": MM[1], "z": MM[2]}, None),
    "north_m": ({"north_m": X, "east_m": Y, "down_m": Z}, "ned"),
    "D,E,N": ({"D": Z, "E": Y, "N": X}, "ned"),
    "E,N,U": ({"E": X, "N": Y, "U": Z}, "enu"),
    "pos_north": ({"pos_east": X, "pos_north": Y, "altitude_m": JUNK, "pos_up": Z}, "enu"),
}  # fmt: skip


@pytest.mark.parametrize("separator", [",", " "])
@pytest.mark.parametrize("case", POSITIONS)
def test_read_position_file_detects_frame_from_column_names(read, case, separator):
    columns, frame = POSITIONS[case]
    file = read(table({"time": UNIX_S, **columns}, separator=separator))
    assert_track(file)
    assert file.frames == ((frame,) if frame else ())


@pytest.mark.parametrize(("case", "words"), [
    ("mm unsaid", ("mm", "m is too large for an indoor flight", "--position-unit")),
    ("two tracks", ("'raw_x', 'raw_y', 'raw_z' as x, y, z",)),
])  # fmt: skip
def test_position_file_note_names_the_used_position_columns(read, case, words):
    assert_stated(read(table({"time": UNIX_S, **POSITIONS[case][0]})), "position: ", *words)


@pytest.mark.parametrize("unit", METRES_BY_LENGTH_UNIT)
def test_read_position_file_unit_option_overrides_column_name(read, unit):
    columns = {"time": UNIX_S, "x_cm": X, "y_cm": Y, "z": Z, "sigma_cm": fixed(SIGMA_M, 3)}
    samples = read(table(columns), length_unit=unit).samples
    assert samples["x_m"].to_numpy() == pytest.approx(TRACK_M[:, 0] * METRES_BY_LENGTH_UNIT[unit])
    assert samples["z_m"].to_numpy() == pytest.approx(TRACK_M[:, 2] * METRES_BY_LENGTH_UNIT[unit])
    assert samples["sigma_z_m"].to_numpy() == pytest.approx(SIGMA_M * METRES_BY_LENGTH_UNIT[unit])


@pytest.mark.parametrize(("x", "words"), [
    ([*X[:7], "4000.0", *X[8:]], "px4fuse assumes metres, because the column names contain no"),
    (fixed(np.linspace(0.0, 5e6, ROWS), 1), "px4fuse assumes metres"),
])  # fmt: skip
def test_read_position_file_unit_is_not_changed_by_outlier(read, x, words):
    file = read(table({**PLAIN, "x": x}))
    assert file.samples["x_m"].tolist() == list(map(float, x))
    assert file.samples["y_m"].to_numpy() == pytest.approx(TRACK_M[:, 1])
    assert_stated(file, "position: ", words)


@pytest.mark.parametrize("extra", [{}, {"z": [""] * ROWS}, {"z": ["nan"] * ROWS}])
def test_read_position_file_without_height_sets_z_to_nan(read, extra):
    file = read(table({"time": UNIX_S, "x": X, "y": Y, **extra}))
    assert file.samples["z_m"].isna().all()
    assert file.samples["y_m"].to_numpy() == pytest.approx(TRACK_M[:, 1])
    assert_stated(file, "position: ", "without height")


# -- sigma and quality -----------------------------------------------------------------------------

SIGMA = fixed(SIGMA_M, 3)


@pytest.mark.parametrize(("columns", "factors"), [
    ({"sigma": SIGMA}, (1, 1, 1)),
    ({"accuracy_mm": fixed(1000 * SIGMA_M, 0)}, (1, 1, 1)),
    ({"sx": SIGMA, "sy": fixed(2 * SIGMA_M, 3), "sz": fixed(3 * SIGMA_M, 3)}, (1, 2, 3)),
    ({"std_x_m": SIGMA, "y_std": fixed(2 * SIGMA_M, 3)}, (1, 2, np.nan)),
    ({"stdev": SIGMA}, (1, 1, 1)),
    ({"raw_sigma": SIGMA, "filtered_sigma": fixed(9 * SIGMA_M, 3)}, (1, 1, 1)),
])  # fmt: skip
def test_read_position_file_reads_sigma_columns(read, columns, factors):
    file = read(table({**PLAIN, **columns}))
    assert_track(file)
    sigmas = file.samples[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()
    np.testing.assert_allclose(sigmas, np.outer(SIGMA_M, factors), rtol=0, atol=1e-9)
    assert_stated(file, "sigma: ", repr(next(iter(columns))))


def test_read_position_file_sets_non_positive_sigma_to_nan(read):
    sigma = [*SIGMA]
    sigma[3], sigma[4] = "0", "-1"
    file = read(table({**PLAIN, "sigma": sigma}))
    assert_track(file)
    assert np.flatnonzero(file.samples["sigma_x_m"].isna()).tolist() == [3, 4]
    assert_stated(file, "rows with an ignored sigma (not positive): 2")


# -- rows ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "missing",
    ["nan", "", "null", "-", "-inf", "1e999", "12.3m", "1.2.3", "1_000", "1,5", "soon", ".", "0x1f",
     "١", "infinite"],
)  # fmt: skip
def test_read_position_file_drops_rows_without_position(read, missing):
    x, z = [*X], [*Z]
    x[0] = x[20] = z[21] = missing
    file = read(table({**PLAIN, "x": x, "z": z}, separator=";"))
    assert_track(file, rows=np.setdiff1d(np.arange(ROWS), [0, 20, 21]))
    assert_stated(file, "dropped rows without valid time or position: 3 (first: line 2)")


def test_read_position_file_drops_row_with_too_few_columns(read):
    lines = table(PLAIN).splitlines(keepends=True)
    lines[30] = UNIX_S[29] + ",1.0\n"
    file = read("".join(lines))
    assert_track(file, rows=np.setdiff1d(np.arange(ROWS), [29]))
    assert_stated(file, "dropped rows without valid time or position: 1 (first: line 31)")


def test_read_position_file_drops_last_line_without_line_feed(read):
    """The last line may be incomplete, also in its last digits."""
    file = read(table(PLAIN)[:-2])
    assert_track(file, rows=slice(-1))
    [note] = file.notes
    assert "file was dropped" in note


@pytest.mark.parametrize(("shifts_us", "dropped"), [
    ({10: -3_600_000_000}, [10]),
    ({10: 3_600_000_000}, [10]),
    ({10: 3_600_000_000, 40: -60_000_000}, [10, 40]),
    ({0: 10**15}, [0]),
])  # fmt: skip
def test_read_position_file_drops_backward_timestamps(read, shifts_us, dropped):
    stamps = UNIX_US + TIME_US
    for at, shift in shifts_us.items():
        stamps[at] += shift
    file = read(table({**PLAIN, "time": exact(stamps, 6)}))
    assert_track(file, rows=np.setdiff1d(np.arange(ROWS), dropped))
    assert_stated(
        file,
        f"dropped rows (timestamp repeated, decreasing or after the year 2100): {len(dropped)}",
    )


@pytest.mark.parametrize("name", ["tag_id", "tagid", "node"])
def test_position_file_with_two_uwb_tags_requires_choice_of_tag(read, name):
    text = table({name: ["A1", "B2"] * (ROWS // 2), **PLAIN})
    assert "is selected: A1, B2. Choose a" in error_message(read, text)
    assert_track(read(text, body="B2"), rows=slice(1, None, 2))
    assert "is selected: A1, B2" in error_message(read, text, body="C3")
    assert "only one rigid body, without a name" in error_message(read, table(PLAIN), body="C3")


# -- the options -----------------------------------------------------------------------------------

ODD = {"clock": UNIX_S, "a": Y, "b": X, "c": Z, "d_": SIGMA}


BY_NAME = {"time_ms": UNIX_S, "t": UNIX_S, "up_mm": MM[2], "east_mm": MM[0], "north_mm": MM[1]}
# misleading names: the time column is named like a length, a length column like a time
MISNAMED = {"x_m": UNIX_S, "time_ms": X, "b": Y, "c": Z, "x": JUNK, "y": JUNK}


@pytest.mark.parametrize(("given", "columns", "frame"), [
    (ODD, ("clock", "b", "a", "c"), None),
    (ODD, ("CLOCK", "B ", "a", "c", "d_"), None),
    (ODD, ("clock", "3", "a", "4"), None),
    (BY_NAME, ("t", "north_mm", "east_mm", "up_mm"), "enu"),  # frame from the column names
    (MISNAMED, ("1", "2", "3", "4"), None),
])  # fmt: skip
def test_columns_option_overrides_detected_column_names(read, given, columns, frame):
    file = read(PREAMBLE + table(given), columns=columns)
    assert_track(file)
    assert file.frames == ((frame,) if frame else ())
    sigma = SIGMA_M if len(columns) == 5 else np.full(ROWS, np.nan)
    np.testing.assert_allclose(file.samples["sigma_y_m"], sigma)


@pytest.mark.parametrize(("options", "words"), [
    ({"time_unit": "min"}, "`time_unit`: 'min' is not one of s, ms, us, ns."),
    ({"length_unit": "ft"}, "`length_unit`: 'ft' is not one of m, cm, mm."),
    ({"columns": ("time", "x")}, "three to five different columns"),
    ({"columns": ("time", "x", "x", "z")}, "three to five different columns"),
    ({"columns": ("time", "x", "y", "")}, "three to five different columns"),
    ({"columns": ("1", "2", "3", "9")},
     "no column '9'; the columns are 'time', 'x', 'y', 'z'. Name the columns with"),
    ({"columns": ("1", "2", "3", "9" * 5000)}, "no column '9999"),
    ({"columns": ("time", "2", "x", "y")}, "names one column twice"),
])  # fmt: skip
def test_read_position_file_with_invalid_option_raises_error(read, options, words):
    with pytest.raises(SettingsError) as caught:
        read(table(PLAIN), **options)
    assert words in str(caught.value)
    assert_one_line(caught.value)


def test_read_position_file_names_missing_column_in_error(read):
    line = error_message(read, table(PLAIN), columns=("time", "x", "y", "w"))
    assert "no header with the columns 'time', 'w', 'x', 'y'" in line


# -- unreadable files ------------------------------------------------------------------------------


@pytest.mark.parametrize(("content", "words"), [
    (b"", "empty"),
    ("time,x,y,z,sigma\n1,2\n3,4\n", "no table of numbers"),
    (b"\x00\x01time,x,y,z\n1,2,3,4\n", "binary"),
    ((REPOSITORY / "sample_logs" / "aisle_uwb.ulg").read_bytes(), "is a PX4 ULog, not"),
    (b"1,2\n" * 50_000 + b"\0\n1,2\n", "binary"),
    (b"Dear all,\nplease find attached\nthe log.\n", "The first line is 'Dear all,'"),
    (b"a" * 40 + b"\nb\n", f"The first line is '{'a' * 40}'"),
    (b"a" * 41 + b"\nb\n", f"The first line is '{'a' * 37}...'"),
    (table({"x": X, **PLAIN}, header=False), "usable rows"),
    (table({"when": UNIX_S, "x": X, "y": Y}), "The first line is 'when,x,y'"),
    (table({"time": UNIX_S, "x": X, "b": Y}), "no header"),
    (table({"time": UNIX_S, "x [ft]": X, "y [ft]": Y}), "no header"),
    (table({"t": UNIX_S, "lat": X, "lon": Y}), "no header"),
    (table(PLAIN, decimal=","), "has 4 columns, but the rows have 8. Write numbers"),
    ("time,x,y,z\n" + table({"n": JUNK, **PLAIN}, header=False), "4 columns, but the rows have 5"),
    (table({**PLAIN, "time": ["12.5"] * ROWS}), "1 usable rows"),
    ("9,1,2,3\n8,1,2,3\n" + "".join(f"{i},1,2,{i}\n" for i in range(8)),
     "8 usable rows, fewer than 9;"),
])  # fmt: skip
def test_read_position_file_of_unreadable_file_raises_log_error(read, content, words):
    line = error_message(read, content)
    assert words in line
    assert line.startswith("uwb.csv")


def test_read_position_file_rejects_too_large_file(read, monkeypatch):
    monkeypatch.setattr(position_file, "MAX_FILE_BYTES", 1000)
    assert "MB, more than the limit of" in error_message(read, table(PLAIN))


# -- any bytes -------------------------------------------------------------------------------------


def check_any(read, content: bytes) -> None:
    """Check that any content gives valid samples or an error of one line."""
    try:
        file = read(content)
    except (LogError, SettingsError) as error:
        assert_one_line(error)
        return
    samples = file.samples
    assert len(samples) >= 3
    assert np.all(np.diff(samples.index) > 0)
    assert np.isfinite(samples.index).all()
    assert np.isfinite(samples[["x_m", "y_m"]].to_numpy()).all()
    assert not np.isinf(samples.to_numpy()).any()
    assert all(len(line.splitlines()) == 1 for line in (*file.format_detection_notes, *file.notes))


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [line * 9_000 for line in (b'"', b" ", b"1 ", b"1,", b"(", b"x,", b"a1B", b"_", b"1", b"[ ")],
)
def test_position_file_parse_time_is_limited_for_long_lines(read, line):
    text = table(PLAIN).encode()
    line += b"1\n"
    for content in (line + text, text + line, line * 30 + text, line * 300):
        with time_limit():
            check_any(read, content)


# -- real files ------------------------------------------------------------------------------------


@pytest.mark.reallogs
@pytest.mark.parametrize(("pattern", "time", "count"), [
    ("dwm1001__tag__*position.csv", "bag_time", 3), ("vrpn*.csv", "header_stamp", 2),
])  # fmt: skip
def test_read_position_file_of_real_uwb_file_keeps_its_values(pattern, time, count):
    paths = sorted(shared("uwb").glob(f"*/{pattern}"))
    assert len(paths) == count
    for path in paths:
        file = read_position_file(path)
        # Read as text first, because the conversion of pandas may differ in the last bit
        truth = pd.read_csv(path, dtype=str).astype(np.float64)
        truth = truth[truth[["v0", "v1", "v2"]].notna().all(axis=1)]
        np.testing.assert_array_equal(file.samples.index, truth[time])
        np.testing.assert_array_equal(file.samples[AXES], truth[["v0", "v1", "v2"]])
        assert file.clock_kind == "UNIX"
        assert_stated(file, f"'{time}'", "of recording" if time == "bag_time" else "of measurement")
        dropped = len(pd.read_csv(path)) - len(truth)
        if dropped:
            assert_stated(file, f"dropped rows without valid time or position: {dropped}")
