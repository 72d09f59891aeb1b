"""Verification: a changed report is detected, and the redrawn report does not contain it."""

from __future__ import annotations

import copy
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from class_tools import in_this_process
from cli_tools import run_checked
from conftest import LOG, REPORT, REPORT_PAGES, SAMPLES
from forgery import (
    Change,
    Edit,
    Forge,
    VerifiedReport,
    append_update,
    array,
    catalogue,
    dictionary,
    document_info,
    edit_stream,
    font,
    forged,
    glyphs,
    make_verified_report,
    on_page,
    pdf_bytes,
    read_again,
    read_attached_results,
    set_value,
    text,
    to_dict,
    verify_with,
    with_results,
)
from pypdf import PdfReader, PdfWriter
from pypdf.annotations import Link
from pypdf.generic import (
    NameObject,
    TextStringObject,
)
from results_tools import finding

from px4fuse.core.reading import hash_files
from px4fuse.errors import ResultsError
from px4fuse.results.contract import to_json, to_json_dict
from px4fuse.verification import pages, verification
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import (
    ESTIMATE_RELATIVE_TOLERANCE,
    NO_LOG_REASON,
    RESULT_RELATIVE_TOLERANCE,
    VERIFICATION_SCOPE_NOTE,
    compare_results,
    flatten,
    verify,
)

pytestmark = pytest.mark.usefixtures("cached_analyses")

LOOP_LOG = SAMPLES / "loop_vio.ulg"


@pytest.fixture(autouse=True, scope="module")
def _compare_pages_in_process() -> Iterator[None]:
    """Compare pages in this process; test_pages.py tests the separate one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "run_one_with_limits", lambda function, job, *_: function(job))
        yield


@pytest.fixture(scope="module")
def aisle() -> VerifiedReport:
    return make_verified_report(REPORT.read_bytes(), LOG)


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> VerifiedReport:
    folder = tmp_path_factory.mktemp("loop")
    (folder / "notes.md").write_text("# Drift\n\nThe *heading* drifts most.\n", encoding="utf-8")
    target = folder / "loop.pdf"
    own = "--student", "Ada", "--id", "7", "--notes", folder / "notes.md"
    run_checked("loop", LOOP_LOG, "-o", target, *own)
    return make_verified_report(target.read_bytes(), LOOP_LOG)


# -- unchanged reports -----------------------------------------------------------------------------


def test_verify_unchanged_example_report_returns_verified(aisle: VerifiedReport) -> None:
    shipped = REPORT.read_bytes()
    verdict = verify_with(shipped, aisle.files, aisle.recompute)
    assert verdict.status == "verified", verdict
    assert verdict.with_log
    assert verdict.page_status == "same"
    assert VERIFICATION_SCOPE_NOTE in verdict.reasons


def test_verify_unchanged_loop_report_returns_verified(loop: VerifiedReport) -> None:
    verdict = loop.verified(loop.pdf)
    assert verdict.status == "verified", verdict
    text = "".join(page.extract_text() for page in PdfReader(io.BytesIO(loop.pdf)).pages)
    assert "Ada" in text
    assert "heading drifts most" in text.replace("*", "")


def test_verify_report_without_log_returns_cannot_verify(
    aisle: VerifiedReport, loop: VerifiedReport
) -> None:
    for one in (aisle, loop):
        verdict = verify(read_attached_results(one.pdf), one.pdf, {})
        assert verdict.status == "cannot verify"
        assert verdict.reasons == (NO_LOG_REASON,)
        assert verdict.redrawn_pdf == b""
        assert not verdict.with_log


def scaled(value: Any, share: float) -> Any:
    if isinstance(value, float):
        return value * (1.0 + share)
    if isinstance(value, dict):
        return {name: scaled(part, share) for name, part in value.items()}
    return [scaled(part, share) for part in value] if isinstance(value, list | tuple) else value


def move_lines(pdf: bytes, by: float) -> bytes:
    """Move all lines and marks by a distance."""
    # not the numbers of an alternative text such as (σ of 0.084 0.064 m)
    ends = re.compile(rb"(\d[\d.]*) (\d[\d.]*) ([ml])\b(?![^()\n]*\)>>)")

    def moved(match: re.Match[bytes]) -> bytes:
        return b"%.6f %.6f %s" % (float(match[1]) + by, float(match[2]) + by, match[3])

    changes = [
        on_page(number, lambda content: ends.sub(moved, content))
        for number, page in enumerate(PdfReader(io.BytesIO(pdf)).pages, start=1)
        if ends.search(page["/Contents"].get_data())
    ]
    return forged(pdf, *changes)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["aisle", "loop"])
def test_verify_accepts_report_of_other_operating_system(
    which: str, request: pytest.FixtureRequest
) -> None:
    one: VerifiedReport = request.getfixturevalue(which)
    drawn = move_lines(one.pdf, 0.01)
    scaled_results = read_again(scaled(json.loads(to_json(one.again[0])), -1e-9))
    elsewhere = (scaled_results, lambda: drawn)
    verdict = verify_with(one.pdf, one.files, lambda *_: elsewhere)
    assert verdict.outcome == "verified", verdict
    assert f"within {RESULT_RELATIVE_TOLERANCE:g}" in verdict.reasons[0]
    aside = move_lines(one.pdf, 0.6)
    elsewhere = (one.again[0], lambda: aside)
    verdict = verify_with(one.pdf, one.files, lambda *_: elsewhere)
    assert (verdict.status, verdict.outcome) == ("verified", "page differs")
    assert verdict.redrawn_pdf == aside


def test_verify_accepts_recomputed_numbers_that_differ_by_1e_12(aisle: VerifiedReport) -> None:
    """Other kernels of OpenBLAS change results of the sample flights by 3e-8 at most."""
    scaled_results = read_again(scaled(json.loads(to_json(aisle.again[0])), -1e-12))
    elsewhere = (scaled_results, lambda: forged(aisle.pdf))
    verdict = verify_with(aisle.pdf, aisle.files, lambda *_: elsewhere)
    assert verdict.outcome == "verified", verdict


def test_verify_reports_recomputed_numbers_that_differ_by_1e_4(aisle: VerifiedReport) -> None:
    """All numbers, except estimates, which have another tolerance, and those near zero."""
    ours = json.loads(to_json(aisle.again[0]))
    for share, least in ((1e-4, RESULT_RELATIVE_TOLERANCE), (1e-2, ESTIMATE_RELATIVE_TOLERANCE)):
        theirs = scaled(ours, share)
        found = {one.path for one in compare_results(theirs, ours)[0]}
        wide = verification.ESTIMATE_FIELDS if least == RESULT_RELATIVE_TOLERANCE else ()
        expected = {
            path[:120] for path, value in flatten(ours)
            if isinstance(value, float) and abs(value) > 0.01 and not path.startswith(wide)
        }  # fmt: skip
        assert len(expected) > 100
        assert expected - found == set()


KF = ("axes", "north", "filters", "kf")


def test_verify_applies_the_tolerance_of_each_number(aisle: VerifiedReport) -> None:
    ours = json.loads(to_json(aisle.again[0]))
    for share, path, alike in (
        (0.5 * RESULT_RELATIVE_TOLERANCE, (*KF, "nis_mean"), True),
        (2.0 * RESULT_RELATIVE_TOLERANCE, (*KF, "nis_mean"), False),
        (0.5 * ESTIMATE_RELATIVE_TOLERANCE, ("tuning", "horizontal", "sigma_a_m_s2"), True),
        (2.0 * ESTIMATE_RELATIVE_TOLERANCE, ("tuning", "horizontal", "sigma_a_m_s2"), False),
    ):
        theirs = copy.deepcopy(ours)
        part = theirs
        for name in path[:-1]:
            part = part[name]
        part[path[-1]] *= 1.0 + share
        assert (not compare_results(theirs, ours)[0]) == alike, path


# -- changed results -------------------------------------------------------------------------------


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(value, dict):
        for name, part in value.items():
            yield from leaves(part, (*path, name))
    elif isinstance(value, list) and value:
        yield from leaves(value[0], (*path, 0))
    else:
        yield path


def leaf_of_each_name() -> list[tuple[Any, ...]]:
    """Return one path to a value for each name in the results."""
    results = to_dict(read_attached_results(REPORT.read_bytes()))
    # other tests cover the log, the version, and texts that are printed
    apart = ("schema", "student", "provenance")
    kinds = {
        path[-1]: path
        for path in leaves(results)
        if path[0] not in apart and path != ("log", "sha256")
    }
    return list(kinds.values())


KINDS = leaf_of_each_name()
assert len(KINDS) >= 100


def change_value(results: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
    forged = copy.deepcopy(results)
    part: Any = forged
    for name in path[:-1]:
        part = part[name]
    value = part[path[-1]]
    if isinstance(value, bool):
        part[path[-1]] = not value
    elif isinstance(value, int):
        part[path[-1]] = value + 3
    elif isinstance(value, float):
        part[path[-1]] = value * 1.01 + 2e-5
    elif isinstance(value, str):
        part[path[-1]] = value[:-1] + ("x" if value[-1:] != "x" else "y")
    else:
        part[path[-1]] = [1.0]
    return forged


@pytest.mark.parametrize("path", KINDS, ids=lambda path: ".".join(map(str, path)))
def test_verify_finds_each_kind_of_changed_value(
    aisle: VerifiedReport, path: tuple[Any, ...]
) -> None:
    found, *_ = compare_results(change_value(aisle.results, path), to_json_dict(aisle.again[0]))
    difference = found[0]  # an additional list has paths below this one
    assert difference.path.startswith(".".join(map(str, path)))


def delete_value(*path: Any) -> Change:
    def change(results: dict[str, Any]) -> None:
        part: Any = results
        for name in path[:-1]:
            part = part[name]
        del part[path[-1]]

    return change


CAUSE = {"id": "source_gap", "severity": "error", "title": "No position for 5.2 s", "why": ""}
STRUCTURE: dict[str, tuple[Change, str]] = {
    "a finding more": (
        lambda r: r["findings"].append(finding("source_outliers")), "numbers differ",
    ),
    "a cause more": (set_value([CAUSE], "card", "causes"), "numbers differ"),
    "a re-run less": (lambda r: r["trials"].clear(), "numbers differ"),
    "an axis less": (delete_value("axes", "down"), "numbers differ"),
    "a filter's part as if it were not available": (
        set_value({"what": "a", "reason": "b", "remedy": "c"}, "axes", "north", "filters", "ekf2"),
        "numbers differ",
    ),
    "a parameter more": (set_value(1.0, "log", "parameters", "EKF2_HACK"), "numbers differ"),
    "a note more": (set_value("all is well", "notes", 1), "numbers differ"),
    "a number as a text": (set_value("0.5", "settings", "sigma_a_m_s2"), "cannot verify"),
    "an interval narrower": (
        lambda r: r["tuning"]["horizontal"].update(
            sigma_z_m_interval=[r["tuning"]["horizontal"]["sigma_z_m"]] * 2
        ),
        "numbers differ",
    ),
    "a step of a millisecond": (set_value(0.001, "request", "dt_s"), "cannot verify"),
    "no request": (delete_value("request"), "numbers differ"),
    "another command": (set_value("tune", "request", "command"), "numbers differ"),
    "an unknown setting": (set_value(1, "request", "please"), "numbers differ"),
}  # fmt: skip


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("name", STRUCTURE)
def test_verify_report_with_forged_results_is_not_verified(
    aisle: VerifiedReport, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, expected = STRUCTURE[name]
    monkeypatch.setattr(
        verification, "compare_pages", lambda *_, **__: ()
    )  # the pages are unchanged
    results = copy.deepcopy(aisle.results)
    change(results)
    verdict = aisle.verified(aisle.with_results(results))
    if verdict.reasons[0].startswith("results.json"):  # rejected by the schema
        expected = "cannot verify"
    assert verdict.status == verdict.outcome == expected, verdict


@pytest.mark.parametrize(
    "path", [("student", "name"), ("student", "notes"), ("provenance", "libraries", "matplotlib")]
)
def test_verify_report_with_changed_student_name_is_not_verified(
    loop: VerifiedReport, path: tuple[str, ...]
) -> None:
    results = copy.deepcopy(loop.results)
    set_value({"name": "Eve", "notes": "I flew it."}.get(path[-1], "9.9.9"), *path)(results)
    again = verification.recompute_report(read_again(results), loop.files)
    pdf = loop.with_results(results)
    verdict = verify_with(pdf, loop.files, lambda *_: again)
    assert verdict.outcome != "verified", verdict
    assert verdict.differences == ()
    assert verdict.redrawn_pdf != loop.pdf
    named = any("matplotlib 9.9.9; this" in reason for reason in verdict.reasons)
    assert named == (path[-1] == "matplotlib")


@pytest.fixture(scope="module")
def foreign(loop: VerifiedReport) -> VerifiedReport:
    """Report that states another Matplotlib version, in its results and on its last page."""
    results = copy.deepcopy(loop.results)
    set_value("3.99.0", "provenance", "libraries", "matplotlib")(results)
    again = verification.recompute_report(read_again(results), loop.files)
    drawn = again[1]()
    return VerifiedReport(forged(drawn, with_results(to_json(results))), results, again, loop.files)


def test_verify_accepts_report_of_other_library_versions(foreign: VerifiedReport) -> None:
    verdict = foreign.verified(foreign.pdf)
    assert verdict.outcome == "verified", verdict
    assert foreign.verified(forged(foreign.pdf, shifted_page)).outcome == "verified"


def shifted_page(writer: PdfWriter) -> None:
    """Coordinates moved less than the tolerance, as by another version of Matplotlib."""
    on_page(1, lambda content: re.sub(
        rb"(\d+\.\d+) (\d+\.\d+) l\b", lambda m: b"%.6f %s l" % (float(m[1]) + 0.01, m[2]), content
    ))(writer)  # fmt: skip


def in_figure(pattern: bytes, new: bytes) -> Edit:
    """Replace the first match behind the clip of the first figure."""
    return lambda content: re.sub(
        rb"(/Alt\(.*?\sW\sn.*?)" + pattern, rb"\g<1>" + new, content, count=1, flags=re.DOTALL
    )


PLOTS: dict[str, Edit] = {
    "a point erased": in_figure(rb"[\d.]+ [\d.]+ l (?=[\d.]+ [\d.]+ l )", b""),
    "a point moved": in_figure(rb"([\d.]+) ([\d.]+) l\b", rb"9\2 \3 l"),
    "a curve erased": in_figure(rb"[\d.]+ [\d.]+ m(?: [\d.]+ [\d.]+ l)+\s+S", b"0 0 m 0 0 l S"),
    "a curve more": in_figure(rb"", b" 0 0 m 90 90 l S"),
    "another colour": in_figure(rb"[\d.]+ [\d.]+ [\d.]+ SCN", b"0 0.6 0 SCN"),
    "another width": in_figure(rb" [\d.]+ w ", b" 9 w "),
    "covered": in_figure(rb"", b" 1 g 0 0 900 900 re f"),
}


@pytest.mark.parametrize("name", PLOTS)
def test_verify_detects_changed_plot_with_other_library_versions(
    foreign: VerifiedReport, name: str
) -> None:
    verdict = foreign.verified(forged(foreign.pdf, on_page(1, PLOTS[name])))
    assert verdict.outcome == "cannot verify", verdict
    assert "page 1: PDF drawing operation" in verdict.reasons[0]
    assert any("made with matplotlib 3.99.0; this" in reason for reason in verdict.reasons)
    assert verdict.remedy.startswith("Verify the report with matplotlib 3.99.0.")
    assert verdict.redrawn_pdf == foreign.again[1]()


# -- what is changed on the pages ------------------------------------------------------------------


def replace_last(pattern: bytes, replacement: Any) -> Callable[[bytes], bytes]:
    """Replace the last match."""

    def change(content: bytes) -> bytes:
        match = list(re.finditer(pattern, content))[-1]
        new = replacement(match) if callable(replacement) else match.expand(replacement)
        return content[: match.start()] + new + content[match.end() :]

    return change


LETTERS = glyphs(font("/f0")(PdfWriter(clone_from=REPORT)))  # regular font; /f1 is bold
DIGITS = [LETTERS[digit] for digit in "0123456789"]


def last_digit(replacement: Callable[[int], bytes]) -> Edit:
    """Replace the last digit of a page in the regular font."""

    def change(content: bytes) -> bytes:
        line = list(re.finditer(rb"/f0 [^\[]*\[(.*?)\]TJ", content, re.DOTALL))[-1]
        found = {line[1].rfind(text(glyph)): place for place, glyph in enumerate(DIGITS)}
        start = max(found)
        at, digit = line.start(1) + start, found[start]
        return content[:at] + replacement(digit) + content[at + len(text(DIGITS[digit])) :]

    return change


def aside(match: re.Match[bytes]) -> bytes:
    return b"%.6f %s l" % (float(match[1]) + 1.0, match[2])


A = text(LETTERS["A"])
DRAWING: dict[str, Edit] = {
    "another digit": last_digit(lambda digit: text(DIGITS[(digit + 1) % 10])),
    "a digit less": last_digit(lambda _: b""),
    "a point of a line moved": replace_last(rb"([\d.]+) ([\d.]+) l\b", aside),
    "a white rectangle": lambda c: c + b"\n1 g\n100 690 300 90 re\nf\n",
    "a text more": lambda c: c + b"\nBT\n/f0 12 Tf\n100 100 Td\n(" + A + b") Tj\nET\n",
    "a text moved": replace_last(rb"q 1 0 0 -1 ([\d.]+) ([\d.]+) cm", rb"q 1 0 0 -1 9\1 \2 cm"),
    "a text invisible": replace_last(rb"BT 0 Tr", b"BT 3 Tr"),
    "another font": replace_last(rb"/f0 ", b"/f1 "),
    "a colour": replace_last(rb"[\d.]+ [\d.]+ [\d.]+ scn", b"0.123 0.123 0.123 scn"),
    "a comment": lambda c: c + b"\n% nothing\n",
    "clipped": lambda c: b"0 0 300 300 re W n\n" + c,
    "turned over": lambda c: b"-1 0 0 1 595 0 cm\n" + c,
    "nothing at all": lambda c: b"\n",
}

# One change on every page, each other change on one page
PAGE_CASES = [
    (page, name)
    for place, name in enumerate(DRAWING)
    for page in range(1, REPORT_PAGES + 1)
    if name == "another digit" or (page + place) % REPORT_PAGES == 0
]


@pytest.mark.parametrize(("page", "name"), PAGE_CASES)
def test_verify_report_with_changed_page_returns_page_differs(
    aisle: VerifiedReport, page: int, name: str
) -> None:
    verdict = aisle.verified(forged(aisle.pdf, on_page(page, DRAWING[name])))
    assert verdict.redrawn_pdf == aisle.pdf  # the redrawn report does not contain the forgery
    assert verdict.status == "verified"
    assert verdict.outcome == "page differs", verdict
    assert [one.page for one in verdict.pages] == [page]


DOCUMENT: dict[str, tuple[Forge, str, str]] = {
    "a page away": (
        lambda w: w.remove_page(REPORT_PAGES - 1), "page differs",
        f"page {REPORT_PAGES}: the PDF has {REPORT_PAGES - 1} pages; the recomputed report has",
    ),
    "another title": (document_info(Title="my report"), "page differs", "document: the PDF entry"),
    "a form": (
        catalogue("/AcroForm", dictionary(Fields=array())), "cannot verify", "/AcroForm, which",
    ),
    "an annotation": (
        lambda w: w.add_annotation(1, Link(rect=(50, 50, 200, 70), url="http://example.org")),
        "cannot verify", "page 2: the PDF contains an entry /Annots, which px4fuse does not write",
    ),
    "a part that nothing refers to": (lambda w: w._add_object(dictionary()), "verified", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", DOCUMENT)
def test_verify_report_with_changed_pdf_document_gives_reason(
    aisle: VerifiedReport, name: str
) -> None:
    forge, expected, said = DOCUMENT[name]
    verdict = aisle.verified(forged(aisle.pdf, forge))
    assert verdict.redrawn_pdf == aisle.pdf
    assert verdict.outcome == expected, verdict
    assert verdict.status == ("verified" if expected == "page differs" else expected)
    assert any(said in reason for reason in verdict.reasons), verdict
    # the class table prints the first reason
    if expected == "cannot verify":
        assert said in verdict.reasons[0]
        assert verdict.remedy.startswith("Ask the author of the report")
        assert VERIFICATION_SCOPE_NOTE not in verdict.reasons


@pytest.mark.parametrize("key", ["/OpenAction", "/AA"])
def test_read_report_pdf_with_script_is_rejected(aisle: VerifiedReport, key: str) -> None:
    script = dictionary(S=NameObject("/JavaScript"), JS=TextStringObject("app.alert(1)"))
    with pytest.raises(ResultsError):
        read_report(forged(aisle.pdf, catalogue(key, script)), "r.pdf")


def test_verify_lists_differing_numbers_first(aisle: VerifiedReport) -> None:
    results = copy.deepcopy(aisle.results)
    results["axes"]["north"]["filters"]["kf"]["nis_mean"] = 1.0
    form = catalogue("/AcroForm", dictionary(Fields=array()))
    verdict = aisle.verified(forged(aisle.pdf, form, with_results(to_json(results))))
    assert verdict.status == "numbers differ"
    assert "1 of" in verdict.reasons[0]
    assert any("/AcroForm" in reason for reason in verdict.reasons)


def empty_first_page(writer: PdfWriter) -> None:
    """Remove the content of the first page."""
    stream = edit_stream(writer.pages[0]["/Contents"].get_object(), lambda _: b" ")
    writer.pages[0][NameObject("/Contents")] = writer._add_object(stream)


def pages_of_another(one: VerifiedReport, other: VerifiedReport) -> bytes:
    """Return a report with the last page of another one."""
    writer = PdfWriter(clone_from=io.BytesIO(one.pdf))
    writer.remove_page(REPORT_PAGES - 1)
    writer.add_page(PdfReader(io.BytesIO(other.pdf)).pages[-1])
    return pdf_bytes(writer)


def recompress(writer: PdfWriter) -> None:
    """Compress again, as programs do when they save a PDF."""
    writer.compress_identical_objects(remove_duplicates=True)
    for page in writer.pages:
        page.compress_content_streams(level=9)
    writer.add_metadata({"/Producer": "Another program"})


FILES: dict[str, tuple[Callable[[VerifiedReport, VerifiedReport], bytes], set[str]]] = {
    "saved again": (lambda a, _: forged(a.pdf), {"verified"}),
    "packed in another way": (lambda a, _: forged(a.pdf, recompress), {"verified"}),
    "metadata appended": (
        lambda a, _: append_update(a.pdf, document_info(Author="Ada")), {"page differs"},
    ),
    "bytes appended": (lambda a, _: a.pdf + b"\n% Eve\n", {"cannot verify"}),
    "a version appended": (lambda a, _: append_update(a.pdf, empty_first_page), {"page differs"}),
    "a page of another report": (pages_of_another, {"cannot verify"}),
    "a link": (
        lambda a, _: forged(a.pdf, catalogue("/URI", TextStringObject("http://example.org"))),
        {"cannot verify"},
    ),
    "results of another report": (
        lambda a, b: forged(a.pdf, with_results(to_json(b.results))), {"other log"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_verify_accepts_resaved_pdf_and_rejects_changed_content(
    aisle: VerifiedReport, loop: VerifiedReport, name: str
) -> None:
    forge, expected = FILES[name]
    pdf = forge(aisle, loop)
    read_report(pdf, "r.pdf")
    verdict = aisle.verified(pdf)
    assert verdict.redrawn_pdf in (b"", aisle.pdf)
    assert verdict.outcome in expected, verdict
    assert verdict.redrawn_pdf == (b"" if verdict.status == "other log" else aisle.pdf)


def test_log_of_other_flight_gives_verify_status_other_log(aisle: VerifiedReport) -> None:
    for files in ([LOOP_LOG], [LOOP_LOG, Path(__file__)]):
        verdict = verify(read_attached_results(aisle.pdf), aisle.pdf, files)
        assert verdict.status == "other log"
        assert not verdict.with_log


@pytest.mark.usefixtures("cached_pages")
def test_verify_finds_all_input_files_by_sha256(tmp_path: Path) -> None:
    """The file names differ from those of the report."""
    positions, target = SAMPLES / "aisle_uwb_external.csv", tmp_path / "joined.pdf"
    run_checked("compare", LOG, "--position", positions, "--axis", "down", "-o", target)
    pdf = target.read_bytes()
    report = read_attached_results(pdf)
    (tmp_path / "a").write_bytes(LOG.read_bytes())
    (tmp_path / "b").write_bytes(positions.read_bytes())
    verdict = verify(report, pdf, hash_files([tmp_path / "a"]))
    assert verdict.status == "cannot verify"
    assert "--position" in verdict.reasons[0]
    both = hash_files([tmp_path / "a", tmp_path / "b"])
    assert verify(report, pdf, both).status == "verified"


# -- the command -----------------------------------------------------------------------------------


def test_verify_command_prints_and_writes_the_verdict(
    tmp_path: Path, aisle: VerifiedReport, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_this_process(monkeypatch)  # the next test uses a worker process
    target = tmp_path / "verdict.json"
    output = run_checked("verify", REPORT, LOOP_LOG, "--json", target, code=1).output
    assert "other log" in output
    assert VERIFICATION_SCOPE_NOTE in output
    told = json.loads(target.read_text(encoding="utf-8"))
    assert told["status"] == "other log"
    assert told["limit"] == VERIFICATION_SCOPE_NOTE
    assert "cannot verify" in run_checked("verify", REPORT, code=1).output
    output = run_checked("verify", REPORT, "--json", "-", code=1).output
    assert json.loads(output)["status"] == "cannot verify"


@pytest.mark.slow
def test_verify_command_finds_a_renamed_log(tmp_path: Path) -> None:
    target = tmp_path / "loop.pdf"
    run_checked("loop", f"{LOOP_LOG}:ekf2", "-o", target)
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "renamed.bin").write_bytes(LOOP_LOG.read_bytes())
    assert "verified" in run_checked("verify", target, folder).output
