"""Numbers by which ``diff`` compares two results, with their recorded 95 % intervals."""

from collections.abc import Iterator
from dataclasses import dataclass

from px4fuse.ekf2_parameters import AIDS
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.signals import AISLE
from px4fuse.filter.time_offset import Clock
from px4fuse.fleet.rows import at, read_rows
from px4fuse.results.contract import AidsResults, ComparisonResults, Interval

# Columns: path in the results (* is an axis, a tuning or an aid), label, unit ("share": 0 to 1),
# and the field with the 95 % interval (empty if none is recorded)
MEASURES = read_rows("measures.csv")
# Numbers within either tolerance are equal: computers differ in the last digits
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 0.01, 0.001
_REJECTED = "axes.*.rejected_fraction"


@dataclass(frozen=True)
class Number:
    """Number of a comparison with its 95 % interval; None if none is recorded."""

    label: str
    unit: str
    value: float
    interval: Interval | None = None


def numbers(results: ComparisonResults | AidsResults) -> dict[str, Number]:
    """Return the numbers of a comparison by their path in the results."""
    axes = {} if isinstance(results, AidsResults) else results.axes
    # one horizontal axis is enough: EKF2 rejects north and east together
    level = next((name for name in ("north", "east", AISLE) if name in axes), "")
    # the aid of the position source is skipped: the axes contain its numbers
    own: tuple[str, ...] = ("ev_pos", "ev_hgt") if axes else ()
    if at(results, "source.kind") == "gnss":
        own = ("gnss_pos",)
    numbers_by_path: dict[str, Number] = {}
    for measure in MEASURES:
        kind, interval = measure["path"], measure["interval"]
        for path, names in _places(results, kind):
            parent, _, field = path.rpartition(".")
            record, first_name = at(results, parent), names[0] if names else ""
            value = getattr(record, field, None)
            unclear = isinstance(record, Clock) and not record.is_determinable
            unclear |= isinstance(record, HeadingError) and record.drifts
            is_duplicate = kind == _REJECTED and first_name not in (level, "down")
            is_duplicate |= kind.startswith("aids.") and first_name in own
            if unclear or is_duplicate or not isinstance(value, int | float):
                continue
            labels = (AIDS[name].label if name in AIDS else name for name in names)
            numbers_by_path[path] = Number(
                ", ".join((measure["label"], *labels)),
                measure["unit"],
                float(value),
                getattr(record, interval) if interval else None,
            )
    return numbers_by_path


def _places(
    results: ComparisonResults | AidsResults, kind: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield every path that matches the pattern, with the names that replace its ``*``."""
    head, several, tail = kind.partition(".*")
    if not several:
        yield kind, ()
    for name in (at(results, head) or ()) if several else ():
        for path, names in _places(results, f"{head}.{name}{tail}"):
            yield path, (name, *names)
