"""What an instructor should look at: sentences, never points.

A flag is not a proof. Two students may fly one flight together, and advice that px4fuse prints
leads everyone to the same number.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import combinations
from operator import attrgetter
from typing import Any

from px4fuse.assignment.key import folded
from px4fuse.grading.model import Graded
from px4fuse.plain import few_words
from px4fuse.results.contract import LoopResults, Reported, to_plain
from px4fuse.results.reading import one_line
from px4fuse.simulation import flights

# Numbers of a form that two students do not have in common by chance, also where one of them has
# changed each a little
SAME_NUMBERS, NEARLY = 3, 0.02
# A hand-picked part of the flight below this share leaves most of it out
HAND_PICKED = 0.5
SHOWN = 4
# Words in a row by which two texts are compared: of two written apart a few per cent are the same,
# of a copy with an error in every fifth word two in five
RUN = 3
COPIED = 0.25
# Shorter texts are the same by chance
MIN_RUNS = 25
# Of longer texts only the beginning is compared
MAX_CHARACTERS = 36_000
# What more than half of the class has is the instructor's template, from a class of this size on
TEMPLATE_SHARE, TEMPLATE_CLASS = 0.5, 5
# From this share on a text is the report's own words, or has too few of the course's language
QUOTED, OF_THE_LANGUAGE = 0.5, 0.10
JUDGED_FROM = 40
# What a text says to who, or what, grades it
TO_A_GRADER = re.compile(
    r"full points|ignore (the|all|any|previous)|rubric|language model|system prompt|grader",
    re.IGNORECASE,
)

# By the name of a submission
Flags = Iterator[tuple[str, str]]


def own_flags(results: Reported, handed_out: bool = False) -> Iterator[str]:
    """What stands out in one report by itself; nothing in one of a loop alone.

    ``handed_out``: there is an answer key, so that logs are simulated for a reason.
    """
    if isinstance(results, LoopResults):
        return
    settings, whole_s = results.settings, results.log.duration_s
    share = (settings.end_s - settings.start_s) / whole_s if whole_s else 1.0
    chosen = (results.request.start_s, results.request.end_s) != (None, None)
    if chosen and share < HAND_PICKED:
        yield (
            f"The analysed part was chosen by hand and is {share:.0%} of the log "
            f"({settings.start_s:.1f} to {settings.end_s:.1f} s of {whole_s:.1f} s): ask why the "
            "rest was left out."
        )
    if not {"north", "east", "aisle"} & set(results.axes):
        yield "Only the vertical axis was analysed (--axis)."
    without_imu = any(finding.id == "input_unavailable" for finding in results.findings)
    if settings.input == "zero" and not without_imu:
        yield "The IMU was not used (--input zero)."
    if results.log.hardware == flights.HARDWARE and not handed_out:
        yield "The log was made by px4fuse simulate: no vehicle flew."


def _form_numbers(one: Graded) -> dict[tuple[str, str], float]:
    """Sizes, values and quantities of a form by where they stand."""
    if one.form is None:
        return {}
    given: dict[tuple[str, str], object] = {
        (each.kind, name): getattr(each, name)
        for each in one.form.mistakes
        for name in ("size", "value")
    }
    given |= {("", f"q{at}"): number for at, number in enumerate(one.form.quantities)}
    return {key: float(n) for key, n in given.items() if isinstance(n, float | int)}


def _same_numbers(one: Mapping[Any, float], other: Mapping[Any, float]) -> int:
    """How many numbers nearly agree that nobody types by chance; a value follows from its size."""
    return sum(
        _digits(number) > 1
        and abs(number - other[key]) <= (key[1] != "value") * NEARLY * abs(number)
        for key, number in one.items()
        if key in other
    )


def _results_numbers(one: Graded) -> tuple[float, ...]:
    whole = len(one.numbers) >= SAME_NUMBERS and one.verdict.status == "verified"
    return tuple(one.numbers.values()) if whole else ()


def _who(one: Graded) -> str:
    return folded(one.student_id) or folded(one.student) or one.submission


# What no two reports should have in common: the sentence, what it is (empty for nothing to
# compare), and whose it has to be to count: two reports of one student may be on one log
COMMON: tuple[tuple[str, Callable[[Graded], Hashable], Callable[[Graded], str]], ...] = (
    ("The same file as {}.", attrgetter("sha256"), attrgetter("submission")),
    ("The same student id as in {}.", lambda one: folded(one.student_id), attrgetter("submission")),
    ("The same log as {}.", attrgetter("log_sha256"), _who),
    ("The same numbers to the last digit, from a log of another hash, as {}: a copy of the log.",
     _results_numbers, attrgetter("log_sha256")),
)  # fmt: skip


def class_flags(graded: Sequence[Graded]) -> Mapping[str, Sequence[str]]:
    """What stands out between the reports of a class: sentences, by names of submissions."""
    found: dict[str, list[str]] = defaultdict(list)
    for name, flag in (*_common(graded), *_copied_forms(graded), *_copied_notes(graded)):
        found[name].append(flag)
    return found


def _common(graded: Sequence[Graded]) -> Flags:
    for said, what, whose in COMMON:
        where: dict[Hashable, list[Graded]] = defaultdict(list)
        for one in graded:
            where[what(one)].append(one)
        for value, members in where.items():
            if value and len(set(map(whose, members))) > 1:
                for one in members:
                    others = [
                        f"{_name(other)} ({_line(other.submission)})"
                        for other in members
                        if other is not one
                    ]
                    yield one.submission, said.format(few_words(others, SHOWN, "; "))


def _copied_forms(graded: Sequence[Graded]) -> Flags:
    """Whose forms have the same numbers, though the flights are others."""
    found: dict[str, list[str]] = defaultdict(list)
    numbers = [(one, _form_numbers(one)) for one in graded]
    for (one, own), (other, theirs) in combinations(numbers, 2):
        if _same_numbers(own, theirs) >= SAME_NUMBERS and _who(one) != _who(other):
            found[one.submission].append(_name(other))
            found[other.submission].append(_name(one))
    for name, others in found.items():
        yield name, f"The form has the numbers of {few_words(others, SHOWN, '; ')}."


def _copied_notes(graded: Sequence[Graded]) -> Flags:
    """Whose texts share passages: with the share of the shorter one, the most alike first."""
    each = [runs(words_of(one.notes[:MAX_CHARACTERS])) for one in graded]
    if len(each) >= TEMPLATE_CLASS:
        counted = Counter(part for parts in each for part in parts)
        common = {part for part, count in counted.items() if count > TEMPLATE_SHARE * len(each)}
        each = [parts - common for parts in each]
    found: dict[str, list[tuple[float, Graded]]] = defaultdict(list)
    long = [(one, own) for one, own in zip(graded, each, strict=True) if len(own) >= MIN_RUNS]
    for (first, own), (second, other) in combinations(long, 2):
        share = len(own & other) / min(len(own), len(other))
        if share >= COPIED and _who(first) != _who(second):
            found[first.submission].append((share, second))
            found[second.submission].append((share, first))
    for name, others in found.items():
        others.sort(key=lambda pair: -pair[0])
        named = [f"{_name(other)} ({share:.0%} of the shorter)" for share, other in others]
        yield name, f"The text shares whole passages with those of {few_words(named, SHOWN)}."


def _name(one: Graded) -> str:
    """A student in a sentence."""
    parts = filter(None, (one.student.strip(), one.student_id.strip()))
    return _line(", ".join(parts) or one.submission)


def _line(text: str) -> str:
    return one_line(text, 80)


def _digits(number: float) -> int:
    """Significant digits of a number as typed."""
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0


# ------------------------------------------------------------------ texts


def words_of(text: str) -> list[str]:
    """Words as they are compared: one spelling per character, no case, no accents, no signs.

    >>> words_of("Naïve, ｎaïve: SIGMA_Z")
    ['naive', 'naive', 'sigma', 'z']
    """
    plain = unicodedata.normalize("NFKD", text).casefold()
    seen = "".join(part for part in plain if unicodedata.category(part) not in ("Mn", "Cf"))
    return re.findall(r"[^\W_]+", seen)


def runs(words: Sequence[str]) -> frozenset[tuple[str, ...]]:
    """Every few words in a row."""
    return frozenset(tuple(words[at : at + RUN]) for at in range(len(words) - RUN + 1))


def text_flags(results: Reported, min_words: int, common_words: Sequence[str]) -> Iterator[str]:
    """What stands out in one text by itself: sentences for the instructor."""
    text = results.student.notes
    words = words_of(text[:MAX_CHARACTERS])
    if not text.strip():
        return
    if len(words) < min_words:
        yield f"The text has {len(words)} words; {min_words} were asked for."
    if len(words) >= JUDGED_FROM and common_words:
        known = sum(word in set(common_words) for word in words) / len(words)
        if known < OF_THE_LANGUAGE:
            yield f"The text is in another language than the course's ({known:.0%} of its words)."
    own = runs(words)
    if len(own) >= MIN_RUNS:
        told = to_plain(results)
        told.pop("student", None)
        printed = runs(words_of(json.dumps(told, ensure_ascii=False)))
        share = len(own & printed) / len(own)
        if share >= QUOTED:
            yield f"The text is px4fuse's own: {share:.0%} of it is in the report."
    if said := TO_A_GRADER.search(text):
        yield f"The text speaks to who grades it (\u201c{said[0]}\u201d): it is not followed."
