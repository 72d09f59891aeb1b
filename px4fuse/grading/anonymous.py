"""Names, ids and names of files out of texts, for a class page that others may see."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence

from px4fuse.grading.model import Entry, Graded

# Shorter words are in every text
SHORTEST_WORD = 3
# Shorter ids are numbers that notes are full of
SHORTEST_ID = 4
NAME = "[name]"


class Veil:
    """What replaces names; nothing where nobody has a pseudonym.

    A full name, an id and a file's name become the pseudonym, single words of names
    :data:`NAME`, also where they mean something else: too much is hidden rather than too little.
    """

    def __init__(self, entries: Sequence[Entry]) -> None:
        veiled = [entry for entry in entries if entry.pseudonym]
        self._instead = {_key(word): NAME for entry in veiled for word in _words(entry)}
        self._instead |= {
            _key(text): entry.pseudonym for entry in veiled for text in _identities(entry)
        }
        self._every = _pattern([*self._instead])
        self._without_short_ids = _pattern(
            [text for text in self._instead
             if len(text) >= SHORTEST_ID or not any(map(str.isdigit, text))]
        )  # fmt: skip

    def hide(self, text: str, *, own_words: bool = False) -> str:
        """A text without names; ``own_words`` are a student's, in which short ids are numbers."""
        pattern = self._without_short_ids if own_words else self._every
        if pattern is None:
            return text
        composed = unicodedata.normalize("NFC", text)
        return pattern.sub(lambda found: self._instead[_key(found[0])], composed)


def hidden_words(entry: Entry, one: Graded) -> tuple[str, ...]:
    """What pictures of a report must not show: names, ids, and of names also each word."""
    texts = {*_identities(entry), *_words(entry), one.student, one.student_id}
    return tuple(sorted(text for text in texts if len(text.strip()) > 1))


def _identities(entry: Entry) -> Iterator[str]:
    """What says who it is, as a whole."""
    yield from (text for text in (entry.student, entry.student_id, entry.email) if text.strip())
    for one in entry.files:
        yield from (text for text in (one.student, one.student_id) if text.strip())
        name = one.submission
        yield name
        # the log's name is often the id's, the file's is often the student's
        yield from (part for part in re.split(r"[/\\]", name) if len(part) > SHORTEST_ID)
        stem = name.rpartition("/")[2].rpartition(".")[0]
        if len(stem) >= SHORTEST_ID and stem.casefold() not in ("report", "result", "results"):
            yield stem


def _words(entry: Entry) -> Iterator[str]:
    for name in {entry.student, *(one.student for one in entry.files)}:
        words = re.findall(r"[^\W\d_]+", unicodedata.normalize("NFC", name))
        # scripts that do not part words have short ones
        yield from (word for word in words if len(word) >= SHORTEST_WORD or ord(word[0]) > 0x2E80)


def _key(text: str) -> str:
    return unicodedata.normalize("NFC", text).casefold()


def _pattern(texts: Sequence[str]) -> re.Pattern[str] | None:
    if not texts:
        return None
    longest_first = sorted(texts, key=lambda text: (-len(text), text))
    # an underscore parts words in names of files
    return re.compile(
        rf"(?<![^\W_])(?:{'|'.join(map(re.escape, longest_first))})(?![^\W_])", re.IGNORECASE
    )
