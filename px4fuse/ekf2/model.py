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
from px4fuse.display import brief
from px4fuse.ekf2.inputs import WHAT, Inputs, prepare, same_sample
from px4fuse.ekf2.intervals import Intervals, Timing, make_intervals
from px4fuse.ekf2.output_predictor import follow_attitude, publish
from px4fuse.ekf2.recursion import HEADING, LEVEL, Run, Variant, run, with_correlation
from px4fuse.ekf2.replay import (
    REJECTING_SHARE,
    UPDATE_COLUMNS,
    VELOCITY_UPDATE_COLUMNS,
    Agreement,
    Ekf2Replay,
    agreement_with_log,
    with_obedient,
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
    check,
)
from px4fuse.errors import SettingsError
from px4fuse.flight import Columns, Ekf2, Flight, Unavailable
from px4fuse.readers.px4_innovations import with_gnss

MAX_HORIZON_S = 1.0  # EKF2_DELAY_MAX

# What an agreement says of an aid by another name
DOUBTED = {FLOW.name: "carried_difference_m"}

Besides = Callable[[Inputs], Sequence[Variant]]


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
    runs: list[Run] = field(default_factory=list, init=False)

    __repr__ = brief


def open_model(flight: Flight, besides: Besides = lambda _: ()) -> Model | Unavailable:
    """Make a flight ready for replays and replay it as flown, or say why the log cannot carry it.

    Parameters
    ----------
    flight : Flight
    besides : callable
        Gives the variants that will be asked for, which cost little when they run along.
    """
    doubted: dict[str, Agreement] = {}
    while not isinstance(model := _open(flight, besides, doubted), Unavailable):
        if not (more := model.agreement.doubtful.keys() - doubted.keys()):
            break
        doubted |= dict.fromkeys(more, model.agreement)
    return model


def _open(
    flight: Flight, besides: Besides, doubted: Mapping[str, Agreement]
) -> Model | Unavailable:
    """The model without the aids that are doubted, each by an agreement that says why."""
    doubtful = {name: found.doubtful[name] for name, found in doubted.items()}
    inputs = prepare(flight, doubtful)
    if isinstance(inputs, Unavailable):
        return structs.replace(inputs, what=WHAT)
    if inputs.aid == GNSS_POS and isinstance(flight.ekf2, Ekf2):
        flight = replace(flight, ekf2=with_gnss(flight.ekf2))
    flown = Variant(inputs.settings)
    timing = flown.timing(inputs)
    intervals = tuple(make_intervals(inputs, stretch, timing) for stretch in inputs.stretches)
    stretches = tuple(
        with_correlation(inputs, stretch, each)
        for stretch, each in zip(inputs.stretches, intervals, strict=True)
    )
    inputs = replace(inputs, stretches=stretches)
    variants = [flown, replace(flown, as_logged=True)]
    for each in besides(inputs):
        variants += [] if each in variants else [each]
    known = {timing: intervals}
    runs = run_variants(inputs, variants, known)
    replay = _assemble(inputs, runs, flown, {})
    agreement = agreement_with_log(flight, replay)
    if isinstance(agreement, Unavailable):
        return agreement
    share = max(agreement.rejected_share_logged, agreement.rejected_share_replayed)
    if share > REJECTING_SHARE and np.isfinite(inputs.received.rejected).any():
        obeyed = agreement_with_log(flight, _assemble(inputs, runs, variants[1], {}))
        if isinstance(obeyed, Agreement):
            told = inputs.received.moved_m is not None
            agreement = with_obedient(agreement, obeyed, all_told=told)
    of_doubted = {DOUBTED.get(name, name): name for name in doubted}
    agreement = structs.replace(
        agreement,
        doubtful={**doubtful, **agreement.doubtful},
        **{of: getattr(doubted[name], of) for of, name in of_doubted.items()},
    )
    replay = structs.replace(replay, agreement=agreement)
    model = Model(flight, inputs, known, replay, agreement)
    model.runs.extend(runs)
    return model


def obedient(model: Model) -> Ekf2Replay:
    """EKF2 as flown, rejecting and resetting where it did itself, as far as the log tells."""
    variant = Variant(model.inputs.settings, as_logged=True)
    return _assemble(model.inputs, _run_model(model, [variant]), variant, {})


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
    changes, inputs = [check(change) for change in settings], model.inputs
    of_others = PARAMETERS.keys() - inputs.settings.keys()
    idle = dict.fromkeys(of_others, f"EKF2 fused {inputs.aid.label} in this log")
    height = f"the height is EKF2's own as flown ({inputs.imposed})"
    if inputs.aid == GNSS_POS:
        no_field = "the log does not hold what EKF2 fused of a magnetometer"
        idle |= dict.fromkeys(of_others & {*MAG.own, *FIELD_NOISES}, no_field)
        idle |= dict.fromkeys(
            of_others & BAROMETER.own, height if inputs.imposed else "EKF2 fused no barometer"
        )
    if inputs.rules.horizon_by_delay:
        firmware = model.flight.log.firmware
        idle["EKF2_DELAY_MAX"] = f"in {firmware} the longest delay makes the horizon"
    if inputs.received.own_times:
        idle[GNSS_POS.delay] = "EKF2 takes the receiver driver's own times"
    for name in [name for change in changes for name in change if name in idle]:
        raise SettingsError(f"{name} changes nothing here: {idle[name]}.")
    without = without or {}
    for name in without:
        if name not in (known := aids_of(inputs)):
            why = f"; {height}" if inputs.imposed else ""
            raise SettingsError(f"{name}: of this log the model fuses {', '.join(known)}{why}.")
    if not changes:
        return ()
    obeys = left_out_s is not None
    if left_out_s is not None:
        row = same_sample(inputs.received.stamp_s, left_out_s)
        rejected = np.full(len(inputs.received.stamp_s), np.nan)
        rejected[row[row >= 0]] = 1.0
        never = np.zeros(len(rejected), dtype=bool)
        inputs = replace(
            inputs, received=replace(inputs.received, rejected=rejected, reset=never, moved_m=None)
        )
        model = replace(model, inputs=inputs)
    variants = [
        Variant({**inputs.settings, **change}, as_logged=obeys, without=without)
        for change in changes
    ]
    runs = _run_model(model, variants)
    replays = [_assemble(inputs, runs, *each) for each in zip(variants, changes, strict=True)]
    if left_out_s is not None:
        replays = [_without(inputs, each, left_out_s) for each in replays]
    return tuple(structs.replace(each, agreement=model.agreement) for each in replays)


def aids_of(inputs: Inputs) -> list[str]:
    """PX4's names of the aids that the model fuses."""
    velocity = [GNSS_VEL.name] if inputs.received.velocity_m_s is not None else []
    magnetic = [MAG.name] if MAG.noise in inputs.settings else []
    flow = [FLOW.name] if inputs.stretches[0].flow is not None else []
    vision = [EV_POS.name] if inputs.vision is not None else []
    heights = inputs.stretches[0].heights
    of_height = heights.fused if heights else ()
    return [inputs.aid.name, *velocity, *vision, *magnetic, *flow, *of_height]


def _without(inputs: Inputs, replay: Ekf2Replay, left_out_s: Array) -> Ekf2Replay:
    """A replay whose updates are not those of samples that were left out."""
    age_s = replay.settings[inputs.aid.delay] * 1e-3 + 0.5 * inputs.step_s
    row = same_sample(replay.updates.index.to_numpy(), left_out_s - age_s)
    kept = np.delete(np.arange(len(replay.updates)), row[row >= 0])
    return structs.replace(replay, updates=replay.updates.iloc[kept])


def disturbed(model: Model, sigma_m: float, seed: int) -> Model:
    """The same flight, with noise on every position that EKF2 was sent.

    Parameters
    ----------
    model : Model
    sigma_m : float
        Standard deviation of the noise (m), per axis.
    seed : int
    """
    inputs, rng = model.inputs, np.random.default_rng(seed)
    sent: dict[str, Any] = {}
    for name, of in {"received": inputs.received, "vision": inputs.vision}.items():
        if of is not None:
            noise = rng.normal(scale=sigma_m, size=of.position_m.shape)
            sent[name] = replace(of, position_m=of.position_m + noise)
    # the intervals between samples hang on their times alone
    return replace(model, inputs=replace(inputs, **sent))


def moved(model: Model, turned_deg: float, later_s: float) -> Model:
    """The same flight, with every position that EKF2 was sent turned, and stamped later.

    Parameters
    ----------
    model : Model
    turned_deg : float
        Clockwise seen from above.
    later_s : float
    """
    if not turned_deg and not later_s:
        return model
    received = model.inputs.received
    turn = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix().T
    speed = received.velocity_m_s
    received = replace(
        received,
        stamp_s=received.stamp_s + later_s,
        position_m=received.position_m @ turn,
        velocity_m_s=None if speed is None else speed @ turn,
    )
    known = {} if later_s else model.intervals
    return replace(model, inputs=replace(model.inputs, received=received), intervals=known)


def delayed_variants(model: Model, variants: Sequence[Variant]) -> Iterator[pd.DataFrame]:
    """Tracks of all at their horizon, one at a time.

    What a filter publishes is as long again, and takes as long to make.
    """
    runs = _run_model(model, variants)
    for at in map(runs[0].variants.index, variants):
        yield pd.concat([_track(part, delayed_states(part, at)[0]) for part in runs])


def _run_model(model: Model, variants: Sequence[Variant]) -> list[Run]:
    """Runs that hold these variants: those of the model, where they are among them."""
    if model.runs and all(variant in model.runs[0].variants for variant in variants):
        return model.runs
    return run_variants(model.inputs, variants, model.intervals)


def run_variants(
    inputs: Inputs, variants: Sequence[Variant], known: Mapping[Timing, Sequence[Intervals]]
) -> list[Run]:
    """Run variants through every stretch; ``known`` are the intervals that there are."""
    timings = [variant.timing(inputs) for variant in variants]
    runs = []
    for at, stretch in enumerate(inputs.stretches):
        intervals = {timing: parts[at] for timing, parts in known.items()}
        for timing in set(timings) - known.keys():
            intervals[timing] = make_intervals(inputs, stretch, timing)
        runs.append(run(inputs, stretch, variants, [intervals[timing] for timing in timings]))
    return runs


def _track(part: Run, state: Array) -> pd.DataFrame:
    """Position and velocity of a state at each step's end."""
    index = pd.Index(part.stretch.time_s, name="time_s")
    position = state[:, POSITION] / part.stretch.metres
    return pd.DataFrame(np.hstack([position, state[:, VELOCITY]]), index, Columns.STATE)


def _assemble(
    inputs: Inputs, runs: Sequence[Run], variant: Variant, changed: Mapping[str, float]
) -> Ekf2Replay:
    at = runs[0].variants.index(variant)
    tracks = [_tracks(inputs, part, at) for part in runs]
    updates = [_updates(part, at) for part in runs]
    return Ekf2Replay(
        settings=variant.settings,
        changed=dict(changed),
        updates=pd.concat(updates),
        carried_s=tuple(
            span
            for part, own in zip(runs, updates, strict=True)
            if part.stretch.flow is not None
            for span in _carried_s(own, part.stretch)
        ),
        delayed=pd.concat([delayed for delayed, _ in tracks]),
        published=pd.concat([published for _, published in tracks]),
        besides=_besides(runs, at),
        stretches_s=tuple(tuple(part.stretch.time_s[[0, -1]].tolist()) for part in runs),
        source=inputs.received.source,
        late=sum(int(part.events[at].late.sum()) for part in runs),
        lost=sum(int(part.events[at].lost.sum()) for part in runs),
    )


def _carried_s(updates: pd.DataFrame, stretch: Stretch) -> list[tuple[float, float]]:
    """Times between positions that are fused, where they are longer than the model goes without."""
    taken = (updates["fused"] > 0.0) | (updates["reset"] > 0.0)
    ends = [*updates.loc[taken, "fused_at_s"], float(stretch.time_s[-1])]
    return [(a, b) for a, b in pairwise(ends) if b - a > RESTART_GAP_S]


def _besides(runs: Sequence[Run], at: int) -> dict[str, pd.DataFrame]:
    """What was done with each sample of what was fused besides, by PX4's name."""
    told: dict[str, list[pd.DataFrame]] = {}
    for part in runs:
        end_s = part.stretch.time_s[part.events[at].end]
        if (heights := part.heights) is not None:
            for name in heights.fused:
                told.setdefault(name, []).append(heights.updates(name, at, end_s))
        if part.vision is not None:
            told.setdefault(EV_POS.name, []).append(part.vision.updates(at, end_s))
    return {name: pd.concat(each) for name, each in told.items()}


def _updates(part: Run, at: int) -> pd.DataFrame:
    events = part.events[at]
    seen = np.flatnonzero(np.isfinite(part.innovation[:, at, LEVEL.start]))
    after = part.variance[seen + 1, at]
    flags = np.stack([part.rejected, part.fused, part.reset], axis=-1)[seen, at]
    told = part.innovation, part.innovation_variance, part.noise
    nu, s, r = (each[seen, at, LEVEL] for each in told)
    speed = [each[seen, at, :3] for each in told[:2]]
    fused_at_s = part.stretch.time_s[events.end[seen], None]
    values = np.hstack([nu, s, flags, after[:, 6:8], after[:, 3:5], r, fused_at_s, *speed])
    index, columns = pd.Index(events.time_s[seen], name="time_s"), UPDATE_COLUMNS
    updates = pd.DataFrame(values, index, [*columns, *VELOCITY_UPDATE_COLUMNS])
    return updates if np.isfinite(speed[0]).any() else updates[columns]


def _tracks(inputs: Inputs, part: Run, at: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The filter's state and what it publishes, at each step."""
    stretch, variant = part.stretch, part.variants[at]
    state, reset = delayed_states(part, at)
    horizon_s = min(variant.timing(inputs).horizon_s, MAX_HORIZON_S)
    lag = max(round(horizon_s / inputs.step_s), 1)
    turned = np.zeros((len(state), 3))
    if variant.attitude:  # the published attitude followed that of EKF2 itself
        apart = state[:, THETA] - stretch.attitude_error_rad
        turned = follow_attitude(apart, lag, inputs.step_s, horizon_s)
    published = publish(stretch, state, reset, turned, lag, variant.settings)
    heading = np.arctan2(stretch.rotation[:, 1, 0], stretch.rotation[:, 0, 0]) + state[:, HEADING]
    delayed = _track(part, state).assign(heading_rad=heading)
    return delayed, _track(part, np.hstack([state[:, THETA], *published]))


def delayed_states(part: Run, at: int) -> tuple[Array, Array]:
    """State of one variant at each step's end, and the position's resets up to then.

    Returns
    -------
    state : ndarray, shape (n + 1, 15)
    reset_m : ndarray, shape (n + 1, 3)
    """
    end, variant = part.events[at].end, part.variants[at]
    stretch, kept = part.stretch, part.state[:, at]
    count, rotation, dt = len(stretch.step_s), stretch.rotation[1:], stretch.step_s[:, None]
    interval = np.searchsorted(end, np.arange(count), side="right")
    first = np.searchsorted(interval, interval)
    state = kept[np.concatenate([[0], interval])]

    def grown(each: Array) -> Array:
        """Sum of what each step adds, from the beginning of its interval on."""
        total = np.cumsum(each, axis=0)
        return np.asarray(total - (total - each)[first])

    def before(after: Array, rows: slice) -> Array:
        """What there was before each step."""
        shifted = np.concatenate([after[:1], after[:-1]])
        return np.where((first == np.arange(count))[:, None], kept[interval, rows], shifted)

    # the equations of the intervals, for this state alone
    turned = -np.einsum("nij,nj->ni", rotation, state[1:, GYRO_BIAS]) * dt
    if variant.attitude:
        turned -= stretch.correction_rad
    state[1:, THETA] += grown(turned)
    force = np.einsum("nij,nj->ni", rotation, stretch.force_m_s2)
    gained = np.cross(before(state[1:, THETA], THETA), force) + force + GRAVITY_M_S2
    gained -= np.einsum("nij,nj->ni", rotation, state[1:, ACCELEROMETER_BIAS])
    state[1:, VELOCITY] += grown(gained * dt)
    speed = state[1:, VELOCITY]
    state[1:, POSITION] += grown(0.5 * dt * (before(speed, VELOCITY) + speed))
    state[end] = kept[1:]
    reset, moved_m = np.zeros((count + 1, 3)), part.moved_m[:, at]
    for e in np.flatnonzero(moved_m.any(axis=1)):
        reset[end[e] :, :2] += moved_m[e]
    return state, reset
