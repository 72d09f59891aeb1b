"""Replay of EKF2 with the logged parameters, or with other parameters.

The replay starts from the logged ``estimator_states`` and fuses the logged measurements. The model
has 15 error states, or 21 with a magnetometer. Without a height sensor, the replay uses EKF2's
published height. Without a magnetometer, the replay uses EKF2's published heading.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import (
    Array,
    ArrayPair,
    BoolArray,
    IntArray,
    cumulative_sums,
    select_intervals,
)
from px4fuse.core.record import Span
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import (
    EV_POS,
    FLOW,
    GNSS_HGT,
    GNSS_POS,
    GNSS_VEL,
    MAG,
    check_parameters,
)
from px4fuse.flight.model import AXIS_NAMES, Columns, Ekf2, Flight, NedAxis, Unavailable, time_index
from px4fuse.readers.px4_innovations import replace_vision_by_gnss_innovations
from px4fuse.trajectory.rotation import rotate

from .filter_batch import FilterConfiguration
from .filter_recursion import (
    HEADING,
    HORIZONTAL_POSITION_COLUMNS,
    SegmentRun,
    estimate_state_correlation,
    run_segment,
)
from .heights import MIN_INNOVATION_GATE
from .inputs import (
    ANALYSIS_NAME,
    ReceivedPositions,
    ReplayInputs,
    find_matching_samples,
    prepare_inputs,
)
from .intervals import make_event_intervals
from .output_predictor import compute_published_state, sum_attitude_corrections
from .replay import (
    HORIZONTAL_AXES,
    MAX_REJECTED_FRACTION_FOR_COMPARISON,
    Ekf2Replay,
    ReplayAgreement,
    compare_with_log,
    judge_agreement_with_logged_rejections,
)
from .replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    HORIZONTAL_POSITION,
    POSITION,
    RESTART_GAP_S,
    THETA,
    VELOCITY,
    ReplaySegment,
    make_update_table,
)

# Maximum delay (s) of the fusion horizon: PX4's maximum of EKF2_DELAY_MAX
MAX_HORIZON_DELAY_S = 1.0

# Number of replays that are computed at once; limits the memory
CONFIGURATIONS_PER_BATCH = 10
# Number of intervals between fusions whose states are computed at once; limits the memory
EVENTS_PER_BLOCK = 512


@dataclass(frozen=True)
class Ekf2Model:
    """Inputs and results of EKF2 replays of one flight.

    Attributes
    ----------
    baseline_replay : Ekf2Replay
        Replay with the logged parameters.
    agreement : ReplayAgreement
        Agreement of this replay with the log.
    """

    flight: Flight
    inputs: ReplayInputs
    baseline_replay: Ekf2Replay
    agreement: ReplayAgreement
    runs: tuple[SegmentRun, ...] = ()


def prepare_ekf2_model(
    flight: Flight,
    list_later_configurations: Callable[
        [ReplayInputs], Sequence[FilterConfiguration]
    ] = lambda _: (),
) -> Ekf2Model | Unavailable:
    """Prepare EKF2 replays of a flight, and replay the flight with the logged parameters.

    If the replay does not agree with the log for an aiding source, it is repeated without this
    source.

    Parameters
    ----------
    list_later_configurations : callable
        Function that returns the filter configurations that later analyses need. They are computed
        together with the logged configuration, which is faster.
    """
    # An aiding source is omitted if its replay does not agree with the log. Keep the reason, and
    # the disagreement from the replay that still fused the source (fields of ReplayAgreement)
    omitted_aids: dict[str, str] = {}
    fields_of_omitted_aids: dict[str, Any] = {}
    while True:
        model = _replay_logged_parameters(flight, list_later_configurations, omitted_aids)
        if isinstance(model, Unavailable):
            return model
        agreement = model.agreement
        failed_aids = [name for name in agreement.doubtful if name not in omitted_aids]
        if not failed_aids:
            break
        for name in failed_aids:
            omitted_aids[name] = agreement.doubtful[name]
            # The field with the agreement of replay and log has the name of the source. For optical
            # flow, it is the largest position difference
            field_name = "carried_difference_m" if name == FLOW.name else name
            fields_of_omitted_aids[field_name] = getattr(agreement, field_name)
    # If many samples are rejected, replay and EKF2 may reject different samples. Then a replay that
    # rejects the same samples as EKF2 is compared with the log
    if (
        max(agreement.rejected_fraction_logged, agreement.rejected_fraction_replayed)
        > MAX_REJECTED_FRACTION_FOR_COMPARISON
        and np.isfinite(model.inputs.received_positions.rejected_flags).any()
    ):
        agreement_with_logged_rejections = compare_with_log(
            model.flight, replay_with_logged_rejections(model)
        )
        if isinstance(agreement_with_logged_rejections, ReplayAgreement):
            agreement = judge_agreement_with_logged_rejections(
                agreement, agreement_with_logged_rejections
            )
    agreement = structs.replace(
        agreement, doubtful={**omitted_aids, **agreement.doubtful}, **fields_of_omitted_aids
    )
    return replace(
        model,
        baseline_replay=structs.replace(model.baseline_replay, agreement=agreement),
        agreement=agreement,
    )


def _replay_logged_parameters(
    flight: Flight,
    list_later_configurations: Callable[[ReplayInputs], Sequence[FilterConfiguration]],
    omitted_aids: Mapping[str, str],
) -> Ekf2Model | Unavailable:
    """Replay a flight without the omitted aiding sources, and compare the replay with the log."""
    inputs = prepare_inputs(flight, omitted_aids)
    if isinstance(inputs, Unavailable):
        return structs.replace(inputs, what=ANALYSIS_NAME)
    if inputs.aid == GNSS_POS and isinstance(flight.ekf2, Ekf2):
        flight = replace(flight, ekf2=replace_vision_by_gnss_innovations(flight.ekf2))
    segments = tuple(estimate_state_correlation(inputs, segment) for segment in inputs.segments)
    inputs = replace(inputs, segments=segments)
    configurations = [FilterConfiguration(inputs.settings)]
    for configuration in list_later_configurations(inputs):
        if configuration not in configurations:
            configurations.append(configuration)
    runs = run_configurations(inputs, configurations)
    baseline_replay = _make_replay(inputs, runs, configurations[0], {})
    agreement = compare_with_log(flight, baseline_replay)
    if isinstance(agreement, Unavailable):
        return agreement
    return Ekf2Model(flight, inputs, baseline_replay, agreement, tuple(runs))


def replay_with_logged_rejections(model: Ekf2Model) -> Ekf2Replay:
    """Replay EKF2 with the logged parameters, rejections and resets."""
    configuration = FilterConfiguration(model.inputs.settings, uses_logged_decisions=True)
    return _make_replay(model.inputs, _run_model(model, [configuration]), configuration, {})


def replay_with_settings(
    model: Ekf2Model,
    settings: Sequence[Mapping[str, float]],
    excluded_times_s: Array | None = None,
    disable_time_s_by_aid: Mapping[str, float] = {},
) -> Iterator[Ekf2Replay]:
    """Yield replays of EKF2 with several sets of changed parameters.

    Parameters
    ----------
    settings : sequence of mapping
        Changed parameters of each replay, by PX4 name and in PX4's units.
    excluded_times_s : ndarray, optional
        Timestamps of position samples that are not used.
    disable_time_s_by_aid : mapping from PX4's name of an aiding source to float, optional
        Time (s) from which the aiding source is not fused.

    Raises
    ------
    SettingsError
        Unknown parameter or aiding source, or a value outside PX4's range.
    """
    changes = [check_parameters(change) for change in settings]
    changed_names = (name for change in changes for name in change)
    _check_replayed_names(model, changed_names, disable_time_s_by_aid)
    if excluded_times_s is not None:
        model = _exclude_samples(model, excluded_times_s)
    inputs = model.inputs
    configurations = [
        FilterConfiguration(
            {**inputs.settings, **change},
            uses_logged_decisions=excluded_times_s is not None,
            disable_time_s_by_aid=disable_time_s_by_aid,
        )
        for change in changes
    ]
    runs: Sequence[SegmentRun] = ()
    for index, (configuration, change) in enumerate(zip(configurations, changes, strict=True)):
        # The configurations of a batch are computed at once, before the first of them is used
        if index % CONFIGURATIONS_PER_BATCH == 0:
            runs = ()  # free the memory before the next batch
            runs = _run_model(model, configurations[index : index + CONFIGURATIONS_PER_BATCH])
        replay = _make_replay(inputs, runs, configuration, change)
        updates = replay.updates
        if excluded_times_s is not None:
            # Updates are indexed by measurement time, see FilterConfiguration.compute_delays
            age_s = configuration.compute_delays(inputs).delay_s + 0.5 * inputs.mean_step_s
            updates = updates[
                ~_find_excluded_rows(updates.index.to_numpy(), excluded_times_s - age_s)
            ]
        yield structs.replace(replay, updates=updates, agreement=model.agreement)


def _check_replayed_names(
    model: Ekf2Model, parameter_names: Iterable[str], aid_names: Iterable[str]
) -> None:
    """Raise SettingsError if a replay cannot use a parameter, or omit an aiding source."""
    inputs = model.inputs
    reasons = {}
    if inputs.rules.is_horizon_set_by_largest_delay:
        reasons["EKF2_DELAY_MAX"] = (
            f"{model.flight.log.firmware} has no EKF2_DELAY_MAX: the largest sensor delay "
            "parameter sets the delay of the fusion horizon"
        )
    if inputs.received_positions.uses_sender_timestamps:
        reasons[GNSS_POS.delay] = "EKF2 uses measurement times that the GNSS driver reports"
    for name in parameter_names:
        if name in reasons or name not in inputs.settings:
            reason = reasons.get(name) or _describe_modelled_aids(inputs)
            raise SettingsError(f"{name} has no effect in a replay of this log: {reason}.")
    for name in aid_names:
        if name not in list_modelled_aids(inputs):
            raise SettingsError(f"{name} cannot be omitted: {_describe_modelled_aids(inputs)}.")


def _exclude_samples(model: Ekf2Model, excluded_times_s: Array) -> Ekf2Model:
    """Return a model that rejects the position samples with these timestamps."""
    received_positions = model.inputs.received_positions
    is_excluded = _find_excluded_rows(received_positions.timestamp_s, excluded_times_s)
    received_positions = replace(
        received_positions,
        rejected_flags=np.where(is_excluded, 1.0, np.nan),
        is_reset_to_sample=np.zeros_like(is_excluded),
        is_every_reset_logged=False,
    )
    return _replace_inputs(model, received_positions=received_positions)


def _replace_inputs(model: Ekf2Model, **changes: Any) -> Ekf2Model:
    """Return a model with other inputs, without the stored replays of the previous inputs."""
    return replace(model, inputs=replace(model.inputs, **changes), runs=())


def _find_excluded_rows(sample_times_s: Array, excluded_times_s: Array) -> BoolArray:
    excluded_rows = find_matching_samples(sample_times_s, excluded_times_s)
    return np.isin(np.arange(len(sample_times_s)), excluded_rows)


def list_modelled_aids(inputs: ReplayInputs) -> list[str]:
    """Return PX4's names of the aiding sources that the EKF2 model fuses."""
    segment = inputs.segments[0]
    is_fused = {
        inputs.aid: True,
        GNSS_VEL: inputs.received_positions.velocity_m_s is not None,
        EV_POS: inputs.aid == EV_POS or inputs.vision_positions is not None,
        MAG: MAG.noise in inputs.settings,
        FLOW: segment.flow is not None,
    }
    height_aids = segment.height_samples.fused_sensors if segment.height_samples else ()
    return [*(aid.name for aid in is_fused if is_fused[aid]), *height_aids]


def _describe_modelled_aids(inputs: ReplayInputs) -> str:
    text = f"the replay of this log fuses only {', '.join(list_modelled_aids(inputs))}"
    if inputs.aid == GNSS_POS and MAG.noise not in inputs.settings:
        text += "; the log does not contain all magnetometer samples that EKF2 fused"
    if inputs.reason_to_use_logged_height:
        text += f"; the replay uses the logged EKF2 height ({inputs.reason_to_use_logged_height})"
    return text


def add_position_noise(model: Ekf2Model, sigma_m: float, seed: int) -> Ekf2Model:
    """Add normal noise with standard deviation ``sigma_m`` (m) to each position in the inputs."""
    rng = np.random.default_rng(seed)

    def add_noise(samples: ReceivedPositions) -> ReceivedPositions:
        position_noise_m = rng.normal(scale=sigma_m, size=samples.position_m.shape)
        return replace(samples, position_m=samples.position_m + position_noise_m)

    received, vision = model.inputs.received_positions, model.inputs.vision_positions
    return _replace_inputs(
        model, received_positions=add_noise(received), vision_positions=vision and add_noise(vision)
    )


def misalign_positions(model: Ekf2Model, rotation_deg: float, delay_s: float) -> Ekf2Model:
    """Rotate measured positions and velocities (clockwise from above), and delay their times."""
    if not rotation_deg and not delay_s:
        return model
    received_positions = model.inputs.received_positions
    rotation_matrix = Rotation.from_euler("z", rotation_deg, degrees=True).as_matrix().T
    velocity_m_s = received_positions.velocity_m_s
    received_positions = replace(
        received_positions,
        timestamp_s=received_positions.timestamp_s + delay_s,
        position_m=received_positions.position_m @ rotation_matrix,
        velocity_m_s=None if velocity_m_s is None else velocity_m_s @ rotation_matrix,
    )
    return _replace_inputs(model, received_positions=received_positions)


def compute_delayed_tracks(
    model: Ekf2Model, configurations: Sequence[FilterConfiguration]
) -> Iterator[pd.DataFrame]:
    """Yield a table of position and velocity for each filter configuration.

    The table covers the whole flight, and contains EKF2's delayed state at the fusion horizon.
    """
    runs = _run_model(model, configurations)
    for configuration in configurations:
        index = runs[0].configurations.index(configuration)
        yield pd.concat(
            [_make_delayed_track(run, compute_delayed_states(run, index)) for run in runs]
        )


def _make_delayed_track(run: SegmentRun, state: Array) -> pd.DataFrame:
    return _make_track(run, state[:, VELOCITY], state[:, POSITION])


def _run_model(
    model: Ekf2Model, configurations: Sequence[FilterConfiguration]
) -> Sequence[SegmentRun]:
    """Return the stored runs if they contain all these configurations; otherwise run them."""
    if model.runs and all(
        configuration in model.runs[0].configurations for configuration in configurations
    ):
        return model.runs
    return run_configurations(model.inputs, configurations)


def run_configurations(
    inputs: ReplayInputs, configurations: Sequence[FilterConfiguration]
) -> list[SegmentRun]:
    """Run several filter configurations; return the results of each flight segment."""
    delays_by_configuration = [
        configuration.compute_delays(inputs) for configuration in configurations
    ]
    runs = []
    for segment in inputs.segments:
        # Configurations with the same delays share their intervals
        intervals_by_delays = {
            delays: make_event_intervals(inputs, segment, delays)
            for delays in set(delays_by_configuration)
        }
        intervals = [intervals_by_delays[delays] for delays in delays_by_configuration]
        runs.append(run_segment(inputs, segment, configurations, intervals))
    return runs


def _make_track(run: SegmentRun, velocity_m_s: Array, position_m: Array) -> pd.DataFrame:
    """Return a table of velocity (m/s) and position (m, in EKF2's published coordinates)."""
    states = np.hstack(
        [position_m / run.segment.internal_to_published_position_ratio, velocity_m_s]
    )
    return pd.DataFrame(states, time_index(run.segment.time_s), Columns.STATE, copy=False)


def _make_replay(
    inputs: ReplayInputs,
    runs: Sequence[SegmentRun],
    configuration: FilterConfiguration,
    changed_parameters: Mapping[str, float],
) -> Ekf2Replay:
    """Join the results of one filter configuration in all flight segments."""
    configuration_index = runs[0].configurations.index(configuration)
    fusion_horizon_tracks, published_tracks = zip(
        *(_make_state_tracks(inputs, run, configuration_index) for run in runs), strict=True
    )
    aid_updates_of_runs = [
        _collect_updates_by_aid(inputs, run, configuration_index) for run in runs
    ]
    updates_by_aid = {
        name: pd.concat([updates[name] for updates in aid_updates_of_runs])
        for name in aid_updates_of_runs[0]
    }
    return Ekf2Replay(
        settings=configuration.settings,
        changed_parameters=dict(changed_parameters),
        updates=updates_by_aid.pop(inputs.aid.name),
        optical_flow_only_spans_s=tuple(
            span
            for run, updates in zip(runs, aid_updates_of_runs, strict=True)
            if run.segment.flow is not None
            for span in _find_flow_only_spans(updates[inputs.aid.name], run.segment)
        ),
        delayed_state=pd.concat(fusion_horizon_tracks),
        published_state=pd.concat(published_tracks),
        other_aid_updates=updates_by_aid,
        stretches_s=tuple(tuple(run.segment.time_s[[0, -1]].tolist()) for run in runs),
        source=inputs.received_positions.source,
        late=sum(int(run.events[configuration_index].late.sum()) for run in runs),
        lost=sum(int(run.events[configuration_index].lost.sum()) for run in runs),
    )


def _find_flow_only_spans(updates: pd.DataFrame, segment: ReplaySegment) -> list[Span]:
    """Return start and end (s) of times without a fused position, longer than RESTART_GAP_S."""
    is_used = (updates["fused"] > 0.0) | (updates["reset"] > 0.0)
    fusion_times_s = np.append(updates.loc[is_used, "fused_at_s"], segment.time_s[-1])
    return select_intervals(fusion_times_s, np.diff(fusion_times_s) > RESTART_GAP_S)


def _collect_updates_by_aid(
    inputs: ReplayInputs, run: SegmentRun, configuration_index: int
) -> dict[str, pd.DataFrame]:
    """Return the updates of one filter configuration, by PX4's name of the aiding source."""
    events, height_filter = run.events[configuration_index], run.height_filter
    end_s = run.segment.time_s[events.end_step]
    # Rows: events. Columns: velocity and position (NED)
    nu, S = run.innovation[:, configuration_index], run.innovation_variance[:, configuration_index]

    def make_axis_table(
        axes: Sequence[NedAxis], columns: slice, *other_values: Any
    ) -> pd.DataFrame:
        """Return a table with ν, S and further columns in the order of make_update_table."""
        update_records = np.column_stack([nu[:, columns], S[:, columns], *other_values])
        # One sample per event
        return make_update_table(update_records[:, None], events.time_s[:, None], end_s, axes)

    updates_by_aid = {
        inputs.aid.name: make_axis_table(
            HORIZONTAL_AXES,
            HORIZONTAL_POSITION_COLUMNS,
            run.rejected[:, configuration_index],
            run.fused[:, configuration_index],
            run.reset[:, configuration_index],
            # Position variance after each event. Row 0 is the start
            run.variance[1:, configuration_index, HORIZONTAL_POSITION],
            run.noise[:, configuration_index, HORIZONTAL_POSITION_COLUMNS],
        )
    }
    if height_filter is not None:
        for name in height_filter.fused_sensors:
            updates_by_aid[name] = height_filter.make_update_table(name, configuration_index, end_s)
    if inputs.received_positions.velocity_m_s is not None:
        gate = run.configurations[configuration_index].settings[GNSS_VEL.gate]
        # The replay does not store if the gate rejected the GNSS velocity, so its innovations are
        # tested again. The factor 1 + 1e-9 allows for rounding errors of innovations that are
        # clipped to the gate
        squared_gate = (1.0 + 1e-9) * max(gate, MIN_INNOVATION_GATE) ** 2
        is_outside_gate = (nu[:, :3] ** 2 > squared_gate * S[:, :3]).any(axis=1)
        # Without GNSS heights, the table contains only the horizontal axes
        axes = AXIS_NAMES if GNSS_HGT.name in updates_by_aid else HORIZONTAL_AXES
        updates_by_aid[GNSS_VEL.name] = make_axis_table(axes, slice(len(axes)), is_outside_gate)
    if run.vision_filter is not None:
        updates_by_aid[EV_POS.name] = run.vision_filter.make_update_table(
            configuration_index, end_s
        )
    return updates_by_aid


def _make_state_tracks(
    inputs: ReplayInputs, run: SegmentRun, configuration_index: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return two tables by time: the state at the fusion horizon, and the published state."""
    segment = run.segment
    configuration = run.configurations[configuration_index]
    state = compute_delayed_states(run, configuration_index)
    # Change of the position by resets in each prediction step
    reset_m = np.zeros((len(state), 3))
    event_steps = run.events[configuration_index].end_step
    np.add.at(reset_m[:, :2], event_steps, run.position_reset_m[:, configuration_index])
    horizon_s = min(configuration.compute_delays(inputs).horizon_s, MAX_HORIZON_DELAY_S)
    # Number of prediction steps from the fusion horizon to the present, over which the output
    # predictor extrapolates
    lag_steps = max(round(horizon_s / inputs.mean_step_s), 1)
    # A filter configuration without attitude states uses EKF2's published attitude without a
    # correction
    attitude_correction_rad = np.zeros((len(state), 3))
    if configuration.estimates_attitude:
        attitude_correction_rad = sum_attitude_corrections(
            state[:, THETA] - segment.attitude_error_rad, lag_steps, inputs.mean_step_s, horizon_s
        )
    published_velocity_m_s, published_position_m = compute_published_state(
        segment,
        state,
        np.cumsum(reset_m, axis=0),
        attitude_correction_rad,
        lag_steps,
        configuration.settings,
    )
    # EKF2 publishes the position of the vehicle's origin, not of the IMU (output_predictor.cpp)
    published_position_m = published_position_m - segment.body_to_ned @ inputs.imu_offset_m
    heading_rad = (
        np.arctan2(segment.body_to_ned[:, 1, 0], segment.body_to_ned[:, 0, 0]) + state[:, HEADING]
    )
    return _make_delayed_track(run, state).assign(heading_rad=heading_rad), _make_track(
        run, published_velocity_m_s, published_position_m
    )


def compute_delayed_states(run: SegmentRun, configuration_index: int) -> Array:
    """Return the state at the fusion horizon after each of n prediction steps.

    The state has the shape (n + 1, 15) or more.
    """
    # States at the start and after each event
    event_states = run.state[:, configuration_index]
    event_steps = run.events[configuration_index].end_step
    step_count = len(run.segment.step_s)
    # First prediction step of the interval after the start and after each event, and end of the
    # last interval
    first_steps = np.concatenate([[0], event_steps, [step_count]])
    states = np.empty((step_count + 1, event_states.shape[1]))
    states[0] = event_states[0]
    for first_event in range(0, len(event_states), EVENTS_PER_BLOCK):
        block_first_steps = first_steps[first_event : first_event + EVENTS_PER_BLOCK + 1]
        # Row 0 is the start, so the state after step i (from 0) is row i + 1
        states[block_first_steps[0] + 1 : block_first_steps[-1] + 1] = _propagate_states(
            run, configuration_index, event_states[first_event:], block_first_steps
        )
    # The state at the prediction step of an event is the state after the fusion of the event
    states[event_steps] = event_states[1:]
    return states


def _propagate_states(
    run: SegmentRun, configuration_index: int, event_states: Array, first_steps: IntArray
) -> Array:
    """Predict the state with the IMU from each fusion to the steps before the next fusion.

    Parameters
    ----------
    event_states : ndarray, shape (intervals or more, states)
        State at the start of each interval, after a fusion.
    first_steps : ndarray of int, shape (intervals + 1,)
        Index of the first step of each interval, and of the last step plus 1.

    Returns
    -------
    ndarray, shape (steps, states)
        State at the end of each step. The biases are constant between fusions.
    """
    segment, configuration = run.segment, run.configurations[configuration_index]
    interval_lengths = np.diff(first_steps)
    event_states = event_states[: len(interval_lengths)]
    # The biases have their final value, the motion states are computed below
    state = np.repeat(event_states, interval_lengths, axis=0)
    steps = slice(first_steps[0], first_steps[-1])
    # Attitude at the end of each step; row 0 is the start of the segment
    body_to_ned, step_s = segment.body_to_ned[1:][steps], segment.step_s[steps, None]

    def integrate(rows: slice, increments: Array) -> ArrayPair:
        """Return the state elements ``rows`` before and after each prediction step.

        ``increments`` are their changes in the steps. In each interval, the state is the state
        after the last fusion plus the sum of the increments since that fusion. This sum is a
        difference of two cumulative sums.
        """
        sums = cumulative_sums(increments)
        sums_at_fusions = sums[first_steps[:-1] - first_steps[0]]
        offsets = np.repeat(event_states[:, rows] - sums_at_fusions, interval_lengths, axis=0)
        return sums[:-1] + offsets, sums[1:] + offsets

    # Prediction of attitude error, velocity and position, see intervals.py
    rotation_increments_rad = -rotate(body_to_ned, state[:, GYRO_BIAS]) * step_s
    if configuration.estimates_attitude:
        rotation_increments_rad -= segment.attitude_correction_rad[steps]
    attitude_error_before_rad, state[:, THETA] = integrate(THETA, rotation_increments_rad)
    specific_force_ned_m_s2 = rotate(body_to_ned, segment.specific_force_m_s2[steps])
    acceleration = (
        np.cross(attitude_error_before_rad, specific_force_ned_m_s2)
        + specific_force_ned_m_s2
        + GRAVITY_M_S2
        - rotate(body_to_ned, state[:, ACCELEROMETER_BIAS])
    )
    velocity_before_m_s, state[:, VELOCITY] = integrate(VELOCITY, acceleration * step_s)
    mean_velocity_m_s = 0.5 * (velocity_before_m_s + state[:, VELOCITY])
    state[:, POSITION] = integrate(POSITION, mean_velocity_m_s * step_s)[1]
    return state
