"""Replay of EKF2 from a default log, with the logged and with other parameters.

The model contains the part of EKF2 that horizontal positions affect: 15 error states about the
published attitude. It starts from the logged ``estimator_states``. Inputs are the logged IMU and
positions; in a flight with GNSS also velocities and, if logged, the magnetometer (21 states). Other
measurements (height; heading without the magnetometer) are replaced by EKF2's published values.
:mod:`px4fuse.ekf2.replay` tests for each log if the model agrees with EKF2.

A *variant* is one configuration of the filter: parameters, estimated states, fused aids and gate.
All variants run together, to save time.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.ekf2.filter_recursion import (
    HEADING,
    POSITION_COLUMNS,
    SegmentRun,
    Variant,
    run_segment,
    with_correlation,
)
from px4fuse.ekf2.inputs import ANALYSIS_NAME, Inputs, prepare_inputs, same_sample
from px4fuse.ekf2.intervals import Intervals, Timing, make_intervals
from px4fuse.ekf2.output_predictor import follow_attitude, publish
from px4fuse.ekf2.replay import (
    MANY_REJECTIONS_SHARE,
    UPDATE_COLUMNS,
    VELOCITY_UPDATE_COLUMNS,
    Agreement,
    Ekf2Replay,
    agreement_with_log,
    with_logged_rejections,
)
from px4fuse.ekf2.replay_segments import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    POSITION,
    RESTART_GAP_S,
    THETA,
    VELOCITY,
    ReplaySegment,
)
from px4fuse.ekf2_parameters import (
    BAROMETER,
    EV_POS,
    FIELD_NOISES,
    FLOW,
    GNSS_POS,
    GNSS_VEL,
    MAG,
    PARAMETERS,
    check_parameters,
)
from px4fuse.errors import SettingsError
from px4fuse.flight import Columns, Ekf2, Flight, Unavailable
from px4fuse.notebook_display import one_line_repr
from px4fuse.readers.px4_innovations import with_gnss_innovations

MAX_HORIZON_S = 1.0  # maximum delay of the fusion horizon: maximum of EKF2_DELAY_MAX

# Fields of Agreement that do not have the name of the aid, by aid
AGREEMENT_FIELDS = {FLOW.name: "carried_difference_m"}

RequestVariants = Callable[[Inputs], Sequence[Variant]]


@dataclass(frozen=True)
class Model:
    """Flight prepared for replays.

    Attributes
    ----------
    flight : Flight
    inputs : Inputs
    intervals : mapping from Timing to tuple of Intervals
        Intervals of each segment with the logged delay; empty if not yet computed.
    flown : Ekf2Replay
        Replay with the logged parameters.
    agreement : Agreement
        Agreement of ``flown`` with the log.
    runs : list of SegmentRun
        One run per segment, with the filter configurations (variants) already computed: logged
        parameters, logged parameters with logged rejections, and the result of
        ``request_variants``.
    """

    flight: Flight
    inputs: Inputs
    intervals: dict[Timing, tuple[Intervals, ...]]
    flown: Ekf2Replay
    agreement: Agreement
    runs: list[SegmentRun] = field(default_factory=list, init=False)

    __repr__ = one_line_repr


def open_model(
    flight: Flight, request_variants: RequestVariants = lambda _: ()
) -> Model | Unavailable:
    """Prepare a flight for EKF2 replays, and replay it with the logged parameters.

    Parameters
    ----------
    flight : Flight
    request_variants : callable
        Function that returns filter configurations (variants) that are needed later. Running all
        variants together saves time.

    Returns
    -------
    Model, or Unavailable with the reason why the flight cannot be replayed.
    """
    failed_agreements: dict[str, Agreement] = {}
    while not isinstance(
        model := _open_without_aids(flight, request_variants, failed_agreements), Unavailable
    ):
        if not (more := model.agreement.doubtful.keys() - failed_agreements.keys()):
            break
        failed_agreements |= dict.fromkeys(more, model.agreement)
    return model


def _open_without_aids(
    flight: Flight, request_variants: RequestVariants, failed_agreements: Mapping[str, Agreement]
) -> Model | Unavailable:
    """Prepare the EKF2 replay without the aids in ``failed_agreements``, keyed by aid name."""
    doubtful = {name: doubt.doubtful[name] for name, doubt in failed_agreements.items()}
    inputs = prepare_inputs(flight, doubtful)
    if isinstance(inputs, Unavailable):
        return structs.replace(inputs, what=ANALYSIS_NAME)
    if inputs.aid == GNSS_POS and isinstance(flight.ekf2, Ekf2):
        flight = replace(flight, ekf2=with_gnss_innovations(flight.ekf2))
    flown_variant = Variant(inputs.settings)
    timing = flown_variant.timing(inputs)
    intervals = tuple(make_intervals(inputs, segment, timing) for segment in inputs.segments)
    segments = tuple(
        with_correlation(inputs, segment, variant)
        for segment, variant in zip(inputs.segments, intervals, strict=True)
    )
    inputs = replace(inputs, segments=segments)
    variants = [flown_variant, replace(flown_variant, uses_logged_decisions=True)]
    for variant in request_variants(inputs):
        variants += [] if variant in variants else [variant]
    known_intervals = {timing: intervals}
    runs = run_variants(inputs, variants, known_intervals)
    replay = _make_replay(inputs, runs, flown_variant, {})
    agreement = agreement_with_log(flight, replay)
    if isinstance(agreement, Unavailable):
        return agreement
    rejected_share = max(agreement.rejected_fraction_logged, agreement.rejected_fraction_replayed)
    if rejected_share > MANY_REJECTIONS_SHARE and np.isfinite(inputs.received.rejected).any():
        logged_agreement = agreement_with_log(flight, _make_replay(inputs, runs, variants[1], {}))
        if isinstance(logged_agreement, Agreement):
            has_all_decisions = inputs.received.correction_m is not None
            agreement = with_logged_rejections(
                agreement, logged_agreement, has_all_decisions=has_all_decisions
            )
    of_doubted = {AGREEMENT_FIELDS.get(name, name): name for name in failed_agreements}
    agreement = structs.replace(
        agreement,
        doubtful={**doubtful, **agreement.doubtful},
        **{of: getattr(failed_agreements[name], of) for of, name in of_doubted.items()},
    )
    replay = structs.replace(replay, agreement=agreement)
    model = Model(flight, inputs, known_intervals, replay, agreement)
    model.runs.extend(runs)
    return model


def replay_with_logged_rejections(model: Model) -> Ekf2Replay:
    """Replay EKF2 with logged parameters, and logged rejections and resets instead of the gate."""
    variant = Variant(model.inputs.settings, uses_logged_decisions=True)
    return _make_replay(model.inputs, _run_model(model, [variant]), variant, {})


def replay_settings(
    model: Model,
    settings: Sequence[Mapping[str, float]],
    excluded_s: Array | None = None,
    without: Mapping[str, float] | None = None,
) -> tuple[Ekf2Replay, ...]:
    """Replay EKF2 with several sets of changed parameters at once.

    Parameters
    ----------
    model : Model
    settings : sequence of mapping
        Changed parameters of each replay, by PX4 name and in PX4's units.
    excluded_s : ndarray, optional
        Timestamps of samples that are not fused and not listed as updates.
    without : mapping from PX4's name of an aid to float, optional
        Time (s) from which the aid is not fused.

    Raises
    ------
    SettingsError
        Unknown parameter or aid, or a value outside PX4's range.
    """
    changes = [check_parameters(change) for change in settings]
    inputs = model.inputs
    unmodelled = PARAMETERS.keys() - inputs.settings.keys()
    unused_parameters = dict.fromkeys(unmodelled, f"EKF2 fused {inputs.aid.label} in this log")
    height_text = f"the replay uses the logged EKF2 height ({inputs.height_reason})"
    if inputs.aid == GNSS_POS:
        reason = "the log does not contain all fused magnetometer samples"
        unused_parameters |= dict.fromkeys(
            unmodelled & {*MAG.own_parameters, *FIELD_NOISES}, reason
        )
        unused_parameters |= dict.fromkeys(
            unmodelled & BAROMETER.own_parameters,
            height_text if inputs.height_reason else "EKF2 fused no barometer height",
        )
    if inputs.rules.horizon_by_delay:
        firmware = model.flight.log.firmware
        unused_parameters["EKF2_DELAY_MAX"] = (
            f"in {firmware} the fusion horizon follows from the largest delay parameter"
        )
    if inputs.received.uses_sender_times:
        unused_parameters[GNSS_POS.delay] = "EKF2 uses the measurement times of the receiver driver"
    for name in [name for change in changes for name in change if name in unused_parameters]:
        raise SettingsError(f"{name} has no effect in this log: {unused_parameters[name]}.")
    without = without or {}
    for name in without:
        if name not in (fused_aids := modelled_aids(inputs)):
            height_note = f"; {height_text}" if inputs.height_reason else ""
            raise SettingsError(
                f"{name}: in this log the replay fuses only {', '.join(fused_aids)}{height_note}."
            )
    if not changes:
        return ()
    uses_logged_decisions = excluded_s is not None
    if excluded_s is not None:
        rows = same_sample(inputs.received.stamp_s, excluded_s)
        rejected = np.full(len(inputs.received.stamp_s), np.nan)
        rejected[rows[rows >= 0]] = 1.0
        no_reset = np.zeros(len(rejected), dtype=bool)
        inputs = replace(
            inputs,
            received=replace(inputs.received, rejected=rejected, reset=no_reset, correction_m=None),
        )
        model = replace(model, inputs=inputs)
    variants = [
        Variant(
            {**inputs.settings, **change},
            uses_logged_decisions=uses_logged_decisions,
            without=without,
        )
        for change in changes
    ]
    runs = _run_model(model, variants)
    replays = [_make_replay(inputs, runs, *each) for each in zip(variants, changes, strict=True)]
    if excluded_s is not None:
        replays = [_without_updates(inputs, each, excluded_s) for each in replays]
    return tuple(structs.replace(each, agreement=model.agreement) for each in replays)


def modelled_aids(inputs: Inputs) -> list[str]:
    """Return PX4's names of the aids that the model fuses."""
    velocity = [GNSS_VEL.name] if inputs.received.velocity_m_s is not None else []
    magnetic = [MAG.name] if MAG.noise in inputs.settings else []
    flow = [FLOW.name] if inputs.segments[0].flow is not None else []
    vision = [EV_POS.name] if inputs.vision is not None else []
    heights = inputs.segments[0].heights
    height_aids = heights.fused if heights else ()
    return [inputs.aid.name, *velocity, *vision, *magnetic, *flow, *height_aids]


def _without_updates(inputs: Inputs, replay: Ekf2Replay, excluded_s: Array) -> Ekf2Replay:
    """Remove the updates of excluded samples from a replay."""
    age_s = replay.settings[inputs.aid.delay] * 1e-3 + 0.5 * inputs.step_s
    excluded_rows = same_sample(replay.updates.index.to_numpy(), excluded_s - age_s)
    remaining_rows = np.delete(np.arange(len(replay.updates)), excluded_rows[excluded_rows >= 0])
    return structs.replace(replay, updates=replay.updates.iloc[remaining_rows])


def with_position_noise(model: Model, sigma_m: float, seed: int) -> Model:
    """Return the model with noise added to every position that EKF2 received.

    Parameters
    ----------
    model : Model
    sigma_m : float
        Standard deviation of the noise (m), per axis.
    seed : int
    """
    inputs = model.inputs
    rng = np.random.default_rng(seed)
    new_inputs: dict[str, Any] = {}
    for name, samples in {"received": inputs.received, "vision": inputs.vision}.items():
        if samples is not None:
            noise = rng.normal(scale=sigma_m, size=samples.position_m.shape)
            new_inputs[name] = replace(samples, position_m=samples.position_m + noise)
    # the noise changes positions only, not their times, so the intervals remain valid
    return replace(model, inputs=replace(inputs, **new_inputs))


def with_misaligned_positions(model: Model, rotation_deg: float, delay_s: float) -> Model:
    """Return the model with every received position rotated, and its timestamp delayed.

    Parameters
    ----------
    model : Model
    rotation_deg : float
        Rotation, clockwise seen from above.
    delay_s : float
    """
    if not rotation_deg and not delay_s:
        return model
    received = model.inputs.received
    rotation = Rotation.from_euler("z", rotation_deg, degrees=True).as_matrix().T
    velocity = received.velocity_m_s
    received = replace(
        received,
        stamp_s=received.stamp_s + delay_s,
        position_m=received.position_m @ rotation,
        velocity_m_s=None if velocity is None else velocity @ rotation,
    )
    intervals = {} if delay_s else model.intervals
    return replace(model, inputs=replace(model.inputs, received=received), intervals=intervals)


def delayed_variants(model: Model, variants: Sequence[Variant]) -> Iterator[pd.DataFrame]:
    """Yield the track of each filter configuration (variant) at its fusion horizon.

    The tracks are computed one at a time and without the output predictor, to limit memory and
    time.
    """
    runs = _run_model(model, variants)
    for variant_index in map(runs[0].variants.index, variants):
        yield pd.concat([_track(run, delayed_states(run, variant_index)[0]) for run in runs])


def _run_model(model: Model, variants: Sequence[Variant]) -> list[SegmentRun]:
    """Run filter configurations, or return the model's stored runs if they contain them."""
    if model.runs and all(variant in model.runs[0].variants for variant in variants):
        return model.runs
    return run_variants(model.inputs, variants, model.intervals)


def run_variants(
    inputs: Inputs,
    variants: Sequence[Variant],
    computed_intervals: Mapping[Timing, Sequence[Intervals]],
) -> list[SegmentRun]:
    """Run filter configurations through every segment, with ``computed_intervals`` if available."""
    timings = [variant.timing(inputs) for variant in variants]
    runs = []
    for segment_index, segment in enumerate(inputs.segments):
        intervals = {
            timing: by_segment[segment_index] for timing, by_segment in computed_intervals.items()
        }
        for timing in set(timings) - computed_intervals.keys():
            intervals[timing] = make_intervals(inputs, segment, timing)
        runs.append(
            run_segment(inputs, segment, variants, [intervals[timing] for timing in timings])
        )
    return runs


def _track(run: SegmentRun, state: Array) -> pd.DataFrame:
    """Return position and velocity of a state as a table with one row per prediction step."""
    index = pd.Index(run.segment.time_s, name="time_s")
    position = state[:, POSITION] / run.segment.metres
    return pd.DataFrame(np.hstack([position, state[:, VELOCITY]]), index, Columns.STATE)


def _make_replay(
    inputs: Inputs, runs: Sequence[SegmentRun], variant: Variant, changed: Mapping[str, float]
) -> Ekf2Replay:
    variant_index = runs[0].variants.index(variant)
    tracks = [_delayed_and_published(inputs, run, variant_index) for run in runs]
    updates = [_position_updates(run, variant_index) for run in runs]
    return Ekf2Replay(
        settings=variant.settings,
        changed=dict(changed),
        updates=pd.concat(updates),
        flow_only_spans_s=tuple(
            span
            for run, run_updates in zip(runs, updates, strict=True)
            if run.segment.flow is not None
            for span in _flow_only_spans_s(run_updates, run.segment)
        ),
        delayed=pd.concat([delayed for delayed, _ in tracks]),
        published=pd.concat([published for _, published in tracks]),
        other_aid_updates=_other_aid_updates(runs, variant_index),
        stretches_s=tuple(tuple(run.segment.time_s[[0, -1]].tolist()) for run in runs),
        source=inputs.received.source,
        late=sum(int(run.events[variant_index].late.sum()) for run in runs),
        lost=sum(int(run.events[variant_index].lost.sum()) for run in runs),
    )


def _flow_only_spans_s(updates: pd.DataFrame, segment: ReplaySegment) -> list[tuple[float, float]]:
    """Return times between fused positions (s) that are longer than RESTART_GAP_S."""
    is_used = (updates["fused"] > 0.0) | (updates["reset"] > 0.0)
    ends = [*updates.loc[is_used, "fused_at_s"], float(segment.time_s[-1])]
    return [(a, b) for a, b in pairwise(ends) if b - a > RESTART_GAP_S]


def _other_aid_updates(runs: Sequence[SegmentRun], variant_index: int) -> dict[str, pd.DataFrame]:
    """Return the updates of all fused aids except the position, by PX4's name of the aid."""
    updates_by_aid: dict[str, list[pd.DataFrame]] = {}
    for run in runs:
        end_s = run.segment.time_s[run.events[variant_index].end_step]
        if (heights := run.heights) is not None:
            for name in heights.fused:
                updates_by_aid.setdefault(name, []).append(
                    heights.updates(name, variant_index, end_s)
                )
        if run.vision is not None:
            updates_by_aid.setdefault(EV_POS.name, []).append(
                run.vision.updates(variant_index, end_s)
            )
    return {name: pd.concat(update_frames) for name, update_frames in updates_by_aid.items()}


def _position_updates(run: SegmentRun, variant_index: int) -> pd.DataFrame:
    events = run.events[variant_index]
    sampled_events = np.flatnonzero(
        np.isfinite(run.innovation[:, variant_index, POSITION_COLUMNS.start])
    )
    variance_after = run.variance[sampled_events + 1, variant_index]
    flags = np.stack([run.rejected, run.fused, run.reset], axis=-1)[sampled_events, variant_index]
    innovation_arrays = run.innovation, run.innovation_variance, run.noise
    nu, s, r = (each[sampled_events, variant_index, POSITION_COLUMNS] for each in innovation_arrays)
    speed = [each[sampled_events, variant_index, :3] for each in innovation_arrays[:2]]
    fused_at_s = run.segment.time_s[events.end_step[sampled_events], None]
    values = np.hstack(
        [nu, s, flags, variance_after[:, 6:8], variance_after[:, 3:5], r, fused_at_s, *speed]
    )
    index = pd.Index(events.time_s[sampled_events], name="time_s")
    columns = UPDATE_COLUMNS
    updates = pd.DataFrame(values, index, [*columns, *VELOCITY_UPDATE_COLUMNS])
    return updates if np.isfinite(speed[0]).any() else updates[columns]


def _delayed_and_published(
    inputs: Inputs, run: SegmentRun, variant_index: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the state at the fusion horizon and the published state at each prediction step."""
    segment = run.segment
    variant = run.variants[variant_index]
    state, reset = delayed_states(run, variant_index)
    horizon_s = min(variant.timing(inputs).horizon_s, MAX_HORIZON_S)
    lag = max(round(horizon_s / inputs.step_s), 1)
    published_rotation = np.zeros((len(state), 3))
    if variant.attitude:  # the nominal (published) attitude already follows EKF2's logged attitude
        attitude_difference = state[:, THETA] - segment.attitude_error_rad
        published_rotation = follow_attitude(attitude_difference, lag, inputs.step_s, horizon_s)
    published = publish(segment, state, reset, published_rotation, lag, variant.settings)
    heading = np.arctan2(segment.rotation[:, 1, 0], segment.rotation[:, 0, 0]) + state[:, HEADING]
    delayed = _track(run, state).assign(heading_rad=heading)
    return delayed, _track(run, np.hstack([state[:, THETA], *published]))


def delayed_states(run: SegmentRun, variant_index: int) -> tuple[Array, Array]:
    """Return the state of one variant at each prediction step, and the sum of position resets.

    Returns
    -------
    state : ndarray, shape (n + 1, 15)
    reset_m : ndarray, shape (n + 1, 3)
    """
    event_steps = run.events[variant_index].end_step
    variant = run.variants[variant_index]
    segment = run.segment
    event_states = run.state[:, variant_index]
    count = len(segment.step_s)
    rotation = segment.rotation[1:]
    dt = segment.step_s[:, None]
    interval = np.searchsorted(event_steps, np.arange(count), side="right")
    first_step = np.searchsorted(interval, interval)
    state = event_states[np.concatenate([[0], interval])]

    def sum_since_event(increments: Array) -> Array:
        """Return the sum of the steps' increments since the last event."""
        total = np.cumsum(increments, axis=0)
        return np.asarray(total - (total - increments)[first_step])

    def value_before_step(after_step: Array, rows: slice) -> Array:
        """Return the value before each step."""
        shifted = np.concatenate([after_step[:1], after_step[:-1]])
        return np.where(
            (first_step == np.arange(count))[:, None], event_states[interval, rows], shifted
        )

    # the equations in the docstring of px4fuse.ekf2.intervals, evaluated for this state only
    rotation_steps = -np.einsum("nij,nj->ni", rotation, state[1:, GYRO_BIAS]) * dt
    if variant.attitude:
        rotation_steps -= segment.correction_rad
    state[1:, THETA] += sum_since_event(rotation_steps)
    force = np.einsum("nij,nj->ni", rotation, segment.force_m_s2)
    acceleration = (
        np.cross(value_before_step(state[1:, THETA], THETA), force) + force + GRAVITY_M_S2
    )
    acceleration -= np.einsum("nij,nj->ni", rotation, state[1:, ACCELEROMETER_BIAS])
    state[1:, VELOCITY] += sum_since_event(acceleration * dt)
    speed = state[1:, VELOCITY]
    state[1:, POSITION] += sum_since_event(0.5 * dt * (value_before_step(speed, VELOCITY) + speed))
    state[event_steps] = event_states[1:]
    reset = np.zeros((count + 1, 3))
    position_reset_m = run.position_reset_m[:, variant_index]
    for e in np.flatnonzero(position_reset_m.any(axis=1)):
        reset[event_steps[e] :, :2] += position_reset_m[e]
    return state, reset
