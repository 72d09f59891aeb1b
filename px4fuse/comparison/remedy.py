"""EKF2 parameters that agree with the estimated noise and delay of the position source."""

import math
from collections.abc import Mapping

import numpy as np

from px4fuse.comparison.estimates import Tuning, first_axis_tuning
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model
from px4fuse.filter.signals import AISLE
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight.ekf2_parameters import EV_POS, PARAMETERS, Aid
from px4fuse.flight.model import Unavailable

# Minimum ratio of √R and EKF2_EVP_NOISE for an R that the sender reports
MIN_REPORTED_RATIO = 1.25
# Prediction step (ms) of EKF2 (EKF2_PREDICT_US)
PREDICTION_STEP_MS = 10.0
# Transmission time (ms) of a position message
TRANSMISSION_MS = 30.0
# Step (ms) to which EKF2_DELAY_MAX is rounded up
DELAY_MAX_STEP_MS = 50.0


def ml_ekf2_parameters(
    comparison: Comparison,
    model: Model,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
) -> dict[str, float]:
    """Return the maximum-likelihood values of EKF2's noise and delay parameters.

    Parameters
    ----------
    comparison : Comparison
    model : Model
        EKF2 of the same flight.
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable

    Returns
    -------
    dict
        Empty without an estimate or if EKF2 did not fuse the analysed source. The delay is included
        only if the flown value is outside its 95 % interval. For GNSS and drifting sources the
        noise is included only if EKF2 uses a smaller one: innovations do not show slow errors.
    """
    if not is_fused_source(comparison, model.inputs):
        return {}
    changes: dict[str, float] = {}
    axis_tuning = first_axis_tuning(tuning, HORIZONTAL, AISLE, "north", "east")
    used_m = noise_used_m(model)
    noise_m = None if axis_tuning is None else axis_tuning.sigma_z.value
    has_slow_errors = comparison.source.origin.may_drift or comparison.source.origin.is_gnss
    if noise_m is not None and not (has_slow_errors and noise_m <= used_m):
        changes |= noise_change(model.inputs.aid, model.inputs.settings, used_m, noise_m)
    return changes | ml_delay_change(comparison, model.inputs, clock)


def is_fused_source(comparison: Comparison, inputs: Inputs) -> bool:
    """Return True if EKF2 fused the analysed source."""
    source = comparison.source
    return source.name == inputs.received.source and source.alignment is None


def ml_delay_change(
    comparison: Comparison, inputs: Inputs, clock: ClockOffset | Unavailable
) -> dict[str, float]:
    """Return the estimated delay parameter of EKF2, if it differs significantly."""
    if isinstance(clock, Unavailable) or not clock.is_determinable:
        return {}
    age_s, flown = comparison.source.age_s, inputs.settings[inputs.aid.delay]
    high, low = (1e3 * (age_s - offset_s) for offset_s in clock.interval_s)
    if low - PREDICTION_STEP_MS <= flown <= high + PREDICTION_STEP_MS:
        return {}
    return delay_change(inputs, 1e3 * (age_s - clock.offset_s))


def aid_of(comparison: Comparison, axis: str = "") -> Aid:
    """Return EKF2's aiding source for the positions along an axis."""
    return comparison.source.aid(axis) or EV_POS


def delay_ms(comparison: Comparison) -> float | None:
    """Return the delay (ms) that EKF2 subtracts from the timestamps of the positions.

    None if the parameter is not logged or EKF2 does not use it.
    """
    source = comparison.source
    if source.origin.aid is None:
        return None
    parameter_ms = comparison.flight.log.parameters.get(source.origin.aid.delay)
    return (
        None
        if source.origin.fused_as_gnss and source.age_s == 0.0 != parameter_ms
        else parameter_ms
    )


def noise_change(
    aid: Aid, settings: Mapping[str, float], used_m: float, noise_m: float
) -> dict[str, float]:
    """Return the EKF2 parameters for a position noise ``noise_m``.

    ``settings`` and ``used_m`` (median √R) are the parameters and the noise as flown.
    """
    changes = {aid.noise: max(float(f"{noise_m:.2g}"), PARAMETERS[aid.noise].minimum)}
    is_reported = used_m > MIN_REPORTED_RATIO * settings.get(aid.noise, math.inf)
    may_differ = aid.noise_mode and settings.get(aid.noise_mode, 0.0) == 0.0
    if may_differ and is_reported and noise_m < used_m:
        changes[aid.noise_mode] = 1.0
    return changes


def delay_change(inputs: Inputs, delay_ms: float) -> dict[str, float]:
    """Return the EKF2 parameters for a position delay ``delay_ms``; early timestamps give 0.

    Empty if the delay exceeds PX4's range or EKF2 uses the measurement times of the source.
    """
    delay = inputs.aid.delay
    parameter = PARAMETERS[delay]
    if delay_ms > parameter.maximum or inputs.received.uses_sender_times:
        return {}
    changes = {delay: max(float(round(delay_ms)), parameter.minimum)}
    needed_ms, flown = changes[delay] + TRANSMISSION_MS, inputs.settings
    if not inputs.rules.uses_delay_as_horizon and needed_ms > flown["EKF2_DELAY_MAX"]:
        changes["EKF2_DELAY_MAX"] = DELAY_MAX_STEP_MS * math.ceil(needed_ms / DELAY_MAX_STEP_MS)
    return {name: value for name, value in changes.items() if value != flown[name]}


def noise_used_m(model: Model) -> float:
    """Return the median √R (m) that EKF2 used for the positions."""
    updates = model.flown.updates
    columns = ["observation_variance_north_m2", "observation_variance_east_m2"]
    return float(np.sqrt(np.median(updates[columns].to_numpy())))


def format_settings(changes: Mapping[str, float]) -> str:
    """Format EKF2 parameters with their new values, for example "EKF2_EV_DELAY to 264 ms"."""
    texts = (f"{n} to {value:.3g} {PARAMETERS[n].printed_unit}" for n, value in changes.items())
    return " and ".join(map(str.rstrip, texts))
