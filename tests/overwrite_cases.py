"""Commands whose output is one of their inputs: by path, link, folder or letter case."""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path

from class_tools import make_report
from conftest import REPORT, SAMPLES
from ulog_tools import make_log

from px4fuse.classroom.assignment.key import AnswerKey, format_answer_key
from px4fuse.results.answer_form import format_answer_form

# Command, its inputs, its options for an output file (with the required ending), and the names that
# it writes to the folder of -o ("" for the folder itself)
RUNS = [
    ("compare l.ulg --position pos.csv", "l.ulg pos.csv", "--json -o.pdf", None),
    ("compare l.ulg --notes notes.md --answers form.toml", "notes.md form.toml", "--json", None),
    ("diff r.pdf q.json", "r.pdf q.json", "--json", None),
    ("explore l.ulg --position pos.csv", "l.ulg pos.csv", "-o.html", None),
    ("info l.ulg", "l.ulg", "--json", None),
    ("tune l.ulg --position pos.csv", "l.ulg pos.csv", "--json", None),
    ("sync l.ulg", "l.ulg", "--json", None),
    ("whatif l.ulg", "l.ulg", "--json", None),
    ("loop l.ulg:ekf2", "l.ulg", "--json -o.pdf --tum --g2o", None),
    ("loop a.tum --reference b.tum", "a.tum b.tum", "--json -o.pdf --tum --g2o", None),
    ("loop g.g2o", "g.g2o", "--json --g2o", None),
    ("evaluate a.tum l.ulg:truth", "a.tum l.ulg", "--json -o.pdf", None),
    ("verify r.pdf l.ulg", "r.pdf l.ulg", "--json -o.pdf", None),
    ("verify r.pdf logs", "logs/x.ulg", "--json -o.pdf", None),
    ("answers l.ulg", "l.ulg", "-o", None),
    ("extract l.ulg", "l.ulg", "", ("", "flight.json")),
    ("batch l.ulg", "l.ulg", "", ("", "fleet.csv", "results/", "rows/")),
    ("batch logs", "logs/x.ulg", "", ("", "fleet.html", "results/", "rows/")),
    ("batch {desk}/log*/*.ulg", "logs/x.ulg", "", ("", "fleet.csv", "results/", "rows/")),
    ("grade subs", "subs/s1.pdf subs/in/s2.pdf", "", ("", "reports/", "records/", "feedback/")),
    ("grade class.zip r.pdf", "class.zip r.pdf", "", ("", "class.csv", "reports/", "grades/")),
    ("grade subs --logs logs --key key.json --rubric rubric.toml",
     "logs/x.ulg key.json rubric.toml", "", ("", "class.csv", "records/")),
    ("grade subs --roster tables/roster.csv --worksheet tables/sheet.csv",
     "tables/roster.csv tables/sheet.csv", "", ("", "names.csv", "class.csv", "grades/")),
    ("simulate --assignment tables/roster.csv --secret-file secret.txt",
     "tables/roster.csv secret.txt", "", ("",)),
    ("simulate --assignment tables/roster.csv --secret-file secret.txt -o {place}/flights",
     "tables/roster.csv secret.txt", "--answer", None),
]  # fmt: skip
PATHS = ("typed", "relative", "absolute", "link", "link to link", "hard link", "folder", "letters")


def make_desk(folder: Path) -> Path:
    """Write all types of inputs to a folder, each type of table to a subfolder."""
    log = make_log("v1.16", 20.0).encode()
    report = make_report("Ada", "1")
    for name, content in {
        "l.ulg": log, "logs/x.ulg": log,
        "pos.csv": (SAMPLES / "aisle_uwb_external.csv").read_bytes(),
        "notes.md": b"words",
        "form.toml": format_answer_form("l.ulg", hashlib.sha256(log).hexdigest()).encode(),
        "r.pdf": report, "subs/s1.pdf": report,
        "subs/in/s2.pdf": report, "q.json": REPORT.with_suffix(".json").read_bytes(),
        "a.tum": (SAMPLES / "loop_slam.tum").read_bytes(),
        "b.tum": (SAMPLES / "loop_slam.tum").read_bytes(),
        "g.g2o": b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n",
        "key.json": format_answer_key(AnswerKey("aisle", ())).encode(), "rubric.toml": b"",
        "secret.txt": b"a secret that is long enough",
        "tables/roster.csv": b"id,name\n1,Ada\n", "tables/sheet.csv": b"id,name,grade\n1,Ada,\n",
    }.items():  # fmt: skip
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(content)
    with zipfile.ZipFile(folder / "class.zip", "w") as archive:
        archive.writestr("s1.pdf", report)
    return folder


def file_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each regular file by its path; links are excluded."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


@dataclass(frozen=True)
class OverwriteCase:
    """A command with one of its outputs at one of its inputs.

    Attributes
    ----------
    option : str
        Output option with the required file ending.
    name : str or None
        Name in the folder of -o; None if the output is one file.
    way : str
        One of :data:`PATHS`.
    """

    command: str
    read: str
    option: str
    name: str | None
    way: str

    def arguments(self, desk: Path, place: Path) -> list[str] | None:
        """Make links below ``place`` and return the arguments; None if the way is not possible."""
        typed = self.command.format(desk=desk, place=place).split()
        option, dot, end = self.option.partition(".")
        if self.name:
            found = _linked_into(desk / self.read, self.way, place, self.name)
        elif self.name is not None:
            found = _another_path(Path(self.read).parent, self.way, desk, place)
        elif self.way == "beside":  # results next to the report
            (place / "r.json").symlink_to(desk / self.read)
            has_results = end == "pdf" and not self.command.startswith("verify")
            found = str(place / "r.pdf") if has_results else None
        else:
            found = _another_path(Path(self.read), self.way, desk, place, dot + end)
        return None if found is None else [*typed, option, found]


def _another_path(read: Path, way: str, desk: Path, place: Path, end: str = "") -> str | None:
    """Return another path of an input, or of its folder."""
    target, link = desk / read, place / f"link{end}"
    if way in ("link", "link to link"):
        (place / "first").symlink_to(os.path.relpath(target, place))
        link.symlink_to("first" if way == "link to link" else target)
        return str(link)
    if way == "hard link" and target.is_file():
        link.hardlink_to(target)
        return str(link)
    if end and target.suffix != end:
        return None
    if way == "folder" and target != desk:
        (place / "folder").symlink_to(target.parent)
        return str(place / "folder" / target.name)
    if way == "letters" and target != desk:
        other = target.with_name(target.name.swapcase())
        return str(other) if other.exists() else None
    paths = {"typed": str(read), "relative": f"subs{os.sep}..{os.sep}{read}"}
    return (paths | {"absolute": str(target)}).get(way)


def _linked_into(target: Path, way: str, place: Path, name: str) -> str | None:
    """Make an output folder that contains a link to an input, or whose subfolder is a link."""
    out, subfolder = place / "out", name.endswith("/")
    out.mkdir()
    if way == "folder" and subfolder:
        (out / name[:-1]).symlink_to(target.parent)
        return str(out)
    link = out / name / f"any{target.suffix}" if subfolder else out / name
    link.parent.mkdir(exist_ok=True)
    if way == "link":
        link.symlink_to(target)
    elif way == "hard link":
        link.hardlink_to(target)
    else:
        return None
    return str(out)


def all_cases() -> list[OverwriteCase]:
    """Return all combinations of command, input, output and way."""
    found = []
    for command, reads, options, names in RUNS:
        outputs = [(option, None) for option in options.split()]
        outputs += [("-o", name) for name in names or ()]
        for read, (option, name), way in itertools.product(
            reads.split(), outputs, (*PATHS, "beside")
        ):
            found.append(OverwriteCase(command, read, option, name, way))
    return found


def make_empty_folder(place: Path) -> Path:
    """Make an empty folder for links and outputs."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place
