"""Answer form of a flight, ``answers.toml``: its questions, and reading a completed form.

``form.toml`` lists the choices: mistakes with the units of their sizes, behaviour of EKF2, panels
of the report, corrections. Reading checks the grammar of a form, not whether answers are right.
"""

import hashlib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from px4fuse.errors import SettingsError
from px4fuse.reading import read_text
from px4fuse.record import Record, Sha256, table

# maximum bytes of a form and characters of a line: tomllib takes seconds and gigabytes for one
# dotted key of 64 kB
MAX_BYTES, MAX_LINE_LENGTH = 20_000, 500
MAX_MISTAKES = 20
NONE = "none"
EMPTY_CELL = "\u2013"


class MistakeKind(Record, frozen=True, rename={"size_quantity": "in"}):
    """Kind of mistake: description, quantity of the size, and range of the size (first unit)."""

    description: str
    size_quantity: str = ""
    range: tuple[float, float] = (-1e6, 1e6)

    @property
    def units(self) -> Mapping[str, float]:
        """Conversion factors of the units to the first unit; empty if the mistake has no size."""
        return _UNITS[self.size_quantity]


class Form(Record, frozen=True):
    """Tables of ``form.toml``."""

    behaviours: tuple[str, ...]
    panels: tuple[str, ...]
    units: dict[str, dict[str, float]]
    mistakes: dict[str, MistakeKind]
    corrections: dict[str, str]
    renamed: dict[str, str]


_FORM = table(__file__, "form.toml", Form)
_UNITS: Mapping[str, Mapping[str, float]] = {"": {}, **_FORM.units}
MISTAKES, EKF2_BEHAVIOURS, PANELS = _FORM.mistakes, _FORM.behaviours, _FORM.panels
# corrections of mistakes, with the units of their value (empty: no value)
CORRECTIONS = {name: _UNITS[units] for name, units in _FORM.corrections.items()}
VERDICTS = ("consistent", "overconfident", "underconfident")

Number = Annotated[float, Meta(gt=-1e9, lt=1e9)]
Unit = Annotated[str, Meta(max_length=10)]
VerdictWord = Literal["", "consistent", "overconfident", "underconfident"]
# a number, or a list of update numbers; None: not answered
QuantityAnswer = Number | Annotated[tuple[Number, ...], Meta(max_length=200)] | None


class StudentMistake(Record, frozen=True):
    """Mistake that a student names in the form.

    Attributes
    ----------
    kind : str
        One of :data:`MISTAKES`.
    size : float or None
        Size with sign, in ``unit``, which is a unit of the kind.
    when : str
        "whole flight", or empty if ``from_s`` and ``until_s`` (s since the first data) are given.
    parameter : str
        Correction, one of :data:`CORRECTIONS`, with its ``value`` in ``value_unit``.
    panel : str
        Part of the report that shows the mistake, one of :data:`PANELS`.
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

    def size_in_first_unit(self) -> float | None:
        """Return the size in the first unit of the kind; a scale factor of 1.05 becomes 5 %."""
        units = MISTAKES[self.kind].units
        if self.size is None or not units:
            return None
        if self.unit == "factor" and self.kind == "scale":
            return (self.size - 1.0) * 100.0
        return self.size * (units[self.unit] if self.unit else next(iter(units.values())))

    def value_in_first_unit(self) -> float | None:
        """Return the value of the correction in the first unit of its parameter."""
        units = CORRECTIONS.get(self.parameter, {})
        if self.value is None or not units:
            return self.value
        return self.value * units.get(self.value_unit, 1.0)


class Answers(Record, frozen=True, kw_only=True):
    """Completed answer form; blank answers are absent.

    Attributes
    ----------
    log_sha256 : str
        SHA-256 of the log that the form is about.
    verdict_kf, verdict_ekf2 : str
        Verdict on the reported σ of KF and EKF2, one of :data:`VERDICTS`.
    quantities : tuple of (float, tuple of float, or None)
        In the order of :func:`draw_questions`; a tuple answers a question about several updates.
    """

    log_sha256: Sha256
    mistakes: Annotated[tuple[StudentMistake, ...], Meta(max_length=MAX_MISTAKES)] = ()
    verdict_kf: VerdictWord = ""
    verdict_ekf2: VerdictWord = ""
    ekf2_did: Annotated[tuple[str, ...], Meta(max_length=len(EKF2_BEHAVIOURS))] = ()
    quantities: Annotated[tuple[QuantityAnswer, ...], Meta(max_length=10)] = ()

    @property
    def names_no_mistake(self) -> bool:
        """Return True if the form states that the flight has no mistake."""
        return [claim.kind for claim in self.mistakes] == [NONE]


QuestionKind = Literal["gain", "variance", "innovation", "nis", "silence", "gate"]
# Kinds of questions; one kind of each pair is drawn
_QUESTION_PAIRS: tuple[tuple[QuestionKind, QuestionKind], ...] = (
    ("gain", "variance"),
    ("innovation", "nis"),
    ("silence", "gate"),
)


class FormQuestion(Record, frozen=True):
    """Question about a number that no report prints, with filter settings drawn for the log.

    Attributes
    ----------
    kind : str
        Requested quantity along the main horizontal axis of the flight ("aisle").
    update : int
        Number of the update, from 1; the first measurement sets the state and is not counted.
    sigma_a_m_s2, sigma_z_m : float
        Settings of KF.
    extra : float
        Prediction time without measurement (s), or the gate (in √S).
    """

    kind: QuestionKind
    update: int
    sigma_a_m_s2: float
    sigma_z_m: float
    extra: float = 0.0

    @property
    def text(self) -> str:
        """Question as printed in the form."""
        update, extra = self.update, f"{self.extra:g}"
        quantity = {
            "gain": f"position gain of update {update}",
            "variance": f"position variance after update {update} (m²)",
            "innovation": f"innovation of update {update} (m)",
            "nis": f"NIS of update {update}",
            "silence": f"position sigma {extra} s after update {update}, without measurement (m)",
            "gate": f"list of the updates {update} to {update + GATE_UPDATES} with an innovation "
            f"outside {extra} sqrt(S); KF uses these updates, too",
        }[self.kind]
        return f"{quantity}; with SIGMA_A {self.sigma_a_m_s2:g} and SIGMA_Z {self.sigma_z_m:g}"


# number of updates in a question about the gate
GATE_UPDATES = 20


def draw_questions(log_sha256: str) -> tuple[FormQuestion, ...]:
    """Draw three questions from the SHA-256 of the log, so that they differ between logs."""
    random_bytes = iter(hashlib.sha256(f"px4fuse answers {log_sha256}".encode()).digest())

    def draw_between(low: float, high: float, decimals: int) -> float:
        return round(low + (high - low) * next(random_bytes) / 255.0, decimals)

    settings = (draw_between(0.2, 0.45, 2), draw_between(0.06, 0.14, 3))
    first_kind, second_kind, third_kind = (pair[next(random_bytes) % 2] for pair in _QUESTION_PAIRS)
    extra = draw_between(1.0, 4.0, 1) if third_kind == "silence" else draw_between(1.3, 2.0, 1)
    return (
        FormQuestion(first_kind, 2 + next(random_bytes) % 7, *settings),
        FormQuestion(second_kind, 20 + next(random_bytes) % 130, *settings),
        FormQuestion(third_kind, 20 + next(random_bytes) % 100, *settings, extra),
    )


def read_answers(path: Path) -> Answers:
    """Read an answer form and check its grammar.

    Raises
    ------
    SettingsError
        The file is not an answer form, or a field has a value that is not allowed.
    """
    text = read_text(path, SettingsError, MAX_BYTES, name=str(path))
    if any(len(line) > MAX_LINE_LENGTH for line in text.splitlines()):
        raise SettingsError(f"{path}: a line has more than {MAX_LINE_LENGTH} characters.")
    try:
        answers = msgspec.convert(_as_record(tomllib.loads(text)), Answers)
        check(answers)
    except (tomllib.TOMLDecodeError, RecursionError, msgspec.ValidationError, ValueError) as error:
        raise SettingsError(f"{path}: {error}", "Correct the form.") from error
    return answers


def _as_record(form: dict[str, Any]) -> dict[str, Any]:
    """Rearrange the TOML file as :class:`Answers`, without blank answers."""
    filled_form = _without_blanks(update_renamed_values(form))
    mistakes = filled_form.pop("mistake", ())
    quantities = msgspec.convert(filled_form.pop("quantities", {}), dict[str, Any])
    names = [f"q{number}" for number in range(1, len(draw_questions("")) + 1)]
    if unknown := sorted({*quantities, *({"mistakes"} & filled_form.keys())} - set(names)):
        raise ValueError(f"{unknown[0]} is not one of mistake, {', '.join(names)}")
    return {
        **filled_form,
        "mistakes": mistakes,
        "quantities": tuple(quantities.get(name) for name in names),
    }


def update_renamed_values(value: Any) -> Any:
    """Replace old names and values in forms and answer keys from before schema version 4."""
    if isinstance(value, dict):
        return {
            _FORM.renamed.get(key, key): update_renamed_values(part) for key, part in value.items()
        }
    if isinstance(value, list):
        return [update_renamed_values(part) for part in value]
    return _FORM.renamed.get(value, value) if isinstance(value, str) else value


def _without_blanks(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_blanks(part) for key, part in value.items() if part != ""}
    if isinstance(value, list):
        return [part for part in map(_without_blanks, value) if part not in ("", {})]
    return value


def check(answers: Answers) -> None:
    """Check choices, ranges and duplicates of a form.

    Raises
    ------
    ValueError
        A value that is not a choice, a number out of range, or a mistake named twice.
    """
    named_kinds = [named.kind for named in answers.mistakes]
    for name in named_kinds:
        _require_choice("kind", name, MISTAKES)
        if named_kinds.count(name) > 1:
            raise ValueError(f"kind {name!r} is given twice; give each mistake once")
    if NONE in named_kinds and len(named_kinds) > 1:
        raise ValueError('kind "none" is given together with a mistake; give only one of them')
    for behaviour in answers.ekf2_did:
        _require_choice("ekf2_did", behaviour, EKF2_BEHAVIOURS)
    for named in answers.mistakes:
        mistake = MISTAKES[named.kind]
        for field, choices in (
            ("parameter", CORRECTIONS),
            ("panel", PANELS),
            ("unit", mistake.units),
            ("value_unit", CORRECTIONS.get(named.parameter)),
        ):
            value = getattr(named, field)
            if value and choices is not None:
                _require_choice(f"{named.kind}: {field}", value, choices)
        low, high = mistake.range
        size = named.size_in_first_unit()
        if size is not None and not low <= size <= high:
            unit = next(iter(mistake.units))
            raise ValueError(
                f"{named.kind}: size {size:g} {unit} is out of range ({low:g} to {high:g} {unit})"
            )


def _require_choice(field: str, value: str, choices: Any) -> None:
    if not choices:
        raise ValueError(f"{field} {value!r} has no choices; leave it empty")
    if value not in choices:
        raise ValueError(f"{field} {value!r} is not one of {_join_quoted(choices)}")


def form_name(log_name: str) -> str:
    """Return the file name of the answer form of a log.

    >>> form_name("s07.ulg")
    's07.answers.toml'
    """
    return f"{Path(log_name).stem}.answers.toml"


def form_text(log_name: str, log_sha256: str) -> str:
    """Return an empty answer form for a log, with comments that list all choices."""
    template = Template(files("px4fuse").joinpath("answer_form.toml").read_text(encoding="utf-8"))
    questions = [
        f'# {question.text}\nq{number} = ""{"    # such as [61, 64]" * (question.kind == "gate")}'
        for number, question in enumerate(draw_questions(log_sha256), start=1)
    ]
    kinds = (
        f"{name:13} {mistake.description}{_format_units(mistake.units)}"
        for name, mistake in MISTAKES.items()
    )
    return template.substitute(
        log=log_name,
        form=form_name(log_name),
        sha256=log_sha256,
        verdicts=_join_quoted(VERDICTS),
        behaviours=_format_block(_format_in_threes(EKF2_BEHAVIOURS)),
        kinds=_format_block(kinds),
        corrections=_format_block(
            f"{name}{_format_units(units)}" for name, units in CORRECTIONS.items()
        ),
        panels=_format_block(_format_in_threes(PANELS)),
        questions="\n".join(questions),
    )


def form_rows(answers: Answers) -> Iterator[tuple[str, str]]:
    """Yield names and values of a completed form, for the report and the class page."""
    yield "Verdict on KF", answers.verdict_kf or EMPTY_CELL
    yield "Verdict on EKF2", answers.verdict_ekf2 or EMPTY_CELL
    yield "Behaviour of EKF2", ", ".join(answers.ekf2_did) or EMPTY_CELL
    for mistake in answers.mistakes:
        time_limits = (("from", mistake.from_s), ("until", mistake.until_s))
        value = _format_number_with_unit(
            mistake.value, mistake.value_unit, CORRECTIONS.get(mistake.parameter, {})
        )
        details = (
            _format_number_with_unit(
                mistake.size, mistake.unit, MISTAKES.get(mistake.kind, MistakeKind("")).units
            ),
            mistake.when
            or " ".join(
                f"{name} {time_s:g} s" for name, time_s in time_limits if time_s is not None
            ),
            f"shown in {mistake.panel}" if mistake.panel else "",
            f"{mistake.parameter} {value}".strip(),
        )
        yield mistake.kind, "; ".join(filter(None, details)) or EMPTY_CELL
    for quantity, quantity_answer in zip(
        draw_questions(answers.log_sha256), answers.quantities, strict=False
    ):
        numbers = (
            quantity_answer
            if isinstance(quantity_answer, tuple)
            else []
            if quantity_answer is None
            else [quantity_answer]
        )
        yield quantity.text, ", ".join(f"{number:g}" for number in numbers) or EMPTY_CELL


def _format_number_with_unit(number: float | None, unit: str, units: Mapping[str, float]) -> str:
    return "" if number is None else f"{number:g} {unit or next(iter(units), '')}".rstrip()


def _format_units(units: Mapping[str, float]) -> str:
    named = ", ".join(filter(None, units))
    return f" [{named}]" if named else ""


def _format_block(lines: Iterable[str]) -> str:
    return "\n".join(f"#     {line}" for line in lines)


def _join_quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _format_in_threes(names: tuple[str, ...]) -> Iterator[str]:
    return (_join_quoted(names[start : start + 3]) for start in range(0, len(names), 3))
