"""The form that a student fills in about a flight: ``answers.toml``.

What it asks stands in ``form.toml``: the mistakes a flight can have, with the units of their sizes;
what EKF2 can have done; the panels that show something; what can be done about it. Reading checks
the form's grammar, never whether it is right.
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

# tomllib takes seconds and gigabytes for one dotted key of 64 kB
MAX_BYTES, MAX_LINE = 20_000, 500
MOST_MISTAKES = 20
NONE = "none"
BLANK = "\u2013"


class NamedMistake(Record, frozen=True, rename={"sized_in": "in"}):
    """What may be wrong, in words; sizes beyond ``range``, in the first unit, are nonsense."""

    words: str
    sized_in: str = ""
    range: tuple[float, float] = (-1e6, 1e6)

    @property
    def units(self) -> Mapping[str, float]:
        """Of its size, with what one of each is in the first of them; none: it has no size."""
        return _UNITS[self.sized_in]


class Form(Record, frozen=True):
    """The tables of ``form.toml``."""

    did: tuple[str, ...]
    panels: tuple[str, ...]
    units: dict[str, dict[str, float]]
    mistakes: dict[str, NamedMistake]
    cures: dict[str, str]
    questions: dict[str, str]


_FORM = table(__file__, "form.toml", Form)
_UNITS: Mapping[str, Mapping[str, float]] = {"": {}, **_FORM.units}
MISTAKES, EKF2_DID, PANELS = _FORM.mistakes, _FORM.did, _FORM.panels
# What can be done about a mistake, with the units of its value (none: it takes no number)
CURES = {name: _UNITS[units] for name, units in _FORM.cures.items()}
VERDICTS = ("consistent", "overstated", "understated")

Number = Annotated[float, Meta(gt=-1e9, lt=1e9)]
Unit = Annotated[str, Meta(max_length=10)]
VerdictWord = Literal["", "consistent", "overstated", "understated"]
# A number, or the updates of a list, as they are asked for; None is left blank
QuantityAnswer = Number | Annotated[tuple[Number, ...], Meta(max_length=200)] | None


class ClaimedMistake(Record, frozen=True):
    """One mistake that a student names.

    Attributes
    ----------
    kind : str
        One of :data:`MISTAKES`.
    size : float or None
        In ``unit``, one of those of the kind; with its sign.
    when : str
        "whole flight", or empty where ``from_s`` and ``until_s`` (since the first data) say it.
    parameter : str
        One of :data:`CURES`, with its ``value`` in ``value_unit``.
    panel : str
        One of :data:`PANELS`: where it was seen.
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
        """The size in the kind's first unit; a length's factor as what it is beyond 1."""
        units = MISTAKES[self.kind].units
        if self.size is None or not units:
            return None
        if self.unit == "factor" and self.kind == "scale":
            return (self.size - 1.0) * 100.0
        return self.size * (units[self.unit] if self.unit else next(iter(units.values())))

    def value_in_first_unit(self) -> float | None:
        """The value in the parameter's first unit."""
        units = CURES.get(self.parameter, {})
        if self.value is None or not units:
            return self.value
        return self.value * units.get(self.value_unit, 1.0)


class Answers(Record, frozen=True, kw_only=True):
    """A form as it was filled in; what was left blank is not there.

    Attributes
    ----------
    log_sha256 : str
        Of the log that the form was made for.
    verdict_ours, verdict_ekf2 : str
        On the innovation variance, one of :data:`VERDICTS`.
    quantities : tuple of (float, tuple of float, or None)
        In the order of :func:`draw_questions`; a tuple where a list of updates was asked for.
    """

    log_sha256: Sha256
    mistakes: Annotated[tuple[ClaimedMistake, ...], Meta(max_length=MOST_MISTAKES)] = ()
    verdict_ours: VerdictWord = ""
    verdict_ekf2: VerdictWord = ""
    ekf2_did: Annotated[tuple[str, ...], Meta(max_length=len(EKF2_DID))] = ()
    quantities: Annotated[tuple[QuantityAnswer, ...], Meta(max_length=10)] = ()

    @property
    def claims_no_mistake(self) -> bool:
        """Whether it says that nothing is wrong."""
        return [claim.kind for claim in self.mistakes] == [NONE]


QuestionKind = Literal["gain", "variance", "innovation", "nis", "silence", "gate"]
# One of each pair is asked
_QUESTION_PAIRS: tuple[tuple[QuestionKind, QuestionKind], ...] = (
    ("gain", "variance"),
    ("innovation", "nis"),
    ("silence", "gate"),
)


class FormQuestion(Record, frozen=True):
    """A number that no report prints, asked at settings of each log's own.

    Attributes
    ----------
    kind : str
        What is asked, along the aisle.
    update : int
        Counted from 1, as rows of ``replay(...).updates``: the first measurement is no update.
    sigma_a_m_s2, sigma_z_m : float
        Settings of our filter.
    extra : float
        Seconds of silence, or the gate in standard deviations.
    """

    kind: QuestionKind
    update: int
    sigma_a_m_s2: float
    sigma_z_m: float
    extra: float = 0.0

    @property
    def words(self) -> str:
        """The question."""
        what = _FORM.questions[self.kind].format(question=self, last=self.update + GATE_UPDATES)
        return f"{what}; with SIGMA_A {self.sigma_a_m_s2:g} and SIGMA_Z {self.sigma_z_m:g}"


# Updates that a question about the gate goes over
GATE_UPDATES = 20


def draw_questions(log_sha256: str) -> tuple[FormQuestion, ...]:
    """Three quantities, which follow from the log and differ between logs."""
    random_bytes = iter(hashlib.sha256(f"px4fuse answers {log_sha256}".encode()).digest())

    def between(low: float, high: float, decimals: int) -> float:
        return round(low + (high - low) * next(random_bytes) / 255.0, decimals)

    settings = (between(0.2, 0.45, 2), between(0.06, 0.14, 3))
    early, late, last = (pair[next(random_bytes) % 2] for pair in _QUESTION_PAIRS)
    extra = between(1.0, 4.0, 1) if last == "silence" else between(1.3, 2.0, 1)
    return (
        FormQuestion(early, 2 + next(random_bytes) % 7, *settings),
        FormQuestion(late, 20 + next(random_bytes) % 130, *settings),
        FormQuestion(last, 20 + next(random_bytes) % 100, *settings, extra),
    )


def read_answers(path: Path) -> Answers:
    """Read a form and check its grammar.

    Raises
    ------
    SettingsError
        It is not a form, or a field does not say what can be said there: which, and what can.
    """
    text = read_text(path, SettingsError, MAX_BYTES, name=str(path))
    if any(len(line) > MAX_LINE for line in text.splitlines()):
        raise SettingsError(f"{path}: has a line of more than {MAX_LINE} characters.")
    try:
        answers = msgspec.convert(_as_record(tomllib.loads(text)), Answers)
        check(answers)
    except (tomllib.TOMLDecodeError, RecursionError, msgspec.ValidationError, ValueError) as error:
        raise SettingsError(f"{path}: {error}", "Correct it there.") from error
    return answers


def _as_record(form: dict[str, Any]) -> dict[str, Any]:
    """The file's own shape as that of :class:`Answers`: what is blank is left out.

    Claims stand under "mistake", and numbers under the names of their questions.
    """
    filled_form = _without_blanks(form)
    claims = filled_form.pop("mistake", ())
    numbers = msgspec.convert(filled_form.pop("quantities", {}), dict[str, Any])
    names = [f"q{number}" for number in range(1, len(draw_questions("")) + 1)]
    if unknown := sorted({*numbers, *({"mistakes"} & filled_form.keys())} - set(names)):
        raise ValueError(f"{unknown[0]} is not one of mistake, {', '.join(names)}")
    return {
        **filled_form,
        "mistakes": claims,
        "quantities": tuple(numbers.get(name) for name in names),
    }


def _without_blanks(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_blanks(part) for key, part in value.items() if part != ""}
    if isinstance(value, list):
        return [part for part in map(_without_blanks, value) if part not in ("", {})]
    return value


def check(answers: Answers) -> None:
    """Check the grammar beyond types, as far as tables say it.

    Raises
    ------
    ValueError
        A word that cannot stand there, a number out of range, a claim twice.
    """
    kinds = [claim.kind for claim in answers.mistakes]
    for name in kinds:
        _one_of("kind", name, MISTAKES)
        if kinds.count(name) > 1:
            raise ValueError(f"kind {name!r} stands there twice: give each mistake once")
    if NONE in kinds and len(kinds) > 1:
        raise ValueError('kind "none" stands beside a mistake: give one or the other')
    for behaviour in answers.ekf2_did:
        _one_of("ekf2_did", behaviour, EKF2_DID)
    for claim in answers.mistakes:
        mistake = MISTAKES[claim.kind]
        for field, known in (
            ("parameter", CURES),
            ("panel", PANELS),
            ("unit", mistake.units),
            ("value_unit", CURES.get(claim.parameter)),
        ):
            value = getattr(claim, field)
            if value and known is not None:
                _one_of(f"of {claim.kind}: {field}", value, known)
        low, high = mistake.range
        size = claim.size_in_first_unit()
        if size is not None and not low <= size <= high:
            unit = next(iter(mistake.units))
            raise ValueError(
                f"of {claim.kind}: size {size:g} {unit} is none that it can have: "
                f"{low:g} to {high:g} {unit}"
            )


def _one_of(field: str, value: str, known: Any) -> None:
    if value not in known:
        allowed = ", ".join(f'"{name}"' for name in known) or "none: leave it empty"
        raise ValueError(f"{field} {value!r} is not one of {allowed}")


def form_name(log_name: str) -> str:
    """What the form of a log is called.

    >>> form_name("s07.ulg")
    's07.answers.toml'
    """
    return f"{Path(log_name).stem}.answers.toml"


def form_text(log_name: str, log_sha256: str) -> str:
    """An empty form for a log, with everything that can be said in it explained."""
    template = Template(files("px4fuse").joinpath("answers.toml").read_text(encoding="utf-8"))
    questions = [
        f'# {one.words}\nq{number} = ""{"    # such as [61, 64]" * (one.kind == "gate")}'
        for number, one in enumerate(draw_questions(log_sha256), start=1)
    ]
    kinds = (f"{name:13} {one.words}{_units(one.units)}" for name, one in MISTAKES.items())
    return template.substitute(
        log=log_name,
        form=form_name(log_name),
        sha256=log_sha256,
        verdicts=_quoted(VERDICTS),
        did=_block(_in_threes(EKF2_DID)),
        kinds=_block(kinds),
        cures=_block(f"{name}{_units(units)}" for name, units in CURES.items()),
        panels=_block(_in_threes(PANELS)),
        questions="\n".join(questions),
    )


def form_rows(answers: Answers) -> Iterator[tuple[str, str]]:
    """A filled form as names and values, for pages."""
    yield "Variance of our filter", answers.verdict_ours or BLANK
    yield "Variance of EKF2", answers.verdict_ekf2 or BLANK
    yield "What EKF2 did", ", ".join(answers.ekf2_did) or BLANK
    for claim in answers.mistakes:
        time_limits = (("from", claim.from_s), ("until", claim.until_s))
        value = _format_number_with_unit(
            claim.value, claim.value_unit, CURES.get(claim.parameter, {})
        )
        details = (
            _format_number_with_unit(
                claim.size, claim.unit, MISTAKES.get(claim.kind, NamedMistake("")).units
            ),
            claim.when
            or " ".join(f"{name} {at:g} s" for name, at in time_limits if at is not None),
            f"seen in {claim.panel}" if claim.panel else "",
            f"{claim.parameter} {value}".strip(),
        )
        yield claim.kind, "; ".join(filter(None, details)) or BLANK
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
        yield quantity.words, ", ".join(f"{number:g}" for number in numbers) or BLANK


def _format_number_with_unit(number: float | None, unit: str, units: Mapping[str, float]) -> str:
    return "" if number is None else f"{number:g} {unit or next(iter(units), '')}".rstrip()


def _units(units: Mapping[str, float]) -> str:
    named = ", ".join(filter(None, units))
    return f" [{named}]" if named else ""


def _block(lines: Iterable[str]) -> str:
    """Lines of a comment."""
    return "\n".join(f"#     {line}" for line in lines)


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _in_threes(names: tuple[str, ...]) -> Iterator[str]:
    return (_quoted(names[start : start + 3]) for start in range(0, len(names), 3))
