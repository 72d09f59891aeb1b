"""A flight of one's own for every student of a class, with an answer key for the instructor.

What is drawn for a student follows from the instructor's secret and the student's id by HMAC
(RFC 2104), so that nobody without the secret can guess another's, and a second run gives the same
bytes.
"""

from __future__ import annotations

import csv
import hashlib
import hmac
import io
import re
import secrets
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from px4fuse.assignment.key import (
    MAX_STUDENTS,
    Answer,
    AnswerKey,
    folded,
    key_text,
    read_key,
)
from px4fuse.errors import OutputError, SettingsError
from px4fuse.plain import plain
from px4fuse.reading import read_whole
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Kind, Scenario
from px4fuse.writing import write_all

MIN_SECRET = 8
MAX_ROSTER_BYTES = 5_000_000
MAX_NAME = 200
# A file system takes 255 bytes, and a character up to 4
MAX_STEM = 48
RESERVED = {"con", "prn", "aux", "nul"} | {f"{n}{i}" for n in ("com", "lpt") for i in range(10)}
# Column titles, letters only, best first: those of Moodle, Canvas, Blackboard, Brightspace, ILIAS
ID_COLUMNS = (
    "studentid", "studentnumber", "studentno", "idnumber", "matriculationnumber", "matriculation",
    "matrikelnummer", "orgdefinedid", "sisuserid", "sid", "id", "number", "userid", "username",
    "user", "login", "loginid", "sisloginid", "emailaddress", "email", "mail",
)  # fmt: skip
NAME_COLUMNS = ("name", "fullname", "studentname", "displayname", "student")
FIRST_NAME_COLUMNS = ("firstname", "givenname", "forename", "vorname")
LAST_NAME_COLUMNS = ("lastname", "surname", "familyname", "nachname")
# What is drawn, and from where to where, with the decimals that are kept. Beyond these the rates at
# which mistakes are found (findings/rates.csv) have not been checked.
NOISES: dict[Kind, dict[str, tuple[float, float, int]]] = {
    "aisle": {
        "sigma_uwb_m": (0.07, 0.12, 3),
        "sigma_a_m_s2": (0.15, 0.30, 3),
        "speed_m_s": (0.9, 1.3, 2),
        "heading_deg": (-180.0, 180.0, 1),
    },
    "loop": {
        "vio_drift": (0.008, 0.02, 4),
        "sigma_vio_m": (0.008, 0.015, 4),
        "sigma_a_m_s2": (0.15, 0.30, 3),
        "speed_m_s": (0.8, 1.2, 2),
        "heading_deg": (-180.0, 180.0, 1),
    },
}
PASSES: dict[Kind, int] = {"aisle": 6, "loop": 1}
# Shares of flights with so many mistakes, where the number is not given. The loop has one mistake
# to offer; with fewer flights without it, "false closure" would be a safe guess.
COUNTS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}
# Of the numbers that only the instructor knows
TRUTH = ("duration_s", "sigma_z_m", "sigma_a_m_s2", "reported_sigma_m", "clock_offset_to_add_s",
         "path_length_m", "closure_error_m")  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """A mistake that may be drawn, at sizes at which it is found.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    finding : str
        What names it.
    group : str
        Of two of the same group, one would hide the other.
    hides : tuple of str
        Other groups whose mistakes this one hides, or whose mistakes hide it.
    low, high : float
        Sizes, in ``unit``; findings/rates.csv has the finding in nine flights of ten or more at
        ``low`` or at something less plain.
    unit : str
        As it is typed.
    either_sign : bool
    at_s : (float, float) or None
        When it begins, where that can be said.
    """

    mistake: str
    finding: str
    group: str
    low: float
    high: float
    unit: str
    either_sign: bool = False
    at_s: tuple[float, float] | None = None
    hides: tuple[str, ...] = ()

    def goes_with(self, other: Choice) -> bool:
        """Whether both are found in one flight."""
        return not (
            self.group == other.group or self.group in other.hides or other.group in self.hides
        )


# Clock and heading are estimated from the IMU. A gap of the IMU is not among the choices: it passes
# for a change of the clock in every second flight. Outliers make EKF2 reject and its NIS grow too.
NEED_IMU = ("clock", "frame")
CHOICES: dict[Kind, tuple[Choice, ...]] = {
    "aisle": (
        Choice("clock-offset", "source_clock_offset", "clock", 220, 350, "ms", True),
        Choice(
            "clock-jump", "source_clock_changes", "clock", 400, 450, "ms", hides=("frame", "gap")
        ),
        Choice("yaw", "source_frame_turned", "frame", 20, 35, "deg", True),
        Choice("nlos", "source_outliers", "outliers", 2, 6, "%"),
        Choice("dropout", "source_gap", "gap", 3, 8, "s", at_s=(30, 70)),
        Choice("imu-rate", "logging_rate_low", "rate", 15, 25, "Hz", hides=NEED_IMU),
        Choice("ekf2-noise", "ekf2_variance_understated", "ekf2", 2, 3, "cm", hides=("outliers",)),
        Choice("ekf2-gate", "ekf2_rejecting", "ekf2", 1.5, 2, "", hides=("outliers",)),
        Choice("ekf2-delay", "ekf2_ev_delay_wrong", "clock", 175, 200, "ms"),
    ),
    "loop": (Choice("open-end", "false_loop_closure", "end", 5, 8, "m"),),
}
POSSIBLE_FINDINGS = frozenset(choice.finding for kind in CHOICES.values() for choice in kind)


@dataclass(frozen=True)
class Student:
    """One row of the roster.

    Attributes
    ----------
    id, name : str
        As they stand there.
    file : str
        Name of the student's log: the id, as far as a file system takes it.
    """

    id: str
    name: str
    file: str


# ------------------------------------------------------------------ drawing


def uniform(secret: bytes, student_id: str, kind: Kind, label: str) -> float:
    """A number in [0, 1) that only those who know the secret can tell."""
    message = "\0".join(("px4fuse assignment 1", kind, folded(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


def draw(
    secret: bytes, student_id: str, kind: Kind, count: int | None = None, truth: bool = True
) -> tuple[Scenario, tuple[Choice, ...], tuple[str, ...]]:
    """Draw one student's flight.

    Parameters
    ----------
    secret : bytes
    student_id : str
    kind : {"aisle", "loop"}
    count : int, optional
        Of mistakes; None draws it.
    truth : bool
        Whether an aisle's log holds the truth. A loop's does not: it would tell where it landed.

    Returns
    -------
    scenario : Scenario
    chosen : tuple of Choice
    mistakes : tuple of str
        As typed, in the same order.
    """

    def number(label: str, low: float, high: float, decimals: int) -> float:
        return round(low + (high - low) * uniform(secret, student_id, kind, label), decimals)

    drawn: dict[str, Any] = {name: number(name, *span) for name, span in NOISES[kind].items()}
    scenario = Scenario(
        kind=kind,
        passes=PASSES[kind],
        truth=truth and kind == "aisle",
        seed=int(uniform(secret, student_id, kind, "seed") * 2**32),
        **drawn,
    )
    if count is None:
        count = _count(uniform(secret, student_id, kind, "count"), COUNTS[kind])
    left = sorted(
        CHOICES[kind], key=lambda c: uniform(secret, student_id, kind, f"order {c.mistake}")
    )
    chosen: list[Choice] = []
    for choice in left:
        if len(chosen) < count and all(map(choice.goes_with, chosen)):
            chosen.append(choice)
    typed = []
    for choice in chosen:
        size = number(f"size {choice.mistake}", choice.low, choice.high, 1)
        if choice.either_sign and uniform(secret, student_id, kind, f"sign {choice.mistake}") < 0.5:
            size = -size
        text = f"{choice.mistake}={size:g}{choice.unit}"
        if choice.at_s is not None:
            text += f",{number(f'at {choice.mistake}', *choice.at_s, 0):g}s"
        typed.append(text)
    return scenario, tuple(chosen), tuple(typed)


def _count(drawn: float, shares: Sequence[float]) -> int:
    total = 0.0
    for count, share in enumerate(shares):
        total += share
        if drawn < total:
            return count
    return len(shares) - 1


def fly(
    secret: bytes, student: Student, kind: Kind, count: int | None = None, truth: bool = True
) -> tuple[bytes, Answer]:
    """One student's log, and the answer to it."""
    scenario, chosen, typed = draw(secret, student.id, kind, count, truth)
    simulation = flights.simulate(scenario, parse(typed))
    log = flights.to_ulog(simulation)
    known = flights.answer(simulation)["truth"]
    answer = Answer(
        student_id=student.id,
        name=student.name,
        file=student.file,
        sha256=hashlib.sha256(log).hexdigest(),
        scenario=plain(asdict(scenario)),
        mistakes=typed,
        findings=tuple(choice.finding for choice in chosen),
        truth={name: float(known[name]) for name in TRUTH},
    )
    return log, answer


@dataclass(frozen=True)
class Assigned:
    """What :func:`assign` did: the key, and how many logs it wrote or found as they should be."""

    key: AnswerKey
    written: int
    kept: int


def key_path(folder: Path, given: Path | None) -> Path:
    """Where the answer key goes: beside the students' folder, never into it.

    Raises
    ------
    OutputError
        It would be among the students' files.
    """
    whole = folder.resolve()
    if given is None:
        if not whole.name:
            raise OutputError(f"{folder}: give a folder of its own with -o.")
        # what was typed may be "." or "..", which have no name
        beside = folder.parent if folder.name not in ("", "..") else whole.parent
        return beside / f"{whole.name}_answers.json"
    if whole == given.resolve() or whole in given.resolve().parents:
        raise OutputError(
            f"{given}: is in the students' folder, where they would find it. Give another place "
            "with --answer."
        )
    return given


def assign(
    students: Sequence[Student],
    folder: Path,
    key_file: Path,
    secret: bytes | None,
    kind: Kind,
    count: int | None = None,
    truth: bool = True,
    step: Callable[[int, int], None] = lambda done, of: None,
) -> Assigned:
    """Write everyone's log into a folder, and the answer key.

    All logs are made before the first is put in its place, so that a run that fails leaves the
    folder as it was. What is there already is never replaced: a log must be the same to the byte,
    and a key may only gain students.

    Parameters
    ----------
    students : sequence of Student
    folder, key_file : Path
    secret : bytes or None
        None takes that of the key that is there already, or makes one up.
    kind : {"aisle", "loop"}
    count : int, optional
        Mistakes per flight; None draws it.
    truth : bool
        Whether logs of an aisle hold the truth.
    step : callable
        Told after every flight how many are made, and of how many.

    Raises
    ------
    SettingsError
        So many mistakes cannot be in one flight.
    OutputError
        A file is there already with other content, or cannot be written.
    """
    if count is not None and not 0 <= count <= most_mistakes(kind):
        raise SettingsError(
            f"--mistakes {count}: a flight of kind {kind} can have 0 to {most_mistakes(kind)}, of "
            "which each is still found beside the others."
        )
    before = read_key(key_file) if key_file.exists() else None
    made_up = before.secret if before is not None else ""
    if secret is None:
        made_up = made_up or secrets.token_urlsafe(24)
        secret = made_up.encode()
    elif made_up.encode() != secret:
        made_up = ""
    known = folder.exists()
    staged: dict[Path, Path] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".px4fuse-", dir=folder) as staging:
            answers = []
            for done, student in enumerate(students, start=1):
                log, answer = fly(secret, student, kind, count, truth)
                answers.append(answer)
                target = folder / student.file
                if not _there(target, log):
                    staged[target] = Path(staging) / student.file
                    staged[target].write_bytes(log)
                step(done, len(students))
            key = AnswerKey(kind, tuple(answers), made_up)
            _check_extends(key_file, before, key)
            _place(staged, key_file, key_text(key).encode())
    except OSError as error:
        raise OutputError(
            f"{error.filename or folder}: cannot be written ({error.strerror}). Choose another "
            "place with -o."
        ) from error
    finally:
        if not known and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    return Assigned(key, len(staged), len(students) - len(staged))


def _there(target: Path, log: bytes) -> bool:
    """Whether a log is there already; another one in its place is not replaced."""
    if not target.exists() and not target.is_symlink():
        return False
    if target.is_file() and target.stat().st_size == len(log) and target.read_bytes() == log:
        return True
    raise OutputError(
        f"{target}: is there already and is another flight; it was not overwritten. Give the same "
        "secret and options as before, or another folder with -o."
    )


def _check_extends(key_file: Path, before: AnswerKey | None, key: AnswerKey) -> None:
    """A key that is there already must be part of the new one."""
    if before is None:
        return
    new = {folded(answer.student_id): answer.sha256 for answer in key.answers}
    lost = [a.student_id for a in before.answers if new.get(folded(a.student_id)) != a.sha256]
    if before.kind != key.kind or lost:
        raise OutputError(
            f"{key_file}: is the answer key of other flights; it was not overwritten. Give the "
            "same secret, options and students as before (more are welcome), or another place with "
            "--answer."
        )


def _place(staged: Mapping[Path, Path], key_file: Path, key: bytes) -> None:
    """Move logs to their places and write the key; no log stays where one of these fails."""
    placed: list[Path] = []
    try:
        for target, path in staged.items():
            path.replace(target)
            placed.append(target)
        write_all({key_file: key})
    except BaseException:
        for target in placed:
            target.unlink(missing_ok=True)
        raise
    # of no use to anyone but the instructor
    key_file.chmod(0o600)


def most_mistakes(kind: Kind) -> int:
    """How many mistakes a flight can have."""
    return len(COUNTS[kind]) - 1


def secret_of(text: str, where: str) -> bytes:
    """A secret as bytes, from an option or a file.

    Raises
    ------
    SettingsError
        It is too short to be one.
    """
    stripped = text.strip()
    if len(stripped) < MIN_SECRET:
        raise SettingsError(
            f"{where}: a secret of {len(stripped)} characters can be guessed. Give "
            f"{MIN_SECRET} or more, or leave it out: one is made up and kept in the answer key."
        )
    return stripped.encode(errors="replace")


# ------------------------------------------------------------------ roster


def read_roster(path: Path) -> tuple[Student, ...]:
    """Read the class list that a learning platform exports: a CSV file with a header.

    Raises
    ------
    SettingsError
        It cannot be read, has no column of ids, or an id is missing or stands there twice.
    """
    lines = _rows(path)
    ids, names, first, last = _columns(path, lines)
    students: list[Student] = []
    row_of: dict[str, int] = {}
    for number, cells in lines[1:]:

        def cell(column: int | None, cells: list[str] = cells) -> str:
            inside = column is not None and column < len(cells)
            return _clean(cells[column]) if inside and column is not None else ""

        student_id = cell(ids)
        if not student_id:
            raise SettingsError(
                f"{path}: row {number} has no id in the column {lines[0][1][ids].strip()!r}. "
                "Give every student one, or delete the row."
            )
        stem = file_stem(student_id)
        if stem is None:
            raise SettingsError(
                f"{path}: row {number}: the id {_short(student_id)} has neither letters nor "
                "digits, so that no file can be named after it."
            )
        other = row_of.setdefault(stem.casefold(), number)
        if other != number:
            raise SettingsError(
                f"{path}: rows {other} and {number} have the same id {_short(student_id)}, or ids "
                "that give the same file name. Give every student one of its own."
            )
        whole = cell(names) or " ".join(part for part in (cell(first), cell(last)) if part)
        students.append(Student(student_id, whole, f"{stem}.ulg"))
    if not students:
        raise SettingsError(f"{path}: no students below the header. Give one row for each.")
    if len(students) > MAX_STUDENTS:
        raise SettingsError(
            f"{path}: {len(students)} students are too many (at most {MAX_STUDENTS}). Split the "
            "roster."
        )
    return tuple(students)


def file_stem(student_id: str) -> str | None:
    """An id as the name of a file on any system; None where nothing of it is left.

    >>> file_stem("s01/2026"), file_stem("../../x"), file_stem("nul"), file_stem("=;")
    ('s01_2026', '_.._x', '_nul', None)
    """
    text = unicodedata.normalize("NFC", student_id.strip())
    kept = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in text)
    if not any(c.isalnum() for c in kept):
        return None
    stem = kept[:MAX_STEM].lstrip(".-+@").rstrip(".")
    return f"_{stem}" if stem.split(".")[0].casefold() in RESERVED else stem


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Rows that are not empty, with their numbers; the first is the header."""
    content = read_whole(
        path,
        SettingsError,
        MAX_ROSTER_BYTES,
        name=str(path),
        smaller="Give a CSV file with one row per student",
    )
    if content.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise SettingsError(f"{path}: a spreadsheet. Save it as CSV.")
    text = _decoded(content)
    if "\0" in text:
        raise SettingsError(f"{path}: not text. Give a CSV file with a header.")
    header = next((line for line in text.splitlines() if line.strip()), "")
    # quoted cells may hold any of them
    bare = Counter(re.sub(r'"[^"]*"', "", header))
    delimiter = max(",;\t|", key=lambda mark: bare[mark])
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
        rows = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise SettingsError(f"{path}: not a CSV file ({error}).") from error
    return [(number, cells) for number, cells in rows if any(map(str.strip, cells))]


def _decoded(content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # as spreadsheets on Windows save it
        return content.decode("cp1252", errors="replace")


def _columns(
    path: Path, lines: list[tuple[int, list[str]]]
) -> tuple[int, int | None, int | None, int | None]:
    """Where id, name, first name and last name stand."""
    titles = ["".join(filter(str.isalpha, t.casefold())) for t in (lines[0][1] if lines else [])]

    def found(names: Sequence[str]) -> list[int]:
        return [titles.index(name) for name in names if name in titles]

    candidates = found(ID_COLUMNS)
    if not candidates:
        raise SettingsError(
            f"{path}: no column of ids. The first row must name the columns; call one 'student id' "
            "and, if you like, one 'name'."
        )
    # platforms export columns that nobody filled in
    filled = [c for c in candidates if any(c < len(row) and row[c].strip() for _, row in lines[1:])]
    names = (found(NAME_COLUMNS), found(FIRST_NAME_COLUMNS), found(LAST_NAME_COLUMNS))
    whole, first, last = (columns[0] if columns else None for columns in names)
    return (filled or candidates)[0], whole, first, last


def _clean(text: str) -> str:
    """A cell without control characters; what looks like a formula stays the text that it is."""
    kept = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in text)
    return " ".join(kept.split())[:MAX_NAME]


def _short(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:39] + "…")
