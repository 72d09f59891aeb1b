"""What a loop shows: false closures, drift beyond what was stated, and what was assumed."""

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Finding, Found, error, info, warning
from px4fuse.loop.model import LANDING, Closure, Loop
from px4fuse.trajectory.graph.covariance import GATE_ALPHA

MOST = 0.5  # of several closures more are true than false
EVIDENCE = ("time_1_s", "time_2_s", "distance_m", "d2", "degrees_of_freedom", "p")
DOUBTFUL_WEIGHT = 0.5  # GNC ends at 0 or 1 (Yang et al. 2020)


def detect(analysis: Analysis) -> Found:
    """What the loop of a flight shows, where it holds one."""
    if isinstance(analysis.loop, Loop):
        yield from find_in(analysis.loop)


def find_in(loop: Loop) -> Found:
    """What a loop shows."""
    yield from closures(loop)
    yield from assumptions(loop)


def closures(loop: Loop) -> Found:
    """Closures that the drift cannot explain, or that the others contradict."""
    weights = [1.0 if c.weight_gnc is None else c.weight_gnc for c in loop.closures]
    dropped = sum(weight < DOUBTFUL_WEIGHT for weight in weights)
    most = dropped > MOST * len(weights)
    if most:
        yield warning(
            "loop_drift_understated",
            f"Robust solving drops {dropped} of {len(weights)} closures",
            ": more likely the odometry drifts more than stated than that most closures are false.",
            "Give a larger --drift or --heading-drift.",
            {"dropped": dropped, "closures": len(weights)},
        )
    for closure, weight in zip(loop.closures, weights, strict=True):
        if not closure.accepted:
            yield _false(closure, loop.end_assumed)
        elif weight < DOUBTFUL_WEIGHT and not most:
            yield warning(
                "loop_closure_doubtful",
                f"The other closures contradict {closure}",
                ": robust solving drops it, although the drift alone could explain it.",
                "Leave it out, or take the robust solution (GNC).",
                _evidence(closure) | {"gnc_weight": weight},
            )


def assumptions(loop: Loop) -> Found:
    """The track does not drift, or nobody said where the vehicle landed."""
    gap_m = loop.closure_error_m
    evidence = {} if gap_m is None else {"closure_error_m": gap_m}
    if loop.absolute:
        yield warning(
            "loop_of_absolute_track",
            "This track follows a positioning system and does not drift",
            ": its closure error is the noise of one position, and to spread it over the path "
            "makes the path worse.",
            "Measure the loop on odometry: send visual-inertial odometry to PX4 as ODOMETRY.",
            evidence,
        )
    if evidence and loop.end_assumed:
        yield info(
            "loop_end_assumed",
            "It is assumed that the vehicle landed where it took off",
            ": if it did not, the distance between the two is counted as closure error.",
            "Measure where it landed and give --landed-at FORWARD,RIGHT (m, along its nose at "
            "take-off and to the right of it).",
            evidence,
        )


def _false(closure: Closure, assumed: bool) -> Finding:
    what, remedy = f"{closure} cannot be true", "Leave it out; it is not used."
    if closure.source == LANDING:
        remedy = (
            "If it landed elsewhere, measure where (--landed-at FORWARD,RIGHT) or leave the "
            "landing out (--open)."
        )
        if assumed:
            what = "the vehicle cannot have landed where it took off, as was assumed"
    return error(
        "false_loop_closure",
        "False loop closure",
        f": {what}. The odometry misses it by {closure.distance_m:.2f} m, and drift explains that "
        f"with a chance of {closure.p:.1g} (d² {closure.d2:.0f}, {closure.degrees_of_freedom} "
        "degrees of freedom). Trusting it would warp the entire path.",
        f"{remedy} If the odometry really drifts that much, say so with --drift and "
        "--heading-drift.",
        _evidence(closure),
    )


def _evidence(closure: Closure) -> dict[str, float]:
    return {**{name: getattr(closure, name) for name in EVIDENCE}, "alpha": GATE_ALPHA}
