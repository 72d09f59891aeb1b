"""What the data ask of EKF2's parameters, and what a replay says of a remedy, EKF2's or ours.

A change is proposed with its effect, and only where the replay confirms it. Where EKF2 cannot be
replayed, the words say so.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from px4fuse.comparison import say
from px4fuse.comparison.comparison import kf_error_statistics
from px4fuse.comparison.estimates import Tuning, first_axis_tuning
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.preparation import shift_clock
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.whatif import Summary, what_if
from px4fuse.ekf2_parameters import EV_POS, PARAMETERS, Aid
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.quick import quick_replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE, make_axes
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight import Unavailable
from px4fuse.plain import capitalise_first
from px4fuse.request import OPTIONS

# EKF2 takes R from the sender where that is more than this many times EKF2_EVP_NOISE
MIN_REPORTED_RATIO = 1.25
# One prediction of EKF2 (EKF2_PREDICT_US), and what a message takes to arrive
UPDATE_MS, ARRIVAL_MS = 10.0, 30.0
DELAY_STEP_MS = 50.0
# How a remedy to type is written; who prints it knows the log (px4fuse.report.commands)
COMMAND = "px4fuse compare LOG"
# A noise must bring |log mean NIS| below this share of itself: what does less is not its cause
MAX_LOG_NIS_RATIO = 0.8
# Half of the rejections are an effect, not a single sample
MAX_REJECTED_RATIO = 0.5
# Times of the error to the truth that are no accident: errors last for seconds, so that a flight of
# two minutes has some fifty that are independent, which tell their root mean square to a tenth
MAX_ERROR_RATIO = 1.10
# The same of our filter, which is replayed exactly: hardly a settings changes it by less
MAX_KF_ERROR_RATIO = 1.005
# Shares of rejected samples below this are not worth a word
REJECTED_SHOWN = 0.005


def ml_ekf2_parameters(
    comparison: Comparison,
    model: Model,
    tuning: Tuning,
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
        that may drift, or of GNSS, only where EKF2 trusts it even more than its short-term noise
        allows: small innovations against such a source say nothing about its error.
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
    """Whether EKF2 fused what was analysed."""
    source = comparison.source
    return source.name == inputs.received.source and source.alignment is None


def ml_delay_change(
    comparison: Comparison, inputs: Inputs, clock: ClockOffset | Unavailable
) -> dict[str, float]:
    """EKF2's delay as the data ask for it; empty where they do not tell, or it is as flown."""
    if isinstance(clock, Unavailable) or not clock.determinable:
        return {}
    age_s, flown = comparison.source.age_s, inputs.settings[inputs.aid.delay]
    high, low = (1e3 * (age_s - end) for end in clock.interval_s)
    if low - UPDATE_MS <= flown <= high + UPDATE_MS:
        return {}
    return delay_change(inputs, 1e3 * (age_s - clock.offset_s))


def aid_of(comparison: Comparison, axis: str = "") -> Aid:
    """What EKF2 takes the source as along an axis, with the names of its parameters."""
    return comparison.source.aid(axis) or EV_POS


def delay_ms(comparison: Comparison) -> float | None:
    """What EKF2 takes positions of the source to be older than their stamps (ms).

    None where the log does not tell, EKF2 never fuses the source, or takes the times of a receiver.
    """
    source = comparison.source
    if source.origin.aid is None:
        return None
    found = comparison.flight.log.parameters.get(source.origin.aid.delay)
    return None if source.origin.fused_as_gnss and source.age_s == 0.0 != found else found


def noise_change(
    aid: Aid, settings: Mapping[str, float], used_m: float, noise_m: float
) -> dict[str, float]:
    """What to set so that EKF2 takes a position's standard deviation (m) to be this.

    Two digits, within PX4's range; ``settings`` and ``used_m`` are what it took.
    """
    changes = {aid.noise: max(float(f"{noise_m:.2g}"), PARAMETERS[aid.noise].minimum)}
    is_reported = used_m > MIN_REPORTED_RATIO * settings.get(aid.noise, math.inf)
    may_differ = aid.noise_mode and settings.get(aid.noise_mode, 0.0) == 0.0
    if may_differ and is_reported and noise_m < used_m:
        changes[aid.noise_mode] = 1.0
    return changes


def delay_change(inputs: Inputs, delay_ms: float) -> dict[str, float]:
    """What to set so that EKF2 takes positions to be this older than their stamps.

    Nothing where PX4's range ends before, or no parameter tells; 0 for stamps that are early.
    """
    delay = inputs.aid.delay
    known = PARAMETERS[delay]
    if delay_ms > known.maximum or inputs.received.own_times:
        return {}
    changes = {delay: max(float(round(delay_ms)), known.minimum)}
    needed, flown = changes[delay] + ARRIVAL_MS, inputs.settings
    if not inputs.rules.horizon_by_delay and needed > flown["EKF2_DELAY_MAX"]:
        changes["EKF2_DELAY_MAX"] = DELAY_STEP_MS * math.ceil(needed / DELAY_STEP_MS)
    return {name: value for name, value in changes.items() if value != flown[name]}


def noise_used_m(model: Model) -> float:
    """Median √R (m) of EKF2 as flown."""
    updates = model.flown.updates
    columns = ["observation_variance_north_m2", "observation_variance_east_m2"]
    return float(np.sqrt(np.median(updates[columns].to_numpy())))


def format_whatif_effect(before: Summary, after: Summary) -> str:
    """What a change of EKF2's parameters does, in numbers, by replays without it and with it."""
    texts = []
    if max(before.rejected_share, after.rejected_share) >= REJECTED_SHOWN:
        texts.append(f"rejected {before.rejected_share:.0%} → {after.rejected_share:.0%}")
    texts.append(f"mean NIS {_format_nis(before.nis_mean)} → {_format_nis(after.nis_mean)}")
    flown_rmse, changed_rmse = before.position_rmse_to_truth_m, after.position_rmse_to_truth_m
    if isinstance(flown_rmse, Unavailable):
        texts.append(
            f"innovations {_innovation_std_m(before):.3f} → {_innovation_std_m(after):.3f} m rms, no truth"
        )
    else:
        texts.append(f"position error {flown_rmse:.2f} → {changed_rmse:.2f} m")
    return f"{', '.join(texts)} (replayed)"


def format_ekf2_remedy(
    model: Model | Unavailable,
    changes: Mapping[str, float],
    helps: Callable[[Summary, Summary], bool],
    *,
    why: str = "",
    fallback_remedy: str,
) -> str:
    """A change of EKF2's parameters in words, as a remedy where no replay denies it.

    Parameters
    ----------
    model : Model or Unavailable
        Of the flight.
    changes : mapping
    helps : callable
        From EKF2 as flown and as changed to whether that is a remedy.
    why : str
        Words before it: what the data ask for.
    fallback_remedy : str
        What to do where the replay says that it is none.
    """
    setting = f"{why}set {format_settings(changes)}"
    replays = model if isinstance(model, Unavailable) else what_if(model, [changes])
    if isinstance(replays, Unavailable):
        return f"{capitalise_first(setting)}. {format_not_replayed(replays)}"
    before, (after,) = replays.replayed, replays.whatif
    if not after.steady:
        settings_text = format_settings(changes)
        return (
            f"{fallback_remedy} What {settings_text} would do is chaotic: single rejections decide."
        )
    effect = format_whatif_effect(before, after)
    if helps(before, after):
        return f"{capitalise_first(setting)}: {effect}."
    settings_text = ", ".join(f"{name} {value:.3g}" for name, value in changes.items())
    return f"{fallback_remedy} {settings_text} is no remedy: {effect}."


def filter_errors_m(comparison: Comparison, changed: Settings) -> tuple[float, float] | None:
    """Position error (m) of our filter to the truth, as it is and with other settings.

    Root of the sum of the mean squares of all axes but the aisle, which is made of the others.
    None without a truth.
    """
    if isinstance(comparison.flight.truth, Unavailable):
        return None
    names = tuple(name for name in comparison.axes if name != AISLE) or (AISLE,)
    results = [comparison.axes[name] for name in names]
    later_s = changed.clock_offset_s - comparison.settings.clock_offset_s
    lines = make_axes(
        comparison.flight,
        shift_clock(comparison.source, later_s),
        comparison.segment,
        names=names,
        heading_deg=results[0].heading_deg,
    )
    errors_m: list[tuple[float, float]] = []
    for result, line in zip(results, lines, strict=True):
        kf_run, before = quick_replay(line, changed), result.filters["kf"].truth
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
    unseen_nats: float | None = None,
) -> str:
    """Other settings of our filter as a remedy, as far as truth or unseen data confirm it.

    Parameters
    ----------
    comparison : Comparison
    changes : mapping from field of Settings to value
        Rounded to three digits.
    suffix : str
        Words behind the options that make them.
    unseen_nats : float or None
        What settings found on one half gain per measurement of the other; None where not known.
    """
    rounded_settings: dict[str, Any] = {
        name: float(f"{value:.3g}") for name, value in changes.items()
    }
    typed = (
        " ".join(f"{OPTIONS[name].name} {value:g}" for name, value in rounded_settings.items())
        + suffix
    )
    changed = replace(comparison.settings, **rounded_settings)
    errors = filter_errors_m(comparison, changed)
    if errors is None:
        if unseen_nats is not None and unseen_nats <= 0.0:
            return say("unseen", typed=typed)
        return f"{COMMAND} {typed}."
    before, after = errors
    effect = f"position error {before:.3f} → {after:.3f} m (replayed)"
    if after > MAX_KF_ERROR_RATIO * before:
        return f"Leave it: {typed} fits the innovations better, but not the truth: {effect}."
    return f"{COMMAND} {typed}: {effect}."


def format_not_replayed(why: Unavailable) -> str:
    """That a remedy was not tried, and why."""
    return f"Not replayed: {why.reason}."


def format_settings(changes: Mapping[str, float]) -> str:
    """Parameters and the values to set."""
    texts = (f"{name} to {value:.3g} {PARAMETERS[name].unit}" for name, value in changes.items())
    return " and ".join(map(str.rstrip, texts))


def noise_helps(before: Summary, after: Summary) -> bool:
    """Whether another noise brings the mean NIS nearer to 1, and neither rejects nor errs more."""
    is_nearer = abs(math.log(after.nis_mean)) < MAX_LOG_NIS_RATIO * abs(math.log(before.nis_mean))
    is_worse = after.rejected_share > before.rejected_share or _increases_error(
        before, after, MAX_ERROR_RATIO
    )
    return is_nearer and not is_worse


def rejects_less(before: Summary, after: Summary) -> bool:
    """Whether far fewer samples are rejected, and the position is not worse."""
    rejects_fewer = after.rejected_share < MAX_REJECTED_RATIO * before.rejected_share
    return rejects_fewer and not _increases_error(before, after, MAX_ERROR_RATIO)


def delay_helps(before: Summary, after: Summary) -> bool:
    """Whether the innovations become smaller, and the error to the truth where there is one."""
    is_smaller = (
        _innovation_std_m(after) < _innovation_std_m(before)
        and after.rejected_share <= before.rejected_share
    )
    return is_smaller and not _increases_error(before, after, 1.0)


def _increases_error(before: Summary, after: Summary, factor: float) -> bool:
    """Whether the error to the truth becomes so many times what it was; not where none is known."""
    error, flown_error = after.position_rmse_to_truth_m, before.position_rmse_to_truth_m
    return (
        isinstance(error, float) and isinstance(flown_error, float) and error > factor * flown_error
    )


def _innovation_std_m(summary: Summary) -> float:
    """Standard deviation of the innovations per axis (m)."""
    return math.sqrt(np.mean([axis.innovation_std_m**2 for axis in summary.axes.values()]))


def _format_nis(nis: float) -> str:
    return f"{nis:.0f}" if nis >= 9.95 else f"{nis:.1f}" if nis >= 0.095 else f"{nis:.2g}"
