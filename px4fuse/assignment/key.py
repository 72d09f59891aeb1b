"""The answer key of an assignment: which flight each student was given, and what is wrong in it."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from px4fuse.assignment.roster import MAX_STUDENTS, Person, Register, normalise_text
from px4fuse.assignment.truth import FormTruth
from px4fuse.errors import SettingsError
from px4fuse.reading import read_text

# A thousand students take two million
MAX_KEY_BYTES = 20_000_000
NOTE = (
    "For the instructor only: it says what is wrong in every student's flight. Do not hand it out "
    "and do not put it into the students' folder."
)
_Text = Annotated[str, Meta(max_length=1000)]
_Number = Annotated[float, Meta(gt=-1e12, lt=1e12)]
_Texts = Annotated[
    tuple[Annotated[str, Meta(min_length=1, max_length=200)], ...], Meta(max_length=20)
]


class Answer(msgspec.Struct, frozen=True, rename={"student_id": "id"}):
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
    truth : dict
        Numbers that the log does not say: ``sigma_z_m``, ``sigma_a_m_s2`` and
        ``clock_offset_to_add_s`` among them.
    difficulty : float or None
        See :class:`px4fuse.assignment.drawing.AssignedFlight`.
    form : FormTruth or None
        The right answers to the form.
    """

    student_id: Annotated[str, Meta(max_length=1000, pattern=r"\S")]
    name: _Text
    file: _Text
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    scenario: dict[str, str | int | float | bool | None] = {}
    mistakes: _Texts = ()
    truth: dict[str, _Number] = {}
    difficulty: _Number | None = None
    form: FormTruth | None = None


class _Schema(msgspec.Struct, frozen=True):
    name: Literal["px4fuse-assignment"] = "px4fuse-assignment"
    version: Literal[3] = 3


class AnswerKey(msgspec.Struct, frozen=True):
    """The answers of a class, as they are written.

    Attributes
    ----------
    kind : str
        Of the flights.
    secret : str
        From which the flights were drawn, where it was made up; else "".
    """

    kind: _Text
    answers: Annotated[tuple[Answer, ...], Meta(min_length=1, max_length=MAX_STUDENTS)] = (
        msgspec.field(name="students")
    )
    secret: _Text = ""
    schema: _Schema = _Schema()
    note: str = NOTE

    def __repr__(self) -> str:  # without the secret
        return f"AnswerKey({self.kind!r}, {len(self.answers)} students)"

    def of_student(self, student_id: str) -> Answer | None:
        """The answer for an id, as a :class:`Register` knows it."""
        student_index = Register(Person(a.student_id) for a in self.answers).student_index(
            Person(student_id)
        )
        return None if student_index is None else self.answers[student_index]

    def of_log(self, sha256: str) -> Answer | None:
        """The answer for a log."""
        return next((a for a in self.answers if sha256 and a.sha256 == sha256), None)


def key_text(key: AnswerKey) -> str:
    """The key as JSON, for :func:`read_key`."""
    return msgspec.json.format(msgspec.json.encode(key), indent=1).decode() + "\n"


def read_key(path: Path) -> AnswerKey:
    """Read and check an answer key.

    Raises
    ------
    SettingsError
        It cannot be read, or is not what ``px4fuse simulate --assignment`` wrote.
    """
    text = read_text(path, SettingsError, MAX_KEY_BYTES, name=str(path))
    try:
        key = msgspec.json.decode(text, type=AnswerKey)
        if len({normalise_text(answer.student_id) for answer in key.answers}) < len(key.answers):
            raise ValueError("two students have the same id")
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise SettingsError.of("no_key", path=path, error=error) from error
    return key
