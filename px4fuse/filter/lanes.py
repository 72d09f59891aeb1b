"""The likelihood of positions in many stretches at once: the filter, step by step, side by side.

The same as :func:`px4fuse.filter.marginal.fit`, whose factorisation takes one long chain well. Here
every stretch, every ratio of the noises and every signal is a lane of an array, and one step of the
filter takes all of them further: what is worked on stays in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.marginal import HELD, Fitted, Positions
from px4fuse.filter.model import spread

MIN_STRETCHES = 2


@dataclass(frozen=True)
class Lanes:
    """Positions with their legs, by step and stretch; stretches that end early are padded.

    Attributes
    ----------
    positions : Positions
    state : ndarray of int, shape (l, s)
        Which state a stretch is in at each step.
    inside : ndarray of bool, shape (l, s)
        Whether it still goes on.
    delta_position_m, delta_velocity_m_s : ndarray, shape (l, s, a, T, 1 + c)
        Of the leg that ends there.
    """

    positions: Positions
    state: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    inside: BoolArray
    delta_position_m: Array
    delta_velocity_m_s: Array

    def fit(self, ratios: Sequence[float], variance: Array) -> list[Fitted]:
        """Fit with several SIGMA_A, as :func:`px4fuse.filter.marginal.fit` with each.

        Parameters
        ----------
        ratios : sequence of float
            SIGMA_A, R of them.
        variance : ndarray, shape (m,)
            Of each measurement.
        """
        positions, count = self.positions, len(ratios)
        shape = self.delta_position_m.shape
        gram = np.zeros((count, shape[1], *shape[3:], shape[4]))
        log_s, freedom = np.zeros(count), 0
        known = np.isfinite(positions.measurement_m)
        left = list(range(known.shape[1]))
        while left:
            axes = [axis for axis in left if np.array_equal(known[:, axis], known[:, left[0]])]
            left = [axis for axis in left if axis not in axes]
            used = known[self.state, axes[0]] & self.inside
            used &= np.count_nonzero(used, axis=0) >= 2  # fewer say nothing
            gains = self._gains(np.square(ratios), variance, used)
            log_s += len(axes) * np.sum(np.log(gains[0]), axis=(0, 2), where=used[:, None])
            # a start that is as good as unknown does not count
            unknown = positions.initial[positions.start][used.any(axis=0)]
            log_s += len(axes) * np.sum(np.log(unknown))
            freedom += len(axes) * (np.count_nonzero(used) - unknown.size)
            gram += self._gram(axes, gains, used)
        sigma = positions.constant_sigma
        return [
            Fitted(one, float(log), freedom, sigma) for one, log in zip(gram, log_s, strict=True)
        ]

    def _gains(self, q: Array, variance: Array, used: BoolArray) -> tuple[Array, Array, Array]:
        """S and K of every step, each of shape (l, R, s)."""
        chain = self.positions.chain
        unit, fixed = np.zeros((2, len(variance), 3))
        unit[chain.end], fixed[chain.end] = chain.noise_unit, chain.noise_fixed
        length = np.zeros(len(variance))
        length[chain.end] = chain.length_s
        # rows of what is done at each step, so that it is looked up once
        noise = (
            q[:, None] * unit[self.state].transpose(2, 0, 1)[:, :, None]
            + (fixed[self.state].transpose(2, 0, 1)[:, :, None])
        )
        made = np.empty((3, len(self.state), len(q), len(self.state.T)))
        start = 1.0 / self.positions.initial[self.positions.start]
        p00, p01, p11 = (
            np.broadcast_to(each, made.shape[2:]) for each in (start[:, 0], 0.0, start[:, 1])
        )
        for step, (at, fused) in enumerate(zip(self.state, used, strict=True)):
            if step:
                p00, p01, p11 = spread((p00, p01, p11), length[at])
                p00, p01, p11 = (
                    p + more for p, more in zip((p00, p01, p11), noise[:, step], strict=True)
                )
            r = variance[at]
            s = p00 + r
            k0, k1 = np.where(fused, p00, 0.0) / s, np.where(fused, p01, 0.0) / s
            made[:, step] = s, k0, k1
            p11 = p11 - k1 * p01
            p00, p01 = np.where(fused, r * k0, p00), np.where(fused, r * k1, p01)
        return made[0], made[1], made[2]

    def _gram(self, axes: list[int], gains: tuple[Array, Array, Array], used: BoolArray) -> Array:
        """Products of the innovations over √S, shape (R, s, T, 1 + c, 1 + c)."""
        chain = self.positions.chain
        length = np.zeros(len(self.positions.measurement_m))
        length[chain.end] = chain.length_s
        whole = axes == list(range(self.delta_position_m.shape[2]))
        dp, dv = (
            part if whole else part[:, :, axes]
            for part in (self.delta_position_m, self.delta_velocity_m_s)
        )
        steps, stretches, _, choices, width = dp.shape
        count = gains[0].shape[1]
        measured = np.nan_to_num(self.positions.measurement_m[:, axes])
        weight = np.where(used[:, None], 1.0 / np.sqrt(gains[0]), 0.0)
        lanes = (count, stretches, len(axes), choices, width)
        out = np.empty((steps, *lanes))
        position, velocity, scratch = np.zeros((3, *lanes))
        more = (slice(None), slice(None), None, None, None)
        for step, (at, row) in enumerate(zip(self.state, out, strict=True)):
            if step:
                np.multiply(velocity, length[at][:, None, None, None], out=scratch)
                position += scratch
                position += dp[step]
                velocity += dv[step]
            np.negative(position, out=row)
            row[..., 0] += measured[at][:, :, None]
            position += np.multiply(row, gains[1][step][more], out=scratch)
            velocity += np.multiply(row, gains[2][step][more], out=scratch)
            np.multiply(row, weight[step][more], out=row)
        by_axis = out.transpose(1, 2, 4, 3, 0, 5).swapaxes(-1, -2)
        return np.asarray((by_axis @ by_axis.swapaxes(-1, -2)).sum(axis=3))


def lanes(positions: Positions, delta_position_m: Array, delta_velocity_m_s: Array) -> Lanes | None:
    """Lay stretches side by side; None where a start is known or there are too few of them.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        As :func:`px4fuse.filter.marginal.fit` takes them.
    """
    start = positions.start
    if len(start) < MIN_STRETCHES or positions.initial.max() > HELD:
        return None
    count = len(positions.measurement_m)
    lengths = np.diff([*start.tolist(), count])
    step = np.arange(lengths.max())[:, None]
    inside = step < lengths
    state = np.where(inside, start + step, start)
    leg = np.zeros(count, dtype=np.intp)
    if delta_position_m.shape[-1] == len(positions.chain.end):
        leg[positions.chain.end] = np.arange(len(positions.chain.end))
    else:
        leg[positions.chain.end] = positions.chain.end - 1
    moved = (
        np.where(
            inside[:, :, None, None, None],
            np.moveaxis(np.take(part, leg[state], axis=-1), (-2, -1), (0, 1)),
            0.0,
        )
        for part in (delta_position_m, delta_velocity_m_s)
    )
    return Lanes(positions, state, inside, *moved)
