"""What a fleet's folder keeps between runs: the rows of every log, by what they depend on."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from px4fuse.errors import OutputError
from px4fuse.fleet.rows import Row

_TABLE = """
create table if not exists rows (
    sha256 text, px4fuse text, settings text, size_bytes integer, severities text, rows text,
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
            "select size_bytes from rows where px4fuse = ? and settings = ?",
            (self.px4fuse, self.settings),
        )
        return {size for (size,) in found}

    def keep(
        self, sha256: str, size_bytes: int | None, severities: Sequence[str], rows: Sequence[Row]
    ) -> None:
        """Keep the rows of a log."""
        with self.connection:
            self.connection.execute(
                "insert or replace into rows values (?, ?, ?, ?, ?, ?)",
                (
                    sha256, self.px4fuse, self.settings, size_bytes, ";".join(severities),
                    json.dumps(rows, ensure_ascii=False),
                ),
            )  # fmt: skip

    def rows(self, sha256: str) -> tuple[list[Row], set[str]]:
        """Rows of a log, and the severities of its findings; nothing of an unknown log."""
        found: tuple[str, str] | None = self.connection.execute(
            "select rows, severities from rows where sha256 = ? and px4fuse = ? and settings = ?",
            (sha256, self.px4fuse, self.settings),
        ).fetchone()
        if found is None:
            return [], set()
        rows: list[dict[str, Any]] = json.loads(found[0])
        return rows, set(found[1].split(";")) - {""}


@contextmanager
def opened(path: Path, px4fuse: str, settings: str) -> Iterator[Store]:
    """Open what a folder keeps.

    Raises
    ------
    OutputError
        It cannot be read or written.
    """
    try:
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(_TABLE)
            yield Store(connection, px4fuse, settings)
    except sqlite3.Error as error:
        raise OutputError(
            f"{path}: cannot be written or read ({error}). Everything before is kept; give "
            "another folder, or make room on the disk."
        ) from error
