"""A report's last line: the hash of all its bytes, so that a file that was changed shows.

It is a PDF comment after the end of the file, which every viewer passes over and every program
that saves the file again drops or invalidates. It is no signature: who writes a PDF of their own
can write the line as well. What a report says is proved by running the analysis again.
"""

from __future__ import annotations

import hashlib
import re
from typing import Literal

_LINE = re.compile(rb"%px4fuse-sha256 ([0-9a-f]{64})\n")
_LENGTH = len(b"%px4fuse-sha256 ") + 64 + 1


def sealed(pdf: bytes) -> bytes:
    """A PDF with its seal as the last line."""
    end = b"" if pdf.endswith(b"\n") else b"\n"
    return pdf + end + b"%px4fuse-sha256 " + hashlib.sha256(pdf + end).hexdigest().encode() + b"\n"


def seal_of(pdf: bytes) -> Literal["intact", "broken", "missing"]:
    """Whether a PDF is as px4fuse wrote it.

    Returns
    -------
    {"intact", "broken", "missing"}
        "broken" where the line is there and does not fit, or is not the last one.
    """
    match = _LINE.fullmatch(pdf[-_LENGTH:])
    if match is None:
        return "broken" if b"%px4fuse-sha256 " in pdf[-2048:] else "missing"
    fits = hashlib.sha256(pdf[:-_LENGTH]).hexdigest().encode() == match[1]
    return "intact" if fits else "broken"
