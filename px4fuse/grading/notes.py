"""The student's own words."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence

# As many as px4fuse compare takes
MAX_NOTES = 200_000
# A text without full stops is cut into pieces of so many words, in which words belong together
LONGEST_SENTENCE = 40
NEGATIONS = frozenset(("no", "without", "not", "never", "nor", "zero"))
# In the words of the rubric: what says that a flight has no mistake
NOTHING = "none"
NO_SPACES = re.compile("[\u0e00-\u0eff\u1780-\u17ff]+|[\u3040-\u30ff\u3400-\u9fff]+")
WORD = re.compile(r"\w+")
SENTENCE_END = re.compile(r"(?<=[.!?;])\s+|\n\s*\n|\n\s*(?:[-*+#]|\d+[.)])\s*")


class Notes:
    """The student's own words, so that it can be told quickly what they mention."""

    def __init__(self, text: str) -> None:
        text = unicodedata.normalize("NFKC", text[:MAX_NOTES]).casefold()
        # scripts that do not part words: five letters of Thai, Lao or Khmer and two of Chinese or
        # Japanese stand for a word
        spaceless = sum(
            -(-len(run) // (2 if run[0] >= "\u3000" else 5)) for run in NO_SPACES.findall(text)
        )
        counted = WORD.findall(NO_SPACES.sub(" ", text))
        self.words = len(counted) + spaceless
        self.different = len(set(counted)) + spaceless
        self._sentences: dict[str, set[int]] = {}
        self._affirmed: dict[str, set[int]] = {}
        number = 0
        for sentence in SENTENCE_END.split(text):
            words = WORD.findall(sentence)
            for start in range(0, len(words), LONGEST_SENTENCE):
                piece = words[start : start + LONGEST_SENTENCE]
                for at, word in enumerate(piece):
                    self._sentences.setdefault(word, set()).add(number)
                    if NEGATIONS.isdisjoint(piece[max(at - 2, 0) : at]):
                        self._affirmed.setdefault(word, set()).add(number)
                number += 1

    def mention(self, phrases: Sequence[str], affirmed: bool = False) -> bool:
        """Whether one sentence has words that begin like all the words of one phrase.

        ``affirmed``: the first of them not after a "no", "not" or "without".
        """
        return any(self._mention(phrase, affirmed) for phrase in phrases)

    def _mention(self, phrase: str, affirmed: bool) -> bool:
        stems = WORD.findall(unicodedata.normalize("NFKC", phrase).casefold())
        if not stems:
            return False
        found = self._with(stems[0], self._affirmed if affirmed else self._sentences)
        for stem in stems[1:]:
            found &= self._with(stem, self._sentences)
        return bool(found)

    @staticmethod
    def _with(stem: str, index: Mapping[str, set[int]]) -> set[int]:
        return set().union(*(at for word, at in index.items() if word.startswith(stem)))
