"""The list of numbers by which two results are compared, with their recorded 95 % intervals."""

from collections.abc import Iterator
from dataclasses import dataclass

from px4fuse.ekf2_parameters import AIDS
from px4fuse.filter.clock import Clock
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.signals import AISLE
from px4fuse.fleet.rows import at, read_rows
from px4fuse.results.contract import AidsResults, ComparisonResults, Interval

# Path in the results (``*`` is the name of an axis, a tuning or an aid), label, unit ("share" for
# 0 to 1), and the field beside the number with its 95 % interval (empty if none is recorded)
MEASURES = read_rows("measures.csv")
# Numbers within either tolerance are equal: machines differ in the last digits
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.01, 0.001
_REJECTED = "axes.*.rejected_share"


@dataclass(frozen=True)
class Number:
    """One number of a comparison, with its 95 % interval; None if none is recorded."""

    label: str
    unit: str
    value: float
    interval: Interval | None = None


def numbers(results: ComparisonResults | AidsResults) -> dict[str, Number]:
    """Numbers of a comparison by their path in its results."""
    axes = {} if isinstance(results, AidsResults) else results.axes
    # EKF2 rejects a horizontal position as a whole
    level = next((name for name in ("north", "east", AISLE) if name in axes), "")
    # the aid that is the position source is listed among the axes
    own: tuple[str, ...] = ("ev_pos", "ev_hgt") if axes else ()
    if at(results, "source.kind") == "gnss":
        own = ("gnss_pos",)
    found: dict[str, Number] = {}
    for measure in MEASURES:
        kind, interval = measure["path"], measure["interval"]
        for path, names in _places(results, kind):
            parent, _, field = path.rpartition(".")
            part, name = at(results, parent), names[0] if names else ""
            value = getattr(part, field, None)
            unclear = isinstance(part, Clock) and not part.determinable
            unclear |= isinstance(part, HeadingError) and part.drifts
            twice = kind == _REJECTED and name not in (level, "down")
            twice |= kind.startswith("aids.") and name in own
            if unclear or twice or not isinstance(value, int | float):
                continue
            words = (AIDS[each].label if each in AIDS else each for each in names)
            found[path] = Number(
                ", ".join((measure["label"], *words)),
                measure["unit"],
                float(value),
                getattr(part, interval) if interval else None,
            )
    return found


def _places(
    results: ComparisonResults | AidsResults, kind: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every path of a kind in the results, and the names that stand for its ``*``."""
    head, several, tail = kind.partition(".*")
    if not several:
        yield kind, ()
    for name in (at(results, head) or ()) if several else ():
        for path, names in _places(results, f"{head}.{name}{tail}"):
            yield path, (name, *names)
