"""Loop closures that a person gives: pairs of times at which the vehicle was at the same place."""

from __future__ import annotations

from pathlib import Path

from px4fuse.errors import TrajectoryError
from px4fuse.readers.text_table import text_of
from px4fuse.reading import read_whole, shown
from px4fuse.request import GivenClosure

MAX_CLOSURES = 10_000
MAX_FILE_BYTES = 1_000_000


def parse_closure(text: str) -> GivenClosure:
    """Read ``T1,T2`` or ``T1,T2,SIGMA``.

    Raises
    ------
    TrajectoryError
        It is not two or three finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(abs(number) < float("inf") for number in numbers):
        raise TrajectoryError(
            f"closure {text.strip()[:60]!r} is not T1,T2 or T1,T2,SIGMA: two times in s and a "
            "standard deviation in m."
        )
    return GivenClosure(*numbers)


def read_closures(path: Path) -> tuple[GivenClosure, ...]:
    """Read a file of closures, one ``T1,T2[,SIGMA]`` a line; ``#`` begins a comment.

    Raises
    ------
    TrajectoryError
        The file cannot be read, holds no closure, or has a line that is not one.
    """
    name = shown(path)
    text = text_of(read_whole(path, TrajectoryError, MAX_FILE_BYTES))
    if text is None:
        raise TrajectoryError(f"{name}: not a text file", "Give one T1,T2[,SIGMA] a line.")
    found: list[GivenClosure] = []
    for number, line in enumerate(text.split("\n"), start=1):
        content = line.split("#", 1)[0].strip()
        if not content or (not found and content[0].isalpha()):  # a header
            continue
        try:
            found.append(parse_closure(content))
        except TrajectoryError as error:
            raise TrajectoryError(f"{name}, line {number}: {error}") from error
    if not 0 < len(found) <= MAX_CLOSURES:
        raise TrajectoryError(
            f"{name}: {len(found)} closures; give 1 to {MAX_CLOSURES}, one T1,T2[,SIGMA] a line."
        )
    return tuple(found)
