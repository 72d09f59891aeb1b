"""The source low-pass filters its positions before it sends them."""

from __future__ import annotations

from dataclasses import asdict

from px4fuse.analysis import Analysis
from px4fuse.filter.smoothing import Smoothing
from px4fuse.findings.model import Found, finding

GAIN_NATS = 12.0  # a likelihood ratio of 160,000; clean flights have 0 to 2
LAG_S = 0.05  # at 1 m/s half of a good UWB's noise
LAG_ERROR_S = 0.10  # at 1 m/s a good UWB's noise


def low_pass(analysis: Analysis) -> Smoothing | None:
    """The low pass in the source, None where there is none or it cannot be told."""
    source, found = analysis.source, analysis.smoothing
    # the error of odometry drifts, which makes that of successive positions agree as well; what
    # was made of EKF2's own output has EKF2's filter in it
    if source.orientation is not None or source.origin.reconstructed:
        return None
    if not isinstance(found, Smoothing) or found.gain_nats < GAIN_NATS or found.lag_s < LAG_S:
        return None
    return found


def detect(analysis: Analysis) -> Found:
    """A low pass that makes errors agree and positions late."""
    found, source = low_pass(analysis), analysis.source
    if found is None:
        return
    yield finding(
        "error" if found.lag_s >= LAG_ERROR_S else "warning",
        "source_smoothed",
        f"{source.name} is smoothed before it is sent",
        ": the errors of successive positions agree (correlation about "
        f"{found.correlation:.1f}), and they come about {found.lag_s:.2f} s behind the motion. "
        f"Behind that is a noise of {found.sigma_z_m:.2g} m. Both filters take the noise of each "
        "position for new, trust them too much, and lag.",
        "Switch the smoothing (averaging, filter) of the positioning system off and send raw "
        "positions; it is no clock error, so leave the stamps as they are.",
        asdict(found),
    )
