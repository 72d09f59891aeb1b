"""EKF2 parameters for the estimated noise and delay of the position source."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.ekf2.model import Ekf2Model, replay_with_settings
from px4fuse.ekf2.replay import rows_inside
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.filter.time_offset import MIN_OFFSET_SIGMAS, MIN_TIME_OFFSET_S, SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, NoiseEstimate
from px4fuse.flight.ekf2_parameters import (
    EV_POS,
    GNSS_POS,
    GNSS_VEL,
    KNOWN_PARAMETERS,
    MODEL_PARAMETERS,
    Aid,
)
from px4fuse.flight.model import Unavailable

from .estimates import TuningByAxis, find_first_available_tuning
from .model import Comparison, PreparedComparison

# Tested values of EKF2_GPS_DELAY (ms)
GNSS_DELAYS_MS = (0.0, 150.0, 300.0)
# Transmission time (ms) of a position message: EKF2_DELAY_MAX includes it
TRANSMISSION_DELAY_MS = 30.0
# EKF2_DELAY_MAX is rounded up to a multiple of this value (ms)
EKF2_DELAY_MAX_STEP_MS = 50.0
# Advice on the height noise of vision: minimum fraction of the time in which EKF2 fused heights
MIN_FUSED_FRACTION_OF_HEIGHTS = 0.5
# Advice on the height noise of vision: minimum ratio of estimated height noise to horizontal noise
MIN_HEIGHT_TO_HORIZONTAL_NOISE_RATIO = 2.0


def estimate_gnss_delay_ms(
    comparison: Comparison, model: Ekf2Model, time_offset: SourceTimeOffset | Unavailable
) -> tuple[float, float] | None:
    """Estimate the GNSS delay and its σ (ms) by replays of EKF2 with values of EKF2_GPS_DELAY.

    The estimate is the delay with the smallest NIS of GNSS position and velocity. Vision positions
    are the reference. Return None if

    - the estimated delay does not differ significantly from the logged delay,
    - vision is missing, or is not the position source of KF, so it was not checked,
    - vision has wrong axes, a wrong unit or a wrong time offset,
    - GNSS has no velocity, or
    - EKF2 ignores EKF2_GPS_DELAY, because the GNSS driver reports measurement times.
    """
    # received_positions are those of GNSS if EKF2 fused both
    received_positions, vision = model.inputs.received_positions, model.inputs.vision_positions
    if (
        vision is None
        or comparison.source.name != vision.source
        or comparison.convention_faults
        or received_positions.velocity_m_s is None
        or received_positions.uses_sender_timestamps
    ):
        return None
    vision_delay_ms = model.inputs.settings[EV_POS.delay]
    if estimate_delay_if_not_as_logged_ms(comparison, time_offset, vision_delay_ms) is not None:
        return None
    nis_sums = []
    for replay in replay_with_settings(
        model, [{GNSS_POS.delay: delay} for delay in GNSS_DELAYS_MS]
    ):
        update_tables = [
            rows_inside(updates, model.baseline_replay.find_evaluated_spans())
            for updates in (replay.updates, replay.other_aid_updates[GNSS_VEL.name])
        ]
        nis = [
            updates[f"innovation_{axis}_m"] ** 2 / updates[f"innovation_variance_{axis}_m2"]
            for axis in ("north", "east")
            for updates in update_tables
        ]
        # The number of updates depends on the delay. To compare the replays, scale the mean NIS to
        # the number of received positions. Each position has 4 NIS: position and velocity along 2
        # axes
        nis_sums.append(float(np.mean(nis)) * len(nis) * len(received_positions.timestamp_s))
    # Normal distribution: NIS sum = -2 ln p = (delay - estimate)² / σ² + constant. Fit this
    # parabola
    quadratic_coefficient, linear_coefficient, _ = np.polyfit(GNSS_DELAYS_MS, nis_sums, 2)
    if quadratic_coefficient <= 0.0:
        return None
    delay_ms = -0.5 * linear_coefficient / quadratic_coefficient
    sigma_ms = quadratic_coefficient**-0.5
    delay_setting_error_ms = abs(delay_ms - model.inputs.settings[GNSS_POS.delay])
    if delay_ms < 0.0 or delay_setting_error_ms <= max(
        1e3 * MIN_TIME_OFFSET_S, MIN_OFFSET_SIGMAS * sigma_ms
    ):
        return None
    return delay_ms, sigma_ms


def estimate_ekf2_parameters(
    comparison: Comparison,
    model: Ekf2Model,
    tuning: TuningByAxis,
    time_offset: SourceTimeOffset | Unavailable,
) -> dict[str, float]:
    """Return the maximum-likelihood values of those EKF2 noises and delays that are wrong.

    Noises of GNSS and odometry are not reduced: innovations do not show their slow errors.
    """
    changes: dict[str, float] = {}
    inputs, origin, gnss_noise_m = model.inputs, comparison.source.origin, 0.0
    vision = inputs.vision_positions
    # If EKF2 fused GNSS and vision, and KF uses vision: compare KF with EKF2's inputs from vision
    if vision is not None and comparison.source.name == vision.source:
        if (gnss_delay := estimate_gnss_delay_ms(comparison, model, time_offset)) is not None:
            changes |= make_delay_change(inputs, gnss_delay[0])
        gnss_noise_m = inputs.settings[GNSS_POS.noise]
        inputs = replace(inputs, aid=EV_POS, received_positions=vision)
    if not is_source_fused(comparison, inputs):
        return {}
    axis_tuning = find_first_available_tuning(tuning, HORIZONTAL, AISLE_AXIS, "north", "east")
    if axis_tuning and (noise_m := axis_tuning.sigma_z.value):
        used_noise_m = find_used_noise_m(inputs)
        is_increase_only = origin.may_drift or origin.is_gnss
        # While EKF2 fuses GNSS, it increases the noise of vision at least to that of GNSS: a change
        # of a smaller noise to another smaller noise has no effect
        has_effect = max(noise_m, used_noise_m) > gnss_noise_m
        if has_effect and (noise_m > used_noise_m or not is_increase_only):
            changes |= make_estimated_noise_change(inputs, axis_tuning.sigma_z, noise_m)
    return changes | make_estimated_delay_change(comparison, inputs, time_offset)


def is_source_fused(comparison: Comparison, ekf2_inputs: ReplayInputs) -> bool:
    """Return True if EKF2 fused the position source that KF uses."""
    source = comparison.source
    return source.name == ekf2_inputs.received_positions.source and source.alignment is None


def make_estimated_delay_change(
    comparison: Comparison, ekf2_inputs: ReplayInputs, time_offset: SourceTimeOffset | Unavailable
) -> dict[str, float]:
    estimated_delay_ms = estimate_delay_if_not_as_logged_ms(
        comparison, time_offset, ekf2_inputs.settings[ekf2_inputs.aid.delay]
    )
    return {} if estimated_delay_ms is None else make_delay_change(ekf2_inputs, estimated_delay_ms)


def estimate_delay_if_not_as_logged_ms(
    comparison: PreparedComparison,
    time_offset: SourceTimeOffset | Unavailable,
    logged_delay_ms: float,
) -> float | None:
    """Return the estimated delay (ms) of the positions if it differs from the logged delay.

    A time offset from the user (--clock-offset) is kept if it is within the 95 % interval.
    """
    if isinstance(time_offset, Unavailable) or not time_offset.is_determinable:
        return None
    offset_s, applied_s = time_offset.offset_s, time_offset.applied_s
    low_s, high_s = time_offset.interval_s
    # If late_s is not 0, px4fuse applied the offset, not the user
    is_offset_from_user = applied_s and not comparison.convention_faults.late_s
    if is_offset_from_user and low_s <= applied_s <= high_s:
        offset_s = applied_s
    # assumed_delay_s was already subtracted from the timestamps of GNSS. The offset of late
    # timestamps is negative, and adds to this delay
    estimated_delay_ms = 1e3 * (comparison.source.assumed_delay_s - offset_s)
    is_significant = time_offset.is_significant(1e-3 * (logged_delay_ms - estimated_delay_ms))
    return estimated_delay_ms if is_significant else None


def describe_delay_limit(
    parameter_name: str, estimated_delay_ms: float, logged_delay_ms: float
) -> str:
    """Return why PX4 does not permit a delay, as the end of a sentence "EKF2_EV_DELAY cannot ...".

    The result is "exceed 300 ms" or "be negative"; it is "" if PX4 permits the delay.
    """
    if estimated_delay_ms > (maximum_ms := MODEL_PARAMETERS[parameter_name].maximum):
        return f"exceed {maximum_ms:g} ms"
    return "be negative" if round(estimated_delay_ms) <= 0.0 == logged_delay_ms else ""


def find_aid(comparison: PreparedComparison, axis: str = "") -> Aid:
    """Return EKF2's aiding source (vision, GNSS, ...) for the positions along an axis."""
    return comparison.source.aid(axis) or EV_POS


def find_logged_delay_ms(comparison: PreparedComparison) -> float | None:
    """Return the logged delay parameter (ms) of the position source, if EKF2 uses it."""
    source = comparison.source
    if source.origin.aid is None or source.alignment is not None:
        return None
    logged_delay_ms = comparison.flight.log.parameters.get(source.origin.aid.delay)
    # If the GNSS timestamps are from the sender of the positions, PX4 does not apply its delay
    # parameter. assumed_delay_s is then 0
    if source.origin.is_fused_as_gnss and source.assumed_delay_s == 0.0:
        return 0.0 if logged_delay_ms == 0.0 else None
    return logged_delay_ms


def find_delay_max_change(
    comparison: PreparedComparison, position_age_ms: float
) -> dict[str, float]:
    """Return a larger EKF2_DELAY_MAX than logged if it is required for this age (ms)."""
    # log.parameters contain only PARAMETERS_IN_RESULTS, so EKF2_DELAY_MAX is missing
    ekf2 = comparison.flight.ekf2
    parameters = {} if isinstance(ekf2, Unavailable) else ekf2.parameters
    return make_delay_max_change(parameters, position_age_ms)


def make_estimated_noise_change(
    ekf2_inputs: ReplayInputs, noise_estimate: NoiseEstimate, noise_m: float
) -> dict[str, float]:
    """Return the EKF2 parameters that set the position noise to ``noise_m``.

    Return no parameters if the noise that EKF2 used is within the 95 % interval of
    ``noise_estimate``, so that no change is necessary.
    """
    if (
        (noise_estimate.low or 0.0)
        <= find_used_noise_m(ekf2_inputs)
        <= (noise_estimate.high or math.inf)
    ):
        return {}
    return make_noise_change(
        ekf2_inputs.aid, ekf2_inputs.settings, _compute_reported_noise_m(ekf2_inputs), noise_m
    )


def make_noise_change(
    aid: Aid, settings: Mapping[str, float], reported_noise_m: float, noise_m: float
) -> dict[str, float]:
    """Return the EKF2 parameters that set the position noise to ``noise_m``.

    EKF2 then ignores a larger noise that the sender reports.
    """
    changes = {aid.noise: max(float(f"{noise_m:.2g}"), MODEL_PARAMETERS[aid.noise].minimum)}
    mode_parameter = aid.noise_mode_parameter
    if mode_parameter and not settings.get(mode_parameter, 0.0) and noise_m < reported_noise_m:
        changes[mode_parameter] = 1.0
    return changes


def make_delay_change(ekf2_inputs: ReplayInputs, delay_ms: float) -> dict[str, float]:
    """Return the EKF2 parameters that set the delay of the positions.

    The parameters are the delay and, if necessary, EKF2_DELAY_MAX. Unchanged parameters are
    omitted. Return {} if the delay exceeds PX4's maximum, or if PX4 ignores the delay parameter.
    """
    delay_name = ekf2_inputs.aid.delay
    parameter = MODEL_PARAMETERS[delay_name]
    if delay_ms > parameter.maximum or ekf2_inputs.received_positions.uses_sender_timestamps:
        return {}
    changes = {delay_name: max(float(round(delay_ms)), parameter.minimum)}
    changes |= make_delay_max_change(ekf2_inputs.settings, changes[delay_name])
    return {name: value for name, value in changes.items() if value != ekf2_inputs.settings[name]}


def make_delay_max_change(
    settings: Mapping[str, float], position_age_ms: float
) -> dict[str, float]:
    """Return a larger EKF2_DELAY_MAX if positions of this age (ms) are otherwise too old.

    PX4 has this parameter since v1.15.
    """
    required_ms = position_age_ms + TRANSMISSION_DELAY_MS
    if required_ms <= settings.get("EKF2_DELAY_MAX", math.inf):
        return {}
    step_count = math.ceil(required_ms / EKF2_DELAY_MAX_STEP_MS)
    return {"EKF2_DELAY_MAX": EKF2_DELAY_MAX_STEP_MS * step_count}


def find_used_noise_m(ekf2_inputs: ReplayInputs) -> float:
    """Return the median √R (m) that EKF2 used for the positions."""
    aid, parameters = ekf2_inputs.aid, ekf2_inputs.settings
    if parameters.get(aid.noise_mode_parameter) == 1.0:  # EKF2 ignores the reported noise
        return parameters[aid.noise]
    return max(parameters[aid.noise], _compute_reported_noise_m(ekf2_inputs))


def _compute_reported_noise_m(ekf2_inputs: ReplayInputs) -> float:
    return float(np.sqrt(np.median(ekf2_inputs.received_positions.variance_m2[:, :2])))


def make_height_noise_advice(
    comparison: PreparedComparison, tuning: TuningByAxis, noise_m: float
) -> str:
    """Return an action if the height noise is much larger than the horizontal noise.

    EKF2 has one noise parameter for position and height of external vision.
    """
    ekf2, down_tuning = comparison.flight.ekf2, find_first_available_tuning(tuning, "down")
    if (
        isinstance(ekf2, Unavailable)
        or isinstance(ekf2.fusion_flags, Unavailable)
        or down_tuning is None
        or not comparison.source.origin.is_vision
    ):
        return ""
    height_noise_m = down_tuning.sigma_z.value or 0.0  # None: not determined
    is_fused = ekf2.fusion_flags["vertical"].mean() > MIN_FUSED_FRACTION_OF_HEIGHTS
    if not is_fused or height_noise_m < MIN_HEIGHT_TO_HORIZONTAL_NOISE_RATIO * noise_m:
        return ""
    return (
        f" EKF2 also uses {EV_POS.noise} as the height noise, but the estimated height noise is "
        f"{height_noise_m:.2g} m. Set {EV_POS.noise_mode_parameter} to 0, and send each position "
        f"with a z variance of {height_noise_m**2:.2g} m²."
    )


def select_changed_settings(
    changes: Mapping[str, float], flight_settings: Mapping[str, float]
) -> dict[str, float]:
    """Return the changes whose values differ from the parameters used in flight."""
    return {
        name: value
        for name, value in changes.items()
        if not math.isclose(value, flight_settings.get(name, math.nan), rel_tol=1e-3)
    }


def format_changes(changes: Mapping[str, float]) -> str:
    """Format EKF2 parameters with their new values, for example "EKF2_EV_DELAY to 264 ms"."""
    parameter_texts = (
        f"{name} to {value:.3g} {KNOWN_PARAMETERS[name].printed_unit}"
        for name, value in changes.items()
    )
    return " and ".join(map(str.rstrip, parameter_texts))
