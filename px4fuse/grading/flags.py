"""What an instructor should look at: sentences, never points.

A flag is not a proof. Two students may fly one flight together, and advice that px4fuse prints
leads everyone to the same number.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import PurePosixPath

from px4fuse.answers import Answers
from px4fuse.assignment.key import AnswerKey
from px4fuse.assignment.key import folded as folded_id
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, HeldOut, Tuned
from px4fuse.grading.model import Graded
from px4fuse.grading.text import copies
from px4fuse.plain import few_words
from px4fuse.results.comparison import ASKED
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported
from px4fuse.results.reading import one_line
from px4fuse.simulation import flights

# Chosen noises have so many digits together before they are the same by chance only once in a
# thousand pairs: 0.3 and 0.1 are what many would type
MIN_DIGITS = 4
# Digits to which px4fuse prints the settings that it advises
PRINTED_DIGITS = 3
# Numbers of a form that two students do not have in common by chance
SAME_NUMBERS = 3
# A hand-picked part of the flight below this share leaves most of it out
HAND_PICKED = 0.5
# Beyond this factor px4fuse itself names a wrong noise (findings/sigma.py, NOISE_OFF is 1.5);
# with a margin for what lies between interval and value
SIGMA_FAR_OFF = 2.0
# What a student chooses; the rest of the settings follows from the log
CHOSEN = ("sigma_a_m_s2", "sigma_z_m", "dt_s", "input", "clock_offset_s")
SHOWN = 4


def own_flags(results: Reported, handed_out: bool = False) -> tuple[str, ...]:
    """What stands out in one report by itself; nothing in one of a loop alone.

    ``handed_out``: there is an answer key, so that logs are simulated for a reason.
    """
    if isinstance(results, LoopResults):
        return ()
    return tuple(
        flag
        for look in (
            _tuned_here,
            _hand_picked,
            _nothing_found,
            _left_out,
            *([] if handed_out else [_simulated]),
        )
        for flag in look(results)
    )


def _tuned_here(results: ComparisonResults) -> Iterator[str]:
    """The settings are the optimum of the very flight that they are graded on."""
    tuned, settings = results.tuning.get(HORIZONTAL), results.settings
    if not isinstance(tuned, Tuned) or tuned.filter_sigma_a_m_s2 is None or tuned.sigma_z_m is None:
        return
    pairs = (
        (settings.sigma_a_m_s2, tuned.filter_sigma_a_m_s2),
        (settings.sigma_z_m, tuned.sigma_z_m),
    )
    if not all(_as_printed(chosen, best) for chosen, best in pairs):
        return
    held = (
        "settings found on its first half alone would be "
        f"{abs(tuned.held_out.gain_nats):.2g} nats per measurement "
        f"{'better' if tuned.held_out.gain_nats > 0 else 'worse'} on the second"
        if isinstance(tuned.held_out, HeldOut)
        else "no half of the flight was held out"
    )
    yield (
        f"SIGMA_A {settings.sigma_a_m_s2:g} and SIGMA_Z {settings.sigma_z_m:g} are the most likely "
        "ones of this very flight: they were tuned on the segment that is graded, so that "
        "consistency and intervals are met by construction and say nothing about another flight "
        f"({held})."
    )


def _as_printed(chosen: float, best: float) -> bool:
    """Whether a chosen number is the best one, rounded to two or more digits as when copied."""
    digits = _digits(chosen)
    if digits < 2 or best <= 0.0:
        return False
    return math.isclose(float(f"{best:.{min(digits, PRINTED_DIGITS)}g}"), chosen, rel_tol=1e-9) or (
        math.isclose(best, chosen, rel_tol=1e-6)
    )


def _hand_picked(results: ComparisonResults) -> Iterator[str]:
    """Start or end were chosen by hand, and most of the flight is left out."""
    settings, whole = results.settings, results.log.duration_s
    if not whole:
        return
    share = (settings.end_s - settings.start_s) / whole
    if settings.segment_reason.startswith("chosen with") and share < HAND_PICKED:
        yield (
            f"The analysed part was chosen by hand and is {share:.0%} of the log "
            f"({settings.start_s:.1f} to {settings.end_s:.1f} s of {whole:.1f} s): ask why the "
            "rest was left out."
        )


def _nothing_found(results: ComparisonResults) -> Iterator[str]:
    """A noise is far off and no finding says so: px4fuse would have."""
    ids = {one.id for one in results.findings}
    tuned = results.tuning.get(HORIZONTAL)
    if "no_motion" in ids or not isinstance(tuned, Tuned):
        return
    for name, label in (("sigma_z_m", "sigma_z"), ("sigma_a_m_s2", "sigma_a")):
        chosen: float = getattr(results.settings, name)
        best: float | None = getattr(tuned, ASKED[name])
        if not best:
            continue
        factor = max(chosen / best, best / chosen)
        low, high = getattr(tuned, f"{ASKED[name]}_interval") or (math.inf, -math.inf)
        named = {
            f"{label}_small", f"{label}_large", "process_noise_forgotten", "source_may_drift",
            "errors_larger_than_claimed",
        } & ids  # fmt: skip
        if factor > SIGMA_FAR_OFF and not low <= chosen <= high and not named:
            yield (
                f"{label.upper()} is {factor:.2g} times off what the data ask for, and no finding "
                "says so: findings may have been taken out."
            )


def _left_out(results: ComparisonResults) -> Iterator[str]:
    """The harder part of the lab was switched off."""
    if not {"north", "east", "aisle"} & set(results.axes):
        yield "Only the vertical axis was analysed (--axis)."
    without_imu = any(finding.id == "input_unavailable" for finding in results.findings)
    if results.settings.input == "zero" and not without_imu:
        yield "The IMU was not used (--input zero)."


def _simulated(results: ComparisonResults) -> Iterator[str]:
    if results.log.hardware == flights.HARDWARE:
        yield "The log was made by px4fuse simulate: no vehicle flew."


def class_flags(
    graded: Sequence[Graded], key: AnswerKey | None = None
) -> Mapping[int, tuple[str, ...]]:
    """What stands out between the reports of a class.

    Parameters
    ----------
    key : AnswerKey, optional
        Tells whose log is whose.

    Returns
    -------
    mapping
        Index into ``graded`` to sentences; those without any are left out.
    """
    found: dict[int, list[str]] = defaultdict(list)
    looks = (
        _same(graded),
        _other_assignment(graded, key),
        _other_version(graded),
        _copied_notes(graded),
        _same_form(graded),
        _same_numbers(graded),
        _other_name(graded, key),
    )
    for look in looks:
        for index, flag in look:
            found[index].append(flag)
    return {index: tuple(flags) for index, flags in sorted(found.items())}


Flags = Iterator[tuple[int, str]]


def _same(graded: Sequence[Graded]) -> Flags:
    # one student may hand in two reports on one log, with one choice of settings
    looks = (
        ("The same file as {}.", [one.sha256 for one in graded], False),
        ("The same student id as in {}.", [folded_id(one.student_id) for one in graded], False),
        ("The same log as {}.", [one.log_sha256 for one in graded], True),
        ("The same settings to the last digit as {}: {}.", [one.settings for one in graded], True),
    )
    for said, values, of_different in looks:
        where: dict[str, list[int]] = defaultdict(list)
        for index, value in enumerate(values):
            where[value].append(index)
        for value, members in where.items():
            students = {_who(graded[index]) for index in members}
            if value and len(students if of_different else members) > 1:
                for index in members:
                    yield index, said.format(_others(graded, members, index), value)


def _other_assignment(graded: Sequence[Graded], key: AnswerKey | None) -> Flags:
    if key is None:
        return
    for index, one in enumerate(graded):
        own, given = key.of_student(one.student_id), key.of_log(one.log_sha256)
        if not one.log_sha256:
            continue
        if given is None:
            yield index, "The log is not one of those that were handed out with the assignment."
        elif own is None:
            absent = f"the id {_line(one.student_id)} is not in the answer key"
            said = absent if one.student_id else "the report gives no id"
            yield index, f"The log was given to {given.student_id}; {said}."
        elif own.sha256 != one.log_sha256:
            yield index, f"The log was given to another student, {given.student_id}."


def chosen_settings(results: Reported) -> str:
    """What was chosen, in words; empty for defaults and for what many would type."""
    if isinstance(results, LoopResults):
        return ""
    default = Settings()
    own = {
        name: value
        for name in CHOSEN
        if (value := getattr(results.settings, name)) != getattr(default, name)
    }
    if sum(_digits(value) for value in own.values() if isinstance(value, float)) < MIN_DIGITS:
        return ""
    return ", ".join(f"{name} {value}" for name, value in own.items())


def _other_version(graded: Sequence[Graded]) -> Flags:
    counted = Counter(one.version for one in graded if one.version)
    if len(counted) < 2:
        return
    usual = counted.most_common(1)[0][0]
    others = f"most of the class with {_line(usual)}"
    for index, one in enumerate(graded):
        if one.version and one.version != usual:
            yield index, f"Made with px4fuse {_line(one.version)}, {others}."


def copied_notes(graded: Sequence[Graded]) -> list[tuple[float, int, int]]:
    """Pairs whose texts share passages: which share of the shorter one, and their places."""
    return copies([one.notes for one in graded], [_who(one) for one in graded])


def _copied_notes(graded: Sequence[Graded]) -> Flags:
    alike: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for share, first, second in copied_notes(graded):
        alike[first].append((share, second))
        alike[second].append((share, first))
    for index, others in sorted(alike.items()):
        others.sort(reverse=True)
        named = [f"{_name(graded[other])} ({share:.0%} of the shorter)" for share, other in others]
        yield index, f"The text shares whole passages with those of {few_words(named, SHOWN)}."


def _same_form(graded: Sequence[Graded]) -> Flags:
    """Wrong numbers that two students have in common, to the last digit."""
    where: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for index, one in enumerate(graded):
        if one.form is not None and len(numbers := _numbers_of(one.form)) >= SAME_NUMBERS:
            where[numbers].append(index)
    for members in where.values():
        if len({_who(graded[index]) for index in members}) > 1:
            for index in members:
                yield index, f"The form has the numbers of {_others(graded, members, index)}."


def _same_numbers(graded: Sequence[Graded]) -> Flags:
    """The same flight under another hash: a byte of the log was changed."""
    where: dict[tuple[float, ...], list[int]] = defaultdict(list)
    for index, one in enumerate(graded):
        if len(one.numbers) >= SAME_NUMBERS and one.verdict.status == "verified":
            where[tuple(one.numbers.values())].append(index)
    for members in where.values():
        if len({graded[index].log_sha256 for index in members}) > 1:
            for index in members:
                said = "The same numbers to the last digit, from a log of another hash, as"
                yield index, f"{said} {_others(graded, members, index)}: a copy of the log."


def _numbers_of(form: Answers) -> tuple[float, ...]:
    """Sizes, values and quantities with digits that nobody types by chance."""
    given = [number for one in form.mistakes for number in (one.size, one.value)]
    given += [number for number in form.quantities if isinstance(number, float)]
    return tuple(number for number in given if number is not None and _digits(number) > 1)


def _other_name(graded: Sequence[Graded], key: AnswerKey | None) -> Flags:
    """The file's name is that of another student of the class."""
    people = {folded_id(one.student_id): one.student for one in graded if one.student_id.strip()}
    people |= {folded_id(a.student_id): a.name for a in (key.answers if key else ())}
    names = {
        parts: folded_id(student_id)
        for student_id, name in people.items()
        # one word is too short to be told from other words of a file name
        if len(parts := frozenset(_words(name))) > 1
    }
    for index, one in enumerate(graded):
        own_id, own_words = folded_id(one.student_id), frozenset(_words(one.student))
        # the key's spelling, where a spreadsheet took away leading zeros
        given = key.of_student(one.student_id) if key else None
        own_ids = {own_id} | ({folded_id(given.student_id)} if given else set())
        stem = PurePosixPath(one.submission.replace("\\", "/")).stem
        words = frozenset(_words(one.submission.removesuffix(".pdf"))) | {folded_id(stem)}
        says_own = bool(own_ids & words) or (own_words and own_words <= words)
        if says_own or not (own_id or own_words):
            continue
        ids = sorted({student_id for student_id in people if student_id in words} - own_ids)
        others = sorted({of for parts, of in names.items() if parts <= words} - own_ids)
        if ids or others:
            other = _line((ids or others)[0])
            yield index, f"The file's name is that of {other}, the report says {_name(one)}."
        elif own_id.isdecimal() and _looks_like(stem, own_id):
            said = f"the report gives the id {_line(one.student_id)}"
            yield index, f"The file is named {_line(stem)}, {said}."


def _looks_like(stem: str, student_id: str) -> bool:
    return stem.isdecimal() and len(stem) == len(student_id) and stem != student_id


def _words(text: str) -> list[str]:
    """Words of a name or a file's name; ids with signs in them stay whole as well."""
    plain = folded_id(text)
    parts = (*re.findall(r"[^\W_]+", plain), *re.split(r"[\s_/(),]+", plain))
    return [part for part in parts if part]


def _who(one: Graded) -> str:
    return folded_id(one.student_id) or folded_id(one.student) or one.submission


def _name(one: Graded) -> str:
    """A student in a sentence."""
    parts = [part for part in (one.student.strip(), one.student_id.strip()) if part]
    return _line(", ".join(parts) or one.submission)


def _others(graded: Sequence[Graded], members: Sequence[int], index: int) -> str:
    others = [graded[other] for other in members if other != index]
    return few_words([f"{_name(one)} ({_line(one.submission)})" for one in others], SHOWN, "; ")


def _line(text: str) -> str:
    return one_line(text, 80)


def _digits(number: float) -> int:
    """Significant digits of a number as typed."""
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0
