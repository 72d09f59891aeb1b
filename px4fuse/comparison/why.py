"""Why EKF2 differs from our filter, along each horizontal axis, in steps and in words.

The steps are those of :mod:`px4fuse.ekf2.walk`, from our filter as it was set to the logged EKF2.
The sentences are made of them last: what each filter does, with numbers, and when it mattered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.remedy import noise_used_m, tuned_noise_m
from px4fuse.ekf2.agreement import settled
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.replay import Spans
from px4fuse.ekf2.walk import (
    ATTITUDE,
    BIASES,
    GATE,
    NOISE,
    OUTPUT,
    PROCESS,
    SAMPLES,
    SPEED,
    STAMPS,
    WHAT,
    Outside,
    Step,
    Why,
    walk,
)
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight import Unavailable

# A noise this many times below what the data ask for is too small: as of EKF2's findings
TOO_SMALL = 1.25
# A rejection in a hundred has causes; 6e-7 of the samples are rejected when all is well
REJECTED_SHARE = 0.01
# Filters whose errors differ by less are equally close to the truth
EQUALLY_CLOSE = 0.05
# Stamps that are wrong by less do not show at flying speed
CLOCK_S = 0.03
# Shares of the mean square below this are not worth a word
NOTABLE = 0.05
# How much farther apart than where they were walked both must be elsewhere to be said (m, times)
FAR_M, FAR_TIMES = 0.5, 3.0
# What noise and gate are together where the one makes the other reject
TOO_SURE = "too small noise and the rejections"


def why_ekf2_differs(
    comparison: Comparison,
    model: Model | Unavailable,
    tuning: Mapping[str, AxisTuning | Unavailable],
    clock: ClockOffset | Unavailable,
) -> dict[str, Why | Unavailable]:
    """Why EKF2 differs along each axis of a comparison.

    Parameters
    ----------
    comparison : Comparison
    model : Model or Unavailable
        Of the comparison's flight.
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
        Shows a measurement noise of EKF2 that is too small.
    clock : ClockOffset or Unavailable
        Shows stamps that are wrong for both filters.

    Returns
    -------
    mapping from axis name to Why or Unavailable
        Of down only where nothing else was compared: the model is of horizontal position.
    """
    results = {name: result for name, result in comparison.axes.items() if name != "down"}
    if not results:
        reason = "the model of EKF2 is of horizontal position"
        return {"down": Unavailable(WHAT, reason, "Analyse a horizontal axis too (--axis).")}
    if isinstance(model, Unavailable):
        return {name: Unavailable(WHAT, model.reason, model.remedy) for name in results}
    settings, asked_m = comparison.settings, tuned_noise_m(tuning)
    if comparison.source.name != model.inputs.received.source:
        settings, asked_m = replace(settings, clock_offset_s=0.0), None
    walked = walk(model, settings, {name: result.replay for name, result in results.items()})
    if isinstance(walked, Unavailable):
        return dict.fromkeys(results, walked)
    certain = clock if isinstance(clock, ClockOffset) and clock.determinable else None
    found: dict[str, Why | Unavailable] = {}
    for name, why in walked.items():
        outside = structs.replace(why, outside=_outside(results[name], why.spans_s))
        found[name] = with_words(name, outside, comparison, model, asked_m, certain)
    return found


def _outside(result: AxisComparison, spans: Spans) -> Outside | None:
    if not isinstance(result.ekf2_state, pd.DataFrame):
        return None
    state = result.ekf2_state[~settled(result.ekf2_state.index, spans)]
    times = state.index.to_numpy()
    apart = np.abs(state_at(result.replay, times)[0] - state["position_m"].to_numpy())
    if not np.isfinite(apart).any():
        return None
    most = int(np.nanargmax(apart))
    return Outside(float(apart[most]), float(times[most]))


def with_words(
    name: str,
    why: Why,
    comparison: Comparison,
    model: Model,
    asked_m: float | None,
    clock: ClockOffset | None,
) -> Why:
    """The same with sentences: what makes EKF2 differ along an axis, the weightiest first.

    Parameters
    ----------
    asked_m : float or None
        Measurement noise that the data ask for, of the source that EKF2 fused.
    clock : ClockOffset or None
        None where it is not determinable.
    """
    used_m, rejected = noise_used_m(model), model.agreement.rejected_share_logged
    too_sure = asked_m is not None and used_m * TOO_SMALL < asked_m and rejected >= REJECTED_SHARE
    first, *others = _parts(why, too_sure=too_sure)
    apart = f"of what ours and EKF2 are apart along {comparison.axes[name].axis.called}"
    because = _reasons(why, comparison, model, clock)
    if too_sure:
        cause = (
            f"{model.inputs.aid.noise} is too small: EKF2 takes the source's noise to be "
            f"{used_m:.2g} m, the data ask for {asked_m:.2g} m, so its gate rejects "
            f"{rejected:.0%} of the samples{_coasted(why)}"
        )
        more = (
            f". This noise and the rejections that follow from it are {_share(first, why)} {apart}"
        )
    else:
        half = 0.5 * why.position_mean_square_m2
        weight = "Most" if first.position_mean_square_m2 >= half else "The largest part"
        cause = (
            f"{weight} {apart} is the {first.name} ({_share(first, why)}): {because[first.name]}"
        )
        more = _moment(first)
    sentences = [*_wrong_stamps(comparison, model, clock), f"{cause}{more}."]
    second = others[0]
    if second.position_mean_square_m2 >= NOTABLE * why.position_mean_square_m2:
        share, reason = _share(second, why), because[second.name]
        sentences.append(f"Then the {second.name} ({share}): {reason}{_moment(second)}.")
    sentences += [_velocity(why, [first, *others]), *_truth(why, too_sure=too_sure)]
    far_m = max(FAR_M, FAR_TIMES * float(np.max(np.abs(why.apart_m))))
    if why.outside is not None and why.outside.maximum_m > far_m:
        sentences.append(
            f"Elsewhere in the flight, where EKF2 started or did not fuse the source, both are up "
            f"to {why.outside.maximum_m:.1f} m apart (at {why.outside.at_s:.0f} s)."
        )
    return structs.replace(why, sentences=tuple(sentences), cause=f"{cause}.")


def _parts(why: Why, *, too_sure: bool) -> list[Step]:
    """Steps by weight in position; noise and gate as one, and first, where one makes the other."""
    parts = sorted(why.steps, key=lambda step: -step.position_mean_square_m2)
    if not too_sure:
        return parts
    two = [step for step in why.steps if step.name in (NOISE, GATE)]
    joined = structs.replace(
        max(two, key=lambda step: step.position_moved_m),
        name=TOO_SURE,
        position_mean_square_m2=sum(step.position_mean_square_m2 for step in two),
        velocity_mean_square_m2_s2=sum(step.velocity_mean_square_m2_s2 for step in two),
    )
    # the cause comes first, even where its steps also bring the tracks nearer
    return [joined, *(step for step in parts if step not in two)]


def _share(part: Step, why: Why) -> str:
    share = part.position_mean_square_m2 / why.position_mean_square_m2
    if share > 1.0:  # the steps add up to all of it, and some have a negative sign
        return "all of the mean square and more, which other changes take back"
    return f"{share:.0%} of the mean square"


def _moment(part: Step) -> str:
    return (
        f"; most at {part.moved_at_s:.1f} s, where it moves the position by "
        f"{part.position_moved_m:.2f} m"
    )


def _coasted(why: Why) -> str:
    coast = why.coast
    if coast is None:
        return ""
    samples = f"{coast.samples} samples in a row" if coast.samples > 1 else "a sample"
    return (
        f": at {coast.start_s:.0f} s it rejected {samples} and coasted {coast.distance_m:.2g} m "
        f"away in {coast.duration_s:.1f} s"
    )


def _reasons(
    why: Why, comparison: Comparison, model: Model, clock: ClockOffset | None
) -> dict[str, str]:
    """What EKF2 does at each step, and what ours does."""
    settings, inputs = comparison.settings, model.inputs
    rejected, aid = model.agreement.rejected_share_logged, model.inputs.aid
    flown, source, fused = inputs.settings, comparison.source.name, inputs.received.source
    samples = (
        f"ours predicts every {settings.dt_s:g} s and starts by itself, EKF2 predicts every "
        f"{inputs.step_s * 1e3:.0f} ms"
    )
    if settings.input == "zero":
        samples = "ours knows no acceleration (--input zero), EKF2 follows the IMU"
    elif source != fused:
        samples = f"ours was given {source}, EKF2 {fused}"
    data = ""
    if clock is not None:
        ends_s = (clock.offset_s, *clock.interval_s[::-1])
        asked, low, high = (1e3 * (comparison.source.age_s - at) for at in ends_s)
        data = f", and the data ask for {asked:.0f} ms (95 % {low:.0f} to {high:.0f})"
    same = flown["EKF2_ACC_NOISE"] * np.sqrt(inputs.step_s / settings.dt_s)
    surer = same < settings.sigma_a_m_s2
    trusted = "the IMU more, and each position less" if surer else "each position more"
    return {
        SAMPLES: samples,
        STAMPS: (
            f"EKF2 takes a position to be {flown[aid.delay]:g} ms older than its stamp "
            f"({aid.delay}), ours {1e3 * (comparison.source.age_s - settings.clock_offset_s):.0f} "
            f"ms{data}"
        ),
        NOISE: (
            f"EKF2 takes the source's noise to be {noise_used_m(model):.2g} m "
            f"({aid.noise}), ours {settings.sigma_z_m:.2g} m"
        ),
        BIASES: "EKF2 estimates the accelerometer's bias in flight, ours knows none",
        PROCESS: (
            f"EKF2_ACC_NOISE {flown['EKF2_ACC_NOISE']:g} is a SIGMA_A of {same:.2g} m/s², ours is "
            f"{settings.sigma_a_m_s2:.2g}, so EKF2 trusts {trusted}"
        ),
        ATTITUDE: "EKF2 lets the positions correct its attitude, ours takes it as it is",
        SPEED: "EKF2 fuses the velocity of GNSS too, ours its position alone",
        GATE: (f"EKF2's gate rejects {rejected:.1%} of the samples, ours takes all{_coasted(why)}"),
        OUTPUT: (
            f"EKF2 filters {inputs.horizon_s * 1e3:.0f} ms behind the present, carries that to now "
            f"by the IMU and smooths it (EKF2_TAU_POS {flown['EKF2_TAU_POS']:g} s)"
        ),
    }


def _velocity(why: Why, parts: list[Step]) -> str:
    position, total = why.position_mean_square_m2, why.velocity_mean_square_m2_s2
    first = max(parts, key=lambda part: part.velocity_mean_square_m2_s2)
    share = first.velocity_mean_square_m2_s2 / total
    # more than all of it makes good what an earlier step did: no cause by itself
    mostly = f", in velocity mostly by the {first.name} ({share:.0%})" if share <= 1.0 else ""
    return (
        f"Where EKF2 was replayed they are {np.sqrt(position):.3f} m and {np.sqrt(total):.3f} m/s "
        f"rms apart{mostly}; the model leaves {why.position_left_share:.1%} of that in position "
        f"and {why.velocity_left_mean_square_m2_s2 / total:.1%} in velocity unexplained."
    )


def _truth(why: Why, *, too_sure: bool) -> list[str]:
    ours, ekf2 = (why.position_rmse_to_truth_m[name] for name in ("kf", "ekf2"))
    if isinstance(ours, Unavailable) or isinstance(ekf2, Unavailable):
        return []
    if abs(ours - ekf2) <= EQUALLY_CLOSE * max(ours, ekf2):
        return [f"To the truth both are equally close, {ours:.3f} m (ours) and {ekf2:.3f} m."]
    path = [ours, *(step.position_rmse_to_truth_m or 0.0 for step in why.steps)]
    changes, names = np.diff(np.square(path)), [step.name for step in why.steps]
    if too_sure:  # one cause
        noise, gate = names.index(NOISE), names.index(GATE)
        changes[[noise, gate]] = 0.0, changes[noise] + changes[gate]
        names[gate] = TOO_SURE
    at = int(np.argmin(changes) if ekf2 < ours else np.argmax(changes))
    through = f"the {names[at]} ({path[at]:.3f} m before that step, {path[at + 1]:.3f} m after)"
    if names[at] == TOO_SURE:
        through = f"its {TOO_SURE}"
    return [
        f"{'EKF2' if ekf2 < ours else 'Our filter'} is closer to the truth, {min(ours, ekf2):.3f} "
        f"m against {max(ours, ekf2):.3f} m rms, mostly through {through}."
    ]


def _wrong_stamps(comparison: Comparison, model: Model, clock: ClockOffset | None) -> list[str]:
    """That the source's stamps are wrong for both filters alike, where they are."""
    if clock is None:
        return []
    delay_s = model.inputs.settings[model.inputs.aid.delay] * 1e-3
    late_s = clock.offset_s - comparison.source.age_s
    wrong_s = min(abs(clock.remaining_s), abs(late_s + delay_s))
    ours_s = comparison.source.age_s - comparison.settings.clock_offset_s
    apart_s = abs(delay_s - ours_s)
    if wrong_s < max(CLOCK_S, clock.chance_s) or apart_s > CLOCK_S:
        return []
    return [
        f"The source's stamps are {'late' if late_s < 0 else 'early'} by {abs(late_s):.2f} s for "
        "both filters alike: positions and IMU contradict each other, and the steps only say how "
        "each filter settles that. Set the clock right first (page Clock)."
    ]
