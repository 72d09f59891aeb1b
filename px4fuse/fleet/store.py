"""What a fleet's folder keeps between runs: a file per log with its rows, and what they rest on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from px4fuse.fleet.rows import Row

FOLDER = "rows"


class Kept(msgspec.Struct, frozen=True):
    """The rows of a log, of one px4fuse and one set of settings."""

    sha256: str
    px4fuse: str
    settings: str
    size_bytes: int | None
    rows: Annotated[list[Row], msgspec.Meta(min_length=1)]

    @property
    def file(self) -> str:
        """Where it is kept, relative to the fleet's folder."""
        return f"{FOLDER}/{self.sha256}.json"


def kept_in(folder: Path, px4fuse: str, settings: str) -> Iterator[Kept]:
    """What a folder keeps of this px4fuse and these settings."""
    for file in sorted((folder / FOLDER).glob("*.json")):
        try:
            kept = msgspec.json.decode(file.read_bytes(), type=Kept)
        except (OSError, msgspec.MsgspecError):
            continue  # not ours, or of another px4fuse: the log is done again
        if (kept.px4fuse, kept.settings) == (px4fuse, settings):
            yield kept
