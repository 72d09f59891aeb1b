"""Requests: parsing of a command line, and formatting of a command line from a request."""

from __future__ import annotations

import shlex

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from px4fuse import request as requests
from px4fuse.cli.compare import compare
from px4fuse.cli.loop import loop, make_loop_request
from px4fuse.cli.options import comparison_request
from px4fuse.request import ComparisonRequest, LoopRequest, PositionFile, Request, command_line

NAMES = st.text("abc ü'\"$-_.", min_size=1, max_size=12).map(lambda text: f"f{text}x")
NUMBERS = st.integers(-10_000, 10_000).map(lambda number: number / 1000.0)
POSITIVE = st.integers(1, 10_000).map(lambda number: number / 1000.0)


def maybe(strategy: st.SearchStrategy) -> st.SearchStrategy:
    return st.none() | strategy


COMPARISONS = st.builds(
    ComparisonRequest,
    log=NAMES,
    system=maybe(st.integers(0, 255)),
    position=maybe(
        st.builds(
            PositionFile, path=NAMES, frame=maybe(st.sampled_from(["ned", "enu", "nwu"])),
            yaw_deg=maybe(NUMBERS | st.just("auto")),
            columns=maybe(st.lists(st.sampled_from("tabcd"), min_size=1).map(tuple)),
            time_unit=maybe(st.sampled_from(["s", "ms", "us", "ns"])),
            length_unit=maybe(st.sampled_from(["m", "cm", "mm"])),
        )
    ),
    position_source=maybe(NAMES),
    source_kind=maybe(st.sampled_from(["uwb", "vio", "mocap", "gnss"])),
    sigma_a_m_s2=POSITIVE,
    sigma_z_m=POSITIVE,
    dt_s=POSITIVE,
    input=maybe(st.sampled_from(["imu", "zero"])),
    axes=st.lists(st.sampled_from(["north", "east", "down", "aisle"])).map(tuple),
    heading_deg=maybe(NUMBERS),
    start_s=maybe(NUMBERS),
    end_s=maybe(NUMBERS),
    clock_offset_s=maybe(NUMBERS | st.just("auto")),
)  # fmt: skip
LOOPS = st.builds(
    LoopRequest, source=NAMES, frame=maybe(st.sampled_from(["NED", "FRD", "ENU", "camera"])),
    system=maybe(st.integers(0, 255)), reference=maybe(NAMES), start_s=maybe(NUMBERS),
    end_s=maybe(NUMBERS), closed_loop=st.booleans(),
    landed_at=maybe(st.builds(requests.Landing, NUMBERS, NUMBERS, maybe(NUMBERS))),
    closures=st.lists(
        st.builds(requests.GivenClosure, NUMBERS, NUMBERS, POSITIVE), max_size=3
    ).map(tuple),
    position_drift_m=POSITIVE, heading_drift_deg=POSITIVE, key_frames_m=maybe(POSITIVE),
)  # fmt: skip


def parsed(command: str) -> Request:
    """Parse a command line like a shell, click and the command."""
    program, name, file, *options = shlex.split(command)
    assert program == "px4fuse"
    made = compare if name == "compare" else loop
    context = made.make_context(name, [*options, "--", file])
    own = (
        "output", "json_path", "fail_on", "checks", "student", "student_id", "notes", "answers",
        "tum_path", "g2o_path", "verbose", "quiet",
    )  # fmt: skip
    values = {key: value for key, value in context.params.items() if key not in own}
    if name == "compare":
        return comparison_request(values.pop("log"), values)
    return make_loop_request(values.pop("source"), values)


@settings(deadline=None)
@given(COMPARISONS | LOOPS)
def test_compare_options_written_as_command_are_parsed_back(request: Request) -> None:
    assert parsed(command_line(request)) == request


@given(COMPARISONS | LOOPS)
def test_compare_options_written_as_json_are_read_back_equal(request: Request) -> None:
    assert msgspec.json.decode(msgspec.json.encode(request), type=Request) == request


def test_command_in_report_names_input_files_without_folders() -> None:
    request = ComparisonRequest(log="/home/eve/a.ulg", position=PositionFile(path="../d.csv"))
    assert command_line(request) == "px4fuse compare a.ulg --position d.csv"
    assert "eve" not in msgspec.json.encode(request.with_file_names()).decode()
    assert LoopRequest(source="x/l.ulg:vio", reference="y/s.tum").with_file_names() == LoopRequest(
        source="l.ulg:vio", reference="s.tum"
    )


@pytest.mark.parametrize(
    ("recorded", "says"),
    [
        ({"command": "tune", "log": "a.ulg"}, "Invalid value 'tune'"),
        ({"command": "compare"}, "missing required field `log`"),
        ({"command": "compare", "log": "a", "output": "b"}, "unknown field `output`"),
        ({"command": "compare", "log": "a", "system": 256}, "<= 255"),
    ],
)
def test_compare_options_from_invalid_json_are_rejected(recorded: object, says: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert(recorded, Request)


@pytest.mark.parametrize(
    ("command", "declared", "kinds"),
    [
        (compare, requests.COMPARISON_OPTIONS, (ComparisonRequest, PositionFile)),
        (loop, requests.OPTION_NAMES[LoopRequest], (LoopRequest,)),
    ],
)
def test_each_command_option_has_a_field_in_python_api(command, declared, kinds) -> None:
    """An option that is not in the request would be missing in the results."""
    about_outputs = {
        "-o", "--json", "--student", "--id", "--notes", "--answers", "--fail-on", "--checks",
        "--tum", "--g2o", "--robust", "--max-size", "--show", "-v", "-q",
    }  # fmt: skip
    options = {parameter.opts[0] for parameter in command.params if parameter.opts[0][0] == "-"}
    request_options = {*declared.values()}
    # --open means an open loop in px4fuse loop, and opens the output in other commands
    assert options - about_outputs - ({"--open"} - request_options) == request_options
    assert set(declared) <= {field for kind in kinds for field in kind.__struct_fields__}
