"""Measurement noise of EKF2 for the source that is too small or too large, confirmed by a replay.

KF takes SIGMA_Z from the same parameter on GNSS, so both filters may have the fault.
"""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import aid_of
from px4fuse.comparison.trials import Trial, distance_from_one
from px4fuse.filter.consistency import classify_ratio
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.model import Findings, Severity, finding, format_percent
from px4fuse.flight import Unavailable
from px4fuse.text import format_factor

# Ratio of the noises from which the finding is an error; below, EKF2 works nearly as well
MIN_RATIO_ERROR = 2.0
# Rejected fraction from which the title names it
MIN_NAMED_REJECTION = 0.05


def detect(analysis: Analysis) -> Findings:
    """Detect a measurement noise whose change brings EKF2's innovations into their band."""
    aid = aid_of(analysis)
    trials = [
        trial
        for trial in analysis.trials
        if trial.filter == "ekf2" and trial.kinds == ("noise",) and _corrects_innovations(trial)
    ]
    if not trials:
        return
    best = min(trials, key=lambda trial: distance_from_one(trial.after))
    assert not isinstance(analysis.ekf2_model, Unavailable)  # a trial of EKF2 needs its model
    flown_m, estimate_m = analysis.ekf2_model.inputs.settings[aid.noise], best.change[aid.noise]
    ratio, is_small = estimate_m / flown_m, estimate_m > flown_m
    size = max(ratio, 1.0 / ratio)
    rejected = best.before.rejected_fraction or 0.0
    effect = (
        f": EKF2 rejects {format_percent(rejected)} of the positions"
        if rejected >= MIN_NAMED_REJECTION
        else ""
    )
    direction = "small" if is_small else "large"
    tuned = analysis.tuning.get(HORIZONTAL)
    interval = ""
    if isinstance(tuned, AxisTuning) and tuned.sigma_z.low and tuned.sigma_z.high:
        interval = f" (95 % {tuned.sigma_z.low:.3g} to {tuned.sigma_z.high:.3g} m)"
    consequence = (
        "EKF2 takes ordinary noise of the source for outliers, rejects it and relies on the IMU."
        if is_small and effect
        else "EKF2 weights the positions too much and reports a σ that is too small."
        if is_small
        else "EKF2 weights the positions too little and reports a σ that is too large."
    )
    severity: Severity = "error" if size >= MIN_RATIO_ERROR else "warning"
    yield finding(
        severity,
        f"ekf2_noise_too_{direction}",
        f"{aid.noise} is {format_factor(size)} times too {direction}{effect}. {aid.noise} is "
        f"{flown_m:g} m; the maximum-likelihood estimate is {estimate_m:.3g} m{interval}. "
        f"{consequence}",
        f"Set {aid.noise} to {estimate_m:g} m.",
        {"flown_m": flown_m, "estimate_m": estimate_m, "factor": ratio},
    )


def _corrects_innovations(trial: Trial) -> bool:
    """Return True if the change brings the ratio against the source into its band."""
    before, after = trial.before.nis_mean, trial.after.nis_mean
    if before is None or after is None:
        return False
    words = [classify_ratio(math.sqrt(mean), "source") for mean in (before, after)]
    return words[0] != "consistent" and words[1] == "consistent"
