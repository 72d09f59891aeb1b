"""What the data ask of EKF2's parameters, by tuning and by the clock offset."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.model import Model
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.signals import AISLE
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight import Unavailable

# EKF2 takes R from the sender where that is more than this many times EKF2_EVP_NOISE
REPORTED_TIMES = 1.25
# One prediction of EKF2 (EKF2_PREDICT_US), and what a message takes to arrive
UPDATE_MS, ARRIVAL_MS = 10.0, 30.0
DELAY_STEP_MS = 50.0


def asked_of_ekf2(
    comparison: Comparison,
    model: Model,
    tuning: Mapping[str, AxisTuning | Unavailable],
    clock: ClockOffset | Unavailable,
) -> dict[str, float]:
    """EKF2's parameters as the data ask for them, by PX4 name and in PX4's units.

    Parameters
    ----------
    comparison : Comparison
    model : Model
        Of its flight.
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable

    Returns
    -------
    dict
        Empty where the data tell nothing, or the source that was analysed is not the one that EKF2
        fused. The delay only where what was flown is outside its interval. The noise of a source
        that may drift only where EKF2 trusts it even more than its short-term noise allows: small
        innovations against such a source say nothing about its error.
    """
    source = comparison.source
    if source.name != model.inputs.vision.source or source.alignment is not None:
        return {}
    changes: dict[str, float] = {}
    noise_m = tuned_noise_m(tuning)
    trusted = noise_m is not None and noise_m <= noise_used_m(model)
    if noise_m is not None and not (trusted and source.origin.may_drift):
        changes |= noise_change(model, noise_m)
    if isinstance(clock, ClockOffset) and clock.determinable:
        flown = model.inputs.settings["EKF2_EV_DELAY"]
        high, low = (-1e3 * end for end in clock.interval_s)
        if not low - UPDATE_MS <= flown <= high + UPDATE_MS:
            changes |= delay_change(model, -1e3 * clock.offset_s)
    return changes


def tuned_noise_m(tuning: Mapping[str, AxisTuning | Unavailable]) -> float | None:
    """Horizontal measurement noise (m) that the data ask for; None where they do not tell."""
    known = (tuning.get(name) for name in (HORIZONTAL, AISLE, "north", "east"))
    return next((tuned.sigma_z.value for tuned in known if isinstance(tuned, AxisTuning)), None)


def noise_change(model: Model, noise_m: float) -> dict[str, float]:
    """What to set so that EKF2 takes a position's standard deviation (m) to be this.

    Two digits, within PX4's range.
    """
    settings = model.inputs.settings
    least = PARAMETERS["EKF2_EVP_NOISE"].minimum
    changes = {"EKF2_EVP_NOISE": max(float(f"{noise_m:.2g}"), least)}
    reported = noise_used_m(model) > REPORTED_TIMES * settings["EKF2_EVP_NOISE"]
    if reported and noise_m < noise_used_m(model) and settings["EKF2_EV_NOISE_MD"] == 0.0:
        changes["EKF2_EV_NOISE_MD"] = 1.0
    return changes


def delay_change(model: Model, delay_ms: float) -> dict[str, float]:
    """What to set so that EKF2 takes positions to be this older than their stamps.

    Nothing where PX4's range ends before; 0 for stamps that are early.
    """
    known = PARAMETERS["EKF2_EV_DELAY"]
    if delay_ms > known.maximum:
        return {}
    changes = {"EKF2_EV_DELAY": max(float(round(delay_ms)), known.minimum)}
    needed, flown = changes["EKF2_EV_DELAY"] + ARRIVAL_MS, model.inputs.settings
    if not model.inputs.rules.horizon_by_delay and needed > flown["EKF2_DELAY_MAX"]:
        changes["EKF2_DELAY_MAX"] = DELAY_STEP_MS * math.ceil(needed / DELAY_STEP_MS)
    return {name: value for name, value in changes.items() if value != flown[name]}


def noise_used_m(model: Model) -> float:
    """Median √R (m) of EKF2 as flown."""
    updates = model.flown.updates
    columns = ["observation_variance_north_m2", "observation_variance_east_m2"]
    return float(np.sqrt(np.median(updates[columns].to_numpy())))
