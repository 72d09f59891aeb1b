"""Loop closures that the drift cannot explain, or that the others contradict."""

from __future__ import annotations

from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.loop.loop import Loop
from px4fuse.loop.model import LANDING, Closure
from px4fuse.trajectory.graph.analysis import GATE_ALPHA

MOST = Threshold(0.5, "share", "of several closures, more are true than false")
DOUBTFUL_WEIGHT = Threshold(0.5, "weight", "GNC ends at 0 or 1 (Yang et al. 2020)")


def _detect(loop: Loop) -> Found:
    weighed = [c for c in loop.closures if c.weight_gnc is not None]
    dropped = [c for c in weighed if (c.weight_gnc or 0.0) < DOUBTFUL_WEIGHT.value]
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
    for closure in loop.closures:
        if not closure.accepted:
            yield _false(closure, loop.end_assumed)
        elif closure in dropped and not most:
            yield Finding(
                "loop_closure_doubtful",
                "warning",
                f"The other closures contradict {closure}: robust solving drops it, "
                "although the drift alone could explain it.",
                "Leave it out, or take the robust solution (GNC).",
                _evidence(closure) | {"gnc_weight": closure.weight_gnc or 0.0},
            )


def _false(closure: Closure, assumed: bool) -> Finding:
    landing = closure.source == LANDING
    remedy = "Leave it out; it is not used."
    if landing:
        remedy = (
            "If it landed elsewhere, measure where (--landed-at FORWARD,RIGHT) or leave the "
            "landing out (--open)."
        )
    what = f"{closure} cannot be true"
    if landing and assumed:
        what = "the vehicle cannot have landed where it took off, as was assumed"
    return Finding(
        "false_loop_closure",
        "error",
        f"False loop closure: {what}. The odometry misses it by {closure.distance_m:.2f} m, and "
        f"drift explains that with a chance of {closure.p:.1g} (d² {closure.d2:.0f}, "
        f"{closure.degrees_of_freedom} degrees of freedom). Trusting it would warp the entire "
        "path.",
        f"{remedy} If the odometry really drifts that much, say so with --drift and "
        "--heading-drift.",
        _evidence(closure),
    )


def _evidence(closure: Closure) -> dict[str, float | str]:
    return {
        "time_1_s": closure.time_1_s,
        "time_2_s": closure.time_2_s,
        "distance_m": closure.distance_m,
        "d2": closure.d2,
        "degrees_of_freedom": float(closure.degrees_of_freedom),
        "p": closure.p,
        "alpha": GATE_ALPHA,
    }


DETECTOR = Detector(
    _detect,
    {
        "false_loop_closure": tuple(
            f"--kind loop --mistake open-end={metres}m" for metres in (3, 4, 5, 8)
        )
    },
    names={
        "false_loop_closure": "a loop that does not end where it began",
        "loop_closure_doubtful": "a closure that the others contradict",
        "loop_drift_understated": "odometry that drifts more than was stated",
    },
)
