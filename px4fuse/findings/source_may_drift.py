"""A source that may drift, and neither truth nor anything else that judges its error."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.errors_larger_than_claimed import hidden_errors
from px4fuse.findings.model import Found, info
from px4fuse.loop.loop import Loop


def detect(analysis: Analysis) -> Found:
    """Told with what it scatters by, and what its loop shows."""
    name, tuned, loop = analysis.source.name, analysis.tuning.get(HORIZONTAL), analysis.loop
    if not analysis.source.origin.may_drift or hidden_errors(analysis):
        return
    evidence: dict[str, float | str] = {"source": name}
    more = ""
    if isinstance(tuned, AxisTuning) and (noise := tuned.sigma_z.value or tuned.sigma_z.high):
        bound = "at most " if tuned.sigma_z.value is None else ""
        evidence |= {"short_term_noise_m": noise}
        more = f" Over a second or so it scatters by {bound}{noise:.2g} m, which is not its error."
    if isinstance(loop, Loop) and (gap_m := loop.closure_error_m) is not None:
        evidence |= {"closure_error_m": gap_m, "path_length_m": loop.path_length_m}
        more += f" Its loop misses by {gap_m:.2f} m after {loop.path_length_m:.0f} m."
    yield info(
        "source_may_drift",
        f"Consistency with {name} is not correctness",
        ": it comes with a heading of its own, as odometry (VIO, SLAM) does, and odometry drifts. "
        "Innovations say how well a filter follows its source, not where the vehicle was."
        f"{more}",
        "Judge it by a loop (px4fuse loop LOG) or by a truth (ATT_POS_MOCAP). Only if it is motion "
        "capture, which does not drift, do its innovations tell its noise.",
        evidence,
    )
