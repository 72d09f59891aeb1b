"""The student's own words, read sentence by sentence: what they claim, deny, or leave open.

No rule here knows a language. Which words deny, doubt or reassure stands in the rubric; whether a
text is one of sentences is told from lengths, repetition and how often its commonest words come.
What rules cannot tell is left open, for the instructor to read.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import islice, product
from typing import Literal

from px4fuse.grading.folding import disguised, folded
from px4fuse.grading.model import Reading
from px4fuse.report import notes as markdown

# As many as px4fuse compare takes
MAX_NOTES = 200_000
# Words in a row that a student has from px4fuse itself: as many are hardly the same by chance
QUOTE_WORDS = 7
# "no sign of any outliers": a word that denies stands at most so many words before
DENIES_BEFORE, DENIES_AFTER = 3, 3
# "no outliers, gaps or jumps": shorter parts of a sentence go with the part before them
SHORT_CLAUSE = 4
SHORT = 2
# Combinations of words that are looked at in one sentence
MAX_TRIES = 500
# Below so many words nothing can be said about how often the commonest come
MIN_COUNTED = 80
COMMONEST = 5
MIN_PACKED_BYTES = 600
# Words of so many letters ("late", "rate", "offset") stand in any text
COMMON_LETTERS = 4, 6
# So many words with letters of other scripts in them are not there by mistake
MANY_DISGUISED = 3

WORD = re.compile(r"\w+")
# Scripts that do not part words: so many letters stand for one
NO_SPACES = re.compile("[\u0e00-\u0eff\u1780-\u17ff]+|[\u3040-\u30ff\u3400-\u9fff]+")
SENTENCE_END = re.compile(r"(?<=[.!?;؟।])\s+|(?<=[。！？])|\n")
CLAUSE_END = re.compile(r"[,،](?=\s)|[;:()\[\]，、；：（）]|\s[-–—]+\s")

Stance = Literal["claimed", "open", "denied"]


@dataclass(frozen=True)
class Words:
    """Words of the rubric that change what a sentence says, folded."""

    negations: frozenset[str]
    doubts: frozenset[str]
    reassurances: frozenset[str]
    contrasts: frozenset[str]


@dataclass(frozen=True)
class Sentence:
    """One sentence: as it stands there, and its folded words.

    Attributes
    ----------
    clause : tuple of int
        Which part between commas, colons and brackets each word is in.
    """

    text: str
    words: tuple[str, ...]
    clause: tuple[int, ...]

    @cached_property
    def length(self) -> int:
        """In words; of scripts that do not part them, as many letters as a word has."""
        return sum(map(_weight, self.words))


@dataclass(frozen=True)
class Mention:
    """How the notes speak of something."""

    stance: Stance
    passage: str


@dataclass(frozen=True)
class Notes:
    """The notes of one report.

    Attributes
    ----------
    sentences : tuple of Sentence
        Of the student's own: whole, none twice, none that px4fuse wrote.
    problem : str
        Why they do not count: the end of a sentence that begins with "your notes"; "" for notes.
    disguised : int
        Words with letters in them that only look like what they are taken for.
    quoted : int
        Words in sentences of px4fuse's own.
    """

    sentences: tuple[Sentence, ...]
    problem: str
    disguised: int
    quoted: int
    words_of_rubric: Words

    @cached_property
    def words(self) -> int:
        """How many there are, of the student's own."""
        return sum(sentence.length for sentence in self.sentences)

    @cached_property
    def different(self) -> int:
        """How many different ones."""
        words = {word for sentence in self.sentences for word in sentence.words}
        return sum(map(_weight, words))

    def mention(self, phrases: Sequence[str]) -> Mention | None:
        """What the notes say of something that any of these phrases names.

        All words of one phrase stand in one sentence, in any order; their beginnings are enough.
        Claimed anywhere is claimed, whatever else is said.
        """
        best: Mention | None = None
        for phrase in phrases:
            for found in self._mentions(phrase):
                if best is None or _ORDER[found.stance] < _ORDER[best.stance]:
                    best = found
                if best.stance == "claimed":
                    return best
        return best

    def claims(self, phrases: Sequence[str]) -> bool:
        """Whether a sentence says so, plainly."""
        found = self.mention(phrases)
        return found is not None and found.stance == "claimed"

    def _mentions(self, phrase: str) -> Iterator[Mention]:
        stems = WORD.findall(folded(phrase))
        if not stems or self.problem:
            return
        where = [self._with(stem) for stem in stems]
        for number in sorted(set.intersection(*where)):
            sentence = self.sentences[number]
            for stance in self._stances(sentence, stems):
                yield Mention(stance, sentence.text)

    @cached_property
    def _index(self) -> dict[str, set[int]]:
        index: dict[str, set[int]] = {}
        for number, sentence in enumerate(self.sentences):
            for word in sentence.words:
                index.setdefault(word, set()).add(number)
        return index

    def _with(self, stem: str) -> set[int]:
        begins = _beginning(stem)
        return set().union(*(at for word, at in self._index.items() if begins(word)))

    def _stances(self, sentence: Sentence, stems: Sequence[str]) -> Iterator[Stance]:
        """What a sentence says of a phrase, for each place where its words stand."""
        places = [
            [at for at, word in enumerate(sentence.words) if _beginning(stem)(word)]
            for stem in stems
        ]
        for chosen in islice(product(*places), MAX_TRIES):
            if not self.words_of_rubric.negations.isdisjoint(stems):
                # "not closed" is not any two words of one sentence
                span = chosen[-1] - chosen[0]
                apart = sentence.clause[chosen[0]] != sentence.clause[chosen[-1]]
                if apart or span > len(stems) + 1 or list(chosen) != sorted(set(chosen)):
                    continue
            yield self._stance(sentence, chosen)

    def _stance(self, sentence: Sentence, chosen: Sequence[int]) -> Stance:
        words, known = sentence.words, self.words_of_rubric
        first, last = min(chosen), max(chosen)
        same = [
            at for at in range(len(words))
            if sentence.clause[first] <= sentence.clause[at] <= sentence.clause[last]
            and at not in chosen
        ]  # fmt: skip
        said = {words[at] for at in same}
        denying = [at for at in same if words[at] in known.negations]
        one_clause = sentence.clause[first] == sentence.clause[last]
        before = {
            word for word, clause in zip(words, sentence.clause, strict=True)
            if clause < sentence.clause[first]
        }  # fmt: skip
        goes_on = len(same) + len(chosen) <= SHORT_CLAUSE and not known.contrasts & said
        if any(first - DENIES_BEFORE <= at < first for at in denying):
            return "denied"
        if any(first < at < last for at in denying) or known.reassurances & said:
            return "denied" if one_clause else "open"
        # "I looked at everything: nothing wrong" leaves nothing open
        denies = known.negations.intersection(words[at] for at in chosen)
        unsettling = known.negations if denies else known.negations | known.doubts
        unclear = (
            any(at < first or at <= last + DENIES_AFTER for at in denying),
            any(words[at] in known.doubts for at in same if at < first) and not denies,
            sentence.text.rstrip().endswith(("?", "？", "؟")),
            goes_on and before & unsettling,
        )
        return "open" if any(unclear) else "claimed"


_ORDER: dict[Stance, int] = {"claimed": 0, "open": 1, "denied": 2}


def read_notes(
    text: str,
    words: Words,
    rules: Reading,
    ids: Collection[str] = (),
    theirs: Collection[str] = (),
    terms: Collection[str] = (),
) -> Notes:
    """Read notes.

    Parameters
    ----------
    text : str
        Markdown. What a page does not show (comments, addresses' titles) is not read.
    rules : Reading
        What makes a text of sentences, from the rubric.
    ids : collection of str
        Of findings: names that px4fuse gave, which say nothing by themselves.
    theirs : collection of str
        Texts of px4fuse in the same report.
    terms : collection of str
        Folded beginnings of words of the field.
    """
    drawn = list(_drawn(text[:MAX_NOTES]))
    every = [sentence for block in drawn for sentence in _sentences(block)]
    runs = {run for one in theirs for run in _runs(WORD.findall(folded(one)))}
    own = _own(every, runs)
    kept: dict[tuple[str, ...], Sentence] = {}
    for sentence in own:
        if _whole(sentence, rules, ids):
            kept.setdefault(sentence.words, sentence)
    sentences = tuple(kept.values())
    made = Notes(
        sentences,
        "",
        sum(disguised(word) for block in drawn for word in re.findall(r"[\w\u200b\u2060]+", block)),
        sum(one.length for one in every) - sum(one.length for one in own),
        words,
    )
    return replace(made, problem=_problem(made, own, rules, ids, terms))


def _problem(
    notes: Notes,
    own: Sequence[Sentence],
    rules: Reading,
    ids: Collection[str],
    terms: Collection[str],
) -> str:
    """Why a text is not the student's own about a flight; "" where no rule can say so."""
    words = [word for sentence in own for word in sentence.words]
    length, names = sum(map(_weight, words)), sum(word in ids for word in words)
    if length + notes.quoted < rules.judged_from:
        return ""
    packed = " ".join(words).encode()
    spaced = [word for word in words if not NO_SPACES.match(word)]
    common = [count for _, count in Counter(spaced).most_common(COMMONEST)] or [0]
    field = {term for term in terms if not COMMON_LETTERS[0] <= len(term) <= COMMON_LETTERS[1]}
    about = sum(
        one.length for one in notes.sentences
        if any(any(c.isdigit() for c in word) or _is_term(word, field) for word in one.words)
    )  # fmt: skip
    broken = (
        (
            notes.quoted > rules.quoted * (length + notes.quoted),
            "are mostly sentences of px4fuse itself",
        ),
        (names > rules.ids * len(words), "are mostly names of findings"),
        (
            len(packed) >= MIN_PACKED_BYTES
            and len(zlib.compress(packed, 9)) < rules.packed * len(packed),
            "say the same again and again",
        ),
        (notes.words < rules.in_sentences * length, "are mostly not sentences"),
        (
            len(spaced) >= max(MIN_COUNTED, len(words) // 2)
            and sum(common) < rules.common * len(spaced),
            "are words without the small ones that make sentences of them",
        ),
        (
            len(spaced) >= MIN_COUNTED and common[0] > rules.commonest * len(spaced),
            "hold one word again and again",
        ),
        (
            length >= MIN_COUNTED
            and sum(_is_term(word, terms) for word in words) > rules.terms * len(words),
            "are mostly words for mistakes",
        ),
        (
            about < rules.about * notes.words,
            "say nothing about the flight: no numbers, no words of the field",
        ),
    )
    return next((said for holds, said in broken if holds), "")


def _is_term(word: str, terms: Collection[str]) -> bool:
    return any(word[:end] in terms for end in range(3, len(word) + 1))


def _drawn(text: str) -> Iterator[str]:
    """What a page shows of Markdown, block by block."""
    for block in markdown.read(text):
        if isinstance(block, markdown.Line):
            yield block.text
        else:
            yield from ("; ".join(row) for row in block.rows)


def _sentences(block: str) -> Iterator[Sentence]:
    for text in SENTENCE_END.split(block):
        words: list[str] = []
        clause: list[int] = []
        for number, part in enumerate(CLAUSE_END.split(text)):
            found = WORD.findall(folded(part))
            words += found
            clause += [number] * len(found)
        if words:
            yield Sentence(" ".join(text.split()), tuple(words), tuple(clause))


def _whole(sentence: Sentence, rules: Reading, ids: Collection[str]) -> bool:
    """Whether it may be a sentence: neither a list of names nor without an end."""
    said = [word for word in sentence.words if word not in ids]
    if not rules.shortest <= sum(map(_weight, said)) <= rules.longest:
        return False
    return len(sentence.words) - len(said) <= rules.ids * len(sentence.words)


def _runs(words: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Words in a row, whatever their numbers."""
    words = ["0" if word[0].isdigit() else word for word in words]
    for at in range(len(words) - QUOTE_WORDS + 1):
        yield tuple(words[at : at + QUOTE_WORDS])


def _own(sentences: Sequence[Sentence], runs: Collection[tuple[str, ...]]) -> list[Sentence]:
    """Those of which more than half is not of px4fuse, however its words are cut into sentences."""
    words = [word for sentence in sentences for word in sentence.words]
    covered: set[int] = set()
    for at, run in enumerate(_runs(words)):
        if run in runs:
            covered.update(range(at, at + QUOTE_WORDS))
    end, own = 0, []
    for sentence in sentences:
        start, end = end, end + len(sentence.words)
        if 2 * len(covered.intersection(range(start, end))) < len(sentence.words):
            own.append(sentence)
    return own


@cache
def _beginning(stem: str) -> Callable[[str], bool]:
    """Whether a word begins like this one; in scripts that do not part words, holds it.

    Two letters are a word of their own: "no" is not the beginning of "nothing".
    """
    if NO_SPACES.match(stem):
        return lambda word: stem in word
    if len(stem) <= SHORT:
        return stem.__eq__
    return lambda word: word.startswith(stem)


def _weight(word: str) -> int:
    if NO_SPACES.match(word) is None:
        return 1
    return -(-len(word) // (2 if word[0] >= "\u3000" else 5))
