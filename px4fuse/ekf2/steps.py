"""Explanation of the difference between KF (position and velocity states) and EKF2, step by step.

The flight is replayed with KF. In each step, one more property of KF is replaced by EKF2's: sample
times, noise settings, estimated states, gate, and output predictor. A step reduces or increases the
mean square difference from the logged EKF2.

Bias states are added before EKF2's process noise, because this noise is too small for a filter
without bias states. The steps gate and output predictor use EKF2's logged rejections.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array
from px4fuse.core.record import NOT_WRITTEN, Count, NotNegative, NotWritten, Record, Span
from px4fuse.ekf2.filter_recursion import FilterConfiguration
from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.ekf2.model import (
    Ekf2Model,
    compute_delayed_tracks,
    list_modelled_aids,
    replay_with_logged_rejections,
)
from px4fuse.ekf2.replay import (
    HORIZONTAL_AXES,
    Ekf2Replay,
    Spans,
    compute_rmse_to_truth,
    interpolate_component,
    is_inside_spans,
    rows_inside,
)
from px4fuse.filter.kalman import Replay, predict_state
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight.ekf2_parameters import EV_POS, FLOW, GNSS_POS, GNSS_VEL, MAG
from px4fuse.flight.model import Columns, Ekf2, Flight, Truth, Unavailable

ANALYSIS_NAME = "difference KF - EKF2"
NO_TRUTH_OVERLAP = Unavailable(
    "RMSE against ground truth",
    "ground truth and replay do not overlap in time",
    "Record ground truth during the whole flight.",
)
# Names of the properties that differ between KF and EKF2
SAMPLE_TIMES_STEP = "sample times and time steps"
TIMESTAMPS_STEP = "timestamps and delay"
MEASUREMENT_NOISE_STEP = "measurement noise"
BIASES_STEP = "accelerometer bias as a state"
PROCESS_NOISE_STEP = "process noise"
ATTITUDE_STEP = "attitude and gyro bias as states"
MAGNETOMETER_STEP = "magnetometer"
GNSS_VELOCITY_STEP = "GNSS velocity"
FLOW_STEP = "optical flow"
VISION_STEP = "external vision"
REJECTION_STEP = "rejections and resets"
OUTPUT_PREDICTOR_STEP = "output predictor"
# Step that adds an aiding source (PX4's name) to the fused position source
STEP_BY_ADDITIONAL_AID = {FLOW.name: FLOW_STEP, EV_POS.name: VISION_STEP}
# Order in which properties of KF are replaced by properties of EKF2. Additional aiding sources are
# inserted before GATE
REPLACEMENT_STEPS = (
    SAMPLE_TIMES_STEP,
    TIMESTAMPS_STEP,
    MEASUREMENT_NOISE_STEP,
    BIASES_STEP,
    PROCESS_NOISE_STEP,
    ATTITUDE_STEP,
    REJECTION_STEP,
    OUTPUT_PREDICTOR_STEP,
)

TRACK_COLUMNS = (Columns.POSITION, Columns.VELOCITY)


class Step(Record, kw_only=True):
    """Effect of replacing one property of KF, such as the measurement noise, by EKF2's property.

    Attributes
    ----------
    name : str
        Name of the property.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Reduction of the mean square difference from the logged EKF2; negative for an increase.
    position_moved_m, moved_at_s : float
        Largest position change by the replacement, and its time.
    position_rmse_to_truth_m : float or None
        Position RMSE after the replacement.
    """

    name: str
    position_mean_square_m2: float
    velocity_mean_square_m2_s2: float
    position_moved_m: NotNegative
    moved_at_s: float
    position_rmse_to_truth_m: NotNegative | None = None


class RejectionRun(Record, kw_only=True):
    """Longest run of successive position samples that EKF2 rejected in flight.

    Attributes
    ----------
    duration_s : float
        Time from the first rejected sample to the next fused sample.
    distance_m : float
        Largest position difference between the EKF2 replays with and without a gate.
    """

    start_s: float
    samples: Count
    duration_s: NotNegative
    distance_m: NotNegative


class UnreplayedDifference(Record):
    """Largest position difference KF - EKF2 outside the replayed times, and time of the maximum."""

    maximum_m: NotNegative
    at_s: float


class DifferenceExplanation(Record, kw_only=True):
    """Explanation of the mean square difference KF - EKF2 along one axis.

    Each of the ``steps`` replaces one property of KF by EKF2's. Mean square = sum of the reductions
    by all steps + unexplained remainder.

    Attributes
    ----------
    count : int
        Number of EKF2 samples.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Mean square difference between KF and the logged EKF2.
    unexplained_mean_square_m2, unexplained_velocity_mean_square_m2_s2 : float
        Mean square difference after all steps.
    outside : UnreplayedDifference or None
        Difference outside the replayed times, which the steps do not explain.
    corrected : mapping from field of Settings to value
        KF settings that were wrong, and are replaced by estimates before the first step.
    sentences : tuple of str
        Explanations, largest contribution first.
    times_s, kf_minus_ekf2_m, unexplained_m : ndarray
        EKF2 sample times, and position differences before and after all steps.
    cause : str
        Sentence about the largest contribution.
    """

    count: Count
    position_mean_square_m2: NotNegative
    velocity_mean_square_m2_s2: NotNegative
    steps: tuple[Step, ...]
    unexplained_mean_square_m2: NotNegative
    unexplained_velocity_mean_square_m2_s2: NotNegative
    position_rmse_to_truth_m: Mapping[str, NotNegative | Unavailable]
    spans_s: Spans
    longest_rejection: RejectionRun | None = None
    outside: UnreplayedDifference | None = None
    corrected: Mapping[str, float] = {}
    sentences: tuple[str, ...] = ()
    times_s: NotWritten[Array] = NOT_WRITTEN
    kf_minus_ekf2_m: NotWritten[Array] = NOT_WRITTEN
    unexplained_m: NotWritten[Array] = NOT_WRITTEN
    cause: NotWritten[str] = ""

    @property
    def unexplained_fraction(self) -> float:
        """Fraction of the mean square position difference that remains after all steps."""
        return self.unexplained_mean_square_m2 / self.position_mean_square_m2


def explain_by_steps(
    model: Ekf2Model, settings: Settings | None = None, kf_runs: Mapping[str, Replay] | None = None
) -> dict[str, DifferenceExplanation] | Unavailable:
    """Explain the difference KF - EKF2 along each axis by the properties that differ.

    Parameters
    ----------
    model : Ekf2Model
    settings : Settings, optional
        Settings of KF, with the time offset of the position source that EKF2 fused.
    kf_runs : mapping from axis name to Replay, optional
        Runs of KF along horizontal axes; default: north and east, with EKF2's sample times.
    """
    if not model.agreement.good:
        return model.agreement.as_unavailable(ANALYSIS_NAME)
    kf_runs = kf_runs or {}
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    configurations = make_step_configurations(model.inputs, settings or Settings())
    delayed_positions = compute_delayed_tracks(model, list(configurations.values()))
    baseline_replay = replay_with_logged_rejections(model)
    evaluated_spans = model.baseline_replay.find_evaluated_spans()
    state_times_s = ekf2.state.index.to_numpy()
    is_inside = is_inside_spans(state_times_s, evaluated_spans)
    # Only times at which the EKF2 replay and all runs of KF have a state are compared
    for index in (baseline_replay.delayed.index, *(run.steps.index for run in kf_runs.values())):
        is_inside &= (state_times_s >= index[0]) & (state_times_s <= index[-1])
    state_times_s = state_times_s[is_inside]
    if not len(state_times_s):
        return Unavailable(
            ANALYSIS_NAME,
            "KF and the EKF2 replay do not overlap in time",
            "Analyse a segment in which EKF2 fused the source (--start, --end).",
        )
    state_span_s = float(state_times_s[0]), float(state_times_s[-1])
    directions = {name: run.axis.direction for name, run in kf_runs.items()}
    directions = directions or dict(zip(HORIZONTAL_AXES, np.eye(3), strict=False))
    tracks_by_step = []
    # Tracks are computed one at a time, to limit the memory
    tracks = chain(delayed_positions, (baseline_replay.published, ekf2.state))
    for step_name, track in zip(
        (*configurations, OUTPUT_PREDICTOR_STEP, "EKF2 as logged"), tracks, strict=True
    ):
        tracks_by_step.append(
            [
                [
                    interpolate_component(track, columns, direction, state_times_s)
                    for columns in TRACK_COLUMNS
                ]
                for direction in directions.values()
            ]
        )
        # Before REJECTION_STEP, only EKF2's gate and output predictor are missing in the track
        if step_name == [*configurations][-2]:
            track_without_gate = track
    spans = Segment(*state_span_s, "").cut(evaluated_spans)
    longest_rejection = _find_longest_rejection(
        baseline_replay, track_without_gate, state_span_s, evaluated_spans
    )
    explanations = {}
    for axis_index, (axis, direction) in enumerate(directions.items()):
        axis_tracks = [step_tracks[axis_index] for step_tracks in tracks_by_step]
        kf_state = predict_state(kf_runs[axis], state_times_s) if kf_runs else axis_tracks[0]
        explanations[axis] = _explain_axis(
            model.flight,
            direction,
            (*configurations, OUTPUT_PREDICTOR_STEP),
            state_times_s,
            np.array([kf_state, *axis_tracks]),
            spans,
            longest_rejection,
        )
    return explanations


def _explain_axis(
    flight: Flight,
    direction: Array,
    step_names: Sequence[str],
    times_s: Array,
    positions_by_step: Array,
    spans_s: Spans,
    longest_rejection: RejectionRun | None,
) -> DifferenceExplanation:
    """Divide the difference KF - EKF2 along one axis among k properties that KF takes from EKF2.

    ``positions_by_step``, shape (k + 2, 2, n), contains position and velocity of KF, of k replays
    (each with one more property of EKF2), and of the logged EKF2, at the times of EKF2's states.
    """
    difference_by_step_m = positions_by_step - positions_by_step[-1]
    rmse_by_step = [
        compute_rmse_to_truth(flight, track, direction, times_s)
        for track in positions_by_step[:, 0]
    ]
    mean_square_differences = np.mean(difference_by_step_m[:-1] ** 2, axis=2)
    position_change = np.abs(np.diff(positions_by_step[:-1, 0], axis=0))
    steps = tuple(
        Step(
            name=name,
            position_mean_square_m2=position_reduction,
            velocity_mean_square_m2_s2=velocity_reduction,
            position_moved_m=float(position_change_m.max()),
            moved_at_s=float(times_s[position_change_m.argmax()]),
            position_rmse_to_truth_m=rmse_m,
        )
        for name, (position_reduction, velocity_reduction), position_change_m, rmse_m in zip(
            step_names,
            (mean_square_differences[:-1] - mean_square_differences[1:]).tolist(),
            position_change,
            rmse_by_step[1:-1],
            strict=True,
        )
    )
    total_mean_squares, *_, unexplained_mean_squares = mean_square_differences.tolist()
    missing_truth_reason = NO_TRUTH_OVERLAP if isinstance(flight.truth, Truth) else flight.truth
    rmse_by_filter = {"kf": rmse_by_step[0], "ekf2": rmse_by_step[-1]}
    return DifferenceExplanation(
        count=len(times_s),
        position_mean_square_m2=total_mean_squares[0],
        velocity_mean_square_m2_s2=total_mean_squares[1],
        steps=steps,
        unexplained_mean_square_m2=unexplained_mean_squares[0],
        unexplained_velocity_mean_square_m2_s2=unexplained_mean_squares[1],
        position_rmse_to_truth_m={
            name: missing_truth_reason if rmse_m is None else rmse_m
            for name, rmse_m in rmse_by_filter.items()
        },
        spans_s=spans_s,
        longest_rejection=longest_rejection,
        times_s=times_s,
        # Copied, because a view would keep the whole array in memory
        kf_minus_ekf2_m=difference_by_step_m[0, 0].copy(),
        unexplained_m=difference_by_step_m[-2, 0].copy(),
    )


def make_step_configurations(
    inputs: ReplayInputs, kf_settings: Settings
) -> dict[str, FilterConfiguration]:
    """Return the model configurations that change KF into EKF2, one property (key) after the other.

    The last configuration is EKF2 without output predictor.
    """
    logged_settings = inputs.settings
    aid = inputs.aid
    acceleration_noise_m_s2 = kf_settings.sigma_a_m_s2 * math.sqrt(
        kf_settings.dt_s / inputs.mean_step_s
    )
    kf_process_settings = {**logged_settings, "EKF2_ACC_NOISE": acceleration_noise_m_s2}
    kf_noise_settings = {**kf_process_settings, aid.noise: kf_settings.sigma_z_m}
    # KF's GNSS positions have the delay already subtracted, the timestamps of the replay have not
    applied_delay_s = logged_settings[aid.delay] * 1e-3 if aid == GNSS_POS else 0.0
    time_offset_s = kf_settings.clock_offset_s - applied_delay_s
    settings_without_lever_arm = {**kf_noise_settings, **dict.fromkeys(aid.lever_arm, 0.0)}
    replayed_aids = list_modelled_aids(inputs)[1:]
    step_by_aid = {
        aid: step for aid, step in STEP_BY_ADDITIONAL_AID.items() if aid in replayed_aids
    }
    additional_aids = [*step_by_aid]
    kf_configuration = FilterConfiguration(
        kf_noise_settings,
        estimates_biases=False,
        estimates_attitude=False,
        uses_reported_noise=False,
        has_gate=False,
        fuses_velocity=False,
        without=dict.fromkeys((MAG.name, *additional_aids), 0.0),
    )
    noise_step_configuration = replace(
        kf_configuration, settings=kf_process_settings, uses_reported_noise=True
    )
    process_step_configuration = replace(
        noise_step_configuration, settings=logged_settings, estimates_biases=True
    )
    latest_configuration = replace(process_step_configuration, estimates_attitude=True)
    configurations = {
        SAMPLE_TIMES_STEP: replace(
            kf_configuration, settings=settings_without_lever_arm, timestamp_offset_s=time_offset_s
        ),
        TIMESTAMPS_STEP: kf_configuration,
        MEASUREMENT_NOISE_STEP: noise_step_configuration,
        BIASES_STEP: replace(noise_step_configuration, estimates_biases=True),
        PROCESS_NOISE_STEP: process_step_configuration,
        ATTITUDE_STEP: latest_configuration,
    }
    if MAG.name in replayed_aids:
        configurations[MAGNETOMETER_STEP] = latest_configuration = replace(
            latest_configuration, without=dict.fromkeys(additional_aids, 0.0)
        )
    if GNSS_VEL.name in replayed_aids:
        configurations[GNSS_VELOCITY_STEP] = latest_configuration = replace(
            latest_configuration, fuses_velocity=True
        )
    for next_index, step in enumerate(step_by_aid.values(), start=1):
        configurations[step] = latest_configuration = replace(
            latest_configuration, without=dict.fromkeys(additional_aids[next_index:], 0.0)
        )
    return configurations | {
        REJECTION_STEP: FilterConfiguration(logged_settings, uses_logged_decisions=True)
    }


def _find_longest_rejection(
    baseline_replay: Ekf2Replay, track_without_gate: pd.DataFrame, span: Span, spans_s: Spans
) -> RejectionRun | None:
    updates = rows_inside(baseline_replay.updates, spans_s)
    updates = updates[updates["fused_at_s"].between(*span)]
    is_rejected = updates["rejected"].to_numpy() > 0
    fusion_times_s = updates["fused_at_s"].to_numpy()
    if not is_rejected.any():
        return None
    # A run of rejections lasts from the first rejected sample to the next fused sample
    rejection_change = np.diff(is_rejected.astype(int), prepend=0, append=0)
    run_starts = np.flatnonzero(rejection_change == 1)
    run_ends = np.flatnonzero(rejection_change == -1)
    longest_index = int(np.argmax(run_ends - run_starts))
    begin_s = fusion_times_s[run_starts[longest_index]]
    end_s = fusion_times_s[min(run_ends[longest_index], len(fusion_times_s) - 1)]
    track_with_gate = baseline_replay.delayed.loc[begin_s:end_s]
    position_difference = [
        track_with_gate[column]
        - np.interp(track_with_gate.index, track_without_gate.index, track_without_gate[column])
        for column in Columns.POSITION[:2]
    ]
    return RejectionRun(
        start_s=float(begin_s),
        samples=int(run_ends[longest_index] - run_starts[longest_index]),
        duration_s=float(end_s - begin_s),
        distance_m=float(np.max(np.hypot(*position_difference))),
    )
