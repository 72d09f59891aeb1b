"""Loop closures: those that are false, or doubtful, and what a closure error rests on."""

from __future__ import annotations

from collections.abc import Iterator

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Finding, Threshold
from px4fuse.loop.loop import Judged, Loop
from px4fuse.trajectory.graph.analysis import GATE_ALPHA

MOST = Threshold(0.5, "share", "of several closures, more are true than false")
DOUBTFUL_WEIGHT = Threshold(0.5, "weight", "GNC ends at 0 or 1 (Yang et al. 2020)")


def loop_closures(analysis: Analysis) -> Iterator[Finding]:
    """Findings about the loop of a flight that holds one."""
    if isinstance(analysis.loop, Loop):
        yield from find_in_loop(analysis.loop)


def find_in_loop(loop: Loop) -> Iterator[Finding]:
    """Closures that the drift cannot explain, that the others contradict, and assumptions."""
    dropped = [j for j in loop.closures if j.weights.get("gnc", 1.0) < DOUBTFUL_WEIGHT.value]
    most = len(dropped) > MOST.value * len(loop.closures)
    if most:
        yield Finding(
            "loop_drift_understated",
            "warning",
            f"Robust solving drops {len(dropped)} of {len(loop.closures)} closures: more likely "
            "the odometry drifts more than stated than that most closures are false.",
            "Give a larger --drift or --heading-drift.",
            {"dropped": float(len(dropped)), "closures": float(len(loop.closures))},
        )
    for judged in loop.closures:
        if not judged.gate.accepted:
            yield _false(judged, loop.end_assumed)
        elif judged in dropped and not most:
            yield Finding(
                "loop_closure_doubtful",
                "warning",
                f"The other closures contradict {judged.closure}: robust solving drops it, "
                "although the drift alone could explain it.",
                "Leave it out, or take the robust solution (GNC).",
                _evidence(judged) | {"gnc_weight": judged.weights["gnc"]},
            )
    if loop.absolute:
        yield Finding(
            "loop_of_absolute_track",
            "warning",
            "This track follows a positioning system and does not drift: its closure error is the "
            "noise of one position, and to spread it over the path makes the path worse.",
            "Measure the loop on odometry: send visual-inertial odometry to PX4 as ODOMETRY.",
            {} if loop.closure_error_m is None else {"closure_error_m": loop.closure_error_m},
        )
    if loop.closure_error_m is not None and loop.end_assumed:
        yield Finding(
            "loop_end_assumed",
            "info",
            "That the vehicle landed where it took off is assumed: every centimetre that it did "
            "not is counted as closure error.",
            "Measure where it landed and give --landed-at FORWARD,RIGHT (m, along its nose at "
            "take-off and to the right of it).",
            {"closure_error_m": loop.closure_error_m},
        )


def _false(judged: Judged, assumed: bool) -> Finding:
    gate = judged.gate
    landing = judged.closure.source == "landing"
    remedy = "Leave it out; it is not used."
    if landing:
        remedy = (
            "If it landed elsewhere, measure where (--landed-at FORWARD,RIGHT) or leave the "
            "landing out (--open)."
        )
    what = f"{judged.closure} cannot be true"
    if landing and assumed:
        what = "the vehicle cannot have landed where it took off, as was assumed"
    return Finding(
        "false_loop_closure",
        "error",
        f"False loop closure: {what}. The odometry misses it by {judged.distance_m:.2f} m, and "
        f"drift explains that with a chance of {gate.p:.1g} (d² {gate.d2:.0f}, "
        f"{gate.degrees_of_freedom} degrees of freedom). Trusting it would warp the entire path.",
        f"{remedy} If the odometry really drifts that much, say so with --drift and "
        "--heading-drift.",
        _evidence(judged),
    )


def _evidence(judged: Judged) -> dict[str, float | str]:
    return {
        "time_1_s": judged.closure.time_1_s,
        "time_2_s": judged.closure.time_2_s,
        "distance_m": judged.distance_m,
        "d2": judged.gate.d2,
        "degrees_of_freedom": float(judged.gate.degrees_of_freedom),
        "p": judged.gate.p,
        "alpha": GATE_ALPHA,
    }
