"""The variance that the source reports is not that of its noise."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.source_smoothed import low_pass
from px4fuse.flight import POSITION_VARIANCE_COLUMNS, Unavailable
from px4fuse.plain import factor_words

REPORTED = Threshold(2.0, "times", "in variance; EKF2's own NIS is off by about that")
REPORTED_ERROR = Threshold(3.0, "times", "in variance: beyond what EKF2's NIS bears")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    source, tuned = comparison.source, analysis.tuning.get(HORIZONTAL)
    # odometry reports how far it has drifted, or its noise: it cannot be told which
    if (
        source.orientation is not None
        or source.origin.reconstructed
        or not isinstance(tuned, AxisTuning)
    ):
        return
    reported = within(source.samples, comparison.segment)[POSITION_VARIANCE_COLUMNS[:2]].dropna()
    noise = tuned.sigma_z
    if reported.empty or noise.value is None or noise.low is None or noise.high is None:
        return
    sigma = float(np.sqrt(reported.to_numpy().mean(axis=1)).mean())
    factor = (sigma / noise.value) ** 2
    size = max(factor, 1.0 / factor)
    if noise.low <= sigma <= noise.high or size < REPORTED.value:
        return
    # where the source smooths, the noise from one position to the next is not all
    if isinstance(analysis.smoothing, Unavailable) or low_pass(analysis) is not None:
        return
    small = factor < 1.0
    yield Finding(
        "source_variance_wrong",
        "error" if size >= REPORTED_ERROR.value else "warning",
        f"{source.name} reports a standard deviation of {sigma:.3g} m, and its noise is "
        f"{noise.value:.3g} m (95 % {noise.low:.3g} to {noise.high:.3g}): the variance that it "
        f"sends is {factor_words(size)} times too {'small' if small else 'large'}. EKF2 takes R "
        "from it (EKF2_EV_NOISE_MD 0), though never less than EKF2_EVP_NOISE.",
        f"Correct it at the sender: a variance of {noise.value**2:.2g} m², or set "
        f"EKF2_EV_NOISE_MD to 1 and EKF2_EVP_NOISE to {noise.value:.2g}.",
        {
            "reported_sigma_m": sigma,
            "sigma_z_m": noise.value,
            "variance_factor": factor,
        },
    )


DETECTOR = Detector(
    _detect,
    {
        "source_variance_wrong": tuple(
            f"--mistake r-scale={factor:g}" for factor in (0.1, 0.25, 0.5, 4.0)
        )
    },
    names={"source_variance_wrong": "a variance that the position source states wrongly"},
)
