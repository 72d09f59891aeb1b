"""Answer key of an assignment: flight, injected faults and right answers of each student."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from px4fuse.classroom.assignment.roster import MAX_STUDENTS, ClassList, Person, normalise_text
from px4fuse.classroom.assignment.truth import CorrectFormAnswers
from px4fuse.core.reading import read_text
from px4fuse.core.record import Sha256
from px4fuse.errors import SettingsError

# Maximum size (bytes) of an answer key: the key of 1000 students has 2 million bytes
MAX_KEY_BYTES = 20_000_000
ANSWER_KEY_NOTE = (
    "For the instructor only: this file lists the injected faults of every student's flight. Do "
    "not hand it out."
)
_Text = Annotated[str, Meta(max_length=1000)]
_Number = Annotated[float, Meta(gt=-1e12, lt=1e12)]
_ShortTexts = Annotated[
    tuple[Annotated[str, Meta(min_length=1, max_length=200)], ...], Meta(max_length=20)
]


class CorrectAnswers(
    msgspec.Struct, frozen=True, rename={"student_id": "id", "true_values": "truth"}
):
    """Simulated flight of one student, with its injected faults and the right answers.

    Attributes
    ----------
    file, sha256 : str
        File name and SHA-256 of the student's log.
    scenario : dict
        Fields of :class:`px4fuse.simulation.scenario.Scenario`.
    mistakes : tuple of str
        Injected faults, as values of ``px4fuse simulate --mistake``.
    true_values : dict
        Parameters of the simulation that the log does not contain, for example ``sigma_z_m``.
    difficulty : float or None
        Smallest size that px4fuse detects, divided by the size of the injected fault.
    """

    student_id: Annotated[str, Meta(max_length=1000, pattern=r"\S")]
    name: _Text
    file: _Text
    sha256: Sha256
    scenario: dict[str, str | int | float | bool | None] = {}
    mistakes: _ShortTexts = ()
    true_values: dict[str, _Number] = {}
    difficulty: _Number | None = None
    form: CorrectFormAnswers | None = None


class _AnswerKeySchema(msgspec.Struct, frozen=True):
    name: Literal["px4fuse-assignment"] = "px4fuse-assignment"
    version: Literal[3] = 3


class AnswerKey(msgspec.Struct, frozen=True):
    """Right answers for all students of a class (JSON file of the instructor).

    ``kind`` is the flight: "aisle", "loop" or "mixed". ``secret`` is the seed of the random
    numbers.
    """

    kind: _Text
    answers: Annotated[tuple[CorrectAnswers, ...], Meta(min_length=1, max_length=MAX_STUDENTS)] = (
        msgspec.field(name="students")
    )
    secret: _Text = ""
    schema: _AnswerKeySchema = _AnswerKeySchema()
    note: str = ANSWER_KEY_NOTE

    def __repr__(self) -> str:  # an error message must not show the secret
        return f"AnswerKey({self.kind!r}, {len(self.answers)} students)"

    def find_student_answers(self, student_id: str) -> CorrectAnswers | None:
        """Return the right answers for a student; None for an unknown student."""
        class_list = ClassList(Person(answer.student_id) for answer in self.answers)
        student_index = class_list.find_student_index(Person(student_id))
        return None if student_index is None else self.answers[student_index]

    def find_answers_by_log_sha256(self, sha256: str) -> CorrectAnswers | None:
        return next((answer for answer in self.answers if answer.sha256 == sha256), None)


def format_answer_key(key: AnswerKey) -> str:
    return msgspec.json.format(msgspec.json.encode(key), indent=1).decode() + "\n"


def read_answer_key(path: Path) -> AnswerKey:
    """Read the answer key of an assignment.

    Raises
    ------
    SettingsError
        The file cannot be read, or was not written by ``px4fuse simulate --assignment``.
    """
    text = read_text(path, SettingsError, MAX_KEY_BYTES, name=str(path))
    try:
        key = msgspec.json.decode(text, type=AnswerKey)
        if len({normalise_text(answer.student_id) for answer in key.answers}) < len(key.answers):
            raise ValueError("two students have the same id")
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise SettingsError(
            f"{path} is not an answer key, or is from another px4fuse version ({error}).",
            "Give the file that px4fuse simulate --assignment wrote.",
        ) from error
    return key
