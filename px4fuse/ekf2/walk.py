"""Why EKF2 differs: the way from the student's filter to the logged EKF2, one change at a time.

Each stage is a replay of the whole flight with one thing more as EKF2 has it; the order is fixed
and physical: when a sample counts, how much it counts, what is estimated besides, what was left
out, and how the result is carried to the present. The mean square difference to what EKF2 logged
goes from stage to stage, so that the steps and what is left add up to all of it. The first step
takes the student's filter, as it ran on the grid and the source that were chosen, to the same
filter on EKF2's own samples and prediction steps; without it, other steps would be blamed for that.

EKF2's small process noise presupposes its bias states: given to a filter without them it makes
things worse. Therefore the biases come first. The last replays reject what EKF2 rejected: where it
rejects much, one sample on the edge of the gate would else lead the model another way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.display import brief
from px4fuse.ekf2.agreement import at_times, judged_from, settled
from px4fuse.ekf2.model import Model, delayed_variants
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import Ekf2Replay
from px4fuse.flight import POSITION_COLUMNS, VELOCITY_COLUMNS, Ekf2, Truth, Unavailable
from px4fuse.record import Count, NotNegative, Record

Array = NDArray[np.float64]

WHAT = "why EKF2 differs"
STUDENT = "student"
# The filter of the lesson spreads its process noise over steps of DT (DESIGN: Q per second is
# SIGMA_A² · DT); EKF2 adds EKF2_ACC_NOISE² · Δt² each step, EKF2_ACC_NOISE² · Δt per second
SAMPLES = "samples and time steps"
STAMPS = "stamps and delay"
NOISE = "measurement noise"
BIASES = "accelerometer bias as a state"
PROCESS = "process noise"
ATTITUDE = "attitude and gyro bias as states"
GATE = "gate, missed samples, resets"
OUTPUT = "output predictor"
STEPS = (SAMPLES, STAMPS, NOISE, BIASES, PROCESS, ATTITUDE, GATE, OUTPUT)


@dataclass(frozen=True)
class OurFilter:
    """Settings of the student's two-state filter.

    Attributes
    ----------
    sigma_a_m_s2, sigma_z_m, dt_s : float
    clock_offset_s : float
        Added to the stamps.
    """

    sigma_a_m_s2: float = 0.5
    sigma_z_m: float = 0.1
    dt_s: float = 0.1
    clock_offset_s: float = 0.0


@dataclass(frozen=True)
class AxisLine:
    """A horizontal axis to walk along.

    Attributes
    ----------
    north, east : float
        Its unit vector.
    track : DataFrame or None
        What the student's filter gave along it: ``position_m, velocity_m_s`` by time (s). None:
        the same filter on EKF2's samples and steps.
    """

    north: float
    east: float
    track: pd.DataFrame | None = None

    def along(self, frame: pd.DataFrame, columns: list[str], times: Array) -> Array:
        """North and east columns of a time-indexed frame, interpolated, along this line."""
        north, east = (at_times(frame, column, times) for column in columns[:2])
        return self.north * north + self.east * east


class Step(Record, frozen=True, kw_only=True):
    """One change on the way.

    Attributes
    ----------
    name : str
        One of :data:`STEPS`.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        By how much it brings the track nearer to the logged one, in mean square; below 0: farther.
    position_moved_m : float
        How far it moves the position at most, along this axis.
    moved_at_s : float
        When.
    position_rmse_to_truth_m : float or None
        Of the track after it; None without truth.
    """

    name: str
    position_mean_square_m2: float
    velocity_mean_square_m2_s2: float
    position_moved_m: NotNegative
    moved_at_s: float
    position_rmse_to_truth_m: NotNegative | None = None


class Walked(Record, frozen=True, kw_only=True):
    """The way along one axis: the whole is the sum of the steps and what is left, in mean square.

    Attributes
    ----------
    count : int
        EKF2's own samples that the means are over.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Difference of the student's filter to the logged EKF2.
    steps : tuple of Step
    position_left_mean_square_m2, velocity_left_mean_square_m2_s2 : float
        Difference of the model to the logged EKF2.
    position_rmse_to_truth_m : mapping from "kf" and "ekf2" to float or Unavailable
    """

    count: Count
    position_mean_square_m2: NotNegative
    velocity_mean_square_m2_s2: NotNegative
    steps: tuple[Step, ...]
    position_left_mean_square_m2: NotNegative
    velocity_left_mean_square_m2_s2: NotNegative
    position_rmse_to_truth_m: Mapping[str, NotNegative | Unavailable]

    @property
    def position_left_share(self) -> float:
        """What is left of the mean square, as a share of all of it."""
        return self.position_left_mean_square_m2 / self.position_mean_square_m2


class AxisWalk(Walked, frozen=True, kw_only=True, eq=False):
    """:class:`Walked`, with the tracks.

    Attributes
    ----------
    apart_m, left_m : ndarray
        Position of the student's filter, and of the model, minus that of the logged EKF2, at the
        times of the walk.
    """

    written_as = Walked
    apart_m: Array
    left_m: Array

    __repr__ = brief


class Coast(Record, frozen=True, kw_only=True):
    """The longest run of rejected samples in flight.

    Attributes
    ----------
    start_s : float
        Of the first.
    samples : int
    duration_s : float
        Until a sample was used again.
    distance_m : float
        How far EKF2 went from where the same filter without a gate would have been, at most.
    """

    start_s: float
    samples: Count
    duration_s: NotNegative
    distance_m: NotNegative


@dataclass(frozen=True)
class Walk:
    """Why EKF2 differs.

    Attributes
    ----------
    axes : mapping from axis name to AxisWalk
    coast : Coast or None
        None where nothing was rejected.
    times_s : ndarray
        EKF2's own sample times that the means are over.
    """

    axes: Mapping[str, AxisWalk]
    coast: Coast | None
    times_s: Array


@dataclass(frozen=True)
class _Stage:
    """One stage along one axis, at the times of the walk."""

    position_m: Array
    velocity_m_s: Array


def walk(
    model: Model, student: OurFilter | None = None, lines: Mapping[str, AxisLine] | None = None
) -> Walk | Unavailable:
    """Walk from the student's filter to the logged EKF2.

    Parameters
    ----------
    model : Model
    student : OurFilter, optional
        By default the lesson's settings.
    lines : mapping from axis name to AxisLine, optional
        By default north and east, without tracks.

    Returns
    -------
    Walk or Unavailable
        Unavailable where the model does not reproduce what was logged.
    """
    if not model.agreement.good:
        return Unavailable(
            WHAT,
            f"the model does not reproduce what EKF2 logged: {model.agreement.reason}",
            "Record without dropouts, with SDLOG_PROFILE 129 (default and vision).",
        )
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    lines = lines or {"north": AxisLine(1.0, 0.0), "east": AxisLine(0.0, 1.0)}
    variants = _variants(model, student or OurFilter())
    delayed, flown = delayed_variants(model, list(variants.values()))
    judged = judged_from(model.flown)
    times = ekf2.state.index.to_numpy()
    inside = settled(times, judged)
    own = [line.track.index for line in lines.values() if line.track is not None]
    for index in (flown.delayed.index, *own):  # all stages have the replay's times
        inside &= len(index) > 0 and (times >= index[0]) & (times <= index[-1])
    times = times[inside]
    if not len(times):
        return Unavailable(
            WHAT,
            "the student's filter and the replay have no time in common",
            "Analyse the part of the flight in which EKF2 fused vision (--start, --end).",
        )
    stages: dict[str, dict[str, _Stage]] = {name: {} for name in lines}
    ungated = flown.delayed
    # one at a time: each is as long as the flight
    tracks = chain(delayed, (flown.delayed, flown.published))
    for stage, track in zip((*variants, OUTPUT), tracks, strict=True):
        for name, line in lines.items():
            stages[name][stage] = _Stage(
                line.along(track, POSITION_COLUMNS, times),
                line.along(track, VELOCITY_COLUMNS, times),
            )
        if stage == ATTITUDE:
            ungated = track
    return Walk(
        axes={name: _axis(model, stages[name], line, times) for name, line in lines.items()},
        coast=_coast(flown, ungated, (times[0], times[-1]), judged),
        times_s=times,
    )


def _variants(model: Model, student: OurFilter) -> dict[str, Variant]:
    """The filter after each step but the last; from one to the next, one thing changes."""
    inputs, flown = model.inputs, model.inputs.settings
    force = float(student.sigma_a_m_s2 * np.sqrt(student.dt_s / inputs.step_s))
    own = {**flown, "EKF2_EVP_NOISE": student.sigma_z_m, "EKF2_EV_NOISE_MD": 1.0}
    spread = {"EKF2_ACC_NOISE": force}
    first = Variant(
        {**own, **spread, **{f"EKF2_EV_POS_{axis}": 0.0 for axis in "XYZ"}},
        biases=False, attitude=False, gated=False, stamp_offset_s=student.clock_offset_s,
    )  # fmt: skip
    return {
        SAMPLES: first,
        STAMPS: Variant({**own, **spread}, biases=False, attitude=False, gated=False),
        NOISE: Variant({**flown, **spread}, biases=False, attitude=False, gated=False),
        BIASES: Variant({**flown, **spread}, attitude=False, gated=False),
        PROCESS: Variant(flown, attitude=False, gated=False),
        ATTITUDE: Variant(flown, gated=False),
        GATE: Variant(flown, as_logged=True),
    }


def _axis(model: Model, stages: dict[str, _Stage], line: AxisLine, times: Array) -> AxisWalk:
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    own = line.track
    stages = stages | {STUDENT: stages[SAMPLES]}
    if own is not None:
        stages[STUDENT] = _Stage(
            at_times(own, "position_m", times), at_times(own, "velocity_m_s", times)
        )
    logged = line.along(ekf2.state, POSITION_COLUMNS, times)
    logged_speed = line.along(ekf2.state, VELOCITY_COLUMNS, times)
    position = {name: stage.position_m for name, stage in stages.items()}
    square = {name: float(np.mean((there - logged) ** 2)) for name, there in position.items()}
    speed_square = {
        name: float(np.mean((stage.velocity_m_s - logged_speed) ** 2))
        for name, stage in stages.items()
    }
    steps = []
    for before, name in pairwise((STUDENT, *STEPS)):
        moved = np.abs(position[name] - position[before])
        most = int(np.argmax(moved))
        error = _to_truth(model, position[name], line, times)
        steps.append(
            Step(
                name=name,
                position_mean_square_m2=square[before] - square[name],
                velocity_mean_square_m2_s2=speed_square[before] - speed_square[name],
                position_moved_m=float(moved[most]),
                moved_at_s=float(times[most]),
                position_rmse_to_truth_m=None if isinstance(error, Unavailable) else error,
            )
        )
    return AxisWalk(
        count=len(times),
        position_mean_square_m2=square[STUDENT],
        velocity_mean_square_m2_s2=speed_square[STUDENT],
        steps=tuple(steps),
        position_left_mean_square_m2=square[OUTPUT],
        velocity_left_mean_square_m2_s2=speed_square[OUTPUT],
        position_rmse_to_truth_m={
            "kf": _to_truth(model, position[STUDENT], line, times),
            "ekf2": _to_truth(model, logged, line, times),
        },
        apart_m=position[STUDENT] - logged,
        left_m=position[OUTPUT] - logged,
    )


def _to_truth(model: Model, where: Array, line: AxisLine, times: Array) -> float | Unavailable:
    truth = model.flight.truth
    if not isinstance(truth, Truth):
        return truth
    span = truth.samples.index
    inside = (times >= span[0]) & (times <= span[-1])
    if not inside.any():
        return Unavailable("RMSE to truth", "the truth is of another time", "Record both together.")
    known = line.along(truth.samples, POSITION_COLUMNS, times)
    return float(np.sqrt(np.mean((where - known)[inside] ** 2)))


def _coast(
    flown: Ekf2Replay,
    ungated: pd.DataFrame,
    span: tuple[float, float],
    judged: tuple[tuple[float, float], ...],
) -> Coast | None:
    updates = flown.updates[settled(flown.updates.index.to_numpy(), judged)]
    updates = updates[updates["fused_at_s"].between(*span)]
    rejected = updates["rejected"].to_numpy() > 0
    if not rejected.any():
        return None
    # each run from its first rejected sample to the sample after its last
    change = np.diff(np.concatenate([[0], rejected.astype(int), [0]]))
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    longest = int(np.argmax(ends - starts))
    time = updates["fused_at_s"].to_numpy()
    begin = float(time[starts[longest]])
    end = float(time[min(ends[longest], len(time) - 1)])
    part = flown.delayed.loc[begin:end]
    apart = [
        part[column].to_numpy() - at_times(ungated, column, part.index.to_numpy())
        for column in POSITION_COLUMNS[:2]
    ]
    return Coast(
        start_s=begin,
        samples=int(ends[longest] - starts[longest]),
        duration_s=end - begin,
        distance_m=float(np.max(np.hypot(*apart))),
    )
