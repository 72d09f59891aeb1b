"""Why EKF2 differs, in sentences that a student can use: numbers, and when it happened."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from px4fuse.comparison.asked import noise_used_m
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.walk import (
    ATTITUDE,
    BIASES,
    GATE,
    NOISE,
    OUTPUT,
    PROCESS,
    SAMPLES,
    STAMPS,
    AxisWalk,
    Step,
    Walk,
)
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.record import NotNegative, Record

# A noise this many times below what the data ask for is too small: as of EKF2's findings
TOO_SMALL = 1.25
# A rejection in a hundred has causes; 6e-7 of the samples are rejected when all is well
REJECTED_SHARE = 0.01
# Filters whose errors differ by less are equally close to the truth
EQUALLY_CLOSE = 0.05
# Stamps that are wrong by less do not show at flying speed
CLOCK_S = 0.03
STAMPS_WRONG = "The source's stamps are"
# Shares of the mean square below this are not worth a word
NOTABLE = 0.05
# How much farther apart than where they were walked both must be elsewhere to be told (m, times)
FAR_M, FAR_TIMES = 0.5, 3.0


class Outside(Record, frozen=True):
    """Where the walk does not lead: parts of the segment in which EKF2 started or did not fuse.

    Attributes
    ----------
    maximum_m : float
        How far both filters are apart there, at most.
    at_s : float
        When.
    """

    maximum_m: NotNegative
    at_s: float


@dataclass(frozen=True)
class Facts:
    """What the words are made of.

    Attributes
    ----------
    comparison : Comparison
    model : Model
    walked : Walk
    noise_asked_m : float or None
        Measurement noise that the data ask for, of the source that EKF2 fused.
    clock : ClockOffset or Unavailable
    """

    comparison: Comparison
    model: Model
    walked: Walk
    noise_asked_m: float | None
    clock: ClockOffset | Unavailable

    @property
    def rejected(self) -> float:
        """Share of the samples that EKF2's gate rejected, by the log."""
        return self.model.agreement.rejected_share_logged

    @property
    def noise_used_m(self) -> float:
        """Median √R of EKF2."""
        return noise_used_m(self.model)

    @property
    def too_sure(self) -> bool:
        """Whether EKF2 rejects samples because its measurement noise is too small."""
        asked = self.noise_asked_m
        return (
            asked is not None
            and self.noise_used_m * TOO_SMALL < asked
            and self.rejected >= REJECTED_SHARE
        )


@dataclass(frozen=True)
class _Part:
    """A step, or steps that are one thing: its names and what it does."""

    names: tuple[str, ...]
    square_m2: float
    speed_square_m2_s2: float
    moved_m: float
    at_s: float

    @property
    def label(self) -> str:
        joined = len(self.names) > 1
        return "the too small noise and the rejections" if joined else f"the {self.names[0]}"


def sentences(name: str, axis: AxisWalk, facts: Facts, outside: Outside | None) -> tuple[str, ...]:
    """What makes EKF2 differ along the axis of a name, the weightiest first."""
    parts = _parts(axis, joined=facts.too_sure)
    if facts.too_sure:  # the cause comes first, even where its steps also bring the tracks nearer
        parts.sort(key=lambda part: len(part.names) == 1)
    said = _clock(facts)
    said.append(_first(name, axis, parts[0], facts))
    others = [p for p in parts[1:] if p.square_m2 >= NOTABLE * axis.position_mean_square_m2]
    if others:
        share = _share(others[0], axis)
        said.append(f"Then {others[0].label} ({share}): {_because(others[0], facts)}.")
    said.append(_velocity(axis, parts))
    said += _truth(axis, facts)
    far_m = max(FAR_M, FAR_TIMES * float(np.max(np.abs(axis.apart_m))))
    if outside is not None and outside.maximum_m > far_m:
        said.append(
            f"Elsewhere in the flight, where EKF2 started or did not fuse the source, both are up "
            f"to {outside.maximum_m:.1f} m apart (at {outside.at_s:.0f} s)."
        )
    return tuple(said)


def _parts(axis: AxisWalk, *, joined: bool) -> list[_Part]:
    """Steps by weight in position; noise and gate as one where the one follows from the other."""
    steps = {step.name: step for step in axis.steps}
    groups = [(name,) for name in steps if not (joined and name in (NOISE, GATE))]
    made = [_part([steps[name] for name in group]) for group in groups]
    if joined:
        made.append(_part([steps[NOISE], steps[GATE]]))
    return sorted(made, key=lambda part: -part.square_m2)


def _part(steps: list[Step]) -> _Part:
    most = max(steps, key=lambda step: step.position_moved_m)
    return _Part(
        names=tuple(step.name for step in steps),
        square_m2=sum(step.position_mean_square_m2 for step in steps),
        speed_square_m2_s2=sum(step.velocity_mean_square_m2_s2 for step in steps),
        moved_m=most.position_moved_m,
        at_s=most.moved_at_s,
    )


def the(axis: str) -> str:
    """The name of an axis in a sentence."""
    return f"the {axis}" if axis == AISLE else axis


def _share(part: _Part, axis: AxisWalk) -> str:
    return f"{part.square_m2 / axis.position_mean_square_m2:.0%} of the mean square"


def _first(name: str, axis: AxisWalk, part: _Part, facts: Facts) -> str:
    share = _share(part, axis)
    if facts.too_sure:
        return (
            "EKF2_EVP_NOISE is too small: EKF2 takes the source's noise to be "
            f"{facts.noise_used_m:.2g} m, the data ask for {facts.noise_asked_m:.2g} m, so its "
            f"gate rejects {facts.rejected:.0%} of the samples{_coasted(facts)}. This noise and "
            "the rejections that follow from it "
            f"are {share} of what ours and EKF2 are apart along {the(name)}."
        )
    return (
        f"Most of what ours and EKF2 are apart along {the(name)} is {part.label} ({share}): "
        f"{_because(part, facts)}."
    )


def _because(part: _Part, facts: Facts) -> str:
    """What EKF2 does there, what ours does, and when it mattered most."""
    words = BECAUSE[part.names[0]](facts)
    if part.names[0] == GATE:
        words += _coasted(facts)
    return (
        f"{words}; most at {part.at_s:.1f} s, where it moves the position by {part.moved_m:.2f} m"
    )


def _coasted(facts: Facts) -> str:
    coast = facts.walked.coast
    if coast is None:
        return ""
    samples = f"{coast.samples} samples in a row" if coast.samples > 1 else "a sample"
    return (
        f": at {coast.start_s:.0f} s it rejected {samples} and coasted {coast.distance_m:.2g} m "
        f"away in {coast.duration_s:.1f} s"
    )


def _samples(facts: Facts) -> str:
    settings = facts.comparison.settings
    if settings.input == "zero":
        return "ours knows no acceleration (--input zero), EKF2 follows the IMU"
    ours, theirs = facts.comparison.source.name, facts.model.inputs.vision.source
    if ours != theirs:
        return f"ours was given {ours}, EKF2 {theirs}"
    return (
        f"ours predicts every {settings.dt_s:g} s and starts by itself, EKF2 predicts every "
        f"{facts.model.inputs.step_s * 1e3:.0f} ms"
    )


def _stamps(facts: Facts) -> str:
    delay = facts.model.inputs.settings["EKF2_EV_DELAY"]
    own = facts.comparison.settings.clock_offset_s
    words = f"EKF2 takes a position to be {delay:g} ms older than its stamp (EKF2_EV_DELAY), ours "
    words += f"{0.0 - own * 1e3:.0f} ms"
    if isinstance(facts.clock, ClockOffset) and facts.clock.determinable:
        low, high = (-end * 1e3 for end in facts.clock.interval_s[::-1])
        asked = -facts.clock.offset_s * 1e3
        words += f", and the data ask for {asked:.0f} ms (95 % {low:.0f} to {high:.0f})"
    return words


def _noise(facts: Facts) -> str:
    return (
        f"EKF2 takes the source's noise to be {facts.noise_used_m:.2g} m (EKF2_EVP_NOISE), ours "
        f"{facts.comparison.settings.sigma_z_m:.2g} m"
    )


def _process(facts: Facts) -> str:
    settings, inputs = facts.comparison.settings, facts.model.inputs
    same = inputs.settings["EKF2_ACC_NOISE"] * np.sqrt(inputs.step_s / settings.dt_s)
    less = same < settings.sigma_a_m_s2
    trust = "the IMU more, and each position less" if less else "each position more"
    return (
        f"EKF2_ACC_NOISE {inputs.settings['EKF2_ACC_NOISE']:g} is a SIGMA_A of {same:.2g} m/s², "
        f"ours is {settings.sigma_a_m_s2:.2g}, so EKF2 trusts {trust}"
    )


def _gate(facts: Facts) -> str:
    return f"EKF2's gate rejects {facts.rejected:.1%} of the samples, ours takes all"


def _output(facts: Facts) -> str:
    inputs = facts.model.inputs
    return (
        f"EKF2 filters {inputs.horizon_s * 1e3:.0f} ms behind the present, carries that to now by "
        f"the IMU and smooths it (EKF2_TAU_POS {inputs.settings['EKF2_TAU_POS']:g} s)"
    )


BECAUSE: Mapping[str, Callable[[Facts], str]] = {
    SAMPLES: _samples,
    STAMPS: _stamps,
    NOISE: _noise,
    BIASES: lambda _: "EKF2 estimates the accelerometer's bias in flight, ours knows none",
    PROCESS: _process,
    ATTITUDE: lambda _: "EKF2 lets the positions correct its attitude, ours takes it as it is",
    GATE: _gate,
    OUTPUT: _output,
}


def _velocity(axis: AxisWalk, parts: list[_Part]) -> str:
    total = axis.velocity_mean_square_m2_s2
    first = max(parts, key=lambda part: part.speed_square_m2_s2)
    share = first.speed_square_m2_s2 / total
    # more than all of it makes good what an earlier step did: no cause by itself
    mostly = f", in velocity mostly by {first.label} ({share:.0%})" if share <= 1.0 else ""
    position = axis.position_mean_square_m2
    return (
        f"Where EKF2 was replayed they are {np.sqrt(position):.3f} m and {np.sqrt(total):.3f} m/s "
        f"rms apart{mostly}; "
        f"the model leaves {axis.position_left_mean_square_m2 / position:.1%} "
        f"of that in position and {axis.velocity_left_mean_square_m2_s2 / total:.1%} in velocity "
        "unexplained."
    )


def _truth(axis: AxisWalk, facts: Facts) -> list[str]:
    ours, ekf2 = (axis.position_rmse_to_truth_m[name] for name in ("kf", "ekf2"))
    if isinstance(ours, Unavailable) or isinstance(ekf2, Unavailable):
        return []
    if abs(ours - ekf2) <= EQUALLY_CLOSE * max(ours, ekf2):
        return [f"To the truth both are equally close, {ours:.3f} m (ours) and {ekf2:.3f} m."]
    nearer = "EKF2" if ekf2 < ours else "Our filter"
    path = [ours, *(step.position_rmse_to_truth_m for step in axis.steps)]
    known = [value for value in path if isinstance(value, float)]
    changes = np.diff(np.square(known))
    names = [step.name for step in axis.steps]
    if facts.too_sure:  # one cause
        changes[names.index(GATE)] += changes[names.index(NOISE)]
        changes[names.index(NOISE)] = 0.0
    at = int(np.argmin(changes) if ekf2 < ours else np.argmax(changes))
    through = (
        "its too small noise and the rejections"
        if facts.too_sure and names[at] == GATE
        else f"the {names[at]} ({known[at]:.3f} m before that step, {known[at + 1]:.3f} m after)"
    )
    return [
        f"{nearer} is closer to the truth, {min(ours, ekf2):.3f} m against {max(ours, ekf2):.3f} m "
        f"rms, mostly through {through}."
    ]


def _clock(facts: Facts) -> list[str]:
    clock = facts.clock
    if not isinstance(clock, ClockOffset) or not clock.determinable:
        return []
    own = facts.comparison.settings.clock_offset_s
    delay_s = facts.model.inputs.settings["EKF2_EV_DELAY"] * 1e-3
    both = clock.offset_s
    known_s = max(CLOCK_S, clock.chance_s)
    if min(abs(clock.remaining_s), abs(both + delay_s)) < known_s or abs(own + delay_s) > CLOCK_S:
        return []
    return [
        f"{STAMPS_WRONG} {'late' if both < 0 else 'early'} by {abs(both):.2f} s for both "
        "filters alike: positions and IMU contradict each other, and the steps only say how each "
        "filter settles that. Set the clock right first (page Clock)."
    ]
