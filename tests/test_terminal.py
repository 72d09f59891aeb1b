"""Terminal output: wrapping, commands ready to paste, default output files, progress bar."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_tools import error_line, run_checked
from conftest import blank_page
from exchange import replace
from rich.console import Console
from rich.text import Text

from px4fuse.analysis import Analysis
from px4fuse.cli.outputs import choose_default_report_path, make_console, progress
from px4fuse.diagnose import diagnose as analyse
from px4fuse.errors import OutputError
from px4fuse.report import card_text, screen
from px4fuse.report.card_text import format_card_lines, with_typed_path
from px4fuse.report.page import Page
from px4fuse.report.screen import print_paragraph, shorten_commands
from px4fuse.report.terminal import make_comparison_page
from px4fuse.request import ComparisonRequest, PositionFile, command_line, format_settings_suffix
from px4fuse.results.build import make_comparison_results
from px4fuse.results.contract import ComparisonResults, to_json
from px4fuse.results.model import Student
from px4fuse.simulation import flights
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.scenario import Scenario

pytestmark = pytest.mark.usefixtures("cached_analyses")

WIDTH = 99  # the widest line of the card has 98 characters


def commands(text: str) -> list[str]:
    """Return the printed commands, each the last part of a line."""
    return re.findall(r"^(?:.*(?:  |run again: ))?(px4fuse .*)$", text, re.MULTILINE)


@pytest.fixture(scope="module")
def flown() -> bytes:
    """Log of a short flight with late timestamps."""
    scenario = Scenario(passes=2, seed=3)
    return flights.to_ulog(flights.simulate(scenario, parse_faults(("clock-offset=250ms",))))


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flown: bytes) -> Path:
    """Working folder with blanks, a quote and & in its name, and a log in it."""
    folder = tmp_path / "Ana's flights & more"
    folder.mkdir()
    (folder / "l.ulg").write_bytes(flown)
    monkeypatch.chdir(folder)
    return folder


# --- wrapping ---


@pytest.fixture(scope="module")
def document(sample_log: Path) -> tuple[Analysis, ComparisonResults]:
    """Analysis and results of the sample flight with a setting that causes a finding."""
    request = ComparisonRequest(log=str(sample_log), sigma_z_m=0.3)
    analysis = analyse(request)
    return analysis, make_comparison_results(request, analysis)


def test_terminal_summary_wraps_without_cutting_text(document, monkeypatch) -> None:
    summaries: dict[int | None, str] = {}  # by terminal width; None is a pipe
    for width in (WIDTH, 60, None):
        monkeypatch.delenv("COLUMNS", raising=False)
        if width is not None:
            monkeypatch.setenv("COLUMNS", str(width))
        console = make_console()
        with console.capture() as captured:
            page = make_comparison_page(*document, document[0].request.log, verbose=True)
            screen.print_blocks(console, page.blocks, document[0].request)
        summaries[width] = captured.get()
    whole = summaries[None]
    card = with_typed_path(document[1].card, document[0].request.log)
    drawn = [line.wrap(WIDTH)[0] for line in format_card_lines(card) if line.wrap_indent is None]
    for width in (WIDTH, 60):
        assert "…" not in summaries[width]
        assert "--sigma-z" in summaries[width]
        # only headline, commands, tables and axes of the card do not wrap
        long = [line for line in summaries[width].splitlines() if len(line) > width]
        assert all(line in drawn or commands(line) for line in long)
    # cells of a table wrap too, which changes the order of the words
    assert sorted(summaries[WIDTH].split()) == sorted(whole.split())
    assert "\x1b" not in whole
    # the card comes first, also in a pipe; below it a paragraph is one line there
    first = [text for line in format_card_lines(card) for text in line.wrap(len(whole))]
    assert whole.splitlines()[: len(first) + 1] == [*first, ""]
    assert max(map(len, whole.splitlines()[len(first) :])) > card_text.CARD_WIDTH


def test_terminal_paragraph_has_hanging_indent(capsys) -> None:
    console = Console(width=30, highlight=False)
    text = Text("one two three four five six seven")
    print_paragraph(console, text, Text("Label"), indent=9)
    lines = ["Label    one two three four", "         five six seven"]
    assert capsys.readouterr().out.splitlines() == lines


def test_table_on_narrow_terminal_keeps_words_whole(capsys) -> None:
    page = Page()
    topics = ["vehicle_visual_odometry", "estimator_aid_src_ev_pos"]
    page.add_table(["data", "topic", "samples"], [["position", topic, "650"] for topic in topics])
    screen.print_blocks(Console(width=40, highlight=False), page.blocks)
    words = capsys.readouterr().out.replace(",", "").split()
    assert [word for word in words if word in topics] == topics


def test_text_output_modules_do_not_import_matplotlib() -> None:
    """Importing matplotlib takes 0.3 s, which text-only commands such as `sync` save."""
    modules = ", ".join(f"px4fuse.report.{n}" for n in ("terminal", "loop", "whatif", "evaluation"))
    code = f"import sys, {modules}; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- commands ready to paste ---


def test_recommended_commands_contain_files_and_options_of_user() -> None:
    request = ComparisonRequest(
        log="my flights/a'b.ulg", position=PositionFile(path="u w/b.csv"),
        start_s=12.5, sigma_z_m=0.3,
    )  # fmt: skip
    text, (command, loops) = shorten_commands(
        "Try px4fuse compare LOG --sigma-z 0.2 --clock-offset -0.125: better. Or (px4fuse loop "
        "LOG). Not px4fuse sync LOG.ulg.",
        request,
    )
    assert text == (
        "Try --sigma-z 0.2 --clock-offset -0.125: better. Or (px4fuse loop). Not px4fuse sync "
        "LOG.ulg."
    )
    assert shlex.split(command) == [
        "px4fuse", "compare", "my flights/a'b.ulg", "--sigma-z", "0.3",
        "--start", "12.5", "--position", "u w/b.csv", "--sigma-z", "0.2", "--clock-offset",
        "-0.125",
    ]  # fmt: skip
    assert shlex.split(loops) == ["px4fuse", "loop", "my flights/a'b.ulg"]
    # a file name that begins with - is not an option
    typed = command_line(ComparisonRequest(log="-a.ulg"), "tune", for_shell=True)
    assert typed == "px4fuse tune ./-a.ulg"


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    "typed",
    ["compare {log} --sigma-z 0.5", "tune {log} --axis north --start 8", "sync {log} --dt 0.05",
     "info {log}"],
)  # fmt: skip
def test_printed_command_lines_run_when_pasted_in_a_shell(desk, monkeypatch, typed) -> None:
    monkeypatch.chdir(desk.parent)  # the typed path then contains blanks and a quote
    words = shlex.split(typed.format(log=shlex.quote(f"{desk.name}/l.ulg")))
    printed = commands(run_checked(*words).stdout)
    assert printed
    for command in printed:
        pasted = shlex.split(command)
        assert pasted[:3] == ["px4fuse", "compare", f"{desk.name}/l.ulg"]
        assert {word for word in words if word.startswith("--")} <= set(pasted)
        run_checked(*pasted[1:])


@pytest.mark.usefixtures("no_drawing")
def test_command_advised_for_a_fault_removes_that_fault(desk) -> None:
    first = run_checked("compare", "l.ulg", "--sigma-z", "0.12")
    assert "reports/l_sigma-z-0.12.pdf" in first.stdout.replace(os.sep, "/")
    command = next(command for command in commands(first.stdout) if "--clock-offset" in command)
    run_checked(*shlex.split(command)[1:], "--json", "b.json")
    findings = [
        {one["id"] for one in json.loads(Path(name).read_text())["findings"]}
        for name in ("reports/l_sigma-z-0.12.json", "b.json")
    ]
    assert "source_time_offset" in findings[0] - findings[1]


# --- files ---


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", ["compare", "tune", "sync", "whatif", "loop", "info"])
def test_json_option_to_standard_output_writes_no_file(command, desk) -> None:
    assert json.loads(run_checked(command, "l.ulg", "--json", "-").stdout)
    assert files(desk) == {"l.ulg"}


def test_json_option_to_file_writes_no_report(desk) -> None:
    run_checked("compare", "l.ulg", "--json", "a.json")
    assert files(desk) == {"a.json", "l.ulg"}


@pytest.fixture
def made(document, sample_log: Path, tmp_path, monkeypatch) -> ComparisonResults:
    """Results of the sample flight; the working folder is empty."""
    monkeypatch.chdir(tmp_path)
    request = ComparisonRequest(log=str(sample_log))
    return make_comparison_results(request, document[0])


def reported(made: ComparisonResults, **changes: object) -> str:
    """Write a report without pages to its default path and return the file name."""
    student = Student(name=str(changes.pop("student", "")))
    request = replace(made.request, **changes)
    changed = replace(made, request=request.with_file_names(), student=student)
    path = choose_default_report_path(
        Path(request.log).stem + format_settings_suffix(request), changed
    )
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(blank_page(None, to_json(changed)))
    path.with_suffix(".json").write_text(to_json(changed), encoding="utf-8")
    return path.name


def test_default_report_of_same_log_and_settings_is_replaced(made) -> None:
    assert reported(made) == reported(made) == "aisle_uwb.pdf"
    assert reported(made, sigma_z_m=0.05) == "aisle_uwb_sigma-z-0.05.pdf"
    # a report without a student may be replaced by one with a student
    assert reported(made, student="Ana") == reported(made, student="Ana") == "aisle_uwb.pdf"


def test_default_report_file_name_is_shortened_if_too_long(made) -> None:
    log = f"{'ü' * 110}.ulg"
    names = {reported(made, log=log), reported(made, log=log, sigma_z_m=0.05)}
    assert len(names) == 2
    assert all(len(os.fsencode(name)) < 200 and name.startswith("ü" * 80) for name in names)


def test_default_report_file_of_other_student_is_not_replaced(made) -> None:
    reported(made, student="Ana")
    before = Path("reports/aisle_uwb.pdf").read_bytes()
    other = replace(made, log=replace(made.log, sha256="0" * 64))
    for results_, student in ((other, "Ana"), (made, "Ben"), (made, "")):
        with pytest.raises(
            OutputError, match=r"aisle_uwb\.pdf exists .* Choose another name with -o"
        ):
            reported(results_, student=student)
    assert Path("reports/aisle_uwb.pdf").read_bytes() == before


@pytest.mark.parametrize("name", ["aisle_uwb.pdf", "aisle_uwb.json"])
def test_default_report_does_not_replace_another_file(made, name) -> None:
    mine = Path("reports") / name
    mine.parent.mkdir()
    mine.write_text("mine")
    with pytest.raises(OutputError, match=f"{name} exists and was not overwritten, because"):
        reported(made)
    assert mine.read_text() == "mine"


@pytest.mark.usefixtures("no_drawing")
def test_report_is_not_replaced_by_report_on_log_of_same_name(desk, sample_log) -> None:
    (desk / "b").mkdir()
    shutil.copy(sample_log, desk / "b" / "l.ulg")
    run_checked("compare", "l.ulg")
    before = Path("reports/l.pdf").read_bytes()
    assert "Choose another name with -o" in error_line("compare", "b/l.ulg")
    assert Path("reports/l.pdf").read_bytes() == before
    run_checked("compare", "l.ulg")


@pytest.mark.usefixtures("no_drawing")
def test_compare_with_answer_form_replaces_earlier_report(desk) -> None:
    run_checked("compare", "l.ulg")
    run_checked("answers", "l.ulg")
    run_checked("compare", "l.ulg", "--answers", "l.answers.toml")
    assert b"log_sha256" in Path("reports/l.json").read_bytes()


def test_explore_page_of_another_log_is_not_overwritten(desk, sample_log) -> None:
    (desk / "b").mkdir()
    shutil.copy(sample_log, desk / "b" / "l.ulg")
    page = Path("reports/l.html")
    run_checked("explore", "l.ulg")
    before = page.read_bytes()
    assert "l.html exists and was not overwritten" in error_line("explore", "b/l.ulg")
    assert page.read_bytes() == before
    run_checked("explore", "l.ulg")


@pytest.mark.parametrize(
    "command",
    ["explore l.ulg", "practice --seed 3 --flights 1 --no-open"],
    ids=["explore", "practice"],
)
@pytest.mark.parametrize(
    "mine", [b"mine", b"\xff", b"<html><title>l.ulg - px4fuse explore</title>"]
)
def test_html_file_of_user_is_not_overwritten_by_default(desk, command, mine) -> None:
    page = Path("reports", "practice_3.html" if "practice" in command else "l.html")
    page.parent.mkdir()
    page.write_bytes(mine)
    message = error_line(*command.split())
    assert f"{page} exists and was not overwritten, because the file is not recognised" in message
    assert page.read_bytes() == mine
    run_checked(*command.split(), "-o", page)
    assert page.read_bytes() != mine
    run_checked(*command.split())  # an own page is replaced


def test_output_name_made_from_settings_has_valid_characters() -> None:
    request = ComparisonRequest(
        log="a.ulg", axes=("north", "east"), clock_offset_s=-0.12, heading_deg=30.0,
        position=PositionFile(path="/home/x/u wb.csv", columns=("t", "x/y", "*")),
    )  # fmt: skip
    assert format_settings_suffix(request) == (
        "_axis-north_axis-east_heading-30_clock-offset--0.12_position-u-wb_position-columns-t,x-y,-"
    )
    assert format_settings_suffix(ComparisonRequest(log="a.ulg")) == ""


# --- progress bar ---


def test_progress_bar_appears_only_on_a_terminal(monkeypatch, capsys) -> None:
    with progress() as step:
        step("reading x")
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", "100")
    with progress() as step:
        step("reading x")
        step("fitting y", 2, 5)
    shown = capsys.readouterr().err
    assert "fitting y" in shown
    assert "2 of 5" in shown
    with progress(Path("-")) as step:
        step("reading x")
    assert capsys.readouterr().err == ""


# --- styles ---


def test_bold_text_of_report_is_bold_on_terminal() -> None:
    for weight, bold in (("bold", True), ("regular", False)):
        block = {"text": "so", "colour": "black", "weight": weight}
        assert ("bold" in str(screen._make_rich_text(block).style)) is bold  # type: ignore[arg-type]
