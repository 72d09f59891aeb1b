"""Names, ids and names of files out of texts, for a class page that others may see."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from typing import Any

from px4fuse.grading.model import INSTRUCTOR, Entry
from px4fuse.webpage.frame import Part

# Shorter words are in every text
SHORTEST_WORD = 3
# Shorter parts of a file's name as well
SHORTEST_PART = 4
# A cell that is one number, which may be somebody's id
POINTS = re.compile(r"\d{1,3}(\.\d+)?")
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
        longest_first = sorted(self._instead, key=lambda text: (-len(text), text))
        # an underscore parts words in names of files
        self._names = re.compile(
            rf"(?<![^\W_])(?:{'|'.join(map(re.escape, longest_first))})(?![^\W_])", re.IGNORECASE
        )

    def hide(self, text: str, *, own_words: bool = False) -> str:
        """A text without names; ``own_words`` are a person's, in which short ids are numbers."""
        if not self._instead:
            return text
        composed = unicodedata.normalize("NFC", text)

        def instead(found: re.Match[str]) -> str:
            kept = own_words and POINTS.fullmatch(found[0])
            return found[0] if kept else self._instead[_key(found[0])]

        return self._names.sub(instead, composed)

    def of_part(self, part: Part) -> Part:
        """What a row unfolds to, with every text in it without names; its kind stays."""
        if part[0] == "prose":
            return [*part[:2], self.hide(part[2], own_words=True)]
        return [part[0], *map(self._hidden, part[1:])]

    def _hidden(self, value: Any) -> Any:
        if isinstance(value, str):
            rules, mark, said = value.partition(INSTRUCTOR)
            rules = rules if POINTS.fullmatch(rules) else self.hide(rules)
            return f"{rules}{mark}{self.hide(said, own_words=True)}"
        return [*map(self._hidden, value)] if isinstance(value, list | tuple) else value


def _identities(entry: Entry) -> Iterator[str]:
    """What says who it is, as a whole."""
    yield from (text for text in (entry.student, entry.student_id, entry.email) if text.strip())
    for one in entry.files:
        yield from (text for text in (one.student, one.student_id) if text.strip())
        name = one.submission
        yield name
        # the log's name is often the id's, the file's is often the student's
        yield from (part for part in re.split(r"[/\\]", name) if len(part) > SHORTEST_PART)
        stem = name.rpartition("/")[2].rpartition(".")[0]
        if len(stem) >= SHORTEST_PART and stem.casefold() not in ("report", "result", "results"):
            yield stem


def _words(entry: Entry) -> Iterator[str]:
    for name in {entry.student, *(one.student for one in entry.files)}:
        words = re.findall(r"[^\W\d_]+", unicodedata.normalize("NFC", name))
        # scripts that do not part words have short ones
        yield from (word for word in words if len(word) >= SHORTEST_WORD or ord(word[0]) > 0x2E80)


def _key(text: str) -> str:
    return unicodedata.normalize("NFC", text).casefold()
