"""EKF2 replayed from an ordinary log, as it flew and with other parameters.

The model is the part of EKF2 that horizontal positions move: 15 error states about the published
attitude, started from the log's own ``estimator_states`` and fed with IMU and positions as logged,
of GNSS with their velocities, and with the magnetometer (21 states) where the log holds it.
It is not EKF2: what else EKF2 fuses (height, else the heading) is taken from its own output. How
far it can be believed is measured on each log, see :mod:`px4fuse.ekf2.replay`.
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
from px4fuse.display import one_line_repr
from px4fuse.ekf2.inputs import ANALYSIS_NAME, Inputs, prepare_inputs, same_sample
from px4fuse.ekf2.intervals import Intervals, Timing, make_intervals
from px4fuse.ekf2.output_predictor import follow_attitude, publish
from px4fuse.ekf2.recursion import (
    HEADING,
    POSITION_COLUMNS,
    StretchRun,
    Variant,
    run_stretch,
    with_correlation,
)
from px4fuse.ekf2.replay import (
    REJECTING_SHARE,
    UPDATE_COLUMNS,
    VELOCITY_UPDATE_COLUMNS,
    Agreement,
    Ekf2Replay,
    agreement_with_log,
    with_logged_rejections,
)
from px4fuse.ekf2.stretches import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    POSITION,
    RESTART_GAP_S,
    THETA,
    VELOCITY,
    Stretch,
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
from px4fuse.readers.px4_innovations import with_gnss_innovations

MAX_HORIZON_S = 1.0  # EKF2_DELAY_MAX

# What an agreement says of an aid by another name
AGREEMENT_FIELDS = {FLOW.name: "carried_difference_m"}

RequestVariants = Callable[[Inputs], Sequence[Variant]]


@dataclass(frozen=True)
class Model:
    """A flight made ready for replays.

    Attributes
    ----------
    flight : Flight
    inputs : Inputs
    intervals : mapping from Timing to tuple of Intervals
        Of each stretch, for the delay as flown; empty where they are yet to be made.
    flown : Ekf2Replay
        With the parameters of the log.
    agreement : Agreement
        Of ``flown`` with what the log holds.
    runs : list of Run
        Through each stretch, of these inputs: as flown, the same rejecting and resetting where EKF2
        did, and the variants that were asked for besides. What is not there is run when needed.
    """

    flight: Flight
    inputs: Inputs
    intervals: dict[Timing, tuple[Intervals, ...]]
    flown: Ekf2Replay
    agreement: Agreement
    runs: list[StretchRun] = field(default_factory=list, init=False)

    __repr__ = one_line_repr


def open_model(flight: Flight, besides: RequestVariants = lambda _: ()) -> Model | Unavailable:
    """Make a flight ready for replays and replay it as flown, or say why the log cannot carry it.

    Parameters
    ----------
    flight : Flight
    besides : callable
        Gives the variants that will be asked for, which cost little when they run along.
    """
    doubted: dict[str, Agreement] = {}
    while not isinstance(model := _open_without(flight, besides, doubted), Unavailable):
        if not (more := model.agreement.doubtful.keys() - doubted.keys()):
            break
        doubted |= dict.fromkeys(more, model.agreement)
    return model


def _open_without(
    flight: Flight, besides: RequestVariants, doubted: Mapping[str, Agreement]
) -> Model | Unavailable:
    """The model without the aids that are doubted, each by an agreement that says why."""
    doubtful = {name: doubt.doubtful[name] for name, doubt in doubted.items()}
    inputs = prepare_inputs(flight, doubtful)
    if isinstance(inputs, Unavailable):
        return structs.replace(inputs, what=ANALYSIS_NAME)
    if inputs.aid == GNSS_POS and isinstance(flight.ekf2, Ekf2):
        flight = replace(flight, ekf2=with_gnss_innovations(flight.ekf2))
    flown_variant = Variant(inputs.settings)
    timing = flown_variant.timing(inputs)
    intervals = tuple(make_intervals(inputs, stretch, timing) for stretch in inputs.stretches)
    stretches = tuple(
        with_correlation(inputs, stretch, variant)
        for stretch, variant in zip(inputs.stretches, intervals, strict=True)
    )
    inputs = replace(inputs, stretches=stretches)
    variants = [flown_variant, replace(flown_variant, as_logged=True)]
    for variant in besides(inputs):
        variants += [] if variant in variants else [variant]
    known_intervals = {timing: intervals}
    runs = run_variants(inputs, variants, known_intervals)
    replay = _make_replay(inputs, runs, flown_variant, {})
    agreement = agreement_with_log(flight, replay)
    if isinstance(agreement, Unavailable):
        return agreement
    share = max(agreement.rejected_share_logged, agreement.rejected_share_replayed)
    if share > REJECTING_SHARE and np.isfinite(inputs.received.rejected).any():
        obedient_agreement = agreement_with_log(flight, _make_replay(inputs, runs, variants[1], {}))
        if isinstance(obedient_agreement, Agreement):
            has_all_decisions = inputs.received.moved_m is not None
            agreement = with_logged_rejections(
                agreement, obedient_agreement, has_all_decisions=has_all_decisions
            )
    of_doubted = {AGREEMENT_FIELDS.get(name, name): name for name in doubted}
    agreement = structs.replace(
        agreement,
        doubtful={**doubtful, **agreement.doubtful},
        **{of: getattr(doubted[name], of) for of, name in of_doubted.items()},
    )
    replay = structs.replace(replay, agreement=agreement)
    model = Model(flight, inputs, known_intervals, replay, agreement)
    model.runs.extend(runs)
    return model


def replay_with_logged_rejections(model: Model) -> Ekf2Replay:
    """EKF2 as flown, rejecting and resetting where it did itself, as far as the log tells."""
    variant = Variant(model.inputs.settings, as_logged=True)
    return _make_replay(model.inputs, _run_model(model, [variant]), variant, {})


def replay_settings(
    model: Model,
    settings: Sequence[Mapping[str, float]],
    left_out_s: Array | None = None,
    without: Mapping[str, float] | None = None,
) -> tuple[Ekf2Replay, ...]:
    """Replay with several settings at once, each a change of what was flown.

    Parameters
    ----------
    model : Model
    settings : sequence of mapping
        What each changes, by PX4 name and in PX4's units.
    left_out_s : ndarray, optional
        Stamps of samples that are not fused, and not among the updates.
    without : mapping from PX4's name of an aid to float, optional
        From when on (s) it is not fused.

    Raises
    ------
    SettingsError
        A parameter or an aid that the model does not have, or a value outside PX4's range.
    """
    changes, inputs = [check_parameters(change) for change in settings], model.inputs
    unmodelled = PARAMETERS.keys() - inputs.settings.keys()
    unused_parameters = dict.fromkeys(unmodelled, f"EKF2 fused {inputs.aid.label} in this log")
    height = f"the height is EKF2's own as flown ({inputs.imposed})"
    if inputs.aid == GNSS_POS:
        no_field = "the log does not hold what EKF2 fused of a magnetometer"
        unused_parameters |= dict.fromkeys(
            unmodelled & {*MAG.own_parameters, *FIELD_NOISES}, no_field
        )
        unused_parameters |= dict.fromkeys(
            unmodelled & BAROMETER.own_parameters,
            height if inputs.imposed else "EKF2 fused no barometer",
        )
    if inputs.rules.horizon_by_delay:
        firmware = model.flight.log.firmware
        unused_parameters["EKF2_DELAY_MAX"] = f"in {firmware} the longest delay makes the horizon"
    if inputs.received.own_times:
        unused_parameters[GNSS_POS.delay] = "EKF2 takes the receiver driver's own times"
    for name in [name for change in changes for name in change if name in unused_parameters]:
        raise SettingsError(f"{name} changes nothing here: {unused_parameters[name]}.")
    without = without or {}
    for name in without:
        if name not in (known := modelled_aids(inputs)):
            why = f"; {height}" if inputs.imposed else ""
            raise SettingsError(f"{name}: of this log the model fuses {', '.join(known)}{why}.")
    if not changes:
        return ()
    as_logged = left_out_s is not None
    if left_out_s is not None:
        rows = same_sample(inputs.received.stamp_s, left_out_s)
        rejected = np.full(len(inputs.received.stamp_s), np.nan)
        rejected[rows[rows >= 0]] = 1.0
        no_reset = np.zeros(len(rejected), dtype=bool)
        inputs = replace(
            inputs,
            received=replace(inputs.received, rejected=rejected, reset=no_reset, moved_m=None),
        )
        model = replace(model, inputs=inputs)
    variants = [
        Variant({**inputs.settings, **change}, as_logged=as_logged, without=without)
        for change in changes
    ]
    runs = _run_model(model, variants)
    replays = [_make_replay(inputs, runs, *each) for each in zip(variants, changes, strict=True)]
    if left_out_s is not None:
        replays = [_without_updates(inputs, each, left_out_s) for each in replays]
    return tuple(structs.replace(each, agreement=model.agreement) for each in replays)


def modelled_aids(inputs: Inputs) -> list[str]:
    """PX4's names of the aids that the model fuses."""
    velocity = [GNSS_VEL.name] if inputs.received.velocity_m_s is not None else []
    magnetic = [MAG.name] if MAG.noise in inputs.settings else []
    flow = [FLOW.name] if inputs.stretches[0].flow is not None else []
    vision = [EV_POS.name] if inputs.vision is not None else []
    heights = inputs.stretches[0].heights
    of_height = heights.fused if heights else ()
    return [inputs.aid.name, *velocity, *vision, *magnetic, *flow, *of_height]


def _without_updates(inputs: Inputs, replay: Ekf2Replay, left_out_s: Array) -> Ekf2Replay:
    """A replay whose updates are not those of samples that were left out."""
    age_s = replay.settings[inputs.aid.delay] * 1e-3 + 0.5 * inputs.step_s
    left_out_rows = same_sample(replay.updates.index.to_numpy(), left_out_s - age_s)
    remaining_rows = np.delete(np.arange(len(replay.updates)), left_out_rows[left_out_rows >= 0])
    return structs.replace(replay, updates=replay.updates.iloc[remaining_rows])


def with_position_noise(model: Model, sigma_m: float, seed: int) -> Model:
    """The same flight, with noise on every position that EKF2 was sent.

    Parameters
    ----------
    model : Model
    sigma_m : float
        Standard deviation of the noise (m), per axis.
    seed : int
    """
    inputs, rng = model.inputs, np.random.default_rng(seed)
    new_inputs: dict[str, Any] = {}
    for name, samples in {"received": inputs.received, "vision": inputs.vision}.items():
        if samples is not None:
            noise = rng.normal(scale=sigma_m, size=samples.position_m.shape)
            new_inputs[name] = replace(samples, position_m=samples.position_m + noise)
    # the intervals between samples hang on their times alone
    return replace(model, inputs=replace(inputs, **new_inputs))


def with_misaligned_positions(model: Model, rotation_deg: float, delay_s: float) -> Model:
    """The same flight, with every position that EKF2 was sent turned, and stamped later.

    Parameters
    ----------
    model : Model
    rotation_deg : float
        Clockwise seen from above.
    delay_s : float
    """
    if not rotation_deg and not delay_s:
        return model
    received = model.inputs.received
    turn = Rotation.from_euler("z", rotation_deg, degrees=True).as_matrix().T
    speed = received.velocity_m_s
    received = replace(
        received,
        stamp_s=received.stamp_s + delay_s,
        position_m=received.position_m @ turn,
        velocity_m_s=None if speed is None else speed @ turn,
    )
    intervals = {} if delay_s else model.intervals
    return replace(model, inputs=replace(model.inputs, received=received), intervals=intervals)


def delayed_variants(model: Model, variants: Sequence[Variant]) -> Iterator[pd.DataFrame]:
    """Tracks of all at their horizon, one at a time.

    What a filter publishes is as long again, and takes as long to make.
    """
    runs = _run_model(model, variants)
    for at in map(runs[0].variants.index, variants):
        yield pd.concat([_track(part, delayed_states(part, at)[0]) for part in runs])


def _run_model(model: Model, variants: Sequence[Variant]) -> list[StretchRun]:
    """Runs that hold these variants: those of the model, where they are among them."""
    if model.runs and all(variant in model.runs[0].variants for variant in variants):
        return model.runs
    return run_variants(model.inputs, variants, model.intervals)


def run_variants(
    inputs: Inputs, variants: Sequence[Variant], known: Mapping[Timing, Sequence[Intervals]]
) -> list[StretchRun]:
    """Run variants through every stretch; ``known`` are the intervals that there are."""
    timings = [variant.timing(inputs) for variant in variants]
    runs = []
    for at, stretch in enumerate(inputs.stretches):
        intervals = {timing: by_stretch[at] for timing, by_stretch in known.items()}
        for timing in set(timings) - known.keys():
            intervals[timing] = make_intervals(inputs, stretch, timing)
        runs.append(
            run_stretch(inputs, stretch, variants, [intervals[timing] for timing in timings])
        )
    return runs


def _track(part: StretchRun, state: Array) -> pd.DataFrame:
    """Position and velocity of a state at each step's end."""
    index = pd.Index(part.stretch.time_s, name="time_s")
    position = state[:, POSITION] / part.stretch.metres
    return pd.DataFrame(np.hstack([position, state[:, VELOCITY]]), index, Columns.STATE)


def _make_replay(
    inputs: Inputs, runs: Sequence[StretchRun], variant: Variant, changed: Mapping[str, float]
) -> Ekf2Replay:
    at = runs[0].variants.index(variant)
    tracks = [_delayed_and_published(inputs, part, at) for part in runs]
    updates = [_position_updates(part, at) for part in runs]
    return Ekf2Replay(
        settings=variant.settings,
        changed=dict(changed),
        updates=pd.concat(updates),
        flow_only_spans_s=tuple(
            span
            for part, own in zip(runs, updates, strict=True)
            if part.stretch.flow is not None
            for span in _flow_only_spans_s(own, part.stretch)
        ),
        delayed=pd.concat([delayed for delayed, _ in tracks]),
        published=pd.concat([published for _, published in tracks]),
        other_aid_updates=_other_aid_updates(runs, at),
        stretches_s=tuple(tuple(part.stretch.time_s[[0, -1]].tolist()) for part in runs),
        source=inputs.received.source,
        late=sum(int(part.events[at].late.sum()) for part in runs),
        lost=sum(int(part.events[at].lost.sum()) for part in runs),
    )


def _flow_only_spans_s(updates: pd.DataFrame, stretch: Stretch) -> list[tuple[float, float]]:
    """Times between positions that are fused, where they are longer than the model goes without."""
    taken = (updates["fused"] > 0.0) | (updates["reset"] > 0.0)
    ends = [*updates.loc[taken, "fused_at_s"], float(stretch.time_s[-1])]
    return [(a, b) for a, b in pairwise(ends) if b - a > RESTART_GAP_S]


def _other_aid_updates(runs: Sequence[StretchRun], at: int) -> dict[str, pd.DataFrame]:
    """What was done with each sample of what was fused besides, by PX4's name."""
    updates_by_aid: dict[str, list[pd.DataFrame]] = {}
    for part in runs:
        end_s = part.stretch.time_s[part.events[at].end]
        if (heights := part.heights) is not None:
            for name in heights.fused:
                updates_by_aid.setdefault(name, []).append(heights.updates(name, at, end_s))
        if part.vision is not None:
            updates_by_aid.setdefault(EV_POS.name, []).append(part.vision.updates(at, end_s))
    return {name: pd.concat(update_frames) for name, update_frames in updates_by_aid.items()}


def _position_updates(part: StretchRun, at: int) -> pd.DataFrame:
    events = part.events[at]
    sampled_events = np.flatnonzero(np.isfinite(part.innovation[:, at, POSITION_COLUMNS.start]))
    after = part.variance[sampled_events + 1, at]
    flags = np.stack([part.rejected, part.fused, part.reset], axis=-1)[sampled_events, at]
    innovation_arrays = part.innovation, part.innovation_variance, part.noise
    nu, s, r = (each[sampled_events, at, POSITION_COLUMNS] for each in innovation_arrays)
    speed = [each[sampled_events, at, :3] for each in innovation_arrays[:2]]
    fused_at_s = part.stretch.time_s[events.end[sampled_events], None]
    values = np.hstack([nu, s, flags, after[:, 6:8], after[:, 3:5], r, fused_at_s, *speed])
    index, columns = pd.Index(events.time_s[sampled_events], name="time_s"), UPDATE_COLUMNS
    updates = pd.DataFrame(values, index, [*columns, *VELOCITY_UPDATE_COLUMNS])
    return updates if np.isfinite(speed[0]).any() else updates[columns]


def _delayed_and_published(
    inputs: Inputs, part: StretchRun, at: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The filter's state and what it publishes, at each step."""
    stretch, variant = part.stretch, part.variants[at]
    state, reset = delayed_states(part, at)
    horizon_s = min(variant.timing(inputs).horizon_s, MAX_HORIZON_S)
    lag = max(round(horizon_s / inputs.step_s), 1)
    published_rotation = np.zeros((len(state), 3))
    if variant.attitude:  # the published attitude followed that of EKF2 itself
        attitude_difference = state[:, THETA] - stretch.attitude_error_rad
        published_rotation = follow_attitude(attitude_difference, lag, inputs.step_s, horizon_s)
    published = publish(stretch, state, reset, published_rotation, lag, variant.settings)
    heading = np.arctan2(stretch.rotation[:, 1, 0], stretch.rotation[:, 0, 0]) + state[:, HEADING]
    delayed = _track(part, state).assign(heading_rad=heading)
    return delayed, _track(part, np.hstack([state[:, THETA], *published]))


def delayed_states(part: StretchRun, at: int) -> tuple[Array, Array]:
    """State of one variant at each step's end, and the position's resets up to then.

    Returns
    -------
    state : ndarray, shape (n + 1, 15)
    reset_m : ndarray, shape (n + 1, 3)
    """
    end, variant = part.events[at].end, part.variants[at]
    stretch, event_states = part.stretch, part.state[:, at]
    count, rotation, dt = len(stretch.step_s), stretch.rotation[1:], stretch.step_s[:, None]
    interval = np.searchsorted(end, np.arange(count), side="right")
    first = np.searchsorted(interval, interval)
    state = event_states[np.concatenate([[0], interval])]

    def sum_since_event(increments: Array) -> Array:
        """Sum of what each step adds, from the beginning of its interval on."""
        total = np.cumsum(increments, axis=0)
        return np.asarray(total - (total - increments)[first])

    def value_before_step(after_step: Array, rows: slice) -> Array:
        """What there was before each step."""
        shifted = np.concatenate([after_step[:1], after_step[:-1]])
        return np.where((first == np.arange(count))[:, None], event_states[interval, rows], shifted)

    # the equations of the intervals, for this state alone
    rotation_steps = -np.einsum("nij,nj->ni", rotation, state[1:, GYRO_BIAS]) * dt
    if variant.attitude:
        rotation_steps -= stretch.correction_rad
    state[1:, THETA] += sum_since_event(rotation_steps)
    force = np.einsum("nij,nj->ni", rotation, stretch.force_m_s2)
    gained = np.cross(value_before_step(state[1:, THETA], THETA), force) + force + GRAVITY_M_S2
    gained -= np.einsum("nij,nj->ni", rotation, state[1:, ACCELEROMETER_BIAS])
    state[1:, VELOCITY] += sum_since_event(gained * dt)
    speed = state[1:, VELOCITY]
    state[1:, POSITION] += sum_since_event(0.5 * dt * (value_before_step(speed, VELOCITY) + speed))
    state[end] = event_states[1:]
    reset, moved_m = np.zeros((count + 1, 3)), part.moved_m[:, at]
    for e in np.flatnonzero(moved_m.any(axis=1)):
        reset[end[e] :, :2] += moved_m[e]
    return state, reset
