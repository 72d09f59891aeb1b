"""EKF2 replayed from an ordinary log, as it flew and with other parameters.

The model is the part of EKF2 that external vision moves: 15 error states about the published
attitude, started from the log's own ``estimator_states`` and fed with IMU and vision as logged.
It is not EKF2: what else EKF2 fuses (height, heading) is taken from its own output. How far it can
be believed is measured on each log, see :mod:`px4fuse.ekf2.agreement`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from msgspec import structs
from numpy.typing import NDArray

from px4fuse.display import brief
from px4fuse.ekf2.agreement import REJECTING_SHARE, agreement_with_log, with_obedient
from px4fuse.ekf2.inputs import Inputs, prepare
from px4fuse.ekf2.legs import (
    ACCELEROMETER_BIAS,
    GRAVITY_M_S2,
    GYRO_BIAS,
    POSITION,
    THETA,
    VELOCITY,
    FusionEvents,
    Legs,
    Timing,
    make_legs,
)
from px4fuse.ekf2.output_predictor import follow_attitude, later, publish
from px4fuse.ekf2.recursion import Run, Variant, run, with_correlation
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Agreement, Ekf2Replay
from px4fuse.ekf2.stretches import Stretch
from px4fuse.ekf2_parameters import check
from px4fuse.errors import SettingsError
from px4fuse.flight import STATE_COLUMNS, Flight, Unavailable

Array = NDArray[np.float64]

# Where a log's EKF2 is this model (simulated flights), the log says so in these words
MODEL_NOTE = (
    "EKF2 in this log is px4fuse's model of EKF2, run on the simulated sensors, not PX4's EKF2"
)
MAX_HORIZON_S = 1.0  # EKF2_DELAY_MAX
HORIZONTAL_POSITION, HORIZONTAL_VELOCITY = slice(6, 8), slice(3, 5)


@dataclass(frozen=True)
class Model:
    """A flight made ready for replays.

    Attributes
    ----------
    flight : Flight
    inputs : Inputs
    legs : tuple of Legs
        Of each stretch, for the delay as flown.
    flown : Ekf2Replay
        With the parameters of the log.
    agreement : Agreement
        Of ``flown`` with what the log holds.
    """

    flight: Flight
    inputs: Inputs
    legs: tuple[Legs, ...]
    flown: Ekf2Replay
    agreement: Agreement

    __repr__ = brief


def replay_ekf2(
    flight: Flight, parameters: Mapping[str, float] | None = None
) -> Ekf2Replay | Unavailable:
    """Replay EKF2 from a flight's log.

    Parameters
    ----------
    flight : Flight
    parameters : mapping, optional
        What to change, by PX4 name and in PX4's units; by default nothing.

    Returns
    -------
    Ekf2Replay or Unavailable
        Its ``agreement`` is that of the replay as flown, whatever was changed.

    Raises
    ------
    SettingsError
        A parameter that the model does not have, or a value outside PX4's range.
    """
    changed = check(parameters or {})
    model = open_model(flight)
    if isinstance(model, Unavailable):
        return model
    return replay_settings(model, [changed])[0] if changed else model.flown


def open_model(flight: Flight) -> Model | Unavailable:
    """Make a flight ready for replays and replay it as flown, or say why the log cannot carry it.

    Parameters
    ----------
    flight : Flight
    """
    inputs = prepare(flight)
    if isinstance(inputs, Unavailable):
        return inputs
    variant = Variant(inputs.settings)
    timing = variant.timing(inputs)
    legs = tuple(make_legs(inputs, stretch, timing) for stretch in inputs.stretches)
    stretches = tuple(
        with_correlation(inputs, stretch, leg)
        for stretch, leg in zip(inputs.stretches, legs, strict=True)
    )
    inputs = replace(inputs, stretches=stretches)
    runs = run_variants(inputs, [variant], {timing: legs})
    flown = _assemble(inputs, runs, 0, {})
    agreement = agreement_with_log(flight, flown)
    if isinstance(agreement, Unavailable):
        return agreement
    share = max(agreement.rejected_share_logged, agreement.rejected_share_replayed)
    if agreement.good and share > REJECTING_SHARE and np.isfinite(inputs.vision.rejected).any():
        variant = Variant(inputs.settings, as_logged=True)
        obedient = _assemble(inputs, run_variants(inputs, [variant], {timing: legs}), 0, {})
        obeyed = agreement_with_log(flight, obedient)
        if isinstance(obeyed, Agreement):
            agreement = with_obedient(agreement, obeyed)
    return Model(flight, inputs, legs, structs.replace(flown, agreement=agreement), agreement)


def replay_settings(
    model: Model, settings: Sequence[Mapping[str, float]]
) -> tuple[Ekf2Replay, ...]:
    """Replay with several settings at once, each a change of what was flown.

    Parameters
    ----------
    model : Model
    settings : sequence of mapping
        What each changes, by PX4 name and in PX4's units.

    Raises
    ------
    SettingsError
        A parameter that the model does not have, or a value outside PX4's range.
    """
    changes = [check(change) for change in settings]
    if model.inputs.rules.horizon_by_delay and any("EKF2_DELAY_MAX" in c for c in changes):
        raise SettingsError(
            f"EKF2_DELAY_MAX: {model.flight.log.firmware} has no such parameter; there the longest "
            "delay makes the horizon."
        )
    if not changes:
        return ()
    flown = model.inputs.settings
    variants = [Variant({**flown, **change}) for change in changes]
    return tuple(
        structs.replace(replay, agreement=model.agreement)
        for replay in replay_variants(model, variants, changes)
    )


def replay_variants(
    model: Model, variants: Sequence[Variant], changes: Sequence[Mapping[str, float]]
) -> list[Ekf2Replay]:
    """Replay filters of any kind; ``changes`` are what each is said to have changed."""
    inputs = model.inputs
    made = {Variant(inputs.settings).timing(inputs): model.legs}
    runs = run_variants(inputs, variants, made)
    return [_assemble(inputs, runs, at, change) for at, change in enumerate(changes)]


def delayed_variants(
    model: Model, variants: Sequence[Variant]
) -> tuple[Iterator[pd.DataFrame], Ekf2Replay]:
    """Tracks of all but the last at their horizon, one at a time, and all that the last one did.

    What a filter publishes is as long again, and takes as long to make.
    """
    made = {Variant(model.inputs.settings).timing(model.inputs): model.legs}
    runs = run_variants(model.inputs, variants, made)
    last = _assemble(model.inputs, runs, len(variants) - 1, {})
    tracks = (
        pd.concat([_delayed(part, delayed_states(part, at)[0]) for part in runs])
        for at in range(len(variants) - 1)
    )
    return tracks, last


def _delayed(part: StretchRun, state: Array) -> pd.DataFrame:
    index = pd.Index(part.stretch.time_s, name="time_s")
    return pd.DataFrame(np.hstack([state[:, 6:9], state[:, 3:6]]), index, STATE_COLUMNS)


@dataclass(frozen=True)
class StretchRun:
    """One stretch with its events by delay, and what the variants did in it."""

    stretch: Stretch
    events: tuple[FusionEvents, ...]
    which: NDArray[np.intp]
    run: Run
    variants: tuple[Variant, ...]


def run_variants(
    inputs: Inputs, variants: Sequence[Variant], made: Mapping[Timing, Sequence[Legs]]
) -> list[StretchRun]:
    """Run variants through every stretch; ``made`` are the legs that there are."""
    timings = [variant.timing(inputs) for variant in variants]
    distinct = list(dict.fromkeys(timings))
    which = np.array([distinct.index(timing) for timing in timings])
    runs = []
    for at, stretch in enumerate(inputs.stretches):
        legs = tuple(
            made[timing][at] if timing in made else make_legs(inputs, stretch, timing)
            for timing in distinct
        )
        done = run(inputs, stretch, legs, which, variants)
        events = tuple(each.events for each in legs)
        runs.append(StretchRun(stretch, events, which, done, tuple(variants)))
    return runs


def _assemble(
    inputs: Inputs, runs: Sequence[StretchRun], at: int, changed: Mapping[str, float]
) -> Ekf2Replay:
    updates, delayed, published = [], [], []
    for part in runs:
        updates.append(_updates(part, at))
        state, output = _tracks(inputs, part, at)
        delayed.append(state)
        published.append(output)
    return Ekf2Replay(
        settings=runs[0].variants[at].settings,
        changed=dict(changed),
        updates=pd.concat(updates),
        delayed=pd.concat(delayed),
        published=pd.concat(published),
        stretches_s=tuple(
            (float(part.stretch.time_s[0]), float(part.stretch.time_s[-1])) for part in runs
        ),
        source=inputs.vision.source,
        late=sum(int(part.events[part.which[at]].late.sum()) for part in runs),
        lost=sum(int(part.events[part.which[at]].lost.sum()) for part in runs),
    )


def _updates(part: StretchRun, at: int) -> pd.DataFrame:
    events, done = part.events[part.which[at]], part.run
    seen = np.flatnonzero(np.isfinite(done.innovation_m[:, at, 0]))
    after = done.variance[seen + 1, at]
    values = np.column_stack(
        [
            done.innovation_m[seen, at],
            done.variance_m2[seen, at],
            done.rejected[seen, at],
            done.fused[seen, at],
            done.reset[seen, at],
            after[:, HORIZONTAL_POSITION],
            after[:, HORIZONTAL_VELOCITY],
            done.noise_m2[seen, at],
            part.stretch.time_s[events.end[seen]],
        ]
    )
    index = pd.Index(events.time_s[seen], name="time_s")
    return pd.DataFrame(values, index=index, columns=UPDATE_COLUMNS)


def _tracks(inputs: Inputs, part: StretchRun, at: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The filter's state and what it publishes, at each step."""
    stretch, variant = part.stretch, part.variants[at]
    state, reset = delayed_states(part, at)
    horizon_s = min(variant.timing(inputs).horizon_s, MAX_HORIZON_S)
    lag = max(round(horizon_s / inputs.step_s), 1)
    # the bias that the newest IMU samples are corrected with is the horizon's
    force = stretch.force_m_s2 - later(state[:, ACCELEROMETER_BIAS], lag)[1:]
    force = np.einsum("nij,nj->ni", stretch.rotation[1:], force)
    if variant.attitude:  # the published attitude followed that of EKF2 itself
        turned = follow_attitude(
            state[:, :3] - stretch.attitude_error_rad, lag, inputs.step_s, horizon_s
        )
        force = force + np.cross(turned[1:], force)
    velocity, position = publish(
        gain_m_s=(force + GRAVITY_M_S2) * stretch.step_s[:, None],
        step_s=stretch.step_s,
        velocity_m_s=state[:, 3:6],
        position_m=state[:, 6:9],
        reset_m=reset,
        lag=lag,
        tau_velocity_s=variant.settings["EKF2_TAU_VEL"],
        tau_position_s=variant.settings["EKF2_TAU_POS"],
    )
    index = pd.Index(stretch.time_s, name="time_s")
    return (
        _delayed(part, state),
        pd.DataFrame(np.hstack([position, velocity]), index, STATE_COLUMNS),
    )


def delayed_states(part: StretchRun, at: int) -> tuple[Array, Array]:
    """State of one variant at each step's end, and the position's resets up to then.

    Returns
    -------
    state : ndarray, shape (n + 1, 15)
    reset_m : ndarray, shape (n + 1, 3)
    """
    events, variant = part.events[part.which[at]], part.variants[at]
    stretch, kept = part.stretch, part.run.state[:, at]
    count, rotation, dt = len(stretch.step_s), stretch.rotation[1:], stretch.step_s[:, None]
    leg = np.searchsorted(events.end, np.arange(count), side="right")
    first = np.searchsorted(leg, leg)
    state = kept[np.concatenate([[0], leg])]

    def grown(each: Array) -> Array:
        """Sum of what each step adds, from the beginning of its leg on."""
        total = np.cumsum(each, axis=0)
        return np.asarray(total - (total - each)[first])

    def before(after: Array, rows: slice) -> Array:
        """What there was before each step."""
        shifted = np.concatenate([after[:1], after[:-1]])
        return np.where((first == np.arange(count))[:, None], kept[leg, rows], shifted)

    # the equations of the legs, for this state alone
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
    state[events.end] = kept[1:]
    reset = np.zeros((count + 1, 3))
    for e in np.flatnonzero(part.run.reset[:, at]):
        # measured position minus the state before: the innovation itself
        reset[events.end[e] :, :2] += part.run.innovation_m[e, at]
    return state, reset
