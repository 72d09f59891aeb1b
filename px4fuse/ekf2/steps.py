"""Explanation of the difference between KF and EKF2.

A series of replays changes KF into EKF2. Each replay replaces one more property of KF by EKF2's:
sample times, noise settings, estimated states, rejections, output predictor. Each replacement
changes the mean square difference from the logged EKF2.

EKF2's process noise is too small for a filter without bias states. Therefore the accelerometer bias
becomes a state before EKF2's process noise is used.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array
from px4fuse.core.record import NOT_IN_JSON, Count, NonNegativeFloat, NotInJson, Record, Span
from px4fuse.filter.kalman import KfRun, predict_track
from px4fuse.filter.model import STATE_COLUMNS
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight.ekf2_parameters import EV_POS, FLOW, GNSS_POS, GNSS_VEL, MAG
from px4fuse.flight.model import Columns, Ekf2, Flight, Spans, Truth, Unavailable

from .filter_batch import FilterConfiguration
from .inputs import ReplayInputs
from .model import (
    Ekf2Model,
    compute_delayed_tracks,
    list_modelled_aids,
    replay_with_logged_rejections,
)
from .replay import (
    Ekf2Replay,
    compute_rmse_to_truth,
    interpolate_component,
    is_inside_spans,
    rows_inside,
    subtract_states,
)

DIFFERENCE_ANALYSIS_NAME = "difference KF - EKF2"
NO_TRUTH_OVERLAP = Unavailable(
    "RMSE against ground truth",
    "ground truth and replay do not overlap in time",
    "Record ground truth during the whole flight.",
)
# Names of the properties in which KF and EKF2 differ. KF's properties are replaced by those of EKF2
# one after the other
SAMPLE_TIMES_PROPERTY_NAME = "sample times and time steps"
TIMESTAMPS_PROPERTY_NAME = "timestamps and delay"
MEASUREMENT_NOISE_PROPERTY_NAME = "measurement noise"
ACCELEROMETER_BIAS_PROPERTY_NAME = "accelerometer bias state"
PROCESS_NOISE_PROPERTY_NAME = "process noise"
ATTITUDE_PROPERTY_NAME = "attitude and gyro bias states"
MAGNETOMETER_PROPERTY_NAME = "magnetometer"
GNSS_VELOCITY_PROPERTY_NAME = "GNSS velocity"
FLOW_PROPERTY_NAME = "optical flow"
VISION_PROPERTY_NAME = "external vision"
REJECTION_PROPERTY_NAME = "rejections and resets"
OUTPUT_PREDICTOR_PROPERTY_NAME = "output predictor"
# Names of the properties for optical flow and additional external vision, which KF does not fuse.
# The keys are PX4's names of the sources
REPLACEMENT_NAME_BY_ADDITIONAL_AID = {
    FLOW.name: FLOW_PROPERTY_NAME,
    EV_POS.name: VISION_PROPERTY_NAME,
}


class PropertyReplacement(Record, kw_only=True):
    """Effect of replacing one property of KF, such as the measurement noise, by that of EKF2.

    Attributes
    ----------
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Reduction of the mean square difference from the logged EKF2; negative for an increase.
    position_moved_m, moved_at_s : float
        Largest change of the position by the replacement, and its time.
    position_rmse_to_truth_m : float or None
        Position RMSE against ground truth after the replacement.
    """

    name: str
    position_mean_square_m2: float
    velocity_mean_square_m2_s2: float
    position_moved_m: NonNegativeFloat
    moved_at_s: float
    position_rmse_to_truth_m: NonNegativeFloat | None = None


class RejectionSeries(Record, kw_only=True):
    """Longest series of successive position samples that EKF2 rejected in flight.

    Attributes
    ----------
    duration_s : float
        Time from the first rejected sample to the next fused sample.
    distance_m : float
        Largest position difference between EKF2 replays with and without rejections.
    """

    start_s: float
    samples: Count
    duration_s: NonNegativeFloat
    distance_m: NonNegativeFloat


class DifferenceOutsideReplay(Record):
    """Largest position difference KF - EKF2 in the parts of the flight that are not replayed.

    ``at_s`` is the time of this difference. The EKF2 replay does not cover the whole flight.
    """

    maximum_m: NonNegativeFloat
    at_s: float


class DifferenceExplanation(Record, kw_only=True):
    """Explanation of the mean square difference KF - EKF2 along one axis.

    One property of KF after another, such as the measurement noise, is replaced by that of EKF2.
    Each replacement reduces (or increases) the mean square difference from the logged EKF2. The sum
    of all reductions and the unexplained remainder is the mean square difference KF - EKF2.

    Attributes
    ----------
    count : int
        Number of EKF2 samples.
    position_mean_square_m2, velocity_mean_square_m2_s2 : float
        Mean square difference between KF and the logged EKF2.
    steps : tuple of PropertyReplacement
        Replaced properties, with the reduction of the mean square difference by each of them.
    unexplained_mean_square_m2, unexplained_velocity_mean_square_m2_s2 : float
        Mean square difference from the logged EKF2 after all replacements.
    outside : DifferenceOutsideReplay or None
        Largest difference KF - EKF2 in the parts of the flight that are not replayed.
    corrected : mapping from field of Settings to value
        Estimated noises that replace the noise settings of KF in this analysis; else empty.
    sentences : tuple of str
        Explanations for the user, largest contribution first.
    times_s, kf_minus_ekf2_m, unexplained_difference_m : ndarray
        EKF2 sample times, and position differences before and after all replacements.
    """

    count: Count
    position_mean_square_m2: NonNegativeFloat
    velocity_mean_square_m2_s2: NonNegativeFloat
    steps: tuple[PropertyReplacement, ...]
    unexplained_mean_square_m2: NonNegativeFloat
    unexplained_velocity_mean_square_m2_s2: NonNegativeFloat
    position_rmse_to_truth_m: Mapping[str, NonNegativeFloat | Unavailable]
    spans_s: Spans
    longest_rejection: RejectionSeries | None = None
    outside: DifferenceOutsideReplay | None = None
    corrected: Mapping[str, float] = {}
    sentences: tuple[str, ...] = ()
    times_s: NotInJson[Array] = NOT_IN_JSON
    kf_minus_ekf2_m: NotInJson[Array] = NOT_IN_JSON
    unexplained_difference_m: NotInJson[Array] = NOT_IN_JSON

    @property
    def unexplained_fraction(self) -> float:
        """Mean square position difference after all replacements ÷ that before all replacements."""
        return self.unexplained_mean_square_m2 / self.position_mean_square_m2


def explain_difference_by_replacements(
    model: Ekf2Model, settings: Settings, kf_runs: Mapping[str, KfRun]
) -> dict[str, DifferenceExplanation] | Unavailable:
    """Explain the difference KF - EKF2 along each horizontal axis.

    One property of KF after another, such as the measurement noise, is replaced by that of EKF2.
    The explanation consists of the change of the difference by each replacement.

    Parameters
    ----------
    settings : Settings
        Settings of KF, with the time offset of the position source.
    kf_runs : mapping from axis name to KfRun
        Results of KF by horizontal axis.
    """
    if not model.agreement.good:
        return model.agreement.report_disagreement(DIFFERENCE_ANALYSIS_NAME)
    ekf2 = model.flight.ekf2
    assert isinstance(ekf2, Ekf2)
    configurations = make_stepwise_configurations(model.inputs, settings)
    # This configuration is not replayed again, because baseline_replay is its replay
    del configurations[REJECTION_PROPERTY_NAME]
    baseline_replay = replay_with_logged_rejections(model)
    evaluated_spans = model.baseline_replay.find_evaluated_spans()
    state_times_s = ekf2.state.index.to_numpy()
    is_inside = is_inside_spans(state_times_s, evaluated_spans)
    # Only times at which the EKF2 replay and KF have a state are compared
    for index in (
        baseline_replay.delayed_state.index,
        *(run.steps.index for run in kf_runs.values()),
    ):
        is_inside &= (state_times_s >= index[0]) & (state_times_s <= index[-1])
    state_times_s = state_times_s[is_inside]
    if not len(state_times_s):
        return Unavailable(
            DIFFERENCE_ANALYSIS_NAME,
            "KF and the EKF2 replay do not overlap in time",
            "Analyse a segment in which EKF2 fused the position source (--start, --end).",
        )
    state_span_s = float(state_times_s[0]), float(state_times_s[-1])

    def select_states(track: pd.DataFrame) -> dict[str, Array]:
        """Return position and velocity of a track along each axis, shape (2, n)."""
        return {
            axis: np.array(
                [
                    interpolate_component(track, columns, run.axis.direction, state_times_s)
                    for columns in (Columns.POSITION, Columns.VELOCITY)
                ]
            )
            for axis, run in kf_runs.items()
        }

    # Tracks are computed one at a time, to limit the memory
    states_by_replacement = {}
    tracks = compute_delayed_tracks(model, [*configurations.values()])
    for name, track in zip(configurations, tracks, strict=True):
        states_by_replacement[name] = select_states(track)
    # The last track is EKF2 without its rejections. Its difference from baseline_replay, which
    # contains the rejections, is their effect
    longest_rejection = _find_longest_rejection(
        baseline_replay, track, state_span_s, evaluated_spans
    )
    states_by_replacement |= {
        REJECTION_PROPERTY_NAME: select_states(baseline_replay.delayed_state),
        OUTPUT_PREDICTOR_PROPERTY_NAME: select_states(baseline_replay.published_state),
    }
    logged_states = select_states(ekf2.state)
    spans = Segment(*state_span_s, "").clip_spans(evaluated_spans)
    return {
        axis: _explain_difference_along_axis(
            model.flight,
            kf_run.axis.direction,
            state_times_s,
            predict_track(kf_run, state_times_s)[STATE_COLUMNS].to_numpy().T,
            {name: states[axis] for name, states in states_by_replacement.items()},
            logged_states[axis],
            spans,
            longest_rejection,
        )
        for axis, kf_run in kf_runs.items()
    }


def _explain_difference_along_axis(
    flight: Flight,
    direction: Array,
    times_s: Array,
    kf_state: Array,
    states_by_replacement: Mapping[str, Array],
    logged_state: Array,
    spans_s: Spans,
    longest_rejection: RejectionSeries | None,
) -> DifferenceExplanation:
    """Attribute the mean square difference KF - EKF2 along one axis to properties of KF.

    Properties of KF, such as the measurement noise, were replaced by those of EKF2, one after the
    other. A property explains the reduction of the mean square difference by its replacement. Each
    state contains position and velocity at n times, shape (2, n).

    Parameters
    ----------
    kf_state, logged_state : ndarray
        States of KF and of the logged EKF2.
    states_by_replacement : mapping from name to ndarray
        States after each replacement, in the order of the replacements.
    """

    def compute_mean_squares(state: Array) -> Array:
        """Return the mean square differences of position and velocity from the logged EKF2."""
        return np.asarray(np.mean((state - logged_state) ** 2, axis=1))

    def compute_rmse(state: Array) -> float | None:
        return compute_rmse_to_truth(flight, state[0], direction, times_s)

    steps = []
    state = kf_state
    for name, replaced_state in states_by_replacement.items():
        reductions = compute_mean_squares(state) - compute_mean_squares(replaced_state)
        position_change_m = np.abs(replaced_state[0] - state[0])
        steps.append(
            PropertyReplacement(
                name=name,
                position_mean_square_m2=float(reductions[0]),
                velocity_mean_square_m2_s2=float(reductions[1]),
                position_moved_m=float(position_change_m.max()),
                moved_at_s=float(times_s[position_change_m.argmax()]),
                position_rmse_to_truth_m=compute_rmse(replaced_state),
            )
        )
        state = replaced_state
    position_mean_square_m2, velocity_mean_square_m2_s2 = compute_mean_squares(kf_state).tolist()
    # All properties of KF are now replaced by those of EKF2. The remaining difference between
    # ``state`` and the logged EKF2 is unexplained
    unexplained_m2, unexplained_m2_s2 = compute_mean_squares(state).tolist()
    missing_truth_reason = NO_TRUTH_OVERLAP if isinstance(flight.truth, Truth) else flight.truth
    return DifferenceExplanation(
        count=len(times_s),
        position_mean_square_m2=position_mean_square_m2,
        velocity_mean_square_m2_s2=velocity_mean_square_m2_s2,
        steps=tuple(steps),
        unexplained_mean_square_m2=unexplained_m2,
        unexplained_velocity_mean_square_m2_s2=unexplained_m2_s2,
        position_rmse_to_truth_m={
            name: missing_truth_reason if rmse_m is None else rmse_m
            for name, rmse_m in (
                ("kf", compute_rmse(kf_state)),
                ("ekf2", compute_rmse(logged_state)),
            )
        },
        spans_s=spans_s,
        longest_rejection=longest_rejection,
        times_s=times_s,
        kf_minus_ekf2_m=kf_state[0] - logged_state[0],
        unexplained_difference_m=state[0] - logged_state[0],
    )


def make_stepwise_configurations(
    inputs: ReplayInputs, kf_settings: Settings
) -> dict[str, FilterConfiguration]:
    """Return filter configurations for replays that change step by step from KF to EKF2.

    The first configuration is KF with the sample times and time steps of EKF2. Each further
    configuration replaces one more property of KF by that of EKF2. The keys are the names of the
    replaced properties.
    """
    logged_settings, aid = inputs.settings, inputs.aid
    # The acceleration error is constant in a time step: n shorter steps give the same velocity
    # variance with √n times the noise
    kf_process_noise = {
        "EKF2_ACC_NOISE": kf_settings.sigma_a_m_s2
        * math.sqrt(kf_settings.dt_s / inputs.mean_step_s)
    }
    kf_noises = {**kf_process_noise, aid.noise: kf_settings.sigma_z_m}
    # The delay is already subtracted from KF's GNSS times, but not from the replay's timestamps
    applied_delay_s = logged_settings[aid.delay] * 1e-3 if aid == GNSS_POS else 0.0
    # The first source is the position source
    other_aids = list_modelled_aids(inputs)[1:]
    additional_aids = [name for name in REPLACEMENT_NAME_BY_ADDITIONAL_AID if name in other_aids]
    # The first configuration is KF with the sample times of EKF2. Like KF, it does not fuse
    # magnetometer, optical flow or additional external vision: they are disabled from 0 s on
    configuration = FilterConfiguration(
        {**logged_settings, **kf_noises, **dict.fromkeys(aid.lever_arm, 0.0)},
        estimates_biases=False,
        estimates_attitude=False,
        uses_reported_noise=False,
        has_gate=False,
        fuses_velocity=False,
        disable_time_s_by_aid=dict.fromkeys((MAG.name, *additional_aids), 0.0),
        timestamp_offset_s=kf_settings.clock_offset_s - applied_delay_s,
    )
    # Each entry replaces one property of KF, such as the measurement noise, by that of EKF2. It
    # contains the new values of fields of FilterConfiguration. The entries apply one after the
    # other
    replacements: dict[str, dict[str, Any]] = {
        TIMESTAMPS_PROPERTY_NAME: {
            "settings": {**logged_settings, **kf_noises},
            "timestamp_offset_s": None,
        },
        MEASUREMENT_NOISE_PROPERTY_NAME: {
            "settings": {**logged_settings, **kf_process_noise},
            "uses_reported_noise": True,
        },
        ACCELEROMETER_BIAS_PROPERTY_NAME: {"estimates_biases": True},
        PROCESS_NOISE_PROPERTY_NAME: {"settings": logged_settings},
        ATTITUDE_PROPERTY_NAME: {"estimates_attitude": True},
    }
    if MAG.name in other_aids:
        replacements[MAGNETOMETER_PROPERTY_NAME] = {
            "disable_time_s_by_aid": dict.fromkeys(additional_aids, 0.0)
        }
    if GNSS_VEL.name in other_aids:
        replacements[GNSS_VELOCITY_PROPERTY_NAME] = {"fuses_velocity": True}
    # Enable the additional sources one after the other; those after ``name`` stay disabled
    for index, name in enumerate(additional_aids):
        replacements[REPLACEMENT_NAME_BY_ADDITIONAL_AID[name]] = {
            "disable_time_s_by_aid": dict.fromkeys(additional_aids[index + 1 :], 0.0)
        }
    # Each configuration keeps all earlier replacements. The last one is EKF2 with its logged
    # rejections and resets
    configurations = {SAMPLE_TIMES_PROPERTY_NAME: configuration}
    for name, changes in replacements.items():
        configuration = replace(configuration, **changes)
        configurations[name] = configuration
    configurations[REJECTION_PROPERTY_NAME] = FilterConfiguration(
        logged_settings, uses_logged_decisions=True
    )
    return configurations


def _find_longest_rejection(
    baseline_replay: Ekf2Replay,
    fusion_horizon_track_without_gate: pd.DataFrame,
    span: Span,
    spans_s: Spans,
) -> RejectionSeries | None:
    """Return the longest series of successive positions that EKF2 rejected.

    Only fusion times in ``span`` (times of the compared states) and in ``spans_s`` (evaluated parts
    of the replay) are searched. The replays with and without rejections, ``baseline_replay`` and
    ``fusion_horizon_track_without_gate``, give the effect of the series on the position.
    """
    updates = rows_inside(baseline_replay.updates, spans_s)
    updates = updates[updates["fused_at_s"].between(*span)]
    is_rejected = updates["rejected"].to_numpy() > 0
    fusion_times_s = updates["fused_at_s"].to_numpy()
    if not is_rejected.any():
        return None
    # For each series of successive rejected samples: row of the first rejected sample, and row of
    # the next fused sample
    change_rows = np.flatnonzero(np.diff(is_rejected, prepend=False, append=False))
    run_starts, run_ends = change_rows.reshape(-1, 2).T
    longest_index = int(np.argmax(run_ends - run_starts))
    begin_s = fusion_times_s[run_starts[longest_index]]
    # If the longest series of rejected samples continues to the end of the flight, no sample is
    # fused after it
    end_s = fusion_times_s[min(run_ends[longest_index], len(fusion_times_s) - 1)]
    difference = subtract_states(
        fusion_horizon_track_without_gate, baseline_replay.delayed_state.loc[begin_s:end_s]
    )
    return RejectionSeries(
        start_s=float(begin_s),
        samples=int(run_ends[longest_index] - run_starts[longest_index]),
        duration_s=float(end_s - begin_s),
        distance_m=float(np.hypot(difference["north_m"], difference["east_m"]).max()),
    )
