"""What a fleet's folder keeps between runs: the rows of every log, by what they depend on."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from px4fuse.errors import OutputError
from px4fuse.fleet.rows import Row

ROWS = "rows.sqlite"
_TABLE = """
create table if not exists kept (
    sha256 text, px4fuse text, settings text, size_bytes integer, rows text,
    primary key (sha256, px4fuse, settings)
) without rowid"""


@dataclass(frozen=True)
class Store:
    """Rows by the hash of their log, of one px4fuse and one set of settings.

    A row is there as a whole or not at all, whatever ends the run.
    """

    connection: sqlite3.Connection
    px4fuse: str
    settings: str

    def sizes(self) -> set[int]:
        """Sizes of the logs that it knows."""
        found = self.connection.execute(
            "select size_bytes from kept where px4fuse = ? and settings = ?",
            (self.px4fuse, self.settings),
        )
        return {size for (size,) in found}

    def keep(self, sha256: str, size_bytes: int | None, rows: Sequence[Row]) -> None:
        """Keep the rows of a log."""
        text = json.dumps(rows, ensure_ascii=False)
        with self.connection:
            self.connection.execute(
                "insert or replace into kept values (?, ?, ?, ?, ?)",
                (sha256, self.px4fuse, self.settings, size_bytes, text),
            )

    def rows(self, sha256: str) -> list[Row]:
        """Rows of a log; none of an unknown log."""
        found = self.connection.execute(
            "select rows from kept where sha256 = ? and px4fuse = ? and settings = ?",
            (sha256, self.px4fuse, self.settings),
        ).fetchone()
        rows: list[Row] = [] if found is None else json.loads(found[0])
        return rows


@contextmanager
def opened(folder: Path, px4fuse: str, settings: str) -> Iterator[Store]:
    """Open what a folder keeps.

    Raises
    ------
    OutputError
        It cannot be read or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}). Give another.") from error
    try:
        with closing(sqlite3.connect(folder / ROWS)) as connection:
            connection.execute(_TABLE)
            yield Store(connection, px4fuse, settings)
    except sqlite3.Error as error:
        raise OutputError(
            f"{folder / ROWS}: cannot be written or read ({error}). Everything before is kept; "
            "give another folder, or make room on the disk."
        ) from error
