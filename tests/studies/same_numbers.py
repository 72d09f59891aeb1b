"""Whether results of schema 3.0 hold the numbers that results of schema 2.0 held.

    python tests/studies/same_numbers.py OLD_FOLDER NEW_FOLDER

Both hold results as JSON under the same file names. Keys are mapped from old to new by the table
below; every number and every verdict is compared, and differences are told key by key.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TOLERANCE = 1e-9
# From keys of schema 2.0 to keys of 3.0, in this order
RENAMED = (
    (r"^position_source\b", "source"),
    (r"^log\b(.*)\bsize_bytes$", r"log\1bytes"),
    (r"^(axes\.\w+)\.(kf|ekf2)\b", r"\1.filters.\2"),
    (r"^(axes\.\w+)\.truth\.(kf|ekf2)_", r"\1.filters.\2.truth."),
    (r"^(why\.\w+)\.(kf|ekf2)_position_rmse_to_truth_m$", r"\1.position_rmse_to_truth_m.\2"),
    (r"\bsame_share$", "decisions_same"),
    (r"innovation_rms_difference_m$", "innovation_rms_difference"),
    (r"^(tuning\.\w+\.\w+)_lower_bound$", r"\1_interval.0"),
    (r"^(tuning\.\w+\.\w+)_upper_bound$", r"\1_interval.1"),
    (r"\.unavailable\.(what|reason|remedy)$", r".\1"),
)
# Words, and what two runs differ by anyhow
NOT_COMPARED = re.compile(
    r"^(schema|request|provenance|story|notes)\b|\.(message|remedy|reason|sentences|what|note)\b"
    r"|^axes\.\w+\.truth\.(what|reason|remedy)|^(source|log)\.\w*(description|note)|^missing\b"
)


def values(part: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every number, word and truth value of some results, by its path."""
    if isinstance(part, dict | list):
        pairs = part.items() if isinstance(part, dict) else enumerate(part)
        for name, below in pairs:
            yield from values(below, f"{path}.{name}" if path else str(name))
    elif part is not None:
        yield path, part


def renamed(path: str) -> str:
    """A key of schema 2.0 as schema 3.0 has it."""
    for old, new in RENAMED:
        path = re.sub(old, new, path)
    return path


def same(old: Any, new: Any) -> bool:
    """Whether two values are the same, numbers to one in a thousand million."""
    if isinstance(old, bool | str) or isinstance(new, bool | str):
        return bool(old == new)
    return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Keys of the old results whose values the new ones do not have."""
    found = dict(values(new))
    for path, value in values(old):
        if NOT_COMPARED.search(path):
            continue
        key, expected = renamed(path), value
        if path.endswith(".variance_factor") and "evidence" not in path:
            key, expected = key.replace("variance_factor", "sigma_factor"), math.sqrt(value)
        if key not in found or not same(expected, found[key]):
            yield key, expected, found.get(key)


def main(old_folder: str, new_folder: str) -> int:
    """Compare two folders; how many files differ."""
    keys: Counter[str] = Counter()
    compared, off, examples = 0, 0, {}
    for path in sorted(Path(old_folder).glob("*.json")):
        other = Path(new_folder) / path.name
        if not other.exists():
            continue
        compared += 1
        found = list(differences(*(json.loads(each.read_text()) for each in (path, other))))
        off += bool(found)
        for key, was, now in found:
            general = re.sub(r"\.\d+\b", "[]", key)
            keys[general] += 1
            examples.setdefault(general, f"{path.name}: {was} -> {now}")
    for key, count in keys.most_common():
        print(f"{count:6} {key}   {examples[key]}")
    print(f"{compared} files compared, {off} differ")
    return int(off > 0 or not compared)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
