"""Why EKF2 differs: the way from our filter to the logged EKF2, one change at a time.

Each stage is a replay of the whole flight with one thing more as EKF2 has it; the order is fixed
and physical: when a sample counts, how much it counts, what is estimated besides, what was left
out, and how the result is carried to the present. The mean square difference to what EKF2 logged
goes from stage to stage, so that the steps and what is left add up to all of it. The first step
takes our filter, as it ran on the grid and the source that were chosen, to the same filter on
EKF2's own samples and prediction steps; without it, other steps would be blamed for that.

EKF2's small process noise presupposes its bias states: given to a filter without them it makes
things worse. Therefore the biases come first. The last replays reject what EKF2 rejected: where it
rejects much, one sample on the edge of the gate would else lead the model another way.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.display import one_line_repr
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, delayed_variants, modelled_aids, replay_with_logged_rejections
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import Ekf2Replay, Spans, along, inside_spans, rms_to_truth
from px4fuse.ekf2_parameters import EV_POS, FLOW, GNSS_POS, MAG
from px4fuse.filter.kalman import Replay, state_at
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight import Columns, Ekf2, Truth, Unavailable
from px4fuse.record import Count, NotNegative, Record, missing_data

ANALYSIS_NAME = "why EKF2 differs"
OTHER_TIME = Unavailable("RMSE to truth", "the truth is of another time", "Record both together.")
# The filter of the lesson spreads its process noise over steps of DT (DESIGN: Q per second is
# SIGMA_A² · DT); EKF2 adds EKF2_ACC_NOISE² · Δt² each step, EKF2_ACC_NOISE² · Δt per second
SAMPLES = "samples and time steps"
STAMPS = "stamps and delay"
NOISE = "measurement noise"
BIASES = "accelerometer bias as a state"
PROCESS = "process noise"
ATTITUDE = "attitude and gyro bias as states"
FIELD = "magnetometer"
SPEED = "velocity of GNSS"
FLOWING = "optical flow"
VISION = "external vision"
GATE = "gate, missed samples, resets"
OUTPUT = "output predictor"
# FIELD, SPEED, FLOWING and VISION come before GATE, where EKF2 fuses these
STEPS = (SAMPLES, STAMPS, NOISE, BIASES, PROCESS, ATTITUDE, GATE, OUTPUT)

COLUMNS = (Columns.POSITION, Columns.VELOCITY)


class Step(Record, frozen=True, kw_only=True):
    """One change on the way.

    Attributes
    ----------
    name : str
        One of :data:`STEPS`, :data:`FIELD`, :data:`SPEED`, :data:`FLOWING` or :data:`VISION`.
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


class RejectionRun(Record, frozen=True, kw_only=True):
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


class UnreplayedPart(Record, frozen=True):
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


class WhySteps(Record, frozen=True, kw_only=True):
    """Why EKF2 differs along one axis: the whole is the sum of the steps and what is left.

    Attributes
    ----------
    count : int
        EKF2's own samples that the means are over.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Difference of our filter to the logged EKF2.
    steps : tuple of Step
    position_left_mean_square_m2, velocity_left_mean_square_m2_s2 : float
        Difference of the model to the logged EKF2.
    position_rmse_to_truth_m : mapping from "kf" and "ekf2" to float or Unavailable
    spans_s : tuple of (float, float)
        Parts of the flight that the means are over.
    coast : Coast or None
        None where nothing was rejected.
    outside : Outside or None
        None where the walk covers the segment.
    sentences : tuple of str
        What made the difference, in the order of their weight.
    """

    count: Count
    position_mean_square_m2: NotNegative
    velocity_mean_square_m2_s2: NotNegative
    steps: tuple[Step, ...]
    position_left_mean_square_m2: NotNegative
    velocity_left_mean_square_m2_s2: NotNegative
    position_rmse_to_truth_m: Mapping[str, NotNegative | Unavailable]
    spans_s: Spans
    coast: RejectionRun | None = None
    outside: UnreplayedPart | None = None
    sentences: tuple[str, ...] = ()

    @property
    def position_left_share(self) -> float:
        """What is left of the mean square, as a share of all of it."""
        return self.position_left_mean_square_m2 / self.position_mean_square_m2


class Why(WhySteps, frozen=True, kw_only=True, eq=False):
    """:class:`WhySteps`, with the tracks.

    Attributes
    ----------
    times_s, kf_minus_ekf2_m, unexplained_m : ndarray
        EKF2's own sample times, and how far our filter and the model are from EKF2's position.
    cause : str
        The weightiest of the steps in a sentence, without its moment.
    """

    schema_type = WhySteps
    times_s: Array
    kf_minus_ekf2_m: Array
    unexplained_m: Array
    cause: str = ""

    __repr__ = one_line_repr


def explain_by_steps(
    model: Model, settings: Settings | None = None, runs: Mapping[str, Replay] | None = None
) -> dict[str, Why] | Unavailable:
    """Walk from our filter to the logged EKF2, without words.

    Parameters
    ----------
    model : Model
    settings : Settings, optional
        Of our filter; its clock offset is that of the source that EKF2 fused.
    runs : mapping from axis name to Replay, optional
        Our filter along horizontal axes; by default the same filter on EKF2's own samples and
        steps, along north and east.

    Returns
    -------
    dict from axis name to Why, or Unavailable
        Unavailable where the model does not reproduce what was logged.
    """
    if not model.agreement.good:
        return model.agreement.as_unavailable(ANALYSIS_NAME)
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    variants = step_variants(model.inputs, settings or Settings())
    delayed, flown = (
        delayed_variants(model, list(variants.values())),
        replay_with_logged_rejections(model),
    )
    evaluated_spans, times = model.flown.judged_s, ekf2.state.index.to_numpy()
    is_inside = inside_spans(times, evaluated_spans)
    # all stages have the replay's times
    for index in (flown.delayed.index, *(run.steps.index for run in (runs or {}).values())):
        is_inside &= (times >= index[0]) & (times <= index[-1])
    times = times[is_inside]
    if not len(times):
        return missing_data("walk_elsewhere", what=ANALYSIS_NAME)
    span = float(times[0]), float(times[-1])
    directions = {name: run.axis.direction for name, run in (runs or {}).items()}
    directions = directions or {"north": np.eye(3)[0], "east": np.eye(3)[1]}
    ungated, stages = flown.delayed, []
    # one at a time: each is as long as the flight
    tracks = chain(delayed, (flown.published, ekf2.state))
    for stage, track in zip((*variants, OUTPUT, "EKF2 as logged"), tracks, strict=True):
        stages.append(
            [
                [along(track, columns, direction, times) for columns in COLUMNS]
                for direction in directions.values()
            ]
        )
        if stage in (ATTITUDE, FIELD, SPEED, FLOWING, VISION):  # the last without a gate
            ungated = track
    spans = Segment(*span, "").cut(evaluated_spans)
    coast = _longest_rejection(flown, ungated, span, evaluated_spans)
    truth, steps_by_axis = model.flight.truth, {}
    no_truth = OTHER_TIME if isinstance(truth, Truth) else truth
    for axis_index, (axis, direction) in enumerate(directions.items()):
        kf_state = state_at(runs[axis], times) if runs else stages[0][axis_index]
        # ours, after each step, and the logged EKF2, shape (k + 2, 2, n)
        path = np.array([kf_state, *(stage[axis_index] for stage in stages)])
        difference = path - path[-1]
        errors = [rms_to_truth(model.flight, track, direction, times) for track in path[:, 0]]
        position, velocity = np.mean(difference[:-1] ** 2, axis=2).T.tolist()
        position_change = np.abs(np.diff(path[:-1, 0], axis=0))
        steps = tuple(
            Step(
                name=name,
                position_mean_square_m2=position[step_index - 1] - position[step_index],
                velocity_mean_square_m2_s2=velocity[step_index - 1] - velocity[step_index],
                position_moved_m=float(position_change[step_index - 1].max()),
                moved_at_s=float(times[position_change[step_index - 1].argmax()]),
                position_rmse_to_truth_m=errors[step_index],
            )
            for step_index, name in enumerate((*variants, OUTPUT), start=1)
        )
        filter_errors = {"kf": errors[0], "ekf2": errors[-1]}
        steps_by_axis[axis] = Why(
            count=len(times),
            position_mean_square_m2=position[0],
            velocity_mean_square_m2_s2=velocity[0],
            steps=steps,
            position_left_mean_square_m2=position[-1],
            velocity_left_mean_square_m2_s2=velocity[-1],
            position_rmse_to_truth_m={
                name: no_truth if error is None else error for name, error in filter_errors.items()
            },
            spans_s=spans,
            coast=coast,
            times_s=times,
            # copies: a view would keep all steps
            kf_minus_ekf2_m=difference[0, 0].copy(),
            unexplained_m=difference[-2, 0].copy(),
        )
    return steps_by_axis


def step_variants(inputs: Inputs, kf_settings: Settings) -> dict[str, Variant]:
    """The filter after each step but the last; from one to the next, one thing changes."""
    flown, aid, received = inputs.settings, inputs.aid, inputs.received
    kf_process_noise = {
        "EKF2_ACC_NOISE": float(
            kf_settings.sigma_a_m_s2 * np.sqrt(kf_settings.dt_s / inputs.step_s)
        )
    }
    kf_parameters = {**flown, **kf_process_noise, aid.noise: kf_settings.sigma_z_m}
    # from positions of GNSS, which ours is given, the delay was taken already
    applied_delay_s = flown[aid.delay] * 1e-3 if aid == GNSS_POS else 0.0
    offset_s = kf_settings.clock_offset_s - applied_delay_s
    without_lever_arm = {**kf_parameters, **dict.fromkeys(aid.place, 0.0)}
    aids = modelled_aids(inputs)
    others = [name for name in (FLOW.name, EV_POS.name) if name in aids[1:]]
    kf_variant = Variant(
        kf_parameters,
        biases=False,
        attitude=False,
        velocity=False,
        reported=False,
        gated=False,
        without=dict.fromkeys((MAG.name, *others), 0.0),
    )
    variants = {
        SAMPLES: replace(kf_variant, settings=without_lever_arm, stamp_offset_s=offset_s),
        STAMPS: kf_variant,
        NOISE: (
            noise := replace(kf_variant, settings={**flown, **kf_process_noise}, reported=True)
        ),
        BIASES: replace(noise, biases=True),
        PROCESS: replace(noise, settings=flown, biases=True),
        ATTITUDE: (variant := replace(noise, settings=flown, biases=True, attitude=True)),
    }
    if MAG.name in aids:
        variants[FIELD] = variant = replace(variant, without=dict.fromkeys(others, 0.0))
    if received.velocity_m_s is not None:
        variants[SPEED] = variant = replace(variant, velocity=True)
    for position, name in enumerate(others, start=1):
        step = FLOWING if name == FLOW.name else VISION
        variants[step] = variant = replace(variant, without=dict.fromkeys(others[position:], 0.0))
    return variants | {GATE: Variant(flown, as_logged=True)}


def _longest_rejection(
    flown: Ekf2Replay, ungated: pd.DataFrame, span: tuple[float, float], spans: Spans
) -> RejectionRun | None:
    updates = flown.updates[inside_spans(flown.updates.index, spans)]
    updates = updates[updates["fused_at_s"].between(*span)]
    rejected, time = updates["rejected"].to_numpy() > 0, updates["fused_at_s"].to_numpy()
    if not rejected.any():
        return None
    # each run from its first rejected sample to the sample after its last
    change = np.diff(rejected.astype(int), prepend=0, append=0)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    longest = int(np.argmax(ends - starts))
    begin, end = time[starts[longest]], time[min(ends[longest], len(time) - 1)]
    rejected_part = flown.delayed.loc[begin:end]
    ungated_difference = [
        rejected_part[column] - np.interp(rejected_part.index, ungated.index, ungated[column])
        for column in Columns.POSITION[:2]
    ]
    return RejectionRun(
        start_s=float(begin),
        samples=int(ends[longest] - starts[longest]),
        duration_s=float(end - begin),
        distance_m=float(np.max(np.hypot(*ungated_difference))),
    )
