"""The source low-pass filters its positions before it sends them."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.smoothing import Smoothing
from px4fuse.findings.model import Detector, Finding, Found, Threshold

SMOOTHING_GAIN = Threshold(12.0, "nats", "a likelihood ratio of 160,000; clean flights have 0 to 2")
SMOOTHING_LAG = Threshold(0.05, "s", "at 1 m/s half of a good UWB's noise")
SMOOTHING_LAG_ERROR = Threshold(0.10, "s", "at 1 m/s a good UWB's noise")


def low_pass(analysis: Analysis) -> Smoothing | None:
    """The low pass in the source, None where there is none or it cannot be told."""
    source = analysis.source
    # the error of odometry drifts, which makes that of successive positions agree as well; what
    # was made of EKF2's own output has EKF2's filter in it
    if source.orientation is not None or source.origin.reconstructed:
        return None
    found = analysis.smoothing
    if not isinstance(found, Smoothing):
        return None
    if found.gain_nats < SMOOTHING_GAIN.value or found.lag_s < SMOOTHING_LAG.value:
        return None
    return found


def _detect(analysis: Analysis) -> Found:
    found, source = low_pass(analysis), analysis.source
    if found is None:
        return
    yield Finding(
        "source_smoothed",
        "error" if found.lag_s >= SMOOTHING_LAG_ERROR.value else "warning",
        f"{source.name} is smoothed before it is sent: the errors of successive positions agree "
        f"(correlation about {found.correlation:.1f}), and they come about {found.lag_s:.2f} s "
        f"behind the motion. Behind that is a noise of {found.sigma_z_m:.2g} m. Both filters take "
        "the noise of each position for new, trust them too much, and lag.",
        "Switch the smoothing (averaging, filter) of the positioning system off and send raw "
        "positions; it is no clock error, so leave the stamps as they are.",
        {
            "correlation": found.correlation,
            "lag_s": found.lag_s,
            "sigma_z_m": found.sigma_z_m,
            "gain_nats": found.gain_nats,
        },
    )


DETECTOR = Detector(
    _detect,
    {"source_smoothed": tuple(f"--mistake smoothed={size}" for size in ("0.1s", "0.2s", "0.5s"))},
    names={"source_smoothed": "positions that were smoothed before they were sent"},
)
