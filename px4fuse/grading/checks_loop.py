"""Checks of a loop: what was measured, and what was made of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from px4fuse.grading.evidence import Evidence, absence
from px4fuse.results.model import Absent
from px4fuse.results.trajectories import Correction, Corrections, Loop, Score


def loop(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The loop was measured, and the path corrected where that is right."""
    loop = evidence.results.loop
    if not isinstance(loop, Loop) or loop.closure_error_m is None:
        why = absence(loop.known_end if isinstance(loop, Loop) else loop)
        return 0.0, f"Your report measures no loop{why}."
    if loop.absolute:
        return 0.0, (
            "Your loop is on a track that follows a positioning system and does not drift; measure "
            "it on odometry."
        )
    measured = f"You measured a closure error of {loop.closure_error_m:.3g} m"
    if loop.closures and not any(one.accepted for one in loop.closures):
        said = f"{measured} and rejected the closure as false, which leaves the path as it is"
        if evidence.names("false_loop_closure"):
            return 1.0, f"{said}."
        return 2 / 3, f"{said}; your notes should say why it cannot be true."
    share, comment = _corrected(loop.corrections, given["without_reference"])
    return (1.0 + share) / 3.0, f"{measured}{comment}"


def _corrected(corrections: Corrections, without_reference: float) -> tuple[float, str]:
    """One for a corrected path and one for an ATE below the uncorrected one."""
    tried = (
        corrections.by_distance_plain, corrections.by_distance, corrections.pose_graph_gated,
    )  # fmt: skip
    done = [one for one in tried if isinstance(one, Correction)]
    if not done:
        return 0.0, ", but the path is not corrected."
    before = _ates(corrections.uncorrected)
    pairs = [
        (before[name], ate) for one in done for name, ate in _ates(one).items() if before.get(name)
    ]
    if not pairs:
        return 1.0 + without_reference, (
            " and corrected the path, but not against a reference: with --reference its error "
            "would show."
        )
    was, now = min(pairs, key=lambda pair: pair[1] / pair[0])
    if now < was:
        return 2.0, f", and correcting the path brought its ATE from {was:.3g} m to {now:.3g} m."
    return 1.0, (
        f" and corrected the path, but its ATE is {now:.3g} m against {was:.3g} m uncorrected: "
        "explain why the correction makes it worse."
    )


def _ates(correction: Correction | Absent) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }
