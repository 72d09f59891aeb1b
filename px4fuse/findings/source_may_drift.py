"""A source that may drift, and neither truth nor anything else that judges its error."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.errors_larger_than_claimed import hidden_errors
from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.loop.loop import Loop


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    if not comparison.source.origin.may_drift or hidden_errors(comparison):
        return
    evidence: dict[str, float | str] = {"source": comparison.source.name}
    tuned = analysis.tuning.get(HORIZONTAL)
    scatter = ""
    if isinstance(tuned, AxisTuning) and (noise := tuned.sigma_z.value or tuned.sigma_z.high):
        bound = "at most " if tuned.sigma_z.value is None else ""
        evidence |= {"short_term_noise_m": noise}
        scatter = (
            f" Over a second or so it scatters by {bound}{noise:.2g} m, which is not its error."
        )
    loop = analysis.loop
    closed = ""
    if isinstance(loop, Loop) and loop.closure_error_m is not None:
        evidence |= {
            "closure_error_m": loop.closure_error_m,
            "path_length_m": loop.path_length_m,
        }
        closed = (
            f" Its loop misses by {loop.closure_error_m:.2f} m after {loop.path_length_m:.0f} m."
        )
    yield Finding(
        "source_may_drift",
        "info",
        f"Consistency with {comparison.source.name} is not correctness: it comes with a heading of "
        "its own, as odometry (VIO, SLAM) does, and odometry drifts. Innovations say how well a "
        f"filter follows its source, not where the vehicle was.{scatter}{closed}",
        "Judge it by a loop (px4fuse loop LOG) or by a truth (ATT_POS_MOCAP). Only if it is motion "
        "capture, which does not drift, do its innovations tell its noise.",
        evidence,
    )


DETECTOR = Detector(
    _detect,
    names={"source_may_drift": "a position source that may drift"},
)
