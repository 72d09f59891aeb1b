"""Checks of a loop: what was measured, what was made of it, and whether the flight allows it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from scipy.stats import chi2

from px4fuse.grading.evidence import Evidence, absence
from px4fuse.loop.model import Correction, LoopPart, Way
from px4fuse.plain import length_words, p_words
from px4fuse.record import Maybe, Unavailable
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LoopResults
from px4fuse.trajectory.evaluation import Score
from px4fuse.trajectory.graph.analysis import GATE_ALPHA

OPEN = "open-end"
# A tape and a pilot's feet are not better, and an open end is not smaller
TAPE_M = 0.5
# A drift stated so many times larger or smaller than it is
FAR_OFF = 4.0
# What odometry indoors reaches, the defaults of px4fuse loop: after 100 m
USUAL_DRIFT_M, USUAL_HEADING_DEG = 1.0, 3.0
# Chance of an end that fits this well or better
TOO_GOOD = 0.001


def contradictions(evidence: Evidence) -> tuple[str, ...]:
    """Options of a loop that its log or the answer key contradict: sentences."""
    results = evidence.results
    if not isinstance(results, LoopResults):
        return ()
    return tuple(_contradictions(evidence, results.request, results.loop))


def _contradictions(evidence: Evidence, request: LoopRequest, loop: LoopPart) -> Iterator[str]:
    landed, at = _landed_m(evidence), request.landed_at
    if landed is not None and at is not None:
        said = math.hypot(at.forward_m, at.right_m)
        if abs(said - landed) > TAPE_M:
            yield (
                f"--landed-at says {length_words(said)} from the place of take-off; it landed "
                f"{length_words(landed)} from it."
            )
    if landed is not None and landed <= TAPE_M and not request.came_back:
        yield "--open says that it did not come back, but it landed where it took off."
    factor = stated_drift(request)
    true_m = None if evidence.answer is None else evidence.answer.scenario.get("vio_drift")
    if isinstance(true_m, float) and true_m > 0.0:
        off = request.position_drift_m / (100.0 * true_m)
        if max(off, 1.0 / off, request.heading_drift_deg / USUAL_HEADING_DEG) > FAR_OFF:
            yield (
                f"--drift {request.position_drift_m:g} and --heading-drift "
                f"{request.heading_drift_deg:g} are far from how the odometry of this log drifts."
            )
    elif factor > FAR_OFF:
        yield (
            f"--drift {request.position_drift_m:g} and --heading-drift "
            f"{request.heading_drift_deg:g} are up to {factor:.2g} times what odometry indoors "
            "drifts."
        )
    chosen = at is not None or factor != 1.0
    for one in loop.closures:
        if chosen and one.accepted and 1.0 - one.p < TOO_GOOD:
            yield (
                "The loop closes far better than the stated drift lets any loop close: "
                "--landed-at, --drift or --heading-drift may have been chosen for that."
            )
            break


def stated_drift(request: LoopRequest) -> float:
    """How many times the usual drift was stated, at most."""
    position = request.position_drift_m / USUAL_DRIFT_M
    heading = request.heading_drift_deg / USUAL_HEADING_DEG
    return max(position, heading)


def _landed_m(evidence: Evidence) -> float | None:
    """How far from the place of take-off it landed; None where only the vehicle knows."""
    return None if evidence.answer is None else evidence.answer.truth.get("closure_error_m")


def _open_end(evidence: Evidence) -> tuple[float, str]:
    """What the words "it did not come back" are worth, and why."""
    landed = _landed_m(evidence)
    if landed is not None and landed <= TAPE_M:
        return 0.0, "but your vehicle landed where it took off"
    if evidence.claims(OPEN):
        return 1.0, "as your form says"
    return 0.5, "but your form does not say that it landed elsewhere"


def loop(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The loop was measured, and the path corrected where that is right."""
    results, loop = evidence.results, evidence.results.loop
    opened = isinstance(results, LoopResults) and not results.request.came_back
    if not isinstance(loop, LoopPart) or (loop.closure_error_m is None and not opened):
        why = absence(loop.known_end if isinstance(loop, LoopPart) else loop)
        return 0.0, f"Your report measures no loop{why}."
    if loop.absolute:
        return 0.0, (
            "Your loop is on a track that follows a positioning system and does not drift; measure "
            "it on odometry."
        )
    if opened and not loop.closures:
        share, why = _open_end(evidence)
        return (1.0 + 2.0 * share) / 3.0 if share else 0.0, (
            f"You left the end open (--open), {why}."
        )
    measured = f"You measured a closure error of {loop.closure_error_m or 0.0:.3g} m"
    if opened:
        measured = f"You left the end open (--open) and gave {len(loop.closures)} closures"
    wrong = contradictions(evidence)
    if loop.closures and not any(one.accepted for one in loop.closures) and not wrong:
        return _rejected(evidence, measured)
    landed, request = _landed_m(evidence), getattr(results, "request", None)
    assumed = isinstance(request, LoopRequest) and request.landed_at is None and not opened
    if landed is not None and landed > TAPE_M and assumed:
        wrong += (
            "It did not land at the place of take-off: say where it did (--landed-at) or leave "
            "the end open (--open).",
        )
    if wrong:
        return 1 / 3, f"{measured}, but {wrong[0][:1].lower() + wrong[0][1:]}"
    share, comment = _corrected(loop.corrections, given["without_reference"])
    return (1.0 + share) / 3.0, f"{measured}{comment}"


def _rejected(evidence: Evidence, measured: str) -> tuple[float, str]:
    """A closure that the gate rejected, and what the notes make of it."""
    share, why = _open_end(evidence)
    said = f"{measured}; the closure was rejected as false, which leaves the path as it is"
    return (1.0 + 2.0 * share) / 3.0, f"{said}, {why}."


def closure(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The closure error is one that the odometry's drift explains, or the end is rightly open."""
    results, loop = evidence.results, evidence.results.loop
    if not isinstance(loop, LoopPart) or not isinstance(results, LoopResults):
        return 0.0, f"Your report measures no loop{absence(loop)}."
    wrong = contradictions(evidence)
    if wrong:
        return 0.0, f"No points, since {wrong[0][:1].lower() + wrong[0][1:]}"
    landing = [one for one in loop.closures if one.accepted] or list(loop.closures)
    if not results.request.came_back or not any(one.accepted for one in landing):
        known = _landed_m(evidence) is not None
        share, why = _open_end(evidence)
        share = share if known or landing else min(share, given["open_unknown"])
        return share if evidence.claims(OPEN) else 0.0, (
            f"Your loop is not closed, {why}. A closure error that drift cannot explain is no "
            "error of the odometry."
        )
    # a larger drift that was stated explains any error
    scale = max(stated_drift(results.request), 1.0) ** 2
    p = min(float(chi2.sf(one.d2 * scale, one.degrees_of_freedom)) for one in landing)
    off = loop.closure_error_m or 0.0
    said = f"Your closure error is {length_words(off)} in {length_words(loop.path_length_m)}"
    if p >= given["enough_p"]:
        return 1.0, f"{said}, as odometry that drifts as usual may have ({p_words(p)})."
    share = 0.0
    if p > GATE_ALPHA:
        share = math.log(p / GATE_ALPHA) / math.log(given["enough_p"] / GATE_ALPHA)
    return share, (
        f"{said}, more than the odometry's usual drift explains ({p_words(p)}); look for what made "
        "it drift, or whether it landed elsewhere."
    )


def _corrected(
    corrections: Mapping[Way, Maybe[Correction]], without_reference: float
) -> tuple[float, str]:
    """One for a corrected path and one for an ATE below the uncorrected one."""
    ways: tuple[Way, ...] = ("by_distance_plain", "by_distance", "pose_graph_gated")
    tried = [corrections.get(way) for way in ways]
    done = [one for one in tried if isinstance(one, Correction)]
    if not done:
        return 0.0, ", but the path is not corrected."
    before = _ates(corrections.get("uncorrected"))
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


def _ates(correction: Correction | Unavailable | None) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }
