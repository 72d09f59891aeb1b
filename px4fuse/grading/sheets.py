"""Every page of the redrawn reports as pictures, in files beside the class page.

Three hundred reports have a hundred megabytes of pictures: too many for the page itself, which
loads those of a report when it is unfolded. Files are named by what they show, so that none is
drawn twice and none says whose it is.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from px4fuse.flight import Unavailable
from px4fuse.verification.pages import page_pictures
from px4fuse.verification.workers import run_bounded
from px4fuse.writing import write_all

# What a picture looks like besides its report; a change draws all anew
DRAWN_AS = "700 px, 16 colours"
# What the pictures are called; nothing else in their folder is ever deleted
NAMED = re.compile(r"([0-9a-f]{16})-\d{3}-of-\d{3}\.png")


Key = TypeVar("Key")
# A redrawn report, and the words that its pictures must not show
Redrawn = tuple[Path, Sequence[str]]


def draw_sheets(
    reports: Mapping[Key, Redrawn], folder: Path, processes: int | None = None
) -> dict[Key, tuple[str, ...]]:
    """Draw the pages of reports that are not drawn yet, in processes of their own.

    Pictures that it drew before of reports that are no longer among these are deleted.

    Parameters
    ----------
    reports : mapping
        Key to the redrawn PDF, and the words that its pictures must not show.
    processes : int, optional
        By default as many as there are cores.

    Returns
    -------
    dict
        Key to names of files in the folder, page by page; empty for what cannot be drawn.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    stems = {key: _stem(report) for key, report in reports.items()}
    missing = [reports[key] for key, stem in stems.items() if not _drawn(folder, stem)]
    for _ in run_bounded(partial(draw, folder=folder), missing, processes=processes):
        pass
    for path in folder.glob("*.png"):
        named = NAMED.fullmatch(path.name)
        if named and named[1] not in stems.values():
            path.unlink(missing_ok=True)
    return {key: _drawn(folder, stem) for key, stem in stems.items()}


def draw(report: Redrawn, folder: Path) -> None:
    """Write the pictures of one report, if it can be drawn."""
    pdf, hide = report
    drawn = page_pictures(pdf.read_bytes(), hide)
    if not isinstance(drawn, Unavailable):
        names = f"{_stem(report)}-{{:03}}-of-{len(drawn):03}.png"
        write_all({folder / names.format(at): made for at, made in enumerate(drawn, start=1)})


def _stem(report: Redrawn) -> str:
    """By which the pictures of a report are known."""
    pdf, hide = report
    made = hashlib.sha256(pdf.read_bytes())
    made.update("\0".join((DRAWN_AS, *hide)).encode("utf-8", "replace"))
    return made.hexdigest()[:16]


def _drawn(folder: Path, stem: str) -> tuple[str, ...]:
    """What is there of a report, if all of it is."""
    names = sorted(path.name for path in folder.glob(f"{stem}-*-of-*.png"))
    whole = bool(names) and names[0].endswith(f"-of-{len(names):03}.png")
    return tuple(names) if whole else ()
