"""Numbers that ``px4fuse diff`` compares, as listed in ``measures.csv``, with 95 % intervals.

A path consists of the keys that lead to a value in the results, joined by dots. In a pattern, ``*``
replaces the name of an axis, a tuning result or an aiding source.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from px4fuse.batch.rows import read_rows, value_at
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.signals import AISLE
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.results.contract import AidsResults, ComparisonResults, Interval

FILTER_LABELS = {"kf": "KF", "ekf2": "EKF2"}
# Columns of measures.csv: pattern of the path, label, unit ("share": fraction from 0 to 1), and
# field with the 95 % interval (empty if the results contain none). FILTER represents KF and EKF2
MEASURES = [
    row
    | {key: row[key].replace("FILTER", text) for key, text in (("path", name), ("label", label))}
    for row in read_rows("measures.csv")
    for name, label in (FILTER_LABELS.items() if "FILTER" in row["path"] else [("", "")])
]
# Minimum relative difference of two numbers that px4fuse diff lists
RELATIVE_TOLERANCE = 0.01
# Minimum difference of two numbers, in their unit, that px4fuse diff lists
ABSOLUTE_TOLERANCE = 0.001


@dataclass(frozen=True)
class ComparedNumber:
    """Value in the results with its label, unit, and 95 % interval if the results contain one."""

    label: str
    unit: str
    value: float
    interval: Interval | None = None


def collect_numbers(results: ComparisonResults | AidsResults) -> dict[str, ComparedNumber]:
    """Return the numbers of MEASURES by path, except estimates that are not determinable."""
    axes = {} if isinstance(results, AidsResults) else results.axes
    # EKF2 rejects north and east together, so px4fuse diff lists the rejections of one axis only
    horizontal_axis = next((name for name in ("north", "east", AISLE) if name in axes), "")
    # the numbers of the aiding source that is the position source are in the axes already
    source_aids: tuple[str, ...] = ("ev_pos", "ev_hgt") if axes else ()
    if value_at(results, "source.kind") == "gnss":
        source_aids = ("gnss_pos",)
    numbers_by_path: dict[str, ComparedNumber] = {}
    for measure in MEASURES:
        pattern, interval_field = measure["path"], measure["interval"]
        for path, names in _matching_paths(results, pattern):
            parent, _, field = path.rpartition(".")
            record, first_name = value_at(results, parent), names[0] if names else ""
            value = getattr(record, field, None)
            is_undetermined = isinstance(record, ClockOffset) and not record.is_determinable
            is_undetermined |= isinstance(record, HeadingError) and record.drifts
            is_duplicate = pattern.startswith("aids.") and first_name in source_aids
            if pattern == "axes.*.rejected_fraction":
                is_duplicate = first_name not in (horizontal_axis, "down")
            if is_undetermined or is_duplicate or not isinstance(value, int | float):
                continue
            labels = (AIDS[name].label if name in AIDS else name for name in names)
            numbers_by_path[path] = ComparedNumber(
                ", ".join((measure["label"], *labels)),
                measure["unit"],
                float(value),
                getattr(record, interval_field) if interval_field else None,
            )
    return numbers_by_path


def _matching_paths(
    results: ComparisonResults | AidsResults, pattern: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each path in the results that matches a pattern, with the names in place of ``*``."""
    head, has_wildcard, tail = pattern.partition(".*")
    if not has_wildcard:
        yield pattern, ()
    for name in (value_at(results, head) or ()) if has_wildcard else ():
        for path, names in _matching_paths(results, f"{head}.{name}{tail}"):
            yield path, (name, *names)
