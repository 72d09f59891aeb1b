"""Reports that prove themselves: no change of one reaches what an instructor then looks at."""

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
from cli_tools import done
from conftest import LOG, REPORT, SAMPLES
from forgery import (
    Base,
    Change,
    Edit,
    Forge,
    appended,
    array,
    base,
    dictionary,
    edited,
    font,
    forged,
    glyphs,
    on_page,
    plain,
    put,
    read_again,
    report_of,
    root,
    saved,
    text,
    titled,
    with_results,
)
from pypdf import PdfReader, PdfWriter
from pypdf.annotations import Link
from pypdf.generic import (
    NameObject,
    TextStringObject,
)

from px4fuse.errors import ResultsError
from px4fuse.reading import files_by_sha256
from px4fuse.results.contract import to_json, to_plain
from px4fuse.verification import pages, verification
from px4fuse.verification.intake import read_report
from px4fuse.verification.verification import (
    ESTIMATE_RELATIVE_TOLERANCE,
    LIMIT,
    NO_LOG,
    RELATIVE_TOLERANCE,
    compare_results,
    flatten,
    verify,
)

pytestmark = pytest.mark.usefixtures("analysed_once")

LOOP_LOG = SAMPLES / "loop_vio.ulg"


@pytest.fixture(autouse=True, scope="module")
def _pages_in_this_process() -> Iterator[None]:
    """The process that bounds the comparison of pages takes seconds; test_pages.py has one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "run_one_bounded", lambda function, job, *_: function(job))
        yield


@pytest.fixture(scope="module")
def aisle() -> Base:
    return base(REPORT.read_bytes(), LOG)


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Base:
    folder = tmp_path_factory.mktemp("loop")
    (folder / "notes.md").write_text("# Drift\n\nThe *heading* drifts most.\n", encoding="utf-8")
    target = folder / "loop.pdf"
    own = "--student", "Ada", "--id", "7", "--notes", folder / "notes.md"
    done("loop", LOOP_LOG, "-o", target, *own)
    return base(target.read_bytes(), LOOP_LOG)


# -- what is untouched -----------------------------------------------------------------------------


def test_the_shipped_report_is_verified(aisle: Base) -> None:
    shipped = REPORT.read_bytes()
    verdict = verify(report_of(shipped), shipped, aisle.files, recompute=aisle.recompute)
    assert verdict.status == "verified", verdict
    assert verdict.with_log
    assert verdict.page_status == "same"
    assert LIMIT in verdict.reasons


def test_a_report_on_a_loop_is_verified(loop: Base) -> None:
    verdict = loop.verified(loop.pdf)
    assert verdict.status == "verified", verdict
    text = "".join(page.extract_text() for page in PdfReader(io.BytesIO(loop.pdf)).pages)
    assert "Ada" in text
    assert "heading drifts most" in text.replace("*", "")


def test_nothing_is_verified_without_the_log(aisle: Base, loop: Base) -> None:
    for one in (aisle, loop):
        verdict = verify(report_of(one.pdf), one.pdf, {})
        assert verdict.status == "cannot verify"
        assert verdict.reasons == (NO_LOG,)
        assert verdict.redrawn == b""
        assert not verdict.with_log


def nudged(value: Any, share: float) -> Any:
    if isinstance(value, float):
        return value * (1.0 + share)
    if isinstance(value, dict):
        return {name: nudged(part, share) for name, part in value.items()}
    return [nudged(part, share) for part in value] if isinstance(value, list | tuple) else value


def shifted(pdf: bytes, by: float) -> bytes:
    """All lines and marks a little aside."""
    ends = re.compile(rb"(\d[\d.]*) (\d[\d.]*) ([ml])\b")

    def moved(match: re.Match[bytes]) -> bytes:
        return b"%.6f %.6f %s" % (float(match[1]) + by, float(match[2]) + by, match[3])

    changes = [
        on_page(number, lambda content: ends.sub(moved, content))
        for number, page in enumerate(PdfReader(io.BytesIO(pdf)).pages, start=1)
        if ends.search(page["/Contents"].get_data())
    ]
    return forged(pdf, *changes)


@pytest.mark.parametrize("which", ["aisle", "loop"])
def test_another_platform_is_still_verified(which: str, request: pytest.FixtureRequest) -> None:
    one: Base = request.getfixturevalue(which)
    drawn = shifted(one.pdf, 0.01)
    nudged_ = read_again(nudged(json.loads(to_json(one.again[0])), -1e-9))
    elsewhere = (nudged_, lambda: drawn)
    verdict = verify(report_of(one.pdf), one.pdf, one.files, recompute=lambda *_: elsewhere)
    assert verdict.outcome == "verified", verdict
    assert f"within {RELATIVE_TOLERANCE:g}" in verdict.reasons[0]
    aside = shifted(one.pdf, 0.6)
    elsewhere = (one.again[0], lambda: aside)
    verdict = verify(report_of(one.pdf), one.pdf, one.files, recompute=lambda *_: elsewhere)
    assert (verdict.status, verdict.outcome) == ("verified", "page differs")
    assert verdict.redrawn == aside


def test_verify_numbers_1e_12_apart_are_verified(aisle: Base) -> None:
    """Other kernels of OpenBLAS change results of the sample flights by 3e-8 at most."""
    nudged_ = read_again(nudged(json.loads(to_json(aisle.again[0])), -1e-12))
    elsewhere = (nudged_, lambda: forged(aisle.pdf))
    verdict = verify(report_of(aisle.pdf), aisle.pdf, aisle.files, recompute=lambda *_: elsewhere)
    assert verdict.outcome == "verified", verdict


def test_compare_results_numbers_1e_4_apart_differ(aisle: Base) -> None:
    """Every number but those with the tolerance of an estimate, and those near zero."""
    ours = json.loads(to_json(aisle.again[0]))
    for share, least in ((1e-4, RELATIVE_TOLERANCE), (1e-2, ESTIMATE_RELATIVE_TOLERANCE)):
        theirs = nudged(ours, share)
        found = {one.path for one in compare_results(theirs, ours)[0]}
        wide = verification.ESTIMATE_PATHS if least == RELATIVE_TOLERANCE else ()
        expected = {
            path[:120] for path, value in flatten(ours)
            if isinstance(value, float) and abs(value) > 0.01 and not path.startswith(wide)
        }  # fmt: skip
        assert len(expected) > 100
        assert expected - found == set()


KF = ("axes", "north", "filters", "kf")


def test_tolerances(aisle: Base) -> None:
    ours = json.loads(to_json(aisle.again[0]))
    for share, path, alike in (
        (0.5 * RELATIVE_TOLERANCE, (*KF, "nis_mean"), True),
        (2.0 * RELATIVE_TOLERANCE, (*KF, "nis_mean"), False),
        (0.5 * ESTIMATE_RELATIVE_TOLERANCE, ("tuning", "horizontal", "sigma_a_m_s2"), True),
        (2.0 * ESTIMATE_RELATIVE_TOLERANCE, ("tuning", "horizontal", "sigma_a_m_s2"), False),
    ):
        theirs = copy.deepcopy(ours)
        part = theirs
        for name in path[:-1]:
            part = part[name]
        part[path[-1]] *= 1.0 + share
        assert (not compare_results(theirs, ours)[0]) == alike, path


# -- what is changed in the results ----------------------------------------------------------------


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(value, dict):
        for name, part in value.items():
            yield from leaves(part, (*path, name))
    elif isinstance(value, list) and value:
        yield from leaves(value[0], (*path, 0))
    else:
        yield path


def one_of_each_kind() -> list[tuple[Any, ...]]:
    """A leaf of every name in the results."""
    results = plain(report_of(REPORT.read_bytes()))
    # what another test is for: the log, the version, and what is printed anew
    apart = ("schema", "student", "provenance")
    kinds = {
        path[-1]: path
        for path in leaves(results)
        if path[0] not in apart and path != ("log", "sha256")
    }
    return list(kinds.values())


KINDS = one_of_each_kind()
assert len(KINDS) >= 100


def changed(results: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
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
def test_a_changed_leaf_of_the_results(aisle: Base, path: tuple[Any, ...]) -> None:
    found, *_ = compare_results(changed(aisle.results, path), to_plain(aisle.again[0]))
    difference = found[0]  # where there was none, a list has places of its own
    assert difference.path.startswith(".".join(map(str, path)))


def without(*path: Any) -> Change:
    def change(results: dict[str, Any]) -> None:
        part: Any = results
        for name in path[:-1]:
            part = part[name]
        del part[path[-1]]

    return change


STRUCTURE: dict[str, tuple[Change, str]] = {
    "a finding more": (
        lambda r: r["findings"].append(copy.deepcopy(r["findings"][0])), "numbers differ",
    ),
    "an axis less": (without("axes", "down"), "numbers differ"),
    "a filter's part as if it were not available": (
        put({"what": "a", "reason": "b", "remedy": "c"}, "axes", "north", "filters", "ekf2"),
        "numbers differ",
    ),
    "a parameter more": (put(1.0, "log", "parameters", "EKF2_HACK"), "numbers differ"),
    "a note more": (put("all is well", "notes", 1), "numbers differ"),
    "a number as a text": (put("0.5", "settings", "sigma_a_m_s2"), "cannot verify"),
    "an interval narrower": (
        lambda r: r["tuning"]["horizontal"].update(
            sigma_z_m_interval=[r["tuning"]["horizontal"]["sigma_z_m"]] * 2
        ),
        "numbers differ",
    ),
    "a step of a millisecond": (put(0.001, "request", "dt_s"), "cannot verify"),
    "no request": (without("request"), "numbers differ"),
    "another command": (put("tune", "request", "command"), "numbers differ"),
    "an unknown setting": (put(1, "request", "please"), "numbers differ"),
}  # fmt: skip


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("name", STRUCTURE)
def test_changed_results(aisle: Base, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, expected = STRUCTURE[name]
    monkeypatch.setattr(verification, "compare_pages", lambda *_, **__: ())  # they are as drawn
    results = copy.deepcopy(aisle.results)
    change(results)
    verdict = aisle.verified(aisle.with_results(results))
    if verdict.reasons[0].startswith("results.json"):  # no such results are read at all
        expected = "cannot verify"
    assert verdict.status == verdict.outcome == expected, verdict


@pytest.mark.parametrize(
    "path", [("student", "name"), ("student", "notes"), ("provenance", "libraries", "matplotlib")]
)
def test_what_is_printed_from_the_record(loop: Base, path: tuple[str, ...]) -> None:
    results = copy.deepcopy(loop.results)
    put({"name": "Eve", "notes": "I flew it."}.get(path[-1], "9.9.9"), *path)(results)
    again = verification.recompute(read_again(results), loop.files)
    pdf = loop.with_results(results)
    verdict = verify(report_of(pdf), pdf, loop.files, recompute=lambda *_: again)
    assert verdict.outcome != "verified", verdict
    assert verdict.differences == ()
    assert verdict.redrawn != loop.pdf
    named = any("matplotlib 9.9.9; here" in reason for reason in verdict.reasons)
    assert named == (path[-1] == "matplotlib")


@pytest.fixture(scope="module")
def foreign(loop: Base) -> Base:
    """Report that states another Matplotlib version, in its results and on its last page."""
    results = copy.deepcopy(loop.results)
    put("3.99.0", "provenance", "libraries", "matplotlib")(results)
    again = verification.recompute(read_again(results), loop.files)
    drawn = again[1]()
    return Base(forged(drawn, with_results(to_json(results))), results, again, loop.files)


def test_verify_other_libraries_same_drawing_is_verified(foreign: Base) -> None:
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
def test_verify_other_libraries_changed_plot_is_found(foreign: Base, name: str) -> None:
    verdict = foreign.verified(forged(foreign.pdf, on_page(1, PLOTS[name])))
    assert verdict.outcome == "cannot verify", verdict
    assert "page 1: drawing operation" in verdict.reasons[0]
    assert any("made with matplotlib 3.99.0; here" in reason for reason in verdict.reasons)
    assert verdict.remedy.startswith("Verify it with matplotlib 3.99.0.")
    assert verdict.redrawn == foreign.again[1]()


# -- what is changed on the pages ------------------------------------------------------------------


def once(pattern: bytes, replacement: Any) -> Callable[[bytes], bytes]:
    """Replace the last match."""

    def change(content: bytes) -> bytes:
        match = list(re.finditer(pattern, content))[-1]
        new = replacement(match) if callable(replacement) else match.expand(replacement)
        return content[: match.start()] + new + content[match.end() :]

    return change


LETTERS = glyphs(font("/f0")(PdfWriter(clone_from=REPORT)))  # nearly all text; /f1 is bold
DIGITS = [LETTERS[digit] for digit in "0123456789"]


def last_digit(replacement: Callable[[int], bytes]) -> Edit:
    """The last digit on a page in its usual font, as something else."""

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
    "a point of a line moved": once(rb"([\d.]+) ([\d.]+) l\b", aside),
    "a white rectangle": lambda c: c + b"\n1 g\n100 690 300 90 re\nf\n",
    "a text more": lambda c: c + b"\nBT\n/f0 12 Tf\n100 100 Td\n(" + A + b") Tj\nET\n",
    "a text moved": once(rb"q 1 0 0 -1 ([\d.]+) ([\d.]+) cm", rb"q 1 0 0 -1 9\1 \2 cm"),
    "a text invisible": once(rb"BT 0 Tr", b"BT 3 Tr"),
    "another font": once(rb"/f0 ", b"/f1 "),
    "a colour": once(rb"[\d.]+ [\d.]+ [\d.]+ scn", b"0.123 0.123 0.123 scn"),
    "a comment": lambda c: c + b"\n% nothing\n",
    "clipped": lambda c: b"0 0 300 300 re W n\n" + c,
    "turned over": lambda c: b"-1 0 0 1 595 0 cm\n" + c,
    "nothing at all": lambda c: b"\n",
}
PAGES = 8

# Every page in one way, and each of the others on one page
DRAW_LABEL = [
    (page, name)
    for place, name in enumerate(DRAWING)
    for page in range(1, PAGES + 1)
    if name == "another digit" or (page + place) % PAGES == 0
]


@pytest.mark.parametrize(("page", "name"), DRAW_LABEL)
def test_a_changed_page(aisle: Base, page: int, name: str) -> None:
    verdict = aisle.verified(forged(aisle.pdf, on_page(page, DRAWING[name])))
    assert verdict.redrawn == aisle.pdf  # what is redrawn is never touched by a forgery
    assert verdict.status == "verified"
    assert verdict.outcome == "page differs", verdict
    assert [one.page for one in verdict.pages] == [page]


DOCUMENT: dict[str, tuple[Forge, str, str]] = {
    "a page away": (lambda w: w.remove_page(7), "page differs", "page 8: missing"),
    "another title": (titled(Title="my report"), "page differs", "document: /Title is"),
    "a form": (root("/AcroForm", dictionary(Fields=array())), "cannot verify", "form fields that"),
    "an annotation": (
        lambda w: w.add_annotation(1, Link(rect=(50, 50, 200, 70), url="http://example.org")),
        "cannot verify", "page 2: an annotation that px4fuse does not write",
    ),
    "a part that nothing refers to": (lambda w: w._add_object(dictionary()), "verified", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", DOCUMENT)
def test_a_changed_document(aisle: Base, name: str) -> None:
    forge, expected, said = DOCUMENT[name]
    verdict = aisle.verified(forged(aisle.pdf, forge))
    assert verdict.redrawn == aisle.pdf
    assert verdict.outcome == expected, verdict
    assert verdict.status == ("verified" if expected == "page differs" else expected)
    assert any(said in reason for reason in verdict.reasons), verdict
    # the reason that a class table shows is the one that counts
    if expected == "cannot verify":
        assert said in verdict.reasons[0]
        assert verdict.remedy.startswith("Ask for the PDF")
        assert LIMIT not in verdict.reasons


@pytest.mark.parametrize("key", ["/OpenAction", "/AA"])
def test_a_document_with_a_script_is_refused(aisle: Base, key: str) -> None:
    script = dictionary(S=NameObject("/JavaScript"), JS=TextStringObject("app.alert(1)"))
    with pytest.raises(ResultsError):
        read_report(forged(aisle.pdf, root(key, script)), "r.pdf")


def test_verify_numbers_that_differ_come_first(aisle: Base) -> None:
    results = copy.deepcopy(aisle.results)
    results["axes"]["north"]["filters"]["kf"]["nis_mean"] = 1.0
    form = root("/AcroForm", dictionary(Fields=array()))
    verdict = aisle.verified(forged(aisle.pdf, form, with_results(to_json(results))))
    assert verdict.status == "numbers differ"
    assert "1 of" in verdict.reasons[0]
    assert any("form fields" in reason for reason in verdict.reasons)


def emptied(writer: PdfWriter) -> None:
    """The first page without what it draws."""
    stream = edited(writer.pages[0]["/Contents"].get_object(), lambda _: b" ")
    writer.pages[0][NameObject("/Contents")] = writer._add_object(stream)


def pages_of_another(one: Base, other: Base) -> bytes:
    """A report with the last page of another."""
    writer = PdfWriter(clone_from=io.BytesIO(one.pdf))
    writer.remove_page(PAGES - 1)
    writer.add_page(PdfReader(io.BytesIO(other.pdf)).pages[-1])
    return saved(writer)


def packed(writer: PdfWriter) -> None:
    """As programs that save a PDF again pack it: object streams, other compression."""
    writer.compress_identical_objects(remove_duplicates=True)
    for page in writer.pages:
        page.compress_content_streams(level=9)
    writer.add_metadata({"/Producer": "Another program"})


FILES: dict[str, tuple[Callable[[Base, Base], bytes], set[str]]] = {
    "saved again": (lambda a, _: forged(a.pdf), {"verified"}),
    "packed in another way": (lambda a, _: forged(a.pdf, packed), {"verified"}),
    "metadata appended": (lambda a, _: appended(a.pdf, titled(Author="Ada")), {"page differs"}),
    "bytes appended": (lambda a, _: a.pdf + b"\n% Eve\n", {"cannot verify"}),
    "a version appended": (lambda a, _: appended(a.pdf, emptied), {"page differs"}),
    "a page of another report": (pages_of_another, {"cannot verify"}),
    "a link": (
        lambda a, _: forged(a.pdf, root("/URI", TextStringObject("http://example.org"))),
        {"cannot verify"},
    ),
    "results of another report": (
        lambda a, b: forged(a.pdf, with_results(to_json(b.results))), {"other log"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_changed_file(aisle: Base, loop: Base, name: str) -> None:
    forge, expected = FILES[name]
    pdf = forge(aisle, loop)
    read_report(pdf, "r.pdf")
    verdict = aisle.verified(pdf)
    assert verdict.redrawn in (b"", aisle.pdf)
    assert verdict.outcome in expected, verdict
    assert verdict.redrawn == (b"" if verdict.status == "other log" else aisle.pdf)


def test_another_log(aisle: Base) -> None:
    for files in ([LOOP_LOG], [LOOP_LOG, Path(__file__)]):
        verdict = verify(report_of(aisle.pdf), aisle.pdf, files)
        assert verdict.status == "other log"
        assert not verdict.with_log


@pytest.mark.usefixtures("drawn_once")
def test_a_joined_recording_is_found_by_its_content(tmp_path: Path) -> None:
    """And what it is called here does not show."""
    positions, target = SAMPLES / "aisle_uwb_external.csv", tmp_path / "joined.pdf"
    done("compare", LOG, "--position", positions, "--axis", "down", "-o", target)
    pdf = target.read_bytes()
    report = report_of(pdf)
    (tmp_path / "a").write_bytes(LOG.read_bytes())
    (tmp_path / "b").write_bytes(positions.read_bytes())
    verdict = verify(report, pdf, files_by_sha256([tmp_path / "a"]))
    assert verdict.status == "cannot verify"
    assert "--position" in verdict.reasons[0]
    both = files_by_sha256([tmp_path / "a", tmp_path / "b"])
    assert verify(report, pdf, both).status == "verified"


# -- the command -----------------------------------------------------------------------------------


def test_the_command_says_what_it_found(
    tmp_path: Path, aisle: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_this_process(monkeypatch)  # the next one takes one of its own
    target = tmp_path / "verdict.json"
    output = done("verify", REPORT, LOOP_LOG, "--json", target, code=1).output
    assert "other log" in output
    assert LIMIT in output
    told = json.loads(target.read_text(encoding="utf-8"))
    assert told["status"] == "other log"
    assert told["limit"] == LIMIT
    assert "cannot verify" in done("verify", REPORT, code=1).output
    output = done("verify", REPORT, "--json", "-", code=1).output
    assert json.loads(output)["status"] == "cannot verify"


def test_the_command_verifies(tmp_path: Path) -> None:
    target = tmp_path / "loop.pdf"
    done("loop", f"{LOOP_LOG}:ekf2", "-o", target)
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "renamed.bin").write_bytes(LOOP_LOG.read_bytes())
    assert "verified" in done("verify", target, folder).output
