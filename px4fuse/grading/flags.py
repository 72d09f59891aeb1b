"""What an instructor should look at: sentences, never points.

A flag is not a proof. Two students may fly one flight together, and advice that px4fuse prints
leads everyone to the same number.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import combinations
from operator import attrgetter

from px4fuse.assignment.key import AnswerKey, folded
from px4fuse.filter.settings import Settings
from px4fuse.grading.model import Graded
from px4fuse.plain import few_words
from px4fuse.results.contract import LoopResults, Reported, to_plain
from px4fuse.results.reading import one_line
from px4fuse.simulation import flights

# Chosen noises have so many digits together before they are the same by chance only once in a
# thousand pairs: 0.3 and 0.1 are what many would type
MIN_DIGITS = 4
# Numbers of a form that two students do not have in common by chance
SAME_NUMBERS = 3
# A hand-picked part of the flight below this share leaves most of it out
HAND_PICKED = 0.5
# What a student chooses; the rest of the settings follows from the log
CHOSEN = ("sigma_a_m_s2", "sigma_z_m", "dt_s", "input", "clock_offset_s")
SHOWN = 4
# Words in a row by which two texts are compared: of two written apart a few per cent are the same,
# of a copy with an error in every fifth word two in five
RUN = 3
COPIED = 0.25
# Shorter texts are the same by chance
MIN_RUNS = 25
# Of longer texts only the beginning is compared
MAX_WORDS = 3000
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

Flags = Iterator[tuple[int, str]]


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


def _form_numbers(one: Graded) -> tuple[float, ...]:
    """Sizes, values and quantities of a form with digits that nobody types by chance."""
    form = one.form
    given = [] if form is None else [n for each in form.mistakes for n in (each.size, each.value)]
    given += [] if form is None else [n for n in form.quantities if isinstance(n, float)]
    found = tuple(number for number in given if number is not None and _digits(number) > 1)
    return found if len(found) >= SAME_NUMBERS else ()


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
    ("The same settings to the last digit as {}: {}.", attrgetter("settings"), _who),
    ("The form has the numbers of {}.", _form_numbers, _who),
    ("The same numbers to the last digit, from a log of another hash, as {}: a copy of the log.",
     _results_numbers, attrgetter("log_sha256")),
)  # fmt: skip


def class_flags(
    graded: Sequence[Graded], key: AnswerKey | None = None
) -> Mapping[int, tuple[str, ...]]:
    """What stands out between the reports of a class.

    Parameters
    ----------
    key : AnswerKey, optional
        Tells who is in the class.

    Returns
    -------
    mapping
        Index into ``graded`` to sentences; those without any are left out.
    """
    found: dict[int, list[str]] = defaultdict(list)
    for look in (_common(graded), _other_version(graded), _copied_notes(graded),
                 _other_name(graded, key)):  # fmt: skip
        for index, flag in look:
            found[index].append(flag)
    return {index: tuple(flags) for index, flags in sorted(found.items())}


def _common(graded: Sequence[Graded]) -> Flags:
    for said, what, whose in COMMON:
        where: dict[Hashable, list[int]] = defaultdict(list)
        for index, one in enumerate(graded):
            where[what(one)].append(index)
        for value, members in where.items():
            if value and len({whose(graded[index]) for index in members}) > 1:
                for index in members:
                    others = [graded[other] for other in members if other != index]
                    named = [f"{_name(one)} ({_line(one.submission)})" for one in others]
                    yield index, said.format(few_words(named, SHOWN, "; "), value)


def _other_version(graded: Sequence[Graded]) -> Flags:
    versions = Counter(one.version for one in graded if one.version)
    for usual, _ in versions.most_common(1):
        said = f"Made with px4fuse {{}}, most of the class with {_line(usual)}."
        for index, one in enumerate(graded):
            if one.version not in ("", usual):
                yield index, said.format(_line(one.version))


def copied_notes(graded: Sequence[Graded]) -> dict[int, list[tuple[float, int]]]:
    """By place, which texts share passages with one's own: share of the shorter, and their places.

    The most alike are first.
    """
    found: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for share, first, second in copies([one.notes for one in graded], list(map(_who, graded))):
        found[first].append((share, second))
        found[second].append((share, first))
    return {at: sorted(others, key=lambda one: (-one[0], one[1])) for at, others in found.items()}


def _copied_notes(graded: Sequence[Graded]) -> Flags:
    for index, others in copied_notes(graded).items():
        named = [f"{_name(graded[other])} ({share:.0%} of the shorter)" for share, other in others]
        yield index, f"The text shares whole passages with those of {few_words(named, SHOWN)}."


def _other_name(graded: Sequence[Graded], key: AnswerKey | None) -> Flags:
    """The file is named after another student of the class, by id or by full name."""
    people = {folded(one.student_id): one.student for one in graded if one.student_id.strip()}
    people |= {folded(one.student_id): one.name for one in (key.answers if key else ())}
    for index, one in enumerate(graded):
        # the key's spelling, where a spreadsheet took away leading zeros
        given = key.of_student(one.student_id) if key else None
        own = {folded(one.student_id), folded(given.student_id) if given else ""} - {""}
        words = _words(one.submission.removesuffix(".pdf"))
        mine = _words(one.student)
        if not (own or mine) or own & words or (mine and mine <= words):
            continue
        others = [
            student_id
            for student_id, name in people.items()
            # one word of a name is too short to be told from other words of a file name
            if student_id not in own
            and (student_id in words or (len(_words(name)) > 1 and _words(name) <= words))
        ]
        if others:
            other = _line(sorted(others)[0])
            yield index, f"The file's name is that of {other}, the report says {_name(one)}."


def _words(text: str) -> frozenset[str]:
    """Words of a name or a file's name; ids with signs in them stay whole as well."""
    plain = folded(text)
    return frozenset(re.findall(r"[^\W_]+", plain) + re.split(r"[\s_/(),]+", plain)) - {""}


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
    plain = unicodedata.normalize("NFKD", text[: 12 * MAX_WORDS]).casefold()
    seen = "".join(part for part in plain if unicodedata.category(part) not in ("Mn", "Cf"))
    return re.findall(r"[^\W_]+", seen)[:MAX_WORDS]


def runs(words: Sequence[str]) -> frozenset[tuple[str, ...]]:
    """Every few words in a row."""
    return frozenset(tuple(words[at : at + RUN]) for at in range(len(words) - RUN + 1))


def text_flags(results: Reported, min_words: int, common_words: Sequence[str]) -> Iterator[str]:
    """What stands out in one text by itself: sentences for the instructor."""
    text = results.student.notes
    words = words_of(text)
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
        printed = runs_of_all(told)
        share = len(own & printed) / len(own)
        if share >= QUOTED:
            yield f"The text is px4fuse's own: {share:.0%} of it is in the report."
    if said := TO_A_GRADER.search(text):
        yield f"The text speaks to who grades it (\u201c{said[0]}\u201d): it is not followed."


def runs_of_all(value: object) -> frozenset[tuple[str, ...]]:
    """Runs of words of every text in plain results."""
    if isinstance(value, str):
        return runs(words_of(value))
    parts = list(value.values()) if isinstance(value, dict) else value
    if not isinstance(parts, list | tuple):
        return frozenset()
    return frozenset[tuple[str, ...]]().union(*map(runs_of_all, parts))


def copies(texts: Sequence[str], authors: Sequence[str]) -> list[tuple[float, int, int]]:
    """Pairs of texts that share passages: which share of the shorter one, and their places.

    Parameters
    ----------
    authors : sequence of str
        Texts of one author are not compared.
    """
    each = [runs(words_of(text)) for text in texts]
    if len(texts) >= TEMPLATE_CLASS:
        counted = Counter(part for parts in each for part in parts)
        common = {part for part, count in counted.items() if count > TEMPLATE_SHARE * len(texts)}
        each = [parts - common for parts in each]
    long = [at for at, parts in enumerate(each) if len(parts) >= MIN_RUNS]
    pairs = []
    for first, second in combinations(long, 2):
        if authors[first] == authors[second]:
            continue
        share = len(each[first] & each[second]) / min(len(each[first]), len(each[second]))
        if share >= COPIED:
            pairs.append((share, first, second))
    return pairs
