"""Changes of noises, delays or data that may make KF or EKF2 consistent.

In all functions, ``ekf2_inputs`` is None if the filter is not EKF2.
"""

from collections.abc import Iterable

import numpy as np

from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight.ekf2_parameters import GNSS_VEL, MODEL_PARAMETERS
from px4fuse.flight.model import LogInfo, Unavailable

from .estimates import Estimates, TuningByAxis, find_first_available_tuning
from .model import Comparison, FilterSummary
from .remedy import (
    make_delay_max_change,
    make_estimated_delay_change,
    make_estimated_noise_change,
)
from .rerun_effects import (
    CHANGE_KEYS_WITHOUT_EFFECT_ALONE,
    FORWARD_BIAS_KEY,
    OUTLIERS_KEY,
    RIGHT_BIAS_KEY,
    ROTATION_KEY,
    TIME_OFFSET_KEY,
    ChangedValues,
    Statistic,
)

# Minimum SIGMA_Z (m) in a re-run of KF: the position noise of motion capture
MIN_RERUN_SIGMA_Z_M = 0.005
SIGMA_A_KEY, SIGMA_Z_KEY = "sigma_a_m_s2", "sigma_z_m"
# Kind of change for each KF setting and each correction of the data
KIND_BY_CHANGE_NAME = {
    SIGMA_A_KEY: "noises",
    SIGMA_Z_KEY: "noises",
    OUTLIERS_KEY: "outliers",
    TIME_OFFSET_KEY: "time offset",
    ROTATION_KEY: "rotation",
    FORWARD_BIAS_KEY: "bias",
    RIGHT_BIAS_KEY: "bias",
}
KF_NOISE_SETTINGS = frozenset((SIGMA_A_KEY, SIGMA_Z_KEY))
ACC_NOISE = "EKF2_ACC_NOISE"
# EKF2 is re-run with a larger EKF2_ACC_NOISE only if the lower limit of the estimate is above this
# multiple of the logged value: tilt errors and biases also increase the estimate
MIN_ESTIMATED_TO_LOGGED_ACC_NOISE_RATIO = 3.0
PARAMETERS_SET_TO_DEFAULT = (
    ACC_NOISE,
    "EKF2_GYR_NOISE",
    "EKF2_ACC_B_NOISE",
    "EKF2_GYR_B_NOISE",
    GNSS_VEL.noise,
    GNSS_VEL.gate,
)
# A yaw misalignment is corrected in a re-run if it is above this multiple of its σ
MIN_MISALIGNMENT_SIGMAS = 3.0


def find_candidate_changes(
    comparison: Comparison,
    estimates: Estimates,
    ekf2_inputs: ReplayInputs | None,
    axis: str,
    summary: FilterSummary,
    statistic: Statistic,
) -> list[ChangedValues]:
    """Return the changes of settings or data that may correct the mean NIS or NEES of a filter.

    KF: noises, outliers, time offset, rotation and accelerometer bias. EKF2: noise, outliers,
    delay, rotation and default parameters. Along the down axis: noise, outliers and delay only.
    """
    # A filter whose mean NIS is too small needs smaller noises, and outliers are not the cause
    is_underconfident = statistic == "nis" and summary.nis_mean < 1.0
    axis_tuning = find_axis_tuning(estimates.tuning, axis)
    changes = list[ChangedValues]()
    # 1. Noise settings and outliers
    # Do not reduce the noise settings for GNSS or odometry: innovations do not show the slow errors
    # of these sources, only ground truth does
    origin = comparison.source.origin
    may_have_correlated_errors = (
        origin.may_drift or origin.is_gnss
    ) and not summary.is_underconfident_against_truth
    if axis_tuning is not None:
        if not (is_underconfident and may_have_correlated_errors):
            changes += (
                _find_kf_noise_changes(comparison.settings, axis_tuning, is_underconfident)
                if ekf2_inputs is None
                else _find_ekf2_noise_changes(ekf2_inputs, summary, axis_tuning)
            )
        if not is_underconfident and len(axis_tuning.outlier_time_s):
            changes.append({OUTLIERS_KEY: float(len(axis_tuning.outlier_time_s))})
    # 2. Time offset. For EKF2, the delay parameter corrects it, if PX4 permits the delay
    delay_change = {}
    if ekf2_inputs is not None:
        delay_change = make_estimated_delay_change(comparison, ekf2_inputs, estimates.time_offset)
    changes += [delay_change] if delay_change else _find_offset_changes(estimates, ekf2_inputs)
    # 3. The other changes (rotation of the positions, accelerometer bias, default parameters,
    # accelerometer noise) are tested along horizontal axes only
    if axis == "down":
        return changes
    if (
        isinstance(heading := estimates.heading, HeadingError)
        and abs(heading.misalignment_deg) > MIN_MISALIGNMENT_SIGMAS * heading.sigma_deg
    ):
        changes.append({ROTATION_KEY: -round(heading.misalignment_deg, 1)})
    if ekf2_inputs is None:
        return changes + _find_bias_changes(estimates)
    changes += _find_changes_to_defaults(comparison.flight.log, ekf2_inputs)
    if axis_tuning is not None and not is_underconfident:
        changes += _find_acc_noise_changes(comparison.settings, ekf2_inputs, axis_tuning)
    return changes


def find_additional_changes(
    comparison: Comparison,
    estimates: Estimates,
    ekf2_inputs: ReplayInputs | None,
    changes: list[ChangedValues],
) -> list[ChangedValues]:
    """Return the changes to test in addition to ``changes`` along the axis of largest motion."""
    if ekf2_inputs is not None:
        # The user can correct a late EKF2 track by the delay parameter or, alternatively, by the
        # timestamps. find_candidate_changes returns only one of these changes: test the other, too
        is_delay_tested = any(ekf2_inputs.aid.delay in change for change in changes)
        return _find_offset_changes(estimates, ekf2_inputs) if is_delay_tested else []
    # For KF, also test SIGMA_A and SIGMA_Z together, and their default values
    noise_changes = [change for change in changes if change.keys() <= KF_NOISE_SETTINGS]
    if not noise_changes:
        return []
    both_noises = {name: value for change in noise_changes for name, value in change.items()}
    return [change for change in (both_noises, find_default_settings(comparison)) if change]


def remove_repeated_changes(changes: Iterable[ChangedValues]) -> list[ChangedValues]:
    """Return equal changes only once, at the place of the first."""
    return list({frozenset(change.items()): change for change in changes}.values())


def classify_change(
    comparison: Comparison, ekf2_inputs: ReplayInputs | None, change: ChangedValues
) -> tuple[str, ...]:
    """Return the kind of each changed value, for example ("noise",) or ("delay", "outliers")."""
    if ekf2_inputs is None and change == find_default_settings(comparison):
        return ("defaults",)
    kinds = dict(KIND_BY_CHANGE_NAME)
    if ekf2_inputs is not None:
        aid = ekf2_inputs.aid
        kinds |= {aid.noise: "noise", aid.gate: "gate", aid.delay: "delay"}
    changed_names = (name for name in change if name not in CHANGE_KEYS_WITHOUT_EFFECT_ALONE)
    return tuple(dict.fromkeys(kinds.get(name, "process noise") for name in changed_names))


def find_default_settings(comparison: Comparison) -> ChangedValues:
    """Return the change of KF's noise settings to their default values.

    The settings are SIGMA_A and SIGMA_Z; with GNSS positions, only SIGMA_A. Settings with default
    values are omitted.
    """
    user_settings, default_settings = comparison.settings, Settings()
    setting_names = (
        (SIGMA_A_KEY,) if comparison.source.origin.is_gnss else (SIGMA_A_KEY, SIGMA_Z_KEY)
    )
    return {
        name: getattr(default_settings, name)
        for name in setting_names
        if getattr(user_settings, name) != getattr(default_settings, name)
    }


def find_axis_tuning(tuning: TuningByAxis, axis: str) -> AxisTuning | None:
    """Return the noise estimate of an axis. North and east have a common estimate."""
    return find_first_available_tuning(tuning, *(() if axis == "down" else (HORIZONTAL,)), axis)


def _find_offset_changes(
    estimates: Estimates, ekf2_inputs: ReplayInputs | None
) -> list[ChangedValues]:
    """Return the change that corrects a significant time offset of the source, if any."""
    time_offset = estimates.time_offset
    if isinstance(time_offset, Unavailable) or not time_offset.is_determinable:
        return []
    # The user's --clock-offset corrects the timestamps for KF, but not for EKF2
    uncorrected_s = time_offset.remaining_s if ekf2_inputs is None else time_offset.offset_s
    if not time_offset.is_significant(uncorrected_s):
        return []
    change = {TIME_OFFSET_KEY: round(time_offset.offset_s, 3)}
    if ekf2_inputs is not None:
        # With earlier timestamps, positions are older: EKF2 needs a longer buffer to fuse them
        position_age_ms = ekf2_inputs.settings[ekf2_inputs.aid.delay] - 1e3 * time_offset.offset_s
        change |= make_delay_max_change(ekf2_inputs.settings, position_age_ms)
    return [change]


def _find_kf_noise_changes(
    settings: Settings, axis_tuning: AxisTuning, is_underconfident: bool
) -> list[ChangedValues]:
    """Return changes of SIGMA_A and SIGMA_Z to their estimates, if they differ significantly."""
    changes = list[ChangedValues]()
    for name, noise in (
        (SIGMA_A_KEY, axis_tuning.sigma_a_two_state),
        (SIGMA_Z_KEY, axis_tuning.sigma_z),
    ):
        setting, estimate = getattr(settings, name), noise.value
        if is_underconfident:  # is the setting too large, above the 95 % interval?
            is_significant = noise.high is not None and setting > noise.high
            if estimate is None:  # only the upper limit is known: reduce the setting to this limit
                estimate = noise.high
        else:  # is the setting too small, below the 95 % interval?
            is_significant = noise.low is not None and setting < noise.low
        if noise.value is None and name == SIGMA_Z_KEY:
            estimate = max(estimate or 0.0, MIN_RERUN_SIGMA_Z_M)
        if estimate and is_significant:
            changes.append({name: float(f"{estimate:.3g}")})
    return changes


def _find_bias_changes(estimates: Estimates) -> list[ChangedValues]:
    """Return the change that removes a significant accelerometer bias, if any."""
    systematic_errors = estimates.systematic_errors
    if isinstance(systematic_errors, Unavailable) or not systematic_errors.has_significant_bias():
        return []
    biases = {
        FORWARD_BIAS_KEY: systematic_errors.forward_bias_m_s2,
        RIGHT_BIAS_KEY: systematic_errors.right_bias_m_s2,
    }
    return [{name: round(bias.value, 3) for name, bias in biases.items()}]


def _find_ekf2_noise_changes(
    ekf2_inputs: ReplayInputs, summary: FilterSummary, axis_tuning: AxisTuning
) -> list[ChangedValues]:
    """Return the change of EKF2's position noise to its estimate, if it differs significantly."""
    noise_m = axis_tuning.sigma_z.value
    if noise_m is None:  # no estimate: use the RMS innovation, an upper bound of the noise
        noise_m = float(np.hypot(summary.innovation_std_m, summary.innovation_mean_m))
    change = make_estimated_noise_change(ekf2_inputs, axis_tuning.sigma_z, noise_m)
    return [change] if change else []


def _find_changes_to_defaults(log: LogInfo, ekf2_inputs: ReplayInputs) -> list[ChangedValues]:
    """Return one change to PX4's default for each EKF2 noise that differs from the default."""
    gate_parameter = ekf2_inputs.aid.gate
    changes = list[ChangedValues]()
    for name in (gate_parameter, *PARAMETERS_SET_TO_DEFAULT):
        default, value = log.find_default_value(name), ekf2_inputs.settings.get(name, np.nan)
        # Only a gate that is too small affects a consistent filter: it rejects normal positions
        if name == gate_parameter and value > default:
            continue
        # A missing parameter is NaN. Comparisons with NaN are False, so it is not changed
        if abs(value - default) > 1e-3 * abs(default):
            changes.append({name: default})
    return changes


def _find_acc_noise_changes(
    settings: Settings, ekf2_inputs: ReplayInputs, axis_tuning: AxisTuning
) -> list[ChangedValues]:
    """Return the change of EKF2_ACC_NOISE to its estimate, if the estimate is much larger."""
    logged_acc_noise, sigma_a = ekf2_inputs.settings[ACC_NOISE], axis_tuning.sigma_a_two_state
    acc_noise_per_sigma_a = (settings.dt_s / ekf2_inputs.mean_step_s) ** 0.5
    min_acc_noise = (sigma_a.low or 0.0) * acc_noise_per_sigma_a
    acc_noise = min(
        (sigma_a.value or 0.0) * acc_noise_per_sigma_a, MODEL_PARAMETERS[ACC_NOISE].maximum
    )
    if (
        min_acc_noise <= MIN_ESTIMATED_TO_LOGGED_ACC_NOISE_RATIO * logged_acc_noise
        or acc_noise <= logged_acc_noise
    ):
        return []
    return [{ACC_NOISE: float(f"{acc_noise:.2g}")}]
