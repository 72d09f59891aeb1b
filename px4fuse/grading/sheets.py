"""Every page of the redrawn reports as pictures, in files beside the class page.

Three hundred reports have a hundred megabytes of pictures: too many for the page itself, which
loads those of a report when it is unfolded. Files are named by what they show, so that none is
drawn twice and none says whose it is.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from px4fuse.flight import Unavailable
from px4fuse.grading.workers import Failed, run_bounded
from px4fuse.verification.pictures import page_pictures
from px4fuse.writing import write_all

TIMEOUT_S = 120.0
MEMORY_BYTES = 4_000_000_000
# What a picture looks like besides its report; a change draws all anew
DRAWN_AS = "700 px, 16 colours"


@dataclass(frozen=True)
class Job:
    """A redrawn report, the words that its pictures must not show, and where they go."""

    pdf: Path
    hide: tuple[str, ...]
    folder: Path

    @property
    def stem(self) -> str:
        """By which its pictures are known."""
        made = hashlib.sha256(self.pdf.read_bytes())
        made.update("\0".join((DRAWN_AS, *self.hide)).encode("utf-8", "replace"))
        return made.hexdigest()[:16]


def draw_sheets(
    reports: Mapping[str, tuple[Path, Sequence[str]]], folder: Path, processes: int | None = None
) -> dict[str, tuple[str, ...]]:
    """Draw the pages of reports that are not drawn yet, in processes of their own.

    Parameters
    ----------
    reports : mapping
        Key to the redrawn PDF, and the words that its pictures must not show.
    folder : Path
    processes : int, optional
        By default as many as there are cores.

    Returns
    -------
    dict
        Key to names of files in the folder, page by page; those that cannot be drawn are left out.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    jobs = {key: Job(pdf, tuple(hide), folder) for key, (pdf, hide) in reports.items()}
    stems = {key: job.stem for key, job in jobs.items()}
    made = {key: found for key, stem in stems.items() if (found := _drawn(folder, stem))}
    missing = [key for key in jobs if key not in made]

    def done(index: int, count: int | Failed) -> None:
        found = _drawn(folder, stems[missing[index]])
        if found:
            made[missing[index]] = found

    run_bounded(
        draw,
        [jobs[key] for key in missing],
        processes=min(processes or os.cpu_count() or 1, len(missing)),
        timeout_s=TIMEOUT_S,
        memory_bytes=MEMORY_BYTES,
        on_done=done,
        keep=False,
    )
    return made


def draw(job: Job) -> int:
    """Write the pictures of one report; how many there are."""
    drawn = page_pictures(job.pdf.read_bytes(), job.hide)
    if isinstance(drawn, Unavailable):
        return 0
    stem = job.stem
    write_all(
        {
            job.folder / f"{stem}-{number:03}-of-{len(drawn):03}.png": picture
            for number, picture in enumerate(drawn, start=1)
        }
    )
    return len(drawn)


def _drawn(folder: Path, stem: str) -> tuple[str, ...]:
    """What is there of a report, if all of it is."""
    names = sorted(path.name for path in folder.glob(f"{stem}-*-of-*.png"))
    whole = bool(names) and names[0].endswith(f"-of-{len(names):03}.png")
    return tuple(names) if whole else ()
