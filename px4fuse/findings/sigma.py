"""SIGMA_Z or SIGMA_A is not what the innovations ask for, each told from the other.

The mean NIS alone cannot tell them apart: both make S larger. The likelihood can, since
SIGMA_A makes the innovations of a stretch agree with each other and SIGMA_Z does not.
"""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.model import Detector, Finding, Found, Severity, Threshold
from px4fuse.findings.no_motion import MOTION_RANGE, motion_range_m

NOISE_OFF = Threshold(1.5, "times", "in standard deviation; below, hardly a line moves")
NOISE_OFF_ERROR = Threshold(4.0, "times", "the gain is another one")


def _detect(analysis: Analysis) -> Found:
    tunings = map(analysis.tuning.get, (HORIZONTAL, "aisle", "down"))
    tuned = next((tuned for tuned in tunings if isinstance(tuned, AxisTuning)), None)
    if tuned is None:
        return
    settings = analysis.comparison.settings
    # without motion the acceleration's noise is hardly seen
    still = motion_range_m(analysis.comparison) < MOTION_RANGE.value
    for label, option, unit, chosen, found in (
        ("SIGMA_Z", "--sigma-z", "m", settings.sigma_z_m, tuned.sigma_z),
        ("SIGMA_A", "--sigma-a", "m/s²", settings.sigma_a_m_s2, tuned.sigma_a),
    ):
        factor, severity = _off(chosen, found)
        if severity is None or (label == "SIGMA_A" and still):
            continue
        small = factor < 1.0
        value = found.value if found.value is not None else found.high
        assert value is not None
        bound = "at most " if found.value is None else ""
        range_ = "" if found.value is None else f", 95 % {found.low or 0.0:.3g} to {found.high:.3g}"
        yield Finding(
            f"{label.lower()}_{'small' if small else 'large'}",
            severity,
            f"{label} {chosen:g} {unit} is {max(factor, 1.0 / factor):.2g} times too "
            f"{'small' if small else 'large'}: the innovations ({tuned.name}) ask for "
            f"{bound}{value:.3g} {unit}{range_}. {_reading(label, small)}",
            f"{option} {value:.3g}",
            {
                "chosen": chosen,
                "most_likely": value,
                "factor": factor,
                "lag1_autocorrelation": getattr(tuned.before, "lag1_autocorrelation", float("nan")),
            },
        )


def _off(chosen: float, found: Noise) -> tuple[float, Severity | None]:
    """By what factor a chosen noise is off, and how bad that is; None where it is not."""
    reference = found.value if found.value is not None else found.high
    if reference is None:
        return 1.0, None
    factor = chosen / reference
    above = found.high is not None and chosen > found.high
    below = found.value is not None and chosen < (found.low or 0.0)
    size = max(factor, 1.0 / factor)
    if not (above or below) or size < NOISE_OFF.value:
        return factor, None
    return factor, "error" if size >= NOISE_OFF_ERROR.value else "warning"


def _reading(label: str, small: bool) -> str:
    if label == "SIGMA_Z":
        return (
            "The filter mistakes the noise of the measurements for motion."
            if small
            else "The filter distrusts measurements that are better than it thinks."
        )
    return (
        "The variance grows too little between updates, the gain is too small, and the filter "
        "lags behind."
        if small
        else "The variance grows too much between updates, and the filter jumps to every "
        "measurement."
    )


DETECTOR = Detector(
    _detect,
    {
        "sigma_z_small": "sigma_z, sigma z, measurement noise, measurement variance, trusts uwb, "
        "trust uwb",
        "sigma_z_large": "sigma_z, sigma z, measurement noise, measurement variance, distrust",
        "sigma_a_small": "sigma_a, sigma a, process noise",
        "sigma_a_large": "sigma_a, sigma a, process noise",
    },
    {
        "sigma_z_small": tuple(f"sigma_z_m={value:g}" for value in (0.07, 0.05, 0.03)),
        "sigma_z_large": tuple(f"sigma_z_m={value:g}" for value in (0.15, 0.2, 0.3)),
        "sigma_a_small": tuple(f"sigma_a_m_s2={value:g}" for value in (0.18, 0.1, 0.02)),
        "sigma_a_large": tuple(f"sigma_a_m_s2={value:g}" for value in (0.4, 0.8, 2.0)),
    },
)
