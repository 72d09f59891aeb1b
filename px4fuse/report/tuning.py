"""Terminal output of ``px4fuse tune``: estimated noises of KF, and advice."""

from collections.abc import Iterator, Mapping

import numpy as np

from px4fuse.comparison.estimates import find_first_available_tuning
from px4fuse.comparison.model import PreparedComparison
from px4fuse.comparison.remedy import format_changes, make_height_noise_advice, make_noise_change
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, NoiseEstimate
from px4fuse.findings.noises import KEEP_NOISE_BECAUSE_OF_CORRELATION_ACTION
from px4fuse.flight.ekf2_parameters import EV_POS
from px4fuse.flight.model import Columns, Unavailable

from .page import Page
from .phrases import format_noise_estimate, format_settings


def make_tuning_page(
    comparison: PreparedComparison, tunings: Mapping[str, AxisTuning | Unavailable]
) -> Page:
    """Make a page on the estimates of SIGMA_A and SIGMA_Z along each axis."""
    page = Page()
    page.write(comparison.flight.log.name, bold=True)
    for name, tuning in tunings.items():
        axis_name = name.replace(AISLE_AXIS, "axis of largest motion")
        if isinstance(tuning, Unavailable):
            page.write_muted_text(f"No estimate, {axis_name}: {tuning.reason}. {tuning.remedy}")
            continue
        sigma_a, sigma_z = tuning.sigma_a_two_state, tuning.sigma_z
        page.write(
            f"Estimate, {axis_name}: SIGMA_A {format_noise_estimate(sigma_a, 'm/s²')}, "
            f"SIGMA_Z {format_noise_estimate(sigma_z, 'm')}"
        )
    page.write_labelled_texts(dict(list_tuning_advice(comparison, tunings)))
    page.write(f"KF in this run: {format_settings(comparison.settings)}")
    return page


def list_tuning_advice(
    comparison: PreparedComparison, tuning_by_axis: Mapping[str, AxisTuning | Unavailable]
) -> Iterator[tuple[str, str]]:
    """Yield advice from the noise estimates as pairs (label, text)."""
    tuning = find_first_available_tuning(tuning_by_axis, HORIZONTAL, AISLE_AXIS, *tuning_by_axis)
    if tuning is None:
        return
    origin, settings = comparison.source.origin, comparison.settings
    axis_name = tuning.name.replace(AISLE_AXIS, "axis of largest motion")
    sigma_a, sigma_z = tuning.sigma_a_two_state, tuning.sigma_z
    noises = (
        ("--sigma-a", sigma_a, settings.sigma_a_m_s2),
        ("--sigma-z", sigma_z, settings.sigma_z_m),
    )
    options = [
        f"{option} {noise.value:.3g}" for option, noise, _ in noises if noise.value is not None
    ]
    if origin.may_drift:
        yield (
            "Drift",
            "The position source may drift. The estimates describe the noise without the drift. Do "
            "not set SIGMA_Z or EKF2_EVP_NOISE below the error shown by ground truth or a loop "
            "closure.",
        )
    # As the finding kf_underconfident of px4fuse compare: with GNSS, do not advise a smaller noise
    elif origin.is_gnss and any(
        noise.value is not None and noise.high is not None and noise.high < setting
        for _, noise, setting in noises
    ):
        yield (
            "GNSS",
            KEEP_NOISE_BECAUSE_OF_CORRELATION_ACTION.format(sensor="GNSS")
            if isinstance(comparison.flight.truth, Unavailable)
            else "The noise estimates do not contain the time-correlated error of GNSS. Compare "
            "them with ground truth: px4fuse compare LOG.",
        )
    elif options:
        command = f"px4fuse compare LOG {' '.join(options)}"
        yield "Action", f"Re-run with the estimated noise ({axis_name}): {command}"
    if sigma_z.value is None and sigma_z.low is not None:
        yield (
            "SIGMA_Z",
            f"SIGMA_Z cannot be estimated, but is above {sigma_z.low:.2g} m. Possibly the source "
            f"does not measure the position ({axis_name}).",
        )
    elif sigma_z.value is None:
        bound_text = "" if sigma_z.high is None else f" (at most {sigma_z.high:.2g} m)"
        yield (
            "SIGMA_Z",
            f"SIGMA_Z{bound_text} cannot be estimated, because the process noise between two "
            "logged positions is too large. Log the source at a higher rate.",
        )
    elif comparison.flight.log.autopilot == "PX4" and not origin.may_drift and origin.is_vision:
        height_advice = make_height_noise_advice(comparison, tuning_by_axis, sigma_z.value)
        yield "PX4", _make_vision_noise_advice(comparison, sigma_z) + height_advice
    if sigma_a.value is None:
        yield (
            "SIGMA_A",
            "SIGMA_A cannot be estimated: the flight has too little motion, or is too short."
            if sigma_a.low is None
            else f"SIGMA_A cannot be estimated, but is above {sigma_a.low:.2g} m/s²: logged "
            "acceleration and positions disagree.",
        )
    elif tuning.biases_fitted:
        yield (
            "SIGMA_A",
            "The estimate of SIGMA_A includes accelerometer bias and tilt error, which are not "
            "states of KF.",
        )
    if len(tuning.outlier_time_s):
        yield (
            "Outliers",
            f"{len(tuning.outlier_time_s)} of {tuning.count} measurements ({axis_name}) are "
            f"outliers, the first at {tuning.outlier_time_s[0]:.1f} s. The noise estimates exclude "
            "them.",
        )


def _make_vision_noise_advice(comparison: PreparedComparison, estimate: NoiseEstimate) -> str:
    """Return advice on the position noise of EKF2 for external vision."""
    assert estimate.value is not None
    name, parameters = EV_POS.noise, comparison.flight.log.parameters
    low_m, high_m = estimate.low or 0.0, estimate.high or np.inf
    variance_m2 = comparison.source.samples[Columns.POSITION_VARIANCE[:2]].median().mean()
    reported_sigma_m = 0.0 if np.isnan(variance_m2) else float(np.sqrt(variance_m2))
    # Parameters that set EKF2's noise to the estimate: the noise parameter and, if the messages
    # contain a larger σ, the mode parameter
    changes = make_noise_change(EV_POS, parameters, reported_sigma_m, estimate.value)
    noise_parameter_m = parameters.get(name, np.nan)
    # The σ from the messages is significantly too large: EKF2 must use its noise parameter instead
    if EV_POS.noise_mode_parameter in changes and reported_sigma_m > high_m:
        return (
            f"Set {format_changes(changes)}. The source reported a σ of {reported_sigma_m:.2g} m."
        )
    if low_m <= noise_parameter_m <= high_m:
        return f"{name} {noise_parameter_m:g} m is within the 95 % interval of the estimate."
    return f"Set {name} to {changes[name]:g} m (now {noise_parameter_m:g} m)."
