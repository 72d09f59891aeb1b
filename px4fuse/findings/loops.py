"""What a loop shows: false closures, drift beyond what was stated, and what was assumed."""

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Finding, Found, error, info, warning
from px4fuse.loop.model import LANDING, Closure, Loop
from px4fuse.trajectory.graph.covariance import GATE_ALPHA

MAX_DROPPED_SHARE = 0.5  # of several closures more are true than false
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
    most = dropped > MAX_DROPPED_SHARE * len(weights)
    if most:
        yield warning("loop_drift_understated", {"dropped": dropped, "closures": len(weights)})
    for closure, weight in zip(loop.closures, weights, strict=True):
        if not closure.accepted:
            yield _false_closure(closure, loop.is_end_assumed)
        elif weight < DOUBTFUL_WEIGHT and not most:
            evidence = _evidence(closure) | {"gnc_weight": weight}
            yield warning("loop_closure_doubtful", evidence, closure=closure)


def assumptions(loop: Loop) -> Found:
    """The track does not drift, or nobody said where the vehicle landed."""
    gap_m = loop.closure_error_m
    evidence = {} if gap_m is None else {"closure_error_m": gap_m}
    if loop.absolute:
        yield warning("loop_of_absolute_track", evidence)
    if evidence and loop.is_end_assumed:
        yield info("loop_end_assumed", evidence)


def _false_closure(closure: Closure, assumed: bool) -> Finding:
    landing = closure.source == LANDING
    what = landing and assumed
    return error(
        "false_loop_closure", _evidence(closure), closure=closure, landing=landing, what=what
    )


def _evidence(closure: Closure) -> dict[str, float]:
    return {**{name: getattr(closure, name) for name in EVIDENCE}, "alpha": GATE_ALPHA}
