"""Faults of loop closures: contradictions to odometry, and wrong assumptions about the loop."""

from px4fuse.analysis import Analysis
from px4fuse.finding import Finding
from px4fuse.loop.model import LANDING_CLOSURE_SOURCE, Loop, LoopClosure
from px4fuse.trajectory.graph.covariance import GATE_ALPHA

from .model import Findings, make_error, make_note, make_warning

# Maximum fraction of rejected loop closures if the stated odometry drift is correct
MAX_REJECTED_CLOSURE_FRACTION = 0.5
CLOSURE_FIELDS = ("time_1_s", "time_2_s", "distance_m", "d2", "degrees_of_freedom", "p")
# Minimum weight of an accepted loop closure: GNC weights end near 0 or 1 (Yang et al. 2020)
MIN_GNC_WEIGHT = 0.5


def detect(analysis: Analysis) -> Findings:
    if (loop := find_usable_loop(analysis)) is not None:
        yield from detect_loop_faults(loop)


def find_usable_loop(analysis: Analysis) -> Loop | None:
    """Return the loop of the flight, or None if axes, unit or orientation of the poses are wrong.

    With such poses, for example with a wrong heading, a loop closure would deform the path.
    """
    faults = analysis.convention_faults
    if faults.orientation or faults.has_wrong_axes or faults.has_wrong_unit or faults.is_ambiguous:
        return None
    return analysis.loop if isinstance(analysis.loop, Loop) else None


def detect_loop_faults(loop: Loop) -> Findings:
    """Detect false loop closures and wrong assumptions about a loop."""
    yield from detect_inconsistent_closures(loop)
    closure_error_m = loop.closure_error_m
    evidence = {} if closure_error_m is None else {"closure_error_m": closure_error_m}
    if loop.is_absolute_track:
        yield make_warning(
            "loop_on_absolute_positions",
            "This track consists of absolute positions, which do not drift. The closure error is "
            "position noise, so a correction makes the path worse.",
            "Loop closures need odometry: send visual-inertial odometry to PX4 as ODOMETRY.",
            evidence,
        )
    if evidence and loop.is_landing_place_assumed:
        yield make_note(
            "loop_landing_assumed",
            "The landing place is unknown, so px4fuse assumes the take-off place. The loop closure "
            "error contains the distance between both places.",
            "Measure the landing place. Run px4fuse loop --landed-at FORWARD,RIGHT (m, forward and "
            "right of the vehicle at take-off).",
            evidence,
        )


def detect_inconsistent_closures(loop: Loop) -> Findings:
    """Detect loop closures that contradict the odometry drift or other loop closures."""
    weights = [1.0 if item.weight_gnc is None else item.weight_gnc for item in loop.closures]
    rejected_count = sum(weight < MIN_GNC_WEIGHT for weight in weights)
    are_most_closures_rejected = rejected_count > MAX_REJECTED_CLOSURE_FRACTION * len(weights)
    if are_most_closures_rejected:
        yield make_warning(
            "loop_drift_too_small",
            f"Robust optimisation rejects {rejected_count} of {len(weights)} loop closures. The "
            "stated odometry drift is probably too small.",
            "Increase the stated drift (--drift or --heading-drift).",
            {"dropped": rejected_count, "closures": len(weights)},
        )
    for closure, weight in zip(loop.closures, weights, strict=True):
        if not closure.accepted:
            yield _make_false_closure_finding(closure, loop.is_landing_place_assumed)
        elif weight < MIN_GNC_WEIGHT and not are_most_closures_rejected:
            yield make_warning(
                "loop_closure_inconsistent",
                f"{closure!s} contradicts the other loop closures, so robust "
                "optimisation rejects it.",
                "Remove the rejected loop closure, or use the path from robust optimisation (GNC).",
                _make_closure_evidence(closure) | {"gnc_weight": weight},
            )


def _make_false_closure_finding(closure: LoopClosure, is_landing_place_assumed: bool) -> Finding:
    """Make the finding on a loop closure that the χ² test rejects."""
    is_landing = closure.source == LANDING_CLOSURE_SOURCE
    closure_text = str(closure)
    if is_landing and is_landing_place_assumed:
        closure_text = "the landing place is not the take-off place"
    action = "Remove this loop closure. In this run, px4fuse already ignores it."
    if is_landing:
        action = (
            "If the vehicle landed elsewhere, state the place (px4fuse loop --landed-at "
            "FORWARD,RIGHT) or ignore the landing (px4fuse loop --open)."
        )
    return make_error(
        "false_loop_closure",
        f"False loop closure: {closure_text}. The stated odometry drift does not explain the "
        f"closure error of {closure.distance_m:.2f} m (squared Mahalanobis distance "
        f"{closure.d2:.0f}, {closure.degrees_of_freedom} degrees of freedom, p {closure.p:.1g}).",
        f"{action} If the odometry drifts more than stated, increase --drift and --heading-drift.",
        _make_closure_evidence(closure),
    )


def _make_closure_evidence(closure: LoopClosure) -> dict[str, float]:
    return {**{name: getattr(closure, name) for name in CLOSURE_FIELDS}, "alpha": GATE_ALPHA}
