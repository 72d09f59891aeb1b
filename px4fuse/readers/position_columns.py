"""Which columns of a position log are read: those that were named, else by their names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.errors import LogError, SettingsError
from px4fuse.readers.position_names import (
    LENGTH_UNITS,
    TIME_KINDS,
    TIME_UNITS,
    Meaning,
    Position,
    find_position,
    find_sigma,
    meaning,
)
from px4fuse.readers.position_table import COLUMNS, ISO_TIME, MIN_COLUMNS, Table
from px4fuse.readers.text_table import quote


@dataclass(frozen=True)
class ColumnChoice:
    """Columns to read, by index."""

    time: int
    iso: str  # where times are ISO 8601 text: the words on that
    nanoseconds: int | None  # the other half of the time, where it is split
    position: Position
    sigma: tuple[int | None, ...]
    quality: int | None
    units: Mapping[int, str]  # those that names give
    frame: str | None
    detected: list[str]  # on time, position, sigma and quality
    notes: list[str]

    @property
    def axes(self) -> list[int]:
        """Columns of position that there are."""
        return [index for index in self.position if index is not None]

    @property
    def numbers(self) -> list[int]:
        """Columns of numbers besides time, each once."""
        every = (*self.position, *self.sigma, self.quality, self.nanoseconds)
        return list(dict.fromkeys(index for index in every if index is not None))


def choose(table: Table, columns: tuple[str, ...] | None) -> ColumnChoice:
    """Choose the columns: those that the option tells, else by name, else the first ones."""
    width = max(map(len, table.head), default=0)
    meanings = [*map(meaning, table.names), *[Meaning()] * (width - len(table.names))]
    told = _resolve(columns, table, len(meanings)) if columns else []
    if not told and not table.names and table.width() >= MIN_COLUMNS:
        # of more than five columns the fifth is no sigma but an attitude or the like
        is_sigma = table.width() == 5 and table.is_numeric(4)
        told = list(range(5 if is_sigma else min(table.width(), 4)))
    shown = [m if not told or i in told[1:4] else Meaning() for i, m in enumerate(meanings)]
    found = find_position(shown)
    if told:
        time, nanoseconds, time_words = told[0], None, table.label(told[0])
        position: Position = (told[1], told[2], told[3] if len(told) > 3 else None)
        frame, position = found if found and set(found[1]) == set(position) else (None, position)
    else:
        time, nanoseconds, time_words = _choose_time(table, meanings)
        if found is None:
            raise LogError(table.not_found("position columns"))
        frame, position = found
    if max(time, *position[:2], *told[4:]) >= width:
        raise LogError(table.not_found("rows with time and position"))
    if position[2] is not None and not table.column(position[2]):
        position = (*position[:2], None)
    backwards = list(enumerate(meanings))[::-1]  # of several with one meaning the first is kept
    sigmas = {m.key: i for i, m in backwards if m.kind == "sigma" and table.is_numeric(i)}
    sigma = (told[4],) * 3 if len(told) > 4 else find_sigma(sigmas, frame)
    by_kind = {m.kind: i for i, m in backwards}
    quality = by_kind.get("quality")
    quality_words = f"{table.labels([quality])}, as given" if quality is not None else "none"
    if quality is not None and not table.is_numeric(quality):
        quality_words = f"none, as {table.label(quality)} holds no numbers"
        quality = None
    tags = sorted(set(table.column(by_kind["tag"]))) if "tag" in by_kind else []
    first = next(iter(table.column(time)), "")
    iso = "ISO 8601 text" if ISO_TIME.fullmatch(first) else ""
    if iso and not re.search(r"(?:[zZ]|[+-]\d\d(?::?\d\d)?)$", first[10:]):
        iso += ", no zone, taken as UTC"
    units = {
        i: m.unit
        for i, m in enumerate(meanings)
        if m.unit in (TIME_UNITS if i == time else LENGTH_UNITS)
    }
    notes = (
        [f"several tags ({', '.join(map(quote, tags[:2]))}): keep those of one"] if tags[1:] else []
    )
    height = "" if position[2] is not None else " without height"
    words = [
        f"time: {time_words}",
        f"position: {table.labels(position)} as {frame.upper() if frame else 'x, y, z'}{height}",
        f"sigma: {table.labels(sigma) or 'none'}",
        f"quality: {quality_words}",
    ]
    return ColumnChoice(
        time, iso, nanoseconds, position, sigma, quality, units, frame, words, notes
    )


def _resolve(columns: tuple[str, ...], table: Table, width: int) -> list[int]:
    """Columns that the option names, by index."""
    names = [name.casefold() for name in table.names]
    found = []
    for column in columns:
        wanted = column.strip().casefold()
        if wanted not in names and not (wanted.isdecimal() and 1 <= float(wanted) <= width):
            raise SettingsError(table.not_found(f"column {quote(column)}"))
        found.append(names.index(wanted) if wanted in names else int(wanted) - 1)
    if len(set(found)) < len(found):
        raise SettingsError(f"{COLUMNS}: {quote(','.join(columns))} names one column twice.")
    return found


def _choose_time(table: Table, meanings: list[Meaning]) -> tuple[int, int | None, str]:
    """Column of time, the column of its nanoseconds where it is split, and the words on it."""
    times = [index for index, column in enumerate(meanings) if column.kind == "time"]
    if not times:
        raise LogError(table.not_found("time column"))

    def rank(index: int) -> tuple[bool, int]:
        filled = sum(bool(text.strip("+-0.")) for text in table.column(index))
        return 2 * filled <= len(table.head), TIME_KINDS.index(meanings[index].key)

    first, *others = sorted(times, key=rank)
    key = meanings[first].key
    halves = {meanings[i].unit: i for i in reversed(times) if meanings[i].key == key}
    if {"s", "ns"} <= set(halves) and not any(len(t) > 9 for t in table.column(halves["ns"])):
        return halves["s"], halves["ns"], f"{table.labels((halves['s'], halves['ns']))} together"
    words = f", the {key} (not used: {table.labels(others)})" if others else ""
    return first, None, table.label(first) + words
