"""What two notes have in common, as passages to be read side by side."""

from __future__ import annotations

import re

from px4fuse.grading.folding import folded

# Words in a row that are the same in both
SAME_WORDS = 5
Segments = tuple[tuple[str, bool], ...]


def shared_passages(one: str, other: str) -> tuple[Segments, Segments]:
    """Two texts in pieces: each with whether it is, but for spelling, in the other one too.

    >>> a, b = "we saw that the clock is late", "THAT the clock is late, yes"
    >>> shared_passages(a, b)[0]
    (('we saw ', False), ('that the clock is late', True))
    >>> shared_passages(a, b)[1]
    (('THAT the clock is late', True), (', yes', False))
    """
    tokens = [[(folded(m[0]), *m.span()) for m in re.finditer(r"\w+", t)] for t in (one, other)]
    runs = [
        {tuple(word for word, *_ in found[at : at + SAME_WORDS]) for at in _starts(found)}
        for found in tokens
    ]
    both = runs[0] & runs[1]
    return _pieces(one, tokens[0], both), _pieces(other, tokens[1], both)


Token = tuple[str, int, int]


def _starts(tokens: list[Token]) -> range:
    return range(len(tokens) - SAME_WORDS + 1)


def _pieces(text: str, tokens: list[Token], both: set[tuple[str, ...]]) -> Segments:
    spans: list[list[int]] = []
    for at in _starts(tokens):
        run = tokens[at : at + SAME_WORDS]
        if tuple(word for word, *_ in run) in both:
            if spans and run[0][1] <= spans[-1][1]:
                spans[-1][1] = run[-1][2]
            else:
                spans.append([run[0][1], run[-1][2]])
    pieces: list[tuple[str, bool]] = []
    end = 0
    for start, stop in spans:
        pieces += [(text[end:start], False), (text[start:stop], True)]
        end = stop
    pieces.append((text[end:], False))
    return tuple(piece for piece in pieces if piece[0])
