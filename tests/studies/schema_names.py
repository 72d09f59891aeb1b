"""Convert frozen states and results of schema 3 to the names of schema 4.

``schema_names.py BEFORE AFTER`` converts the frozen state BEFORE (``freeze.py``) and lists its
differences to AFTER, as ``freeze.py --compare`` does. ``schema_names.py RESULTS.json`` converts
results in place. The numbers remain; ``sigma_ratio`` is the inverse of ``sigma_factor``.
"""

from __future__ import annotations

import argparse
import gzip
import json
import re
import tempfile
from pathlib import Path
from typing import Any

from freeze import SHOWN_DIFFERENCES, compare

from px4fuse.findings.model import RENAMED_IDS
from px4fuse.results.contract import to_json
from px4fuse.results.model import SCHEMA_VERSION

# Old name: new name, or a pattern for the path of the parent with the new name
FIELDS: dict[str, str | tuple[str, str]] = {
    "absolute": "is_absolute_track",
    "brings_into_band": "is_sufficient",
    "came_back": "closed_loop",
    "change_p": "change_p_value",
    "coast": "longest_rejection",
    "denied_by_truth": "contradicts_truth",
    "determinable": "is_determinable",
    "explains": "explained_fraction",
    "filter_sigma_a_m_s2": "sigma_a_two_state_m_s2",
    "filter_sigma_a_m_s2_interval": "sigma_a_two_state_m_s2_interval",
    "fused_share": "fused_fraction",
    "fusing_share": "fused_fraction",
    "gain_nats": (r"^\.tuning\.", "log_likelihood_gain_per_measurement"),
    "headline": "title",
    "intended_share": "enabled_fraction",
    "judged_s": "evaluated_s",
    "known_end": "true_end",
    "longest_without_s": "longest_gap_s",
    "lost_share": "lost_fraction",
    "moved_max_m": "correction_max_m",
    "moved_rms_m": "correction_rms_m",
    "not_in_log": "missing",
    "of": (r"^\.causes\[", "statistic"),
    "outside_gate": "fraction_outside_gate",
    "outside_two_sigma": "fraction_outside_two_sigma",
    "passage": "path",
    "position_left_mean_square_m2": "unexplained_mean_square_m2",
    "position_rmse_m": (r"\.difference$", "position_rms_m"),
    "receipt_went_back": "receive_time_reversals",
    "rejected_share": "rejected_fraction",
    "rejected_share_logged": "rejected_fraction_logged",
    "rejected_share_replayed": "rejected_fraction_replayed",
    "sigma_factor": "sigma_ratio",
    "steady": "is_predictable",
    "story": "summary",
    "turn_deg": (r"^\.heading$|\.evidence$", "misalignment_deg"),
    "velocity_left_mean_square_m2_s2": "unexplained_velocity_mean_square_m2_s2",
    "velocity_rmse_m_s": (r"\.difference$", "velocity_rms_m_s"),
    "verdict_ours": "verdict_kf",
    "why": (r"^$", "difference_steps"),
}
VALUES = {
    "verdict": {
        "idle": "disabled",
        "starved": "not_fused",
        "variance overstated": "underconfident",
        "variance understated": "overconfident",
    },
    "severity": {"info": "note"},
    "statistic": {"apart": "difference"},
    "version": {"3.0": SCHEMA_VERSION},
}


def rename_field(name: str, parent: str) -> str:
    """Return the name in schema 4 of a field of the record at a path."""
    new = FIELDS.get(name, name)
    if isinstance(new, str):
        return new
    return new[1] if re.search(new[0], parent) else name


def convert(value: Any, path: str = "") -> Any:
    """Convert plain results, or a part of them at a path."""
    if isinstance(value, list):
        return [convert(part, f"{path}[") for part in value]
    if isinstance(value, dict):
        new = {}
        for key, part in value.items():
            name = rename_field(key, path)
            inverse = key == "sigma_factor"
            new[name] = 1.0 / part if inverse else convert(part, f"{path}.{name}")
        return new
    name = re.sub(r"\[$", "", path).rpartition(".")[2]
    if isinstance(value, str) and name in VALUES:
        return VALUES[name].get(value, value)
    if name == "path" and isinstance(value, str):  # of a number of diff
        names = value.split(".")
        for at, each in enumerate(names):
            names[at] = rename_field(each, "." + ".".join(names[:at]) if at else "")
        return ".".join(names)
    return RENAMED_IDS.get(value, value) if isinstance(value, str) else value


def words(lines: list[str]) -> list[str]:
    """Split lines into words with the new names, without folders: longer ids move line ends."""
    new = {**RENAMED_IDS, "info": "note", "info:": "note:"}
    text = [re.sub(r"/\S*/", "", word) for word in " ".join(lines).split()]
    return [re.sub(r"[a-z][a-z0-9_]*:?", lambda name: new.get(name[0], name[0]), w) for w in text]


def convert_record(record: dict[str, Any]) -> dict[str, Any]:
    """Convert the record of one case of a frozen state, without the drawing of its pages."""
    return record | {
        "terminal": words(record["terminal"]),
        "errors": words(record["errors"]),
        "results": convert(record["results"]),
        "pages": [words(page["text"]) for page in record["pages"]],
    }


def main() -> int:
    """Compare two frozen states across the renaming, or convert results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH")
    parser.add_argument("--shown", type=int, default=SHOWN_DIFFERENCES, help="lines per case")
    given = parser.parse_args()
    if given.paths[0].suffix == ".json":
        for path in given.paths:
            results = convert(json.loads(path.read_bytes()))
            path.write_text(to_json(results), encoding="utf-8")
        return 0
    before, after = given.paths
    with tempfile.TemporaryDirectory() as where:
        targets = Path(where, "before"), Path(where, "after")
        for folder, target in zip((before, after), targets, strict=True):
            target.mkdir()
            for path in folder.glob("*.json.gz"):
                record = convert_record(json.loads(gzip.decompress(path.read_bytes())))
                (target / path.name).write_bytes(gzip.compress(json.dumps(record).encode()))
        return min(compare(*targets, given.shown), 1)


if __name__ == "__main__":
    raise SystemExit(main())
