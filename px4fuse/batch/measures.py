"""Numbers that ``px4fuse diff`` compares, with 95 % intervals.

``measures.csv`` lists the path of each number in the results. ``*`` in a path is any key.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from px4fuse.batch.rows import find_value, read_rows
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.signals import AISLE
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.results.contract import AidsResults, ComparisonResults, ConfidenceInterval

# Rows of measures.csv; "interval" is the field in the results that contains the 95 % interval
COMPARED_NUMBER_DEFINITIONS = [
    row
    | {
        "path": row["path"].replace("KF_OR_EKF2", name),
        "label": row["label"].replace("KF_OR_EKF2", label),
    }
    for row in read_rows("measures.csv")
    for name, label in (FILTER_NAMES.items() if "KF_OR_EKF2" in row["path"] else [("", "")])
]
# Maximum relative difference of two numbers that px4fuse diff does not list
MAX_OMITTED_RELATIVE_DIFFERENCE = 0.01
# Maximum difference of two numbers (in their unit) that px4fuse diff does not list
MAX_OMITTED_DIFFERENCE = 0.001


@dataclass(frozen=True)
class ComparedNumber:
    """Number that ``px4fuse diff`` compares, with its 95 % interval if it is an estimate."""

    label: str
    unit: str
    value: float
    interval: ConfidenceInterval | None = None


def collect_compared_numbers(results: ComparisonResults | AidsResults) -> dict[str, ComparedNumber]:
    """Return the numbers that ``px4fuse diff`` compares, by path (``clock.offset_s``)."""
    axes = {} if isinstance(results, AidsResults) else results.axes
    # EKF2 rejects north and east together, so their rejected fractions are equal: keep only one
    first_horizontal_axis = next((name for name in ("north", "east", AISLE) if name in axes), "")
    # skip the aiding source of the positions: the axes contain its numbers
    aids_of_position_source: tuple[str, ...] = ("ev_pos", "ev_hgt") if axes else ()
    if find_value(results, "source.kind") == "gnss":
        aids_of_position_source = ("gnss_pos",)
    numbers_by_path: dict[str, ComparedNumber] = {}
    for definition in COMPARED_NUMBER_DEFINITIONS:
        pattern, interval_field = definition["path"], definition["interval"]
        for path, keys in _find_matching_paths(results, pattern):
            record_path, _, field_name = path.rpartition(".")
            record, first_key = find_value(results, record_path), keys[0] if keys else ""
            value = getattr(record, field_name, None)
            is_undetermined = isinstance(record, SourceTimeOffset) and not record.is_determinable
            is_undetermined |= isinstance(record, HeadingError) and record.drifts
            is_duplicate = pattern.startswith("aids.") and first_key in aids_of_position_source
            if pattern == "axes.*.rejected_fraction":
                is_duplicate = first_key not in (first_horizontal_axis, "down")
            if is_undetermined or is_duplicate or not isinstance(value, int | float):
                continue
            labels = (AIDS[name].label if name in AIDS else name for name in keys)
            numbers_by_path[path] = ComparedNumber(
                ", ".join((definition["label"], *labels)),
                definition["unit"],
                float(value),
                getattr(record, interval_field) if interval_field else None,
            )
    return numbers_by_path


def _find_matching_paths(
    results: ComparisonResults | AidsResults, pattern: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the paths in the results that match a pattern, with the keys that replace ``*``."""
    parent, wildcard, pattern_end = pattern.partition(".*")
    if not wildcard:
        yield pattern, ()
    for key in (find_value(results, parent) or ()) if wildcard else ():
        for path, keys in _find_matching_paths(results, f"{parent}.{key}{pattern_end}"):
            yield path, (key, *keys)
