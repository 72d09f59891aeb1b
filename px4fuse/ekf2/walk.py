"""Why EKF2 differs: the way from the student's filter to the logged EKF2, one change at a time.

Each stage is a replay of the whole flight with one thing more as EKF2 has it; the order is fixed
and physical: when a sample counts, how much it counts, what is estimated besides, what was left
out, and how the result is carried to the present. The mean square difference to what EKF2 logged
goes from stage to stage, so that the steps and what is left add up to all of it.

EKF2's small process noise presupposes its bias states: given to a filter without them it makes
things worse. Therefore the biases come first. The last replays reject what EKF2 rejected: where it
rejects much, one sample on the edge of the gate would else lead the model another way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.ekf2.agreement import at_times, judged_from, settled
from px4fuse.ekf2.model import Model, replay_variants
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import HORIZONTAL, Ekf2Replay
from px4fuse.flight import POSITION_COLUMNS, VELOCITY_COLUMNS, Ekf2, Truth, Unavailable

Array = NDArray[np.float64]

# The filter of the lesson spreads its process noise over steps of DT (DESIGN: Q per second is
# SIGMA_A² · DT); EKF2 adds EKF2_ACC_NOISE² · Δt² each step, EKF2_ACC_NOISE² · Δt per second
STAMPS = "stamps and delay"
NOISE = "measurement noise"
BIASES = "accelerometer bias as a state"
PROCESS = "process noise"
ATTITUDE = "attitude and gyro bias as states"
GATE = "gate, missed samples, resets"
OUTPUT = "output predictor"
STEPS = (STAMPS, NOISE, BIASES, PROCESS, ATTITUDE, GATE, OUTPUT)


@dataclass(frozen=True)
class Student:
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
class Step:
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
    position_rmse_to_truth_m : float or Unavailable
        Of the track after it.
    """

    name: str
    position_mean_square_m2: float
    velocity_mean_square_m2_s2: float
    position_moved_m: float
    moved_at_s: float
    position_rmse_to_truth_m: float | Unavailable


@dataclass(frozen=True)
class AxisWalk:
    """The way along one axis: ``total = sum of the steps + left``, in mean square.

    Attributes
    ----------
    steps : tuple of Step
    position_total_m2, velocity_total_m2_s2 : float
        Mean square difference of the student's filter to the logged EKF2.
    position_left_m2, velocity_left_m2_s2 : float
        Of the model to the logged EKF2.
    student_rmse_to_truth_m, logged_rmse_to_truth_m : float or Unavailable
    """

    steps: tuple[Step, ...]
    position_total_m2: float
    velocity_total_m2_s2: float
    position_left_m2: float
    velocity_left_m2_s2: float
    student_rmse_to_truth_m: float | Unavailable
    logged_rmse_to_truth_m: float | Unavailable

    @property
    def position_left_share(self) -> float:
        """What is left of the mean square, as a share of all of it."""
        return self.position_left_m2 / self.position_total_m2


@dataclass(frozen=True)
class Coast:
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
    samples: int
    duration_s: float
    distance_m: float


@dataclass(frozen=True)
class Walk:
    """Why EKF2 differs.

    Attributes
    ----------
    axes : mapping from "north" and "east" to AxisWalk
    coast : Coast or None
        None where nothing was rejected.
    tracks : mapping from stage to DataFrame
        Position and velocity of each stage, at the step ends of the replay; the first is the
        student's filter, under ``"student"``.
    samples : int
        EKF2's own sample times that the means are over.
    """

    axes: Mapping[str, AxisWalk]
    coast: Coast | None
    tracks: Mapping[str, pd.DataFrame]
    samples: int


def walk(
    model: Model, student: Student | None = None, track: pd.DataFrame | None = None
) -> Walk | Unavailable:
    """Walk from the student's filter to the logged EKF2.

    Parameters
    ----------
    model : Model
    student : Student, optional
        By default the lesson's settings.
    track : DataFrame, optional
        What the student's filter gave: ``north_m``, ``east_m``, ``north_m_s``, ``east_m_s`` by time
        (s). By default the same filter in the model's steps.

    Returns
    -------
    Walk or Unavailable
        Unavailable where the model does not reproduce what was logged.
    """
    if not model.agreement.good:
        return Unavailable(
            "why EKF2 differs",
            f"the model does not reproduce what EKF2 logged: {model.agreement.reason}",
            "Record without dropouts, with SDLOG_PROFILE 129 (default and vision).",
        )
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    variants = _variants(model, student or Student())
    replays = replay_variants(model, list(variants.values()), [{}] * len(variants))
    tracks = {name: replay.delayed for name, replay in zip(variants, replays, strict=True)}
    if track is not None:
        tracks["student"] = track
    tracks[OUTPUT] = replays[-1].published
    judged = judged_from(model.flown)
    times = ekf2.state.index.to_numpy()
    inside = settled(times, judged)
    for one in tracks.values():
        inside &= (times >= one.index[0]) & (times <= one.index[-1])
    times = times[inside]
    if not len(times):
        return Unavailable(
            "why EKF2 differs",
            "the student's filter and the replay have no time in common",
            "Analyse the part of the flight in which EKF2 fused vision (--start, --end).",
        )
    return Walk(
        axes={axis: _axis(model, tracks, axis, times) for axis in HORIZONTAL},
        coast=_coast(replays[-1], tracks[ATTITUDE], judged),
        tracks=tracks,
        samples=len(times),
    )


def _variants(model: Model, student: Student) -> dict[str, Variant]:
    """The filter of each stage but the last; from one to the next, one thing changes."""
    inputs, flown = model.inputs, model.inputs.settings
    force = float(student.sigma_a_m_s2 * np.sqrt(student.dt_s / inputs.step_s))
    own = {**flown, "EKF2_EVP_NOISE": student.sigma_z_m, "EKF2_EV_NOISE_MD": 1.0}
    spread = {"EKF2_ACC_NOISE": force}
    first = Variant(
        {**own, **spread, **{f"EKF2_EV_POS_{axis}": 0.0 for axis in "XYZ"}},
        biases=False, attitude=False, gated=False, stamp_offset_s=student.clock_offset_s,
    )  # fmt: skip
    return {
        "student": first,
        STAMPS: Variant({**own, **spread}, biases=False, attitude=False, gated=False),
        NOISE: Variant({**flown, **spread}, biases=False, attitude=False, gated=False),
        BIASES: Variant({**flown, **spread}, attitude=False, gated=False),
        PROCESS: Variant(flown, attitude=False, gated=False),
        ATTITUDE: Variant(flown, gated=False),
        GATE: Variant(flown, as_logged=True),
    }


def _axis(model: Model, tracks: Mapping[str, pd.DataFrame], axis: str, times: Array) -> AxisWalk:
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    at = HORIZONTAL.index(axis)
    position, velocity = POSITION_COLUMNS[at], VELOCITY_COLUMNS[at]
    logged = at_times(ekf2.state, position, times)
    logged_speed = at_times(ekf2.state, velocity, times)
    stages = ["student", *STEPS]
    where = {name: at_times(tracks[name], position, times) for name in stages}
    square = {name: float(np.mean((where[name] - logged) ** 2)) for name in stages}
    speed_square = {
        name: float(np.mean((at_times(tracks[name], velocity, times) - logged_speed) ** 2))
        for name in stages
    }
    steps = []
    for before, name in pairwise(stages):
        moved = np.abs(where[name] - where[before])
        most = int(np.argmax(moved))
        steps.append(
            Step(
                name=name,
                position_mean_square_m2=square[before] - square[name],
                velocity_mean_square_m2_s2=speed_square[before] - speed_square[name],
                position_moved_m=float(moved[most]),
                moved_at_s=float(times[most]),
                position_rmse_to_truth_m=_to_truth(model, where[name], axis, times),
            )
        )
    return AxisWalk(
        steps=tuple(steps),
        position_total_m2=square["student"],
        velocity_total_m2_s2=speed_square["student"],
        position_left_m2=square[OUTPUT],
        velocity_left_m2_s2=speed_square[OUTPUT],
        student_rmse_to_truth_m=_to_truth(model, where["student"], axis, times),
        logged_rmse_to_truth_m=_to_truth(model, logged, axis, times),
    )


def _to_truth(model: Model, where: Array, axis: str, times: Array) -> float | Unavailable:
    truth = model.flight.truth
    if not isinstance(truth, Truth):
        return truth
    span = truth.samples.index
    inside = (times >= span[0]) & (times <= span[-1])
    if not inside.any():
        return Unavailable("RMSE to truth", "the truth is of another time", "Record both together.")
    known = at_times(truth.samples, POSITION_COLUMNS[HORIZONTAL.index(axis)], times)
    return float(np.sqrt(np.mean((where - known)[inside] ** 2)))


def _coast(
    flown: Ekf2Replay, ungated: pd.DataFrame, judged: tuple[tuple[float, float], ...]
) -> Coast | None:
    updates = flown.updates[settled(flown.updates.index.to_numpy(), judged)]
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
