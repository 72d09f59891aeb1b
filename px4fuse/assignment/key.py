"""The answer key of an assignment: which flight each student was given, and what is wrong in it."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from px4fuse.errors import SettingsError
from px4fuse.reading import read_text

SCHEMA_NAME = "px4fuse-assignment"
SCHEMA_VERSION = 2
# Version 1 had no difficulty, and its flights are drawn by earlier px4fuse only
READ_VERSIONS = (1, SCHEMA_VERSION)
# A thousand students take two million
MAX_KEY_BYTES = 20_000_000
MAX_STUDENTS = 1000
NOTE = (
    "For the instructor only: it says what is wrong in every student's flight. Do not hand it out "
    "and do not put it into the students' folder."
)


@dataclass(frozen=True)
class Answer:
    """One student's flight.

    Attributes
    ----------
    student_id, name : str
        As in the roster.
    file, sha256 : str
        Of the log that was handed out.
    scenario : dict
        What was flown: the fields of :class:`px4fuse.simulation.scenario.Scenario`.
    mistakes : tuple of str
        As ``px4fuse simulate --mistake`` takes them; empty for a flight without one.
    findings : tuple of str
        Ids of the findings that name them.
    truth : dict
        Numbers that the log does not say: ``sigma_z_m``, ``sigma_a_m_s2`` and
        ``clock_offset_to_add_s`` among them.
    difficulty : float or None
        See :class:`px4fuse.assignment.drawing.Drawn`; None in keys of version 1.
    """

    student_id: str
    name: str
    file: str
    sha256: str
    scenario: dict[str, Any] = field(default_factory=dict)
    mistakes: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()
    truth: dict[str, float] = field(default_factory=dict)
    difficulty: float | None = None


@dataclass(frozen=True)
class AnswerKey:
    """The answers of a class.

    Attributes
    ----------
    kind : str
        Of the flights.
    answers : tuple of Answer
    secret : str
        From which the flights were drawn, where it was made up; else "".
    version : int
        Of the schema it was read from.
    """

    kind: str
    answers: tuple[Answer, ...]
    secret: str = field(default="", repr=False)
    version: int = SCHEMA_VERSION

    def of_student(self, student_id: str) -> Answer | None:
        """The answer for an id, however it is capitalised.

        Leading zeros, which spreadsheets take away, may be missing where that is unambiguous.
        """
        wanted = folded(student_id)
        if not wanted:
            return None
        for answer in self.answers:
            if folded(answer.student_id) == wanted:
                return answer
        bare = wanted.lstrip("0")
        close = [a for a in self.answers if bare and folded(a.student_id).lstrip("0") == bare]
        return close[0] if len(close) == 1 else None

    def of_log(self, sha256: str) -> Answer | None:
        """The answer for a log."""
        return next((a for a in self.answers if sha256 and a.sha256 == sha256), None)


def folded(text: str) -> str:
    """Id or name for comparison: one spelling per character, case and outer spaces ignored."""
    return unicodedata.normalize("NFKC", text).strip().casefold()


def key_text(key: AnswerKey) -> str:
    """The key as JSON, for :func:`read_key`."""
    written: dict[str, Any] = {
        "schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION},
        "note": NOTE,
        "kind": key.kind,
        **({"secret": key.secret} if key.secret else {}),
        "students": [
            {
                "id": answer.student_id,
                "name": answer.name,
                "file": answer.file,
                "sha256": answer.sha256,
                "mistakes": list(answer.mistakes),
                "findings": list(answer.findings),
                "truth": answer.truth,
                "difficulty": answer.difficulty,
                "scenario": answer.scenario,
            }
            for answer in key.answers
        ],
    }
    return json.dumps(written, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_key(path: Path) -> AnswerKey:
    """Read and check an answer key.

    Raises
    ------
    SettingsError
        It cannot be read, or is not what ``px4fuse simulate --assignment`` wrote.
    """
    text = read_text(path, SettingsError, MAX_KEY_BYTES, name=str(path))
    try:
        given = json.loads(text, parse_constant=_no_constant)
    # a JSON that is nested too deep, or has an integer of a million digits
    except (ValueError, RecursionError):
        _refuse(path, "not JSON")
    schema = given.get("schema") if isinstance(given, dict) else None
    if not isinstance(schema, dict) or schema.get("name") != SCHEMA_NAME:
        _refuse(path, "not an answer key")
    version = schema.get("version")
    if version not in READ_VERSIONS or isinstance(version, bool):
        _refuse(path, "of a version that this px4fuse does not read")
    students = given.get("students")
    if not isinstance(students, list) or not 1 <= len(students) <= MAX_STUDENTS:
        _refuse(path, f"'students' is not a list of 1 to {MAX_STUDENTS}")
    key = AnswerKey(
        _text(path, given, "kind", "the key"),
        tuple(_answer(path, number, one) for number, one in enumerate(students, start=1)),
        _text(path, given, "secret", "the key") if "secret" in given else "",
        version,
    )
    seen: dict[str, int] = {}
    for number, answer in enumerate(key.answers, start=1):
        other = seen.setdefault(folded(answer.student_id), number)
        if other != number:
            _refuse(path, f"students {other} and {number} have the same id")
    return key


def _answer(path: Path, number: int, given: object) -> Answer:
    where = f"student {number}"
    if not isinstance(given, dict):
        _refuse(path, f"{where} is not an object")
    student_id = _text(path, given, "id", where)
    if not student_id.strip():
        _refuse(path, f"{where} has no id")
    sha256 = _text(path, given, "sha256", where)
    if len(sha256) != 64 or not set(sha256) <= set("0123456789abcdef"):
        _refuse(path, f"{where}: 'sha256' is not a valid SHA-256")
    scenario = given.get("scenario", {})
    simple = str | int | float | bool | None
    if not isinstance(scenario, dict) or not all(isinstance(v, simple) for v in scenario.values()):
        _refuse(path, f"{where}: 'scenario' is not an object of numbers and words")
    return Answer(
        student_id,
        _text(path, given, "name", where),
        _text(path, given, "file", where),
        sha256,
        scenario,
        _texts(path, given, "mistakes", where),
        _texts(path, given, "findings", where),
        _numbers(path, given, "truth", where),
        _number(path, given, "difficulty", where),
    )


def _text(path: Path, given: Mapping[str, Any], name: str, where: str) -> str:
    value = given.get(name)
    if not isinstance(value, str) or len(value) > 1000:
        _refuse(path, f"{where}: '{name}' is no text")
    return value


def _texts(path: Path, given: Mapping[str, Any], name: str, where: str) -> tuple[str, ...]:
    value = given.get(name)
    if not isinstance(value, list) or len(value) > 20:
        _refuse(path, f"{where}: '{name}' is not a list of texts")
    if not all(isinstance(one, str) and 0 < len(one) <= 200 for one in value):
        _refuse(path, f"{where}: '{name}' is not a list of texts")
    return tuple(value)


def _number(path: Path, given: Mapping[str, Any], name: str, where: str) -> float | None:
    value = given.get(name)
    if value is not None and not _is_number(value):
        _refuse(path, f"{where}: '{name}' is not a number")
    return None if value is None else float(value)


def _numbers(path: Path, given: Mapping[str, Any], name: str, where: str) -> dict[str, float]:
    value = given.get(name, {})
    if not isinstance(value, dict) or not all(map(_is_number, value.values())):
        _refuse(path, f"{where}: '{name}' is not an object of numbers")
    return {str(key): float(one) for key, one in value.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12


def _no_constant(text: str) -> NoReturn:
    raise ValueError(text)


def _refuse(path: Path, why: str) -> NoReturn:
    raise SettingsError(
        f"{path}: {why}. Give the answer key as px4fuse simulate --assignment wrote it."
    )
