"""The variance that the source reports is not that of its noise."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.model import Found, finding
from px4fuse.findings.source_smoothed import low_pass
from px4fuse.flight import POSITION_VARIANCE_COLUMNS, Unavailable
from px4fuse.plain import factor_words

REPORTED = 2.0  # times in variance: EKF2's own NIS is off by about that
REPORTED_ERROR = 3.0  # times in variance: beyond what EKF2's NIS bears


def detect(analysis: Analysis) -> Found:
    """Outside the noise's interval; of odometry, which may report how far it has drifted, never."""
    source, tuned = analysis.source, analysis.tuning.get(HORIZONTAL)
    if source.orientation is not None or source.origin.reconstructed:
        return
    if not isinstance(tuned, AxisTuning):
        return
    reported = within(source.samples, analysis.segment)[POSITION_VARIANCE_COLUMNS[:2]].dropna()
    noise, low, high = tuned.sigma_z.value, tuned.sigma_z.low, tuned.sigma_z.high
    if reported.empty or noise is None or low is None or high is None:
        return
    sigma = float(np.sqrt(reported.to_numpy().mean(axis=1)).mean())
    factor = (sigma / noise) ** 2
    size = max(factor, 1.0 / factor)
    if low <= sigma <= high or size < REPORTED:
        return
    # where the source smooths, the noise from one position to the next is not all
    if isinstance(analysis.smoothing, Unavailable) or low_pass(analysis) is not None:
        return
    yield finding(
        "error" if size >= REPORTED_ERROR else "warning",
        "source_variance_wrong",
        f"{source.name} reports a standard deviation of {sigma:.3g} m, and its noise is "
        f"{noise:.3g} m",
        f" (95 % {low:.3g} to {high:.3g}): the variance that it sends is {factor_words(size)} "
        f"times too {'small' if factor < 1.0 else 'large'}. EKF2 takes R from it "
        "(EKF2_EV_NOISE_MD 0), though never less than EKF2_EVP_NOISE.",
        f"Correct it at the sender: a variance of {noise**2:.2g} m², or set EKF2_EV_NOISE_MD to 1 "
        f"and EKF2_EVP_NOISE to {noise:.2g}.",
        {"reported_sigma_m": sigma, "sigma_z_m": noise, "variance_factor": factor},
    )
