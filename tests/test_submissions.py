"""Submissions in folders and zip files: search, names, limits; zip files are not unpacked."""

from __future__ import annotations

import io
import os
import random
import struct
import sys
import tracemalloc
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import pytest

from px4fuse.classroom.assignment.roster import Person
from px4fuse.classroom.grading import submissions
from px4fuse.classroom.grading.model import Submission
from px4fuse.classroom.grading.submissions import (
    add_submitters,
    find_submissions,
    parse_submission_path,
    read_submission,
)
from px4fuse.core.reading import hash_files
from px4fuse.errors import ResultsError, SettingsError
from px4fuse.verification.pdf_input import MAX_PDF_BYTES, read_report

PDF = b"%PDF-1.4 a small one\n%%EOF\n"


def zipped(entries: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return out.getvalue()


def write(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def reason(submission: Submission) -> str:
    with pytest.raises(ResultsError) as refused:
        read_submission(submission)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def name_and_number(name: str) -> tuple[str, str]:
    origin = parse_submission_path(name)
    return origin.person.name, "".join(origin.person.numbers.values())


def single_submission(path: Path) -> Submission:
    (submission,), _ = find_submissions([path])
    return submission


# ------------------------------------------------------------------ search


def test_find_submissions_searches_folders_recursively(tmp_path):
    for name in ("b/report.pdf", "A/Report.PDF", "c.pdf", "notes.docx", "b/log.ulg", "x.docx"):
        write(tmp_path / name, PDF)
    for name in (".hidden.pdf", "__MACOSX/x.pdf", ".git/x.pdf"):
        write(tmp_path / name, PDF)
    found, notes = find_submissions([tmp_path])
    assert [each.name for each in found] == ["A/Report.PDF", "b/report.pdf", "c.pdf"]
    assert notes[0].startswith("Ignored files (not PDF): 3 (")
    assert [read_submission(each) for each in found] == [PDF] * 3
    assert all(each.zip_entry == "" for each in found)


@pytest.mark.parametrize(
    ("name", "is_"),
    [
        ("Müller Zoë_12_assignsubmission_file_/Bericht.pdf", ("Müller Zoë", "12")),
        ("Old Style_99_assignsubmission_file_report.pdf", ("Old Style", "99")),
        ("Roe Max_1_assignsubmission_file/r.pdf", ("Roe Max", "1")),  # Moodle from 4.1 on
        ("doejane_12345_67890_report-1.pdf", ("doejane", "12345")),
        ("roejo_LATE_5_6_r.pdf", ("roejo", "5")),
        ("assignment_7_export/submission_31/report.pdf", ("", "31")),
        # the part of the platform comes first, then names that a student chose
        ("Roe Max_1_assignsubmission_file_/Doe Jane_2_assignsubmission_file_/r.pdf",
         ("Roe Max", "1")),
        ("roemax_5_6_doejane_7_8_report.pdf", ("roemax", "5")),
        ("Roe_Max_roe1_77/Doe Jane_2_assignsubmission_file_/r.pdf", ("Max Roe", "77")),
        ("flight_lab_reports_2026/r.pdf", ("", "")),
    ],
)  # fmt: skip
def test_student_name_is_read_from_learning_platform_file_name(name, is_):
    assert name_and_number(name) == is_


def test_login_and_lateness_are_read_from_submission_file_name():
    blackboard = parse_submission_path(
        "Lab 3_roe1_attempt_2026-11-20-12-34-56_Lab_doe1_attempt_x.pdf"
    )
    assert (blackboard.person.login, blackboard.platform) == ("roe1", "blackboard")
    assert parse_submission_path("Lab_roe1_attempt_2026-99-20-12-34-56_r.pdf").time is None
    ilias = parse_submission_path("Lab 3/Roe_Max_roe1_77/Late Submission - r.pdf")
    assert (ilias.platform, ilias.person.login, ilias.is_late) == ("ilias", "roe1", True)


METADATA = """---
submission_31:
  :submitters:
  - :name: Doe, Jane
    :sid: '0042'
    :email: jane@example.edu
  - :name: Roe, Max
    :sid: '43'
  :created_at: 2026-11-20 22:59:01.123456000 Z
  :results:
    :output: |
      submission_31:
        :submitters:
        - :name: Mallory
  :history:
  - :id: 30
"""


def test_forged_date_or_name_in_upload_file_name_is_ignored():
    """The student's part of the name contains a second time, or a name as from Moodle."""
    usual = [f"Lab_user{n}_attempt_2026-11-20-11-00-0{n}_r.pdf" for n in range(3)]
    forged = [
        "Lab_eve_attempt_2026-11-23-10-00-00_x_attempt_2026-11-19-10-00-00_r.pdf",
        "Lab_mal_attempt_2026-11-23-10-00-00_Doe Jane_4711_assignsubmission_file_r.pdf",
    ]
    files = [Submission(Path("export.zip"), name, name) for name in (*usual, *forged)]
    origins = [one.origin for one in add_submitters(files, {})]
    assert {one.platform for one in origins} == {"blackboard"}
    assert [one.person.login for one in origins[3:]] == ["eve", "mal"]
    assert {one.time.day for one in origins[3:]} == {23}


def test_find_submissions_reads_gradescope_metadata(tmp_path):
    forged = METADATA.replace("Doe, Jane", "Mallory")
    content = zipped(
        {
            "assignment_7_export/submission_metadata.yml": METADATA.encode(),
            "assignment_7_export/submission_31/report.pdf": PDF,
            "assignment_7_export/submission_31/submission_metadata.yml": forged.encode(),
        }
    )
    path = write(tmp_path / "export.zip", content)
    write(tmp_path / "unpacked" / "submission_metadata.yml", METADATA.encode())
    write(tmp_path / "unpacked" / "submission_31" / "submission_metadata.yml", forged.encode())
    write(tmp_path / "unpacked" / "submission_31" / "report.pdf", PDF)
    for place in (path, tmp_path / "unpacked"):
        (found,), notes = find_submissions([place])
        person = found.origin.person
        assert notes[0].startswith("Ignored files (not PDF): 1 (")
        assert person == Person(
            "0042", "Doe, Jane", "jane@example.edu", numbers={"gradescope": "31"}
        )
        assert found.origin.time.isoformat() == "2026-11-20T22:59:01.123456+00:00"


def test_unreadable_gradescope_metadata_give_a_note(tmp_path):
    bomb = zipped({"submission_metadata.yml": b" " * 5_000_000, "submission_3.pdf": PDF})
    (found,), (note,) = find_submissions([write(tmp_path / "export.zip", bomb)])
    assert found.origin.person == Person("", numbers={"gradescope": "3"})
    assert note.startswith(
        "submission_metadata.yml: the zip entry unpacks to more than 100 times its packed size"
    )


def test_find_submissions_does_not_open_nested_zip(tmp_path):
    name = "Roe_1_assignsubmission_file_/work.zip"
    handed_in = zipped({"report.pdf": PDF, "more.zip": zipped({"deep.pdf": PDF})})
    export = write(tmp_path / "all.zip", zipped({name: handed_in, "log.ulg": b""}))
    found, notes = find_submissions([export])
    assert [each.name for each in found] == [name]
    assert name_and_number(found[0].name) == ("Roe", "1")
    with pytest.raises(ResultsError) as refused:
        read_report(read_submission(found[0]), found[0].name)
    assert (
        str(refused.value) == f"{name}: the file is not a PDF. Hand in the file that px4fuse wrote."
    )
    assert notes[1:] == (
        "Zip files not opened: 1. Name each exported zip file on the command line.",
    )
    # the same for an unpacked export
    write(tmp_path / "unpacked" / name, handed_in)
    ((again,), _) = find_submissions([tmp_path / "unpacked"])
    assert (again.name, again.zip_entry) == (name, "")


def test_find_submissions_finds_80_files_in_one_zip(tmp_path):
    class_ = {f"N_{n}_assignsubmission_file_/r.pdf": PDF for n in range(80)}
    assert len(find_submissions([write(tmp_path / "class.zip", zipped(class_))])[0]) == 80


def test_find_submissions_without_pdf_raises_error(tmp_path):
    with pytest.raises(SettingsError, match="not a file or folder"):
        find_submissions([tmp_path / "absent"])
    write(tmp_path / "a.txt", b"")
    with pytest.raises(SettingsError, match="No PDF found") as caught:
        find_submissions([tmp_path])
    assert "\n" not in str(caught.value)


def test_find_submissions_skips_damaged_zip_with_note(tmp_path):
    bad = write(tmp_path / "bad.zip", b"PK" + bytes(100))
    good = write(tmp_path / "good.zip", zipped({"a.pdf": PDF}))
    found, notes = find_submissions([bad, good])
    assert [each.name for each in found] == ["a.pdf"]
    assert len(notes) == 1
    assert "bad.zip was ignored: the file cannot be read (damaged)." in notes


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights that tests do not have")
def test_find_submissions_ignores_links_and_special_files(tmp_path):
    outside = write(tmp_path / "outside" / "secret.pdf", PDF)
    inside = write(tmp_path / "in" / "a.pdf", PDF)
    (tmp_path / "in" / "link.pdf").symlink_to(outside)
    (tmp_path / "in" / "folder").symlink_to(outside.parent)
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "gone.pdf").symlink_to(tmp_path / "nowhere")
    (tmp_path / "in" / "same.pdf").symlink_to(inside)
    (tmp_path / "in" / "circle.pdf").symlink_to(tmp_path / "in" / "circle.pdf")
    os.mkfifo(tmp_path / "in" / "pipe.pdf")
    found, notes = find_submissions([tmp_path / "in"])
    assert [each.name for each in found] == ["a.pdf"]
    assert notes == (
        "in: 6 entries were ignored (links to files outside the folder, special files, unreadable "
        "folders).",
    )


def test_find_submissions_searches_1500_nested_folders(tmp_path):
    """Deeper than Python's recursion limit."""
    folders = [tmp_path / "in" / ("d/" * depth) for depth in range(1_500)]
    for folder in folders:
        folder.mkdir()
    paths = [write(tmp_path / "in" / "a.pdf", PDF), write(folders[-1] / "b.pdf", PDF)]
    try:
        found, notes = find_submissions([tmp_path / "in"])
        known = hash_files([tmp_path / "in"])
    finally:  # shutil.rmtree, which removes temporary folders, is recursive
        for path in paths:
            path.unlink()
        for folder in reversed(folders):
            folder.rmdir()
    assert [each.file for each in found] == paths
    assert notes == ()
    assert [*known.values()] == paths[:1]  # equal content


# ------------------------------------------------------------------ names


def test_find_submissions_removes_control_characters_from_names(tmp_path):
    shown_as = {
        "../../../etc/x.pdf": "etc/x.pdf",
        "C:\\Windows\\system32\\y.pdf": "Windows/system32/y.pdf",
        "a\x1b[2J\u202egnp.pdf": "a[2Jgnp.pdf",
        "new\nline.pdf": "new line.pdf",
        "n" * 5000 + ".pdf": "n" * 100 + "…" + "n" * 95 + ".pdf",
    }
    folder = tmp_path / "work"
    path = write(folder / "x.zip", zipped(dict.fromkeys(shown_as, PDF)))
    before = sorted(tmp_path.rglob("*"))
    found, _ = find_submissions([path])
    assert {each.name for each in found} == set(shown_as.values())
    assert all(read_submission(each) == PDF for each in found)
    assert sorted(tmp_path.rglob("*")) == before


# ------------------------------------------------------------------ bounds


def test_submission_above_size_limit_is_rejected_without_reading(tmp_path):
    path = tmp_path / "large.pdf"
    with path.open("wb") as file:
        file.truncate(500_000_000)  # sparse file
    tracemalloc.start()
    said = reason(single_submission(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert said == "large.pdf: the file is larger than 25 MB."
    assert peak < 3 * MAX_PDF_BYTES


def test_submission_with_zip_bomb_is_rejected(tmp_path, monkeypatch):
    packed = zipped({"bomb.pdf": bytes(20_000_000)})
    path = write(tmp_path / "x.zip", packed)
    assert "more than 100 times its packed size" in reason(single_submission(path))
    path.write_bytes(zipped({"large.pdf": bytes(MAX_PDF_BYTES + 1)}))
    assert "larger than 25 MB" in reason(single_submission(path))
    # declared size below the actual one: zipfile stops there, and the checksum is wrong
    path.write_bytes(packed.replace(struct.pack("<I", 20_000_000), struct.pack("<I", 1000)))
    assert "cannot be read" in reason(single_submission(path))
    monkeypatch.setattr(submissions, "MAX_PDF_BYTES", len(PDF))
    path.write_bytes(zipped({"just.pdf": PDF}))
    assert read_submission(single_submission(path)) == PDF


@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [
        ("MAX_UNPACKED_BYTES", 200, "the zip file unpacks to more than"),
        ("MAX_ZIP_ENTRIES", 3, "more than 3 entries"),
        ("MAX_DIRECTORY_BYTES", 100, "damaged"),
    ],
)
def test_find_submissions_skips_zip_beyond_size_limits(tmp_path, monkeypatch, limit, value, said):
    path = write(tmp_path / "x.zip", zipped({f"{n}.pdf": bytes(100) for n in range(4)}))
    other = write(tmp_path / "y.pdf", PDF)
    monkeypatch.setattr(submissions, limit, value)
    found, notes = find_submissions([path, other])
    assert [each.file for each in found] == [other]
    assert any(note.startswith("x.zip was ignored: ") and said in note for note in notes)


def test_read_submission_from_unsupported_zip_gives_reason(tmp_path):
    link = zipfile.ZipInfo("link.pdf")
    link.external_attr = 0o120777 << 16
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(link, "/etc/passwd")
        archive.writestr("packed.pdf", PDF, zipfile.ZIP_LZMA)
        archive.writestr("locked.pdf", PDF)
        archive.writestr("same.pdf", PDF)
    content = bytearray(out.getvalue())
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        name = content.index(b"locked.pdf", 0 if place == 6 else content.index(b"PK\x01\x02"))
        content[content.rindex(mark, 0, name) + place] |= 1
    found, _ = find_submissions([write(tmp_path / "x.zip", bytes(content))])
    by_name = {each.name: each for each in found}
    assert "symbolic link" in reason(by_name["link.pdf"])
    assert "is not supported" in reason(by_name["packed.pdf"])
    assert reason(by_name["locked.pdf"]) == "locked.pdf: the zip entry is encrypted."
    by_name["same.pdf"].file.unlink()
    assert reason(by_name["same.pdf"]).endswith("(No such file or directory).")


def test_find_submissions_rejects_zip_with_equal_entry_names(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("same.pdf", b"first")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("same.pdf", b"last")
    with pytest.raises(SettingsError, match="two files with the name same"):
        find_submissions([tmp_path / "x.zip"])


def test_find_submissions_makes_equal_file_names_unique(tmp_path):
    for folder in "abc":
        write(tmp_path / folder / "Report.pdf", folder.encode())
    folders = [tmp_path / folder for folder in "abc"]
    found, _ = find_submissions([*folders, *folders])
    assert [each.name for each in found] == ["Report.pdf", "Report.pdf (2)", "Report.pdf (3)"]
    assert [read_submission(each) for each in found] == [b"a", b"b", b"c"]
    # names without the UTF-8 flag
    content = zipped({"M_ller.pdf": PDF, "Zo__.pdf": PDF})
    content = content.replace(b"M_ller", b"M\x81ller").replace(b"Zo__", "Zoë".encode())
    found, _ = find_submissions([write(tmp_path / "x.zip", content)])
    assert [each.name for each in found] == ["Müller.pdf", "Zoë.pdf"]


def test_find_submissions_on_fuzzed_zip_raises_no_exception(tmp_path):
    rng = random.Random(6)
    whole = zipped({"a/report.pdf": PDF * 20, "b.zip": zipped({"c.pdf": PDF}), "d.txt": b""})
    path = tmp_path / "x.zip"
    for _ in range(int(os.environ.get("PX4FUSE_FUZZ", "300"))):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 6)):
            content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content[: rng.choice([len(content), rng.randrange(len(content))])])
        try:
            found, notes = find_submissions([path])
        except SettingsError:
            continue
        for each in found:
            with suppress(ResultsError):
                assert isinstance(read_submission(each), bytes)
        assert all("\n" not in note for note in notes)
