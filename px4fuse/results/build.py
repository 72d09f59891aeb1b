"""The results contract: one JSON object per report, documented by its JSON Schema.

The schema is ``results.schema.json`` beside this file. Names carry units. What could not be
computed is absent, or an object ``{"unavailable": {"what", "reason", "remedy"}}``, never zero.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib import metadata
from importlib.resources import files
from typing import Any

import msgspec

from px4fuse.analysis import Analysis
from px4fuse.comparison.budget import Budget, Effect
from px4fuse.comparison.comparison import AgainstTruth, AxisComparison, Comparison, FilterSummary
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.tuning import AxisTuning, Noise
from px4fuse.findings import Finding
from px4fuse.flight import Unavailable, sample_rate
from px4fuse.loop.loop import Loop
from px4fuse.plain import present, unavailable
from px4fuse.request import ComparisonRequest, LoopRequest
from px4fuse.results.model import Student
from px4fuse.results.trajectories import (
    evaluation_part,
    graph_part,
    loop_part,
    trajectory_part,
)
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import SolvedGraph

SCHEMA_NAME = "px4fuse-results"
SCHEMA_VERSION = "1.2"
# The libraries on whose arithmetic the numbers rest
LIBRARIES = ("numpy", "scipy", "pandas", "pyulog", "pymavlink", "filterpy", "matplotlib", "pypdf")


def schema() -> dict[str, Any]:
    """JSON Schema of the results object."""
    text = files("px4fuse.results").joinpath("results.schema.json").read_text(encoding="utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded


def to_json(results: dict[str, Any]) -> str:
    """Text of a results object: stable order, no NaN, one trailing newline."""
    return json.dumps(results, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def results(
    request: ComparisonRequest,
    analysis: Analysis,
    findings: tuple[Finding, ...],
    student: Student,
    command: str,
) -> dict[str, Any]:
    """Everything that the report says, as plain data.

    Returns
    -------
    dict
        Valid under :func:`schema`.
    """
    comparison = analysis.comparison
    return {
        "schema": {"name": SCHEMA_NAME, "version": SCHEMA_VERSION},
        "request": msgspec.to_builtins(request.recorded()),
        "log": _log(comparison),
        "position_source": _source(comparison),
        "settings": _settings(comparison),
        "axes": {axis.axis.name: _axis(axis) for axis in comparison.axes},
        "horizontal": {
            name: asdict(joint)
            for name, joint in (
                ("kf", comparison.horizontal_kf),
                ("ekf2", comparison.horizontal_ekf2),
            )
            if joint is not None
        },
        "tuning": {name: _tuned(found) for name, found in analysis.tuning.items()},
        "clock": _clock(analysis.clock, comparison.settings.clock_offset_s),
        "budget": {name: _budget(found) for name, found in analysis.budget.items()},
        "loop": loop_part(analysis.loop),
        "findings": [_finding(finding) for finding in findings],
        "notes": list(comparison.notes),
        "missing": [asdict(part) for part in comparison.missing],
        "student": msgspec.structs.asdict(student),
        "provenance": provenance(command),
    }


def tuning_results(
    request: ComparisonRequest,
    comparison: Comparison,
    tuned: Mapping[str, AxisTuning | Unavailable],
    command: str,
) -> dict[str, Any]:
    """What ``px4fuse tune`` found, as plain data."""
    found = {name: _tuned(axis) for name, axis in tuned.items()}
    return _of_command("px4fuse-tuning", request, comparison, command, {"tuning": found})


def sync_results(
    request: ComparisonRequest,
    comparison: Comparison,
    clock: ClockOffset | Unavailable,
    command: str,
) -> dict[str, Any]:
    """What ``px4fuse sync`` found, as plain data."""
    found = _clock(clock, comparison.settings.clock_offset_s)
    return _of_command("px4fuse-sync", request, comparison, command, {"clock": found})


def loop_results(
    request: LoopRequest, loop: Loop, findings: tuple[Finding, ...], student: Student, command: str
) -> dict[str, Any]:
    """What ``px4fuse loop`` found, as plain data."""
    return {
        "schema": {"name": "px4fuse-loop", "version": "1.0"},
        "request": msgspec.to_builtins(request.recorded()),
        "track": trajectory_part(loop.odometry.trajectory),
        "references": [trajectory_part(reference) for reference in loop.references],
        "loop": loop_part(loop),
        "findings": [_finding(finding) for finding in findings],
        "student": msgspec.structs.asdict(student),
        "provenance": provenance(command),
    }


def graph_results(name: str, solved: SolvedGraph, command: str) -> dict[str, Any]:
    """What ``px4fuse loop`` found about a pose graph from a file, as plain data."""
    return {
        "schema": {"name": "px4fuse-graph", "version": "1.0"},
        "graph": graph_part(name, solved),
        "provenance": provenance(command),
    }


def evaluation_results(score: Evaluation, command: str) -> dict[str, Any]:
    """What ``px4fuse evaluate`` found, as plain data."""
    return {
        "schema": {"name": "px4fuse-evaluation", "version": "1.0"},
        "estimate": trajectory_part(score.estimate),
        "reference": trajectory_part(score.reference),
        **evaluation_part(score),
        "provenance": provenance(command),
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "id": finding.id,
        "severity": finding.severity,
        "message": finding.message,
        "evidence": finding.evidence,
        "remedy": finding.remedy,
    }


def _of_command(
    schema_name: str,
    request: ComparisonRequest,
    comparison: Comparison,
    command: str,
    found: dict[str, Any],
) -> dict[str, Any]:
    """What a command found, with what it was found from."""
    return {
        "schema": {"name": schema_name, "version": "1.0"},
        "request": msgspec.to_builtins(request.recorded()),
        "log": _log(comparison),
        "position_source": _source(comparison),
        "settings": _settings(comparison),
        **found,
        "provenance": provenance(command),
    }


def _clock(clock: ClockOffset | Unavailable, applied_s: float) -> dict[str, Any]:
    """Offsets count from the source's own stamps, what was applied already included."""
    if isinstance(clock, Unavailable):
        return unavailable(clock)
    low, high = clock.interval_s
    return present(
        {
            "offset_s": applied_s + clock.offset_s,
            "interval_s": [applied_s + low, applied_s + high],
            "sigma_s": clock.sigma_s,
            "determinable": clock.determinable,
            "reason": clock.reason or None,
            "applied_s": applied_s,
            "drift_ppm": clock.drift_ppm,
            "drift_sigma_ppm": clock.drift_sigma_ppm,
            "change_p": clock.change_p,
            "parts": [
                asdict(replace(part, offset_s=applied_s + part.offset_s)) for part in clock.parts
            ],
            "sigma_a_m_s2": clock.sigma_a_m_s2,
            "sigma_z_m": clock.sigma_z_m,
            "count": clock.count,
            "heading_error_deg": clock.heading_error_deg,
            "heading_sigma_deg": clock.heading_sigma_deg
            if math.isfinite(clock.heading_sigma_deg)
            else None,
        }
    )


def _tuned(found: AxisTuning | Unavailable) -> dict[str, Any]:
    if isinstance(found, Unavailable):
        return unavailable(found)
    held = found.held_out
    return present(
        {
            **_noise("sigma_a_m_s2", found.sigma_a),
            **_noise("sigma_z_m", found.sigma_z),
            "count": found.count,
            "outliers": len(found.outlier_time_s),
            "gain_nats": found.gain_nats,
            "before": _statement(found.before),
            "after": _statement(found.after),
            "held_out": unavailable(held) if isinstance(held, Unavailable) else asdict(held),
            "als_sigma_a_m_s2": found.als_sigma_a_m_s2,
            "als_sigma_z_m": found.als_sigma_z_m,
        }
    )


def _budget(found: Budget | Unavailable) -> dict[str, Any]:
    if isinstance(found, Unavailable):
        return unavailable(found)
    truth = found.truth
    return {
        "count": found.count,
        **present(asdict(found.baseline)),
        "causes": {
            name.replace(" ", "_"): _effect(effect) for name, effect in found.causes.items()
        },
        "together": _effect(found.together),
        "clock": _effect(found.clock),
        "truth": unavailable(truth)
        if isinstance(truth, Unavailable)
        else present(asdict(truth) | {"reasons": list(truth.reasons)}),
    }


def _effect(effect: Effect | Unavailable) -> dict[str, Any]:
    if isinstance(effect, Unavailable):
        return unavailable(effect)
    without = effect.without
    return {
        "made": effect.made,
        **present(asdict(effect.alone)),
        "position_share": effect.position_share,
        "velocity_share": effect.velocity_share,
        **(
            {}
            if without is None
            else {f"without_{name}": value for name, value in present(asdict(without)).items()}
        ),
    }


def _noise(name: str, noise: Noise) -> dict[str, Any]:
    """Value and interval, or a bound where there is only that; an open lower end is 0."""
    if noise.value is None:
        return present({f"{name}_upper_bound": noise.high, f"{name}_lower_bound": noise.low})
    if noise.high is None:
        return {name: noise.value}
    return {name: noise.value, f"{name}_interval": [noise.low or 0.0, noise.high]}


def _statement(statement: Consistency | Unavailable) -> dict[str, Any]:
    return asdict(statement) if isinstance(statement, Consistency) else unavailable(statement)


def provenance(command: str) -> dict[str, Any]:
    """Versions and the command line; nothing else of the machine is recorded."""
    return {
        "px4fuse": metadata.version("px4fuse"),
        "python": platform.python_version(),
        "libraries": {name: metadata.version(name) for name in LIBRARIES},
        "command": command,
    }


def _log(comparison: Comparison) -> dict[str, Any]:
    log = comparison.flight.log
    return {
        "name": log.name,
        "sha256": log.sha256,
        "size_bytes": log.size_bytes,
        "format": log.format,
        "firmware": log.firmware,
        "firmware_hash": log.firmware_hash,
        "hardware": log.hardware,
        "boot_time_s": log.boot_time_s,
        "duration_s": log.duration_s,
        "dropouts": [asdict(dropout) for dropout in log.dropouts],
        "parameters": dict(log.parameters),
        "notes": list(log.notes),
        "autopilot": log.autopilot,
        **present({"start_unix_s": log.start_unix_s}),
        "joined": [asdict(file) for file in comparison.flight.inputs],
        "clocks": [present(asdict(clock)) for clock in comparison.flight.clocks],
    }


def _source(comparison: Comparison) -> dict[str, Any]:
    source = comparison.source
    looked_for = [m for m in comparison.missing if m.what.startswith("position source ")]
    return {
        "name": source.name,
        "rung": source.rung,
        "description": source.description,
        "reason": comparison.source_reason,
        "rate_hz": source.rate_hz,
        "frame": source.frame,
        "clock": source.clock,
        "reconstructed": source.reconstructed,
        "topics": list(source.topics),
        "available": [
            present(
                {
                    "name": track.name,
                    "rung": track.rung,
                    "samples": len(track.samples),
                    "rate_hz": track.rate_hz,
                }
            )
            for track in comparison.flight.positions
        ],
        "not_in_log": [asdict(part) for part in looked_for],
        **present(
            {
                "log": source.log,
                "alignment": present(asdict(source.alignment)) if source.alignment else None,
            }
        ),
    }


def _settings(comparison: Comparison) -> dict[str, Any]:
    settings = comparison.settings
    alignment = comparison.source.alignment
    placed_s = 0.0 if alignment is None else alignment.clock_offset_s
    return {
        "sigma_a_m_s2": settings.sigma_a_m_s2,
        "sigma_z_m": settings.sigma_z_m,
        "dt_s": settings.dt_s,
        "input": settings.input,
        "start_s": comparison.segment.start_s,
        "end_s": comparison.segment.end_s,
        "segment_reason": comparison.segment.reason,
        "clock_offset_s": settings.clock_offset_s + placed_s,
    }


def _axis(result: AxisComparison) -> dict[str, Any]:
    updates = result.replay.updates
    asked = result.noise_asked
    return present(
        {
            "heading_deg": result.axis.heading_deg,
            "direction": [float(part) for part in result.axis.direction],
            "note": result.axis.note,
            "updates": present(
                {
                    "count": len(updates),
                    "first_s": float(updates.index[0]),
                    "last_s": float(updates.index[-1]),
                    "rate_hz": sample_rate(updates) if len(updates) > 1 else None,
                    "input_gap_s": result.replay.input_gap_s,
                    "noise_asked": asdict(asked) if asked is not None else None,
                }
            ),
            "kf": _filter(result.kf),
            "ekf2": _filter(result.ekf2),
            "difference": unavailable(result.difference)
            if isinstance(result.difference, Unavailable)
            else asdict(result.difference),
            "truth": _truth(result),
        }
    )


def _filter(summary: FilterSummary | Unavailable) -> dict[str, Any]:
    if isinstance(summary, Unavailable):
        return unavailable(summary)
    sigmas = asdict(summary)
    del sigmas["consistency"]
    return _statement(summary.consistency) | present(sigmas)


def _truth(result: AxisComparison) -> dict[str, Any]:
    if isinstance(result.truth, Unavailable):
        return unavailable(result.truth)
    values: dict[str, Any] = {}
    for name, part in (("kf", result.kf_truth), ("ekf2", result.ekf2_truth)):
        if isinstance(part, AgainstTruth):
            values |= {f"{name}_{key}": value for key, value in asdict(part).items()}
    return present(values)
