"""Maximum-likelihood EKF2 parameters, and the replayed effect of a change to EKF2 or KF.

A change is proposed with its effect, and only if a replay confirms the effect. If EKF2 cannot be
replayed, the text states the reason.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from px4fuse.comparison.comparison import kf_error_statistics
from px4fuse.comparison.estimates import Tuning, first_axis_tuning
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.preparation import shift_clock
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.whatif import Summary, what_if
from px4fuse.ekf2_parameters import EV_POS, PARAMETERS, Aid
from px4fuse.filter.fast_replay import quick_replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE, make_axes
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight import Unavailable
from px4fuse.request import COMPARISON_OPTIONS
from px4fuse.text import capitalise_first

# Minimum ratio of √R to EKF2_EVP_NOISE from which R counts as reported by the sender
MIN_REPORTED_RATIO = 1.25
# ms; one prediction step of EKF2 (EKF2_PREDICT_US), and transmission time of a message
PREDICTION_STEP_MS, TRANSMISSION_MS = 10.0, 30.0
# ms; EKF2_DELAY_MAX is rounded up to a multiple
DELAY_MAX_STEP_MS = 50.0
# Placeholder of the command to paste; px4fuse.report.commands inserts the log
COMMAND = "px4fuse compare LOG"
# A noise change must reduce |ln(mean NIS)| to less than this share
MAX_LOG_NIS_RATIO = 0.8
# A change must reduce the rejected share to less than this share
MAX_REJECTED_RATIO = 0.5
# Significant ratio of two RMSEs: errors are correlated over seconds, so a flight of two minutes has
# about fifty independent errors, and the standard error of the RMSE is 10 %
MAX_ERROR_RATIO = 1.10
# Significant ratio of two RMSEs of KF, whose replay is exact
MAX_KF_ERROR_RATIO = 1.005
# Minimum share of rejected samples that a text states
MIN_SHOWN_REJECTED_SHARE = 0.005


def ml_ekf2_parameters(
    comparison: Comparison,
    model: Model,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
) -> dict[str, float]:
    """Return maximum-likelihood EKF2 parameters, by PX4 name and in PX4's units.

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
        only if the flown value is outside its interval. For GNSS and drifting sources the noise is
        included only if EKF2 uses less than the short-term noise: innovations do not show the slow
        errors of these sources.
    """
    if not is_fused_source(comparison, model.inputs):
        return {}
    changes: dict[str, float] = {}
    axis_tuning, used_m = (
        first_axis_tuning(tuning, HORIZONTAL, AISLE, "north", "east"),
        noise_used_m(model),
    )
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
    """Return EKF2's maximum-likelihood delay; empty without an estimate or change."""
    if isinstance(clock, Unavailable) or not clock.is_determinable:
        return {}
    age_s, flown = comparison.source.age_s, inputs.settings[inputs.aid.delay]
    high, low = (1e3 * (age_s - offset_s) for offset_s in clock.interval_s)
    if low - PREDICTION_STEP_MS <= flown <= high + PREDICTION_STEP_MS:
        return {}
    return delay_change(inputs, 1e3 * (age_s - clock.offset_s))


def aid_of(comparison: Comparison, axis: str = "") -> Aid:
    """Return the aid as which EKF2 fuses the source along an axis."""
    return comparison.source.aid(axis) or EV_POS


def delay_ms(comparison: Comparison) -> float | None:
    """Return the age of positions (ms, relative to their timestamps) that EKF2 assumes.

    None if the parameter is not logged, EKF2 never fuses the source, or the receiver reports
    measurement times.
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
    """Return the parameters that set EKF2's position noise to ``noise_m``.

    The value has two digits and is within PX4's range. ``settings`` and ``used_m`` (median √R) are
    the parameters and the noise as flown.
    """
    changes = {aid.noise: max(float(f"{noise_m:.2g}"), PARAMETERS[aid.noise].minimum)}
    is_reported = used_m > MIN_REPORTED_RATIO * settings.get(aid.noise, math.inf)
    may_differ = aid.noise_mode and settings.get(aid.noise_mode, 0.0) == 0.0
    if may_differ and is_reported and noise_m < used_m:
        changes[aid.noise_mode] = 1.0
    return changes


def delay_change(inputs: Inputs, delay_ms: float) -> dict[str, float]:
    """Return the parameters that set the position age that EKF2 assumes to ``delay_ms``.

    Empty if the delay exceeds PX4's range or EKF2 uses the measurement times of the source. For
    early timestamps the delay is 0.
    """
    delay = inputs.aid.delay
    parameter = PARAMETERS[delay]
    if delay_ms > parameter.maximum or inputs.received.uses_sender_times:
        return {}
    changes = {delay: max(float(round(delay_ms)), parameter.minimum)}
    needed_ms, flown = changes[delay] + TRANSMISSION_MS, inputs.settings
    if not inputs.rules.horizon_by_delay and needed_ms > flown["EKF2_DELAY_MAX"]:
        changes["EKF2_DELAY_MAX"] = DELAY_MAX_STEP_MS * math.ceil(needed_ms / DELAY_MAX_STEP_MS)
    return {name: value for name, value in changes.items() if value != flown[name]}


def noise_used_m(model: Model) -> float:
    """Return the median √R (m) of EKF2 as flown."""
    updates = model.flown.updates
    columns = ["observation_variance_north_m2", "observation_variance_east_m2"]
    return float(np.sqrt(np.median(updates[columns].to_numpy())))


def format_whatif_effect(before: Summary, after: Summary) -> str:
    """Format the effect of changed EKF2 parameters from replays without and with the change."""
    texts = []
    if max(before.rejected_fraction, after.rejected_fraction) >= MIN_SHOWN_REJECTED_SHARE:
        texts.append(
            f"rejected {100 * before.rejected_fraction:.0f} % → "
            f"{100 * after.rejected_fraction:.0f} %"
        )
    texts.append(f"mean NIS {_format_nis(before.nis_mean)} → {_format_nis(after.nis_mean)}")
    flown_rmse, changed_rmse = before.position_rmse_to_truth_m, after.position_rmse_to_truth_m
    if isinstance(flown_rmse, Unavailable):
        texts.append(
            f"innovation σ {_innovation_std_m(before):.3f} → {_innovation_std_m(after):.3f} m"
            " (no ground truth)"
        )
    else:
        texts.append(f"position RMSE {flown_rmse:.2f} → {changed_rmse:.2f} m")
    return f"{', '.join(texts)} (re-run)"


def format_ekf2_remedy(
    model: Model | Unavailable,
    changes: Mapping[str, float],
    helps: Callable[[Summary, Summary], bool],
    *,
    prefix: str = "",
    fallback_remedy: str,
) -> str:
    """Format a change of EKF2's parameters as an action with its replayed effect.

    Parameters
    ----------
    model : Model or Unavailable
        EKF2 of the flight.
    changes : mapping
    helps : callable
        Called with the summaries as flown and with the change; returns True if the change helps.
    prefix : str
        Text before the action.
    fallback_remedy : str
        Action if the replay shows that the change does not help.
    """
    setting = f"{prefix}set {format_settings(changes)}"
    replays = model if isinstance(model, Unavailable) else what_if(model, [changes])
    if isinstance(replays, Unavailable):
        return f"{capitalise_first(setting)}. {format_not_replayed(replays)}"
    before, (after,) = replays.replayed, replays.whatif
    if not after.is_predictable:
        return (
            f"{fallback_remedy} The effect of setting {format_settings(changes)} is not "
            "predictable: single rejections decide."
        )
    effect = format_whatif_effect(before, after)
    if helps(before, after):
        return f"{capitalise_first(setting)}: {effect}."
    settings_text = ", ".join(f"{name} {value:.3g}" for name, value in changes.items())
    return f"{fallback_remedy} {settings_text} does not help: {effect}."


def filter_errors_m(comparison: Comparison, settings: Settings) -> tuple[float, float] | None:
    """Return KF's position RMSE (m) with the current and with other settings.

    All axes are combined (root of the summed mean squares) except the aisle, which is a
    combination of north and east. None without ground truth.
    """
    if isinstance(comparison.flight.truth, Unavailable):
        return None
    names = tuple(name for name in comparison.axes if name != AISLE) or (AISLE,)
    results = [comparison.axes[name] for name in names]
    shift_s = settings.clock_offset_s - comparison.settings.clock_offset_s
    lines = make_axes(
        comparison.flight,
        shift_clock(comparison.source, shift_s),
        comparison.segment,
        names=names,
        heading_deg=results[0].heading_deg,
    )
    errors_m: list[tuple[float, float]] = []
    for result, line in zip(results, lines, strict=True):
        kf_run, before = quick_replay(line, settings), result.filters["kf"].truth
        after = kf_error_statistics(kf_run, result.truth, result.ekf2_state)
        if isinstance(before, Unavailable) or isinstance(after, Unavailable):
            return None
        errors_m.append((before.position_rmse_m, after.position_rmse_m))
    before_m, after_m = zip(*errors_m, strict=True)
    return math.hypot(*before_m), math.hypot(*after_m)


def format_kf_remedy(
    comparison: Comparison,
    changes: Mapping[str, float],
    suffix: str = "",
    held_out_nats: float | None = None,
) -> str:
    """Format other settings of KF as an action, if ground truth or held-out data confirm it.

    Parameters
    ----------
    comparison : Comparison
    changes : mapping from field of Settings to value
        Rounded to three digits.
    suffix : str
        Text after the options.
    held_out_nats : float or None
        Log-likelihood gain per measurement of the second half of the flight with settings estimated
        on the first half; None if unknown.
    """
    rounded_settings: dict[str, Any] = {
        name: float(f"{value:.3g}") for name, value in changes.items()
    }
    options_text = (
        " ".join(
            f"{COMPARISON_OPTIONS[name]} {value:g}" for name, value in rounded_settings.items()
        )
        + suffix
    )
    changed = replace(comparison.settings, **rounded_settings)
    errors = filter_errors_m(comparison, changed)
    if errors is None:
        if held_out_nats is not None and held_out_nats <= 0.0:
            return (
                f"No change advised: {options_text} is the maximum-likelihood estimate, but "
                "settings estimated on the first half of the flight do not improve the second half."
            )
        return f"{COMMAND} {options_text}."
    before, after = errors
    effect = f"position RMSE {before:.3f} → {after:.3f} m (re-run)"
    if after > MAX_KF_ERROR_RATIO * before:
        return (
            f"No change advised: {options_text} fits the innovations better, but increases the "
            f"error: {effect}."
        )
    return f"{COMMAND} {options_text}: {effect}."


def format_not_replayed(prefix: Unavailable) -> str:
    """Format the reason why a remedy could not be replayed."""
    return f"Not replayed: {prefix.reason}."


def format_settings(changes: Mapping[str, float]) -> str:
    """Format parameters with the values to set: "EKF2_EV_DELAY to 264 ms and ..."."""
    texts = (f"{name} to {value:.3g} {PARAMETERS[name].unit}" for name, value in changes.items())
    return " and ".join(map(str.rstrip, texts))


def noise_helps(before: Summary, after: Summary) -> bool:
    """Return True if the mean NIS is nearer to 1, without more rejections or a larger RMSE."""
    is_nearer = abs(math.log(after.nis_mean)) < MAX_LOG_NIS_RATIO * abs(math.log(before.nis_mean))
    is_worse = after.rejected_fraction > before.rejected_fraction or _increases_error(
        before, after, MAX_ERROR_RATIO
    )
    return is_nearer and not is_worse


def rejects_less(before: Summary, after: Summary) -> bool:
    """Return True if the rejected share is less than half, without a larger position RMSE."""
    rejects_fewer = after.rejected_fraction < MAX_REJECTED_RATIO * before.rejected_fraction
    return rejects_fewer and not _increases_error(before, after, MAX_ERROR_RATIO)


def delay_helps(before: Summary, after: Summary) -> bool:
    """Return True if the innovations are smaller, without more rejections or a larger RMSE."""
    is_smaller = (
        _innovation_std_m(after) < _innovation_std_m(before)
        and after.rejected_fraction <= before.rejected_fraction
    )
    return is_smaller and not _increases_error(before, after, 1.0)


def _increases_error(before: Summary, after: Summary, factor: float) -> bool:
    """Return True if the position RMSE grows by more than ``factor``; False if unknown."""
    error, flown_error = after.position_rmse_to_truth_m, before.position_rmse_to_truth_m
    return (
        isinstance(error, float) and isinstance(flown_error, float) and error > factor * flown_error
    )


def _innovation_std_m(summary: Summary) -> float:
    """Return the RMS over the axes of the innovation standard deviation (m)."""
    return math.sqrt(np.mean([axis.innovation_std_m**2 for axis in summary.axes.values()]))


def _format_nis(nis: float) -> str:
    return f"{nis:.0f}" if nis >= 9.95 else f"{nis:.1f}" if nis >= 0.095 else f"{nis:.2g}"
