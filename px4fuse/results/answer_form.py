"""Form (TOML) in which a student answers questions about a flight and names its faults.

This module writes empty forms, and reads completed forms. It does not check if answers are right.
"""

import hashlib
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from px4fuse.core.reading import read_text
from px4fuse.core.record import Record, Sha256, read_csv, read_toml
from px4fuse.core.text import shorten_to_line
from px4fuse.errors import SettingsError

# Maximum size (bytes) of an answer form
MAX_FORM_BYTES = 20_000
# Maximum length (characters) of a line: tomllib needs gigabytes for very long keys with dots
MAX_LINE_LENGTH = 500
MAX_MISTAKES = 20
NO_FAULT_KIND = "none"
# Text of a table cell for an answer left blank
EMPTY_CELL = "\u2013"


class AllowedAnswers(Record):
    """Allowed answers to the questions of the answer form (``form.toml``)."""

    behaviours: str
    report_panels: str
    units: dict[str, dict[str, float]]


_ALLOWED_ANSWERS = read_toml(__file__, AllowedAnswers, "form.toml")
EKF2_BEHAVIOURS = _ALLOWED_ANSWERS.behaviours.splitlines()
REPORT_PANELS = _ALLOWED_ANSWERS.report_panels.splitlines()


def _find_units(quantity: str) -> Mapping[str, float]:
    """Return the allowed units of a quantity, with the factors that convert to the first unit."""
    return _ALLOWED_ANSWERS.units.get(quantity, {quantity: 1.0}) if quantity else {}


class FaultKind(Record):
    """Kind of fault that a student can name (row of ``fault_kinds.csv``).

    Attributes
    ----------
    quantity : str
        Unit of the fault's size, such as "s", or a quantity with several allowed units; "" for a
        fault without size.
    min_size, max_size : float
        Smallest and largest allowed size, in the first allowed unit.
    description : str
        Meaning of the size, such as "duration of a gap in the IMU data".
    """

    kind: str
    quantity: str
    min_size: float
    max_size: float
    description: str

    @property
    def units(self) -> Mapping[str, float]:
        return _find_units(self.quantity)

    @property
    def standard_unit(self) -> str:
        """First unit that the form allows for the size; "" for a kind of fault without size."""
        return next(iter(self.units), "")


FAULT_KINDS = {fault.kind: fault for fault in read_csv(__file__, FaultKind, "fault_kinds.csv")}
# Allowed units for the value of each correction
UNITS_BY_CORRECTION = {
    row["correction"]: _find_units(row["quantity"])
    for row in read_csv(__file__, dict[str, str], "corrections.csv")
}
# Answer if the consistency of a filter cannot be evaluated
NOT_AVAILABLE = "not available"

Number = Annotated[float, Meta(gt=-1e9, lt=1e9)]
Unit = Annotated[str, Meta(max_length=10)]
VerdictWord = Literal["", "consistent", "overconfident", "underconfident", "not available"]
# Allowed verdicts on a filter, without the blank answer
VERDICTS = get_args(VerdictWord)[1:]
ChoiceLetter = Literal["", "a", "b", "c", "d", "e"]
NUMBER_HELP = (
    "a number with a decimal point such as 0.2, without quotes or unit, or a list such as [61, 64]"
)
# Description of the accepted answers, by field of the form; other fields contain numbers
ACCEPTED_ANSWER_BY_FIELD = {
    **dict.fromkeys(("verdict_kf", "verdict_ekf2"), f"one of {', '.join(VERDICTS)}"),
    **dict.fromkeys(("kind", "unit", "parameter", "value_unit", "panel"), "a text in quotes"),
    "when": '"whole flight", or "" if you give the times in from_s and until_s',
    "ekf2_did": "a list of texts, each in quotes",
    "choices": "a letter from a to e in quotes",
    "log_sha256": "the SHA-256 of the log, as in the form from `px4fuse answers LOG`",
}
# Answer to a question about KF: a number, a list of update numbers, or None if left blank
NumericAnswer = Number | Annotated[tuple[Number, ...], Meta(max_length=200)] | None
# Letters of the answers to a multiple-choice question
CHOICE_LETTERS: tuple[ChoiceLetter, ...] = get_args(ChoiceLetter)[1:]
MAX_CHOICES = 20
FIGURE_QUESTIONS_COMMENT = """
# Figures: the picture of the same name (.png) shows other flights with other faults, analysed with
# SIGMA_A 0.5 and SIGMA_Z 0.1. The background is grey while the vehicle flies in one direction
# of the straight path, and white otherwise. Give the letter of the right answer. A wrong letter
# subtracts a quarter of the points that a right letter gives.
[choices]
"""


class Choice(Record):
    """Multiple-choice question about a figure."""

    question: str
    options: tuple[str, ...]

    def answer_text(self, letter: str) -> str:
        return self.options[CHOICE_LETTERS.index(letter)] if letter else ""

    @property
    def text(self) -> str:
        options = map(": ".join, zip(CHOICE_LETTERS, self.options, strict=True))
        return "\n#     ".join([self.question, *options])


class NamedFault(Record):
    """Fault that a student names in the answer form.

    Attributes
    ----------
    when : str
        "whole flight", or "" if the times are given.
    from_s, until_s : float or None
        Start and end of the fault (s since the first sample).
    parameter, value : str and float
        Parameter that corrects the fault, and its new value.
    panel : str
        Part of the report that shows the fault, for example "innovations".
    """

    kind: str
    size: Number | None = None
    unit: Unit = ""
    when: Literal["", "whole flight"] = ""
    from_s: Number | None = None
    until_s: Number | None = None
    parameter: str = ""
    value: Number | None = None
    value_unit: Unit = ""
    panel: str = ""

    def convert_size_to_standard_unit(self) -> float | None:
        """Convert the size to the standard unit of the fault, for example cm to m.

        Return None if the size is blank, or if the kind of fault has no size. A blank unit is the
        standard unit.
        """
        units = FAULT_KINDS[self.kind].units
        if self.size is None or not units:
            return None
        if self.unit == "factor" and self.kind == "scale":
            return (self.size - 1.0) * 100.0
        return self.size * units.get(self.unit, 1.0)

    def convert_value_to_standard_unit(self) -> float | None:
        """Convert the value to the standard unit, which is the first in ``form.toml`` (cm to m)."""
        if self.value is None:
            return None
        return self.value * UNITS_BY_CORRECTION.get(self.parameter, {}).get(self.value_unit, 1.0)


class Answers(Record, kw_only=True):
    """Student's answers about a flight.

    Attributes
    ----------
    mistakes : tuple of NamedFault
        Faults that the student names.
    verdict_kf, verdict_ekf2 : str
        Consistency of KF and EKF2.
    ekf2_did : tuple of str
        Behaviours of EKF2, from :data:`EKF2_BEHAVIOURS`.
    quantities : tuple of (float, tuple of float, or None)
        Answers to the numeric questions of :func:`select_questions`.
    choices : tuple of str
        Answers (letters) to the multiple-choice questions; "" if left blank.
    """

    log_sha256: Sha256
    mistakes: Annotated[tuple[NamedFault, ...], Meta(max_length=MAX_MISTAKES)] = ()
    verdict_kf: VerdictWord = ""
    verdict_ekf2: VerdictWord = ""
    ekf2_did: Annotated[tuple[str, ...], Meta(max_length=len(EKF2_BEHAVIOURS))] = ()
    quantities: Annotated[tuple[NumericAnswer, ...], Meta(max_length=10)] = ()
    choices: Annotated[tuple[ChoiceLetter, ...], Meta(max_length=MAX_CHOICES)] = ()

    @property
    def declares_no_fault(self) -> bool:
        return [mistake.kind for mistake in self.mistakes] == [NO_FAULT_KIND]


QuestionKind = Literal["gain", "variance", "innovation", "nis", "prediction", "gate"]
# Kinds of the three questions about KF; each kind is selected at random from one pair
_QUESTION_KIND_PAIRS: tuple[tuple[QuestionKind, QuestionKind], ...] = (
    ("gain", "variance"),
    ("innovation", "nis"),
    ("prediction", "gate"),
)


class FormQuestion(Record):
    """Numeric question about KF along the axis of largest motion.

    Attributes
    ----------
    kind : str
        Quantity that the student must compute.
    update_number : int
        Number of the KF update, from 1. The first measurement only sets the state.
    question_parameter : float
        For the kind "prediction": duration (s). For the kind "gate": innovation gate (in √S).
    """

    kind: QuestionKind
    update_number: int
    sigma_a_m_s2: float
    sigma_z_m: float
    question_parameter: float = 0.0

    @property
    def text(self) -> str:
        """Question as the answer form prints it: quantity, update, and settings of KF."""
        update, number_text = self.update_number, f"{self.question_parameter:g}"
        quantity = {
            "gain": f"Kalman gain of the position in update {update}",
            "variance": f"position variance after update {update} (m²)",
            "innovation": f"innovation in update {update} (m)",
            "nis": f"NIS in update {update}",
            "prediction": f"position sigma of KF (m) {number_text} s after update {update}, "
            "without further updates",
            "gate": f"numbers of the updates, from {update} to "
            f"{update + LATER_UPDATE_COUNT_IN_GATE_QUESTION}, with an innovation outside "
            f"±{number_text} sqrt(S), if KF has no gate",
        }[self.kind]
        return f"{quantity}; with SIGMA_A {self.sigma_a_m_s2:g} and SIGMA_Z {self.sigma_z_m:g}"


# A question of the kind "gate" asks which updates are outside the innovation gate, among one update
# of KF and this number of later updates
LATER_UPDATE_COUNT_IN_GATE_QUESTION = 20


def select_questions(log_sha256: str) -> tuple[FormQuestion, ...]:
    """Select three questions about KF at random, with the SHA-256 of the log as seed.

    Each random choice uses the next byte of a hash. Keep the order of the choices: otherwise the
    questions of existing answer keys change.
    """
    random_bytes = iter(hashlib.sha256(f"px4fuse answers {log_sha256}".encode()).digest())

    def draw_number_between(low: float, high: float, decimals: int) -> float:
        return round(low + (high - low) * next(random_bytes) / 255.0, decimals)

    sigmas = (draw_number_between(0.2, 0.45, 2), draw_number_between(0.06, 0.14, 3))
    kinds = [pair[next(random_bytes) % 2] for pair in _QUESTION_KIND_PAIRS]
    # Every form has a question about either "prediction" or "gate". Only these kinds use the
    # parameter: duration (s) of the prediction, or innovation gate (in √S)
    parameter_range = (1.0, 4.0) if "prediction" in kinds else (0.8, 1.3)
    parameter = draw_number_between(*parameter_range, 1)
    # the first of the three questions is about one of the updates 2 to 8, in which the covariance
    # still changes
    update_numbers = (
        2 + next(random_bytes) % 7,
        20 + next(random_bytes) % 130,
        20 + next(random_bytes) % 100,
    )
    return tuple(
        FormQuestion(kind, update_number, *sigmas, parameter)
        for kind, update_number in zip(kinds, update_numbers, strict=True)
    )


def read_answers(path: Path) -> Answers:
    """Read a completed answer form, and check that the answers are allowed.

    Raises
    ------
    SettingsError
        The file is not an answer form, or an answer is not allowed.
    """
    form_toml = read_text(path, SettingsError, MAX_FORM_BYTES, name=str(path))
    if any(len(line) > MAX_LINE_LENGTH for line in form_toml.splitlines()):
        raise SettingsError(f"{path}: a line has more than {MAX_LINE_LENGTH} characters.")
    form_values: dict[str, Any] = {}
    try:
        form_values = _convert_form(tomllib.loads(form_toml))
        answers = msgspec.convert(form_values, Answers)
        check_answers(answers)
    except (RecursionError, ValueError) as error:  # raised by tomllib, msgspec or check_answers
        message = _describe_error(error, form_toml, form_values)
        raise SettingsError(f"{path}: {message}", "Correct the answer form.") from error
    return answers


def _describe_error(error: Exception, form_toml: str, form_values: dict[str, Any]) -> str:
    """Describe an invalid answer and the accepted answers, or a line that is not TOML."""
    message = str(error)
    # error of tomllib
    if line_match := re.search(r"\(at line (\d+), column \d+\)", message):
        line = line_match[1]
        content = shorten_to_line(form_toml.splitlines()[int(line) - 1], 60)
        return f"line {line} ({content}) is not valid; give {NUMBER_HELP}, or a word in quotes"
    # error of msgspec, such as "Expected `str`, got `int` - at `$.mistakes[0].kind`"
    reason, _, path = message.partition(" - at `$.")
    names = re.findall(r"\w+", path)
    if not names:  # error of check_answers: the message already names the answer
        return message
    invalid_value: Any = form_values
    for name in names:
        invalid_value = invalid_value[int(name) if name.isdigit() else name]
    # name of the answer in the form
    label = names[0]
    match names:
        case ["mistakes", index]:
            return f"mistake {int(index) + 1}: {reason}"
        case ["mistakes", index, field]:
            label = f"{field} of mistake {int(index) + 1}"
        case ["quantities", index, *_]:
            label = f"q{int(index) + 1}"
        case ["choices", index]:
            label = f"c{int(index) + 1}"
    accepted_values = ACCEPTED_ANSWER_BY_FIELD.get(names[0]) or ACCEPTED_ANSWER_BY_FIELD.get(
        names[-1], NUMBER_HELP
    )
    return f"{label} is {shorten_to_line(str(invalid_value), 60)!r}; give {accepted_values}"


def _convert_form(form: dict[str, Any]) -> dict[str, Any]:
    """Convert the tables of a form to the fields of :class:`Answers`."""
    filled_form = _remove_empty_values(form)
    # the form has tables [[mistake]], [quantities] (q1, q2, q3) and [choices] (c1, c2, ...)
    mistakes = filled_form.pop("mistake", ())
    quantities, choices = (
        msgspec.convert(filled_form.pop(name, {}), dict[str, Any])
        for name in ("quantities", "choices")
    )
    quantity_fields = [f"q{number}" for number in range(1, len(_QUESTION_KIND_PAIRS) + 1)]
    choice_fields = [f"c{number}" for number in range(1, MAX_CHOICES + 1)]
    # msgspec finds all other unknown fields
    unknown_fields = (quantities.keys() - quantity_fields) | (choices.keys() - choice_fields)
    if "mistakes" in filled_form:
        # The class Answers has a field "mistakes", but in the answer form this field is called
        # "mistake"
        unknown_fields.add("mistakes")
    if unknown_fields:
        raise ValueError(
            f"the answer form has no field {min(unknown_fields)}; known fields: "
            f"mistake, {', '.join(quantity_fields)}"
        )
    # Without answers about figures, "choices" is an empty tuple, not a tuple of blank choices
    return {
        **filled_form,
        "mistakes": mistakes,
        "quantities": tuple(map(quantities.get, quantity_fields)),
        "choices": tuple(choices.get(name, "") for name in choice_fields) if choices else (),
    }


def _remove_empty_values(value: Any) -> Any:
    """Return the values of a form (dict, list or other value) without blank texts."""
    if isinstance(value, dict):
        return {
            key: _remove_empty_values(element) for key, element in value.items() if element != ""
        }
    if isinstance(value, list):
        return [element for element in map(_remove_empty_values, value) if element not in ("", {})]
    return value


def check_answers(answers: Answers) -> None:
    """Raise ValueError for an answer that is not allowed, out of range, or repeated."""
    kinds = [named_fault.kind for named_fault in answers.mistakes]
    if NO_FAULT_KIND in kinds and len(kinds) > 1:
        raise ValueError('the form names "none" and a fault; name only one of them')
    for behaviour in answers.ekf2_did:
        _require_allowed_answer("ekf2_did", behaviour, EKF2_BEHAVIOURS)
    for named_fault in answers.mistakes:
        kind = named_fault.kind
        _require_allowed_answer("kind", kind, FAULT_KINDS)
        if kinds.count(kind) > 1:
            raise ValueError(f"the form names {kind!r} twice; name each kind of fault once")
        fault_kind = FAULT_KINDS[kind]
        # without a parameter, the value is not used, so any unit is allowed
        value_unit = named_fault.value_unit if named_fault.parameter else ""
        for field_name, answer, allowed_answers in (
            ("parameter", named_fault.parameter, UNITS_BY_CORRECTION),
            ("panel", named_fault.panel, REPORT_PANELS),
            ("unit", named_fault.unit, fault_kind.units),
            ("value_unit", value_unit, UNITS_BY_CORRECTION.get(named_fault.parameter, ())),
        ):
            if answer:
                _require_allowed_answer(f"{kind}: {field_name}", answer, allowed_answers)
        size = named_fault.convert_size_to_standard_unit()
        if size is not None and not fault_kind.min_size <= size <= fault_kind.max_size:
            raise ValueError(
                f"{kind}: size {size:g} is out of range ({fault_kind.min_size:g} to "
                f"{fault_kind.max_size:g} {fault_kind.standard_unit})"
            )


def _require_allowed_answer(field_name: str, answer: str, allowed_answers: Iterable[str]) -> None:
    """Raise ValueError if an answer is not one of the allowed answers."""
    if answer not in allowed_answers:
        choices_text = _join_quoted(allowed_answers)
        fault = (
            f"not one of {choices_text}"
            if choices_text
            else "not allowed here: leave the field empty"
        )
        raise ValueError(f"{field_name} {answer!r} is {fault}")


def form_name(log_name: str) -> str:
    """Return the file name of the answer form for a log.

    >>> form_name("s07.ulg")
    's07.answers.toml'
    """
    return f"{Path(log_name).stem}.answers.toml"


def format_answer_form(log_name: str, log_sha256: str, choices: Sequence[Choice] = ()) -> str:
    """Return an empty answer form (TOML) for a log, with all allowed answers in comments."""
    template = Path(__file__).with_name("answer_form.toml").read_text(encoding="utf-8")
    questions = [
        f'# {question.text}\nq{number} = ""{"    # such as [61, 64]" * (question.kind == "gate")}'
        for number, question in enumerate(select_questions(log_sha256), start=1)
    ]
    form = Template(template).substitute(
        log=log_name,
        form=form_name(log_name),
        sha256=log_sha256,
        verdicts=_join_quoted(VERDICTS),
        behaviours=_format_comment_lines(EKF2_BEHAVIOURS),
        kinds=_format_comment_lines(
            f"{name:13} {kind.description}{_format_units(kind.units)}"
            for name, kind in FAULT_KINDS.items()
        ),
        corrections=_format_comment_lines(
            name + _format_units(units) for name, units in UNITS_BY_CORRECTION.items()
        ),
        panels=_format_comment_lines(REPORT_PANELS),
        questions="\n".join(questions),
    )
    if choices:
        form += FIGURE_QUESTIONS_COMMENT
    for number, choice in enumerate(choices, start=1):
        form += f'# {choice.text}\nc{number} = ""\n'
    return form


def form_rows(answers: Answers) -> Iterator[tuple[str, str]]:
    """Yield each question with the student's answer as texts."""
    yield "Consistency of KF", answers.verdict_kf or EMPTY_CELL
    yield "Consistency of EKF2", answers.verdict_ekf2 or EMPTY_CELL
    yield "Behaviour of EKF2", ", ".join(answers.ekf2_did) or EMPTY_CELL
    for mistake in answers.mistakes:
        fault_kind = FAULT_KINDS.get(mistake.kind)
        size_units = fault_kind.units if fault_kind else ()
        correction_units = UNITS_BY_CORRECTION.get(mistake.parameter, ())
        value_text = _format_number_with_unit(mistake.value, mistake.value_unit, correction_units)
        times = (("from", mistake.from_s), ("until", mistake.until_s))
        time_texts = [f"{word} {time_s:g} s" for word, time_s in times if time_s is not None]
        details = (
            _format_number_with_unit(mistake.size, mistake.unit, size_units),
            mistake.when or " ".join(time_texts),
            f"shown in {mistake.panel}" if mistake.panel else "",
            f"{mistake.parameter} {value_text}".strip(),
        )
        yield mistake.kind, "; ".join(filter(None, details)) or EMPTY_CELL
    for question, answer in zip(
        select_questions(answers.log_sha256), answers.quantities, strict=False
    ):
        numbers = answer if isinstance(answer, tuple) else (answer,)
        numbers_text = ", ".join(f"{number:g}" for number in numbers if number is not None)
        yield question.text, numbers_text or EMPTY_CELL
    choice_texts = [
        f"c{number} {letter}" for number, letter in enumerate(answers.choices, 1) if letter
    ]
    if choice_texts:
        yield "Answers about the figures", ", ".join(choice_texts)


def _format_number_with_unit(number: float | None, unit: str, units: Iterable[str]) -> str:
    return "" if number is None else f"{number:g} {unit or next(iter(units), '')}".rstrip()


def _format_units(units: Iterable[str]) -> str:
    unit_text = ", ".join(filter(None, units))
    return f" [{unit_text}]" if unit_text else ""


def _format_comment_lines(lines: Iterable[str]) -> str:
    return "\n".join(f"#     {line}" for line in lines)


def _join_quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)
