"""Checks of a loop: what was measured, what was made of it, and whether the flight allows it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated

from msgspec import Meta
from scipy.stats import chi2

from px4fuse.grading.evidence import Evidence, RubricItem, Scored, absence, falling
from px4fuse.loop.model import Correction, LoopPart, Way
from px4fuse.plain import length_words, p_words
from px4fuse.record import Maybe, Share
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
    drift_m, drift_deg = request.position_drift_m, request.heading_drift_deg
    stated = f"--drift {drift_m:g} and --heading-drift {drift_deg:g} are"
    factor = _stated_drift(request)
    true = 0.0 if evidence.answer is None else evidence.answer.scenario.get("vio_drift") or 0.0
    if isinstance(true, float) and true > 0.0:
        off = drift_m / (100.0 * true)
        if max(off, 1.0 / off, drift_deg / USUAL_HEADING_DEG) > FAR_OFF:
            yield f"{stated} far from how the odometry of this log drifts."
    elif factor > FAR_OFF:
        yield f"{stated} up to {factor:.2g} times what odometry indoors drifts."
    chosen = at is not None or factor != 1.0
    if chosen and any(one.accepted and 1.0 - one.p < TOO_GOOD for one in loop.closures):
        yield (
            "The loop closes far better than the stated drift lets any loop close: "
            "--landed-at, --drift or --heading-drift may have been chosen for that."
        )


def _stated_drift(request: LoopRequest) -> float:
    """How many times the usual drift was stated, at most."""
    position = request.position_drift_m / USUAL_DRIFT_M
    return max(position, request.heading_drift_deg / USUAL_HEADING_DEG)


def _landed_m(evidence: Evidence) -> float | None:
    """How far from the place of take-off it landed; None where only the vehicle knows."""
    return None if evidence.answer is None else evidence.answer.truth.get("closure_error_m")


def _open_end(evidence: Evidence) -> Scored:
    """What the words "it did not come back" are worth, and why."""
    landed = _landed_m(evidence)
    if landed is not None and landed <= TAPE_M:
        return 0.0, "but your vehicle landed where it took off"
    if evidence.claims(OPEN):
        return 1.0, "as your form says"
    return 0.5, "but your form does not say that it landed elsewhere"


class LoopItem(RubricItem, frozen=True, kw_only=True, tag="loop"):
    """The loop was measured, and the path corrected where that is right; a third for each step.

    ``without_reference`` is the share of the last third where nothing tells the ATE.
    """

    without_reference: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """Thirds for measuring, for correcting, and for a path that became better by it."""
        results, loop = evidence.results, evidence.results.loop
        request = results.request if isinstance(results, LoopResults) else None
        opened = request is not None and not request.came_back
        if not isinstance(loop, LoopPart) or (loop.closure_error_m is None and not opened):
            why = absence(loop.known_end if isinstance(loop, LoopPart) else loop)
            return 0.0, f"Your report measures no loop{why}."
        if loop.absolute:
            return 0.0, (
                "Your loop is on a track that follows a positioning system and does not drift; "
                "measure it on odometry."
            )
        share, why = _open_end(evidence)
        if opened and not loop.closures:
            worth = (1.0 + 2.0 * share) / 3.0 if share else 0.0
            return worth, f"You left the end open (--open), {why}."
        measured = f"You measured a closure error of {loop.closure_error_m or 0.0:.3g} m"
        if opened:
            measured = f"You left the end open (--open) and gave {len(loop.closures)} closures"
        wrong = contradictions(evidence)
        if not wrong and loop.closures and not any(one.accepted for one in loop.closures):
            return (1.0 + 2.0 * share) / 3.0, (
                f"{measured}; the closure was rejected as false, which leaves the path as it is, "
                f"{why}."
            )
        landed = _landed_m(evidence)
        assumed = request is not None and request.landed_at is None and not opened
        if landed is not None and landed > TAPE_M and assumed:
            wrong += (
                "It did not land at the place of take-off: say where it did (--landed-at) or leave "
                "the end open (--open).",
            )
        if wrong:
            return 1 / 3, f"{measured}, but {_begun_small(wrong[0])}"
        share, comment = self._corrected(loop.corrections)
        return (1.0 + share) / 3.0, f"{measured}{comment}"

    def _corrected(self, corrections: Mapping[Way, Maybe[Correction]]) -> Scored:
        """One for a corrected path and one for an ATE below the uncorrected one."""
        ways: tuple[Way, ...] = ("by_distance_plain", "by_distance", "pose_graph_gated")
        tried = [corrections.get(way) for way in ways]
        done = [one for one in tried if isinstance(one, Correction)]
        if not done:
            return 0.0, ", but the path is not corrected."
        before = _ates(corrections.get("uncorrected"))
        pairs = [
            (was, now) for one in done for name, now in _ates(one).items()
            if (was := before.get(name))
        ]  # fmt: skip
        if not pairs:
            return 1.0 + self.without_reference, (
                " and corrected the path, but not against a reference: with --reference its error "
                "would show."
            )
        was, now = min(pairs, key=lambda pair: pair[1] / pair[0])
        if now < was:
            return 2.0, (
                f", and correcting the path brought its ATE from {was:.3g} m to {now:.3g} m."
            )
        return 1.0, (
            f" and corrected the path, but its ATE is {now:.3g} m against {was:.3g} m "
            "uncorrected: explain why the correction makes it worse."
        )


def _ates(correction: object) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }


class ClosureItem(RubricItem, frozen=True, kw_only=True, tag="closure"):
    """The closure error is one that the odometry's drift explains, or the end is rightly open.

    Attributes
    ----------
    enough_p : float
        Chance of such an error from which on there are all points.
    open_unknown : float
        Share for an end left open where no key says where it landed.
    """

    enough_p: Annotated[float, Meta(ge=0.002, le=1.0)] = 0.05
    open_unknown: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """By the chance of such an error; none where the gate rejects it."""
        results, loop = evidence.results, evidence.results.loop
        if not isinstance(loop, LoopPart) or not isinstance(results, LoopResults):
            return 0.0, f"Your report measures no loop{absence(loop)}."
        if wrong := contradictions(evidence):
            return 0.0, f"No points, since {_begun_small(wrong[0])}"
        accepted = [one for one in loop.closures if one.accepted]
        if not results.request.came_back or not accepted:
            share, why = _open_end(evidence)
            if _landed_m(evidence) is None and not loop.closures:
                share = min(share, self.open_unknown)
            return share if evidence.claims(OPEN) else 0.0, (
                f"Your loop is not closed, {why}. A closure error that drift cannot explain is no "
                "error of the odometry."
            )
        # a larger drift that was stated explains any error
        scale = max(_stated_drift(results.request), 1.0) ** 2
        p = min(float(chi2.sf(one.d2 * scale, one.degrees_of_freedom)) for one in accepted)
        off, path = length_words(loop.closure_error_m or 0.0), length_words(loop.path_length_m)
        said = f"Your closure error is {off} in {path}"
        if p >= self.enough_p:
            return 1.0, f"{said}, as odometry that drifts as usual may have ({p_words(p)})."
        share = falling(self.enough_p / p, self.enough_p / GATE_ALPHA) if p > 0.0 else 0.0
        return share, (
            f"{said}, more than the odometry's usual drift explains ({p_words(p)}); look for what "
            "made it drift, or whether it landed elsewhere."
        )


def _begun_small(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]
