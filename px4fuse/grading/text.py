"""What a machine can know of a student's own text; what it is worth the instructor says."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations

from px4fuse.results.contract import Reported, to_plain

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
