"""Why EKF2 differs from our filter, along each horizontal axis, in steps and in words.

The steps are those of :mod:`px4fuse.ekf2.walk`, from our filter as it was set to the logged EKF2.
The sentences are made of them last: what each filter does, with numbers, and when it mattered.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.comparison import say
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.remedy import noise_used_m
from px4fuse.ekf2 import walk as ways
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import Spans, inside_spans
from px4fuse.ekf2.walk import Step, UnreplayedPart, Why
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import state_at
from px4fuse.filter.settings import Settings
from px4fuse.flight import Unavailable
from px4fuse.record import table

# Filters whose errors differ by less are equally close to the truth
EQUAL_RMSE_TOLERANCE = 0.05
# Shares of the mean square below this are not worth a word
MIN_NOTABLE_SHARE = 0.05
# How much farther apart than where they were walked both must be elsewhere to be said (m, times)
MIN_ELSEWHERE_M, MIN_ELSEWHERE_RATIO = 0.5, 3.0
REASONS = table(__file__, "steps.toml", dict[str, str])


def explain_ekf2_difference(
    comparison: Comparison, model: Model | Unavailable, clock: ClockOffset | Unavailable
) -> dict[str, Why | Unavailable]:
    """Why EKF2 differs along each axis of a comparison.

    Parameters
    ----------
    comparison : Comparison
    model : Model or Unavailable
        Of the comparison's flight.
    clock : ClockOffset or Unavailable
        Says how old positions are, as the data have it.

    Returns
    -------
    mapping from axis name to Why or Unavailable
        Of down only where nothing else was compared: the model is of horizontal position.
    """
    results = {name: result for name, result in comparison.axes.items() if name != "down"}
    if not results:
        reason = "the model of EKF2 is of horizontal position"
        return {
            "down": Unavailable(
                ways.ANALYSIS_NAME, reason, "Analyse a horizontal axis too (--axis)."
            )
        }
    if isinstance(model, Unavailable):
        return {name: structs.replace(model, what=ways.ANALYSIS_NAME) for name in results}
    settings = _settings(comparison, model.inputs)
    explanations = ways.explain_by_steps(
        model, settings, {name: axis.replay for name, axis in results.items()}
    )
    if isinstance(explanations, Unavailable):
        return dict.fromkeys(results, explanations)
    reasons = _step_reasons(comparison, model, clock)
    sentences_by_axis: dict[str, Why | Unavailable] = {}
    for name, why in explanations.items():
        outside = structs.replace(why, outside=_unreplayed_part(results[name], why.spans_s))
        sentences_by_axis[name] = add_sentences(outside, comparison.axes[name].axis.called, reasons)
    return sentences_by_axis


def explanation_variants(comparison: Comparison, inputs: Inputs) -> list[Variant]:
    """The variants of EKF2 that :func:`explain_ekf2_difference` asks for."""
    return list(ways.step_variants(inputs, _settings(comparison, inputs)).values())


def _settings(comparison: Comparison, inputs: Inputs) -> Settings:
    """Of our filter, whose clock offset is that of the source that was analysed."""
    same = comparison.source.name == inputs.received.source
    return comparison.settings if same else replace(comparison.settings, clock_offset_s=0.0)


def _unreplayed_part(result: AxisComparison, spans: Spans) -> UnreplayedPart | None:
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return None
    state = result.ekf2_state[~inside_spans(result.ekf2_state.index, spans)]
    times = state.index.to_numpy()
    distance_m = np.abs(state_at(result.replay, times)[0] - state["position_m"].to_numpy())
    if not np.isfinite(distance_m).any():
        return None
    largest = int(np.nanargmax(distance_m))
    return UnreplayedPart(float(distance_m[largest]), float(times[largest]))


def add_sentences(why: Why, axis_label: str, reasons: dict[str, str]) -> Why:
    """The same with sentences: what makes EKF2 differ along an axis, the weightiest first.

    Parameters
    ----------
    why : Why
    axis_label : str
        The axis in a sentence.
    reasons : dict
        What EKF2 does at each step, and what ours does.
    """
    reasons = {**reasons, ways.GATE: f"{reasons[ways.GATE]}{_rejection_text(why)}"}
    first, second, *_ = sorted(why.steps, key=lambda step: -step.position_mean_square_m2)
    half = 0.5 * why.position_mean_square_m2
    quantifier = "Most" if first.position_mean_square_m2 >= half else "The largest part"
    cause = (
        f"{quantifier} of what ours and EKF2 are apart along {axis_label} is the {first.name} "
        f"({_format_share(first, why)}): {reasons[first.name]}"
    )
    sentences = [f"{cause}{_moment_text(first)}."]
    if second.position_mean_square_m2 >= MIN_NOTABLE_SHARE * why.position_mean_square_m2:
        share, reason = _format_share(second, why), reasons[second.name]
        sentences.append(f"Then the {second.name} ({share}): {reason}{_moment_text(second)}.")
    sentences += [_velocity_sentence(why), *_truth_sentences(why)]
    far_m = max(MIN_ELSEWHERE_M, MIN_ELSEWHERE_RATIO * float(np.max(np.abs(why.kf_minus_ekf2_m))))
    if why.outside is not None and why.outside.maximum_m > far_m:
        sentences.append(say("elsewhere", why=why))
    return structs.replace(why, sentences=tuple(sentences), cause=f"{cause}.")


def _format_share(part: Step, why: Why) -> str:
    share = part.position_mean_square_m2 / why.position_mean_square_m2
    if share > 1.0:  # the steps add up to all of it, and some have a negative sign
        return "all of the mean square and more, which other changes take back"
    return f"{share:.0%} of the mean square"


def _moment_text(part: Step) -> str:
    return say("moment", part=part)


def _rejection_text(why: Why) -> str:
    coast = why.coast
    if coast is None:
        return ""
    samples = f"{coast.samples} samples in a row" if coast.samples > 1 else "a sample"
    return say("coasted", coast=coast, samples=samples)


def _step_reasons(
    comparison: Comparison, model: Model, clock: ClockOffset | Unavailable
) -> dict[str, str]:
    """What EKF2 does at each step, and what ours does."""
    settings, inputs, source = comparison.settings, model.inputs, comparison.source
    flown, delay, data, samples = inputs.settings, inputs.aid.delay, "", ways.SAMPLES
    if settings.input == "zero":
        samples = "no input"
    elif source.name != inputs.received.source:
        samples = "another source"
    if isinstance(clock, ClockOffset) and clock.determinable:
        ends_s = (clock.offset_s, *clock.interval_s[::-1])
        ml_delay_ms, low, high = (1e3 * (source.age_s - at) for at in ends_s)
        data = f", and the data ask for {ml_delay_ms:.0f} ms (95 % {low:.0f} to {high:.0f})"
    equal_noise = flown["EKF2_ACC_NOISE"] * np.sqrt(inputs.step_s / settings.dt_s)
    trusts_imu_more = equal_noise < settings.sigma_a_m_s2
    facts = {
        "settings": settings,
        "source": source,
        "inputs": inputs,
        "aid": inputs.aid,
        "data": data,
        "flown": flown,
        "delay_ms": flown[delay],
        "noise_m": noise_used_m(model),
        "same": equal_noise,
        "age_ms": 1e3 * (source.age_s - settings.clock_offset_s),
        "step_ms": 1e3 * inputs.step_s,
        "trusted": "the IMU more, and each position less"
        if trusts_imu_more
        else "each position more",
        "horizon_ms": 1e3 * inputs.horizon_s,
        "rejected": model.agreement.rejected_share_logged,
    }
    reasons = {step: text.format_map(facts) for step, text in REASONS.items()}
    return {**reasons, ways.SAMPLES: reasons[samples]}


def _velocity_sentence(why: Why) -> str:
    position, total = why.position_mean_square_m2, why.velocity_mean_square_m2_s2
    first = max(why.steps, key=lambda part: part.velocity_mean_square_m2_s2)
    share = first.velocity_mean_square_m2_s2 / total
    # more than all of it makes good what an earlier step did: no cause by itself
    mostly = f", in velocity mostly by the {first.name} ({share:.0%})" if share <= 1.0 else ""
    return (
        f"Where EKF2 was replayed they are {np.sqrt(position):.3f} m and {np.sqrt(total):.3f} m/s "
        f"rms apart{mostly}; the model leaves {_unexplained_text(why.position_left_share)} of that in position "
        f"and {_unexplained_text(why.velocity_left_mean_square_m2_s2 / total)} in velocity unexplained."
    )


def _unexplained_text(share: float) -> str:
    """Format the unexplained share of a mean square; above 1 the model explains nothing.

    >>> _unexplained_text(0.0071), _unexplained_text(4.2)
    ('0.7%', 'all')
    """
    return f"{share:.1%}" if share <= 1.0 else "all"


def _truth_sentences(why: Why) -> list[str]:
    kf_rmse_m, ekf2_rmse_m = (why.position_rmse_to_truth_m[name] for name in ("kf", "ekf2"))
    if isinstance(kf_rmse_m, Unavailable) or isinstance(ekf2_rmse_m, Unavailable):
        return []
    if abs(kf_rmse_m - ekf2_rmse_m) <= EQUAL_RMSE_TOLERANCE * max(kf_rmse_m, ekf2_rmse_m):
        return [
            f"To the truth both are equally close, {kf_rmse_m:.3f} m (ours) and {ekf2_rmse_m:.3f} m."
        ]
    rmse_by_step = [kf_rmse_m, *(step.position_rmse_to_truth_m or 0.0 for step in why.steps)]
    changes, names = np.diff(np.square(rmse_by_step)), [step.name for step in why.steps]
    step_index = int(np.argmin(changes) if ekf2_rmse_m < kf_rmse_m else np.argmax(changes))
    through = f"the {names[step_index]} ({rmse_by_step[step_index]:.3f} m before that step, {rmse_by_step[step_index + 1]:.3f} m after)"
    return [
        f"{'EKF2' if ekf2_rmse_m < kf_rmse_m else 'Our filter'} is closer to the truth, {min(kf_rmse_m, ekf2_rmse_m):.3f} "
        f"m against {max(kf_rmse_m, ekf2_rmse_m):.3f} m rms, mostly through {through}."
    ]
