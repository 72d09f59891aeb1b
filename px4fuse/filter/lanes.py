"""The likelihood of positions in many stretches at once: the filter, step by step, side by side.

The same as :func:`px4fuse.filter.marginal.fit`, whose factorisation takes one long chain well. Here
every stretch, every ratio of the noises and every signal is a lane of an array, and one step of the
filter takes all of them further: what is worked on stays in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.filter.marginal import HELD, Fitted, Positions
from px4fuse.filter.model import spread

# A step takes as long for few as for many: with fewer of them one factorisation after the other is
# faster
MIN_LANES = 32
# Variance by which a measurement is not used (m²), small enough for its inverse to be a number
UNUSED_M2 = 1e200


@dataclass(frozen=True)
class Gains:
    """The filter's gains at every step of every stretch, for R ratios, which no signal enters.

    Attributes
    ----------
    groups : tuple
        Axes that are measured at the same times, and for each group K of position and velocity and
        1/√S, 0 where nothing is used, of shape (l, R, s).
    length_s : ndarray, shape (l, s)
        Of the leg that ends at each step.
    log_determinant : ndarray, shape (R,)
    freedom : int
    constant_sigma : ndarray, shape (c,)
        As :class:`px4fuse.filter.marginal.Fitted` has them.
    """

    groups: tuple[tuple[list[int], Array, Array, Array], ...]
    length_s: Array
    log_determinant: Array
    freedom: int
    constant_sigma: Array


@dataclass(frozen=True)
class Lanes:
    """Positions with their signals, by step and stretch; stretches that end early are padded.

    Attributes
    ----------
    signal_m : ndarray, shape (l, s, a, T, 1 + c)
        What a filter with no input of its own takes for the measurements of each signal: those of
        the data less where the input alone leads, and for each constant what it adds to that.
    """

    signal_m: Array

    def fit(self, gains: Gains) -> list[Fitted]:
        """Fit with several SIGMA_A, as :func:`px4fuse.filter.marginal.fit` with each.

        Parameters
        ----------
        gains : Gains
            Of these positions.
        """
        grams = [self._gram(*group, gains.length_s) for group in gains.groups]
        return [
            Fitted(one, float(log), gains.freedom, gains.constant_sigma)
            for one, log in zip(np.sum(grams, axis=0), gains.log_determinant, strict=True)
        ]

    def _gram(self, axes: list[int], k0: Array, k1: Array, weight: Array, length: Array) -> Array:
        """Products of the innovations over √S, shape (R, s, T, 1 + c, 1 + c)."""
        whole = axes == list(range(self.signal_m.shape[2]))
        signal = self.signal_m if whole else self.signal_m[:, :, axes]
        lanes = (k0.shape[1], *signal.shape[1:])
        out = np.empty((len(signal), *lanes))
        position, velocity, scratch = np.zeros((3, *lanes))
        length, k0, k1, weight = (each[..., None, None, None] for each in (length, k0, k1, weight))
        for step, (now, row) in enumerate(zip(signal, out, strict=True)):
            if step:
                position += np.multiply(velocity, length[step], out=scratch)
            np.subtract(now, position, out=row)
            position += np.multiply(row, k0[step], out=scratch)
            velocity += np.multiply(row, k1[step], out=scratch)
            np.multiply(row, weight[step], out=row)
        by_axis = out.transpose(1, 2, 4, 3, 0, 5).swapaxes(-1, -2)
        return np.asarray((by_axis @ by_axis.swapaxes(-1, -2)).sum(axis=3))


def gains(positions: Positions, ratios: Sequence[float], variance: Array) -> Gains:
    """Gains of all stretches with several SIGMA_A.

    Parameters
    ----------
    positions : Positions
        With starts as good as unknown.
    ratios : sequence of float
        SIGMA_A, R of them.
    variance : ndarray, shape (m,)
        Of each measurement.
    """
    state, inside = _side_by_side(positions)
    known = np.isfinite(positions.measurement_m)
    log_s, freedom, groups = np.zeros(len(ratios)), 0, []
    left = list(range(known.shape[1]))
    while left:
        axes = [axis for axis in left if np.array_equal(known[:, axis], known[:, left[0]])]
        left = [axis for axis in left if axis not in axes]
        used = known[state, axes[0]] & inside
        used &= np.count_nonzero(used, axis=0) >= 2  # fewer say nothing
        # what is not used weighs nothing
        r = np.where(used, variance[state], UNUSED_M2)
        s, k0, k1 = _recursion(positions, state, np.square(ratios), r)
        log_s += len(axes) * np.sum(np.log(s), axis=(0, 2), where=used[:, None])
        # a start that is as good as unknown does not count
        unknown = positions.initial[positions.start][used.any(axis=0)]
        log_s += len(axes) * np.sum(np.log(unknown))
        freedom += len(axes) * (np.count_nonzero(used) - unknown.size)
        groups.append((axes, k0, k1, np.where(used[:, None], 1.0 / np.sqrt(s), 0.0)))
    length = _by_state(positions, positions.chain.length_s)[state]
    return Gains(tuple(groups), length, log_s, freedom, positions.constant_sigma)


def _recursion(positions: Positions, state: IntArray, q: Array, r: Array) -> Array:
    """S and K of every step, shape (3, l, R, s)."""
    chain = positions.chain
    unit, fixed = (_by_state(positions, each) for each in (chain.noise_unit, chain.noise_fixed))
    # rows of what is done at each step, so that it is looked up once
    noise = q[:, None] * unit[state].transpose(0, 2, 1)[:, :, None]
    noise += fixed[state].transpose(0, 2, 1)[:, :, None]
    length = _by_state(positions, chain.length_s)[state]
    made = np.empty((3, len(state), len(q), len(state.T)))
    start = 1.0 / positions.initial[positions.start]
    p00, p01, p11 = np.zeros((3, *made.shape[2:]))
    p00 += start[:, 0]
    p11 += start[:, 1]
    for step, (r_now, dt, (q00, q01, q11)) in enumerate(zip(r, length, noise, strict=True)):
        if step:
            p00, p01, p11 = spread((p00, p01, p11), dt)
            p00 += q00
            p01 += q01
            p11 = p11 + q11
        s, k0, k1 = made[:, step]
        np.add(p00, r_now, out=s)
        np.divide(p00, s, out=k0)
        np.divide(p01, s, out=k1)
        p11 = p11 - k1 * p01
        p00, p01 = r_now * k0, r_now * k1
    return made


def _by_state(positions: Positions, of_leg: Array) -> Array:
    """What belongs to legs, by the states at which they end; 0 where a stretch begins."""
    made = np.zeros((len(positions.measurement_m), *of_leg.shape[1:]))
    made[positions.chain.end] = of_leg
    return made


def lanes(positions: Positions, delta_position_m: Array, delta_velocity_m_s: Array) -> Lanes | None:
    """Lay stretches side by side; None where a start is known.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        As :func:`px4fuse.filter.marginal.fit` takes them.
    """
    if positions.initial.max() > HELD:
        return None
    chain, count = positions.chain, len(positions.measurement_m)
    state, _ = _side_by_side(positions)
    leg = np.zeros(count, dtype=np.intp)
    only_legs = delta_position_m.shape[-1] == len(chain.end)
    leg[chain.end] = np.arange(len(chain.end)) if only_legs else chain.end - 1
    length = _by_state(positions, chain.length_s)
    velocity, position = (
        np.moveaxis(part, -1, 0)[leg[state]] for part in (delta_velocity_m_s, delta_position_m)
    )
    # where the input alone leads from rest: a state that may start anywhere takes up the rest
    velocity[0] = position[0] = 0.0
    for step, dt in enumerate(length[state][1:, :, None, None, None], 1):
        position[step] += position[step - 1] + velocity[step - 1] * dt
        velocity[step] += velocity[step - 1]
    np.negative(position, out=position)
    position[..., 0] += np.nan_to_num(positions.measurement_m)[state][..., None]
    return Lanes(position)


def lanes_of_paths(positions: Positions, path_m: Array) -> Lanes:
    """The same from where the input leads; the last constant is a scale of the positions.

    Parameters
    ----------
    positions : Positions
        With starts as good as unknown.
    path_m : ndarray, shape (m, a, T, c)
        Where the input alone leads from rest at the start of each stretch, then what each constant
        but the scale adds.
    """
    measured = np.nan_to_num(positions.measurement_m)[:, :, None]
    signal = np.empty((*path_m.shape[:-1], path_m.shape[-1] + 1))
    np.negative(path_m, out=signal[..., :-1])
    signal[..., 0] += measured
    # of smooth motion through the positions, see marginal.centred
    for axes, factor, _ in positions.smooth:
        apart = np.ascontiguousarray(np.moveaxis(signal[..., 0][:, axes], 0, -1))
        apart -= factor.follow(apart)
        apart[..., positions.start] = 0.0
        signal[..., -1][:, axes] = np.moveaxis(apart, -1, 0) - measured[:, axes]
    state, _ = _side_by_side(positions)
    return Lanes(signal[state])


def _side_by_side(positions: Positions) -> tuple[IntArray, BoolArray]:
    start = positions.start
    lengths = np.diff([*start.tolist(), len(positions.measurement_m)])
    step = np.arange(lengths.max())[:, None]
    inside = step < lengths
    return np.where(inside, start + step, start), inside
