"""Likelihood of positions along a few axes, with what is constant in each stretch taken out.

On the chains of :mod:`px4fuse.filter.chain`: biases and the like are columns with a prior, and are
marginalised by the Schur complement of their products.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.filter.chain import Chain, Columns, Factor, factorise

ONE = np.ones(1)
# SIGMA_A and SIGMA_Z of a smooth path
PATH_NOISES = 0.5, 0.1
# Precision of a start (1/m²) above which it is known, below which as good as nothing is
HELD = 1e-3


@dataclass(frozen=True)
class Positions:
    """Positions of one source along a few axes, and what moves them.

    Attributes
    ----------
    chain : Chain
        The same on every axis.
    measurement_m : ndarray, shape (m, a)
        NaN where an axis has none.
    start : ndarray of int, shape (s,)
        First state of each stretch.
    initial : ndarray, shape (m, 2)
        Precision of what is known of position and velocity beforehand: 0 for nothing.
    constant_sigma : ndarray, shape (c,)
        Prior standard deviations of the constants, which each stretch has for itself.
    """

    chain: Chain
    measurement_m: Array
    start: IntArray
    initial: Array
    constant_sigma: Array

    @cached_property
    def smooth(self) -> tuple[tuple[list[int], Factor, int], ...]:
        """Factors for a smooth path through the positions, each with the axes that it serves."""
        variance = np.full(len(self.measurement_m), PATH_NOISES[1] ** 2)
        return tuple(_factors(self, PATH_NOISES[0], variance))


@dataclass(frozen=True)
class Fitted:
    """Positions fitted with one pair of noises, over T choices of the legs.

    Attributes
    ----------
    gram : ndarray, shape (s, T, 1 + c, 1 + c)
        Products of the data and of the constants' signals, under the inverse covariance.
    log_determinant : float
    freedom : int
        Measured positions less what the starts take of them: ln of the scale of all noises counts
        so many times.
    constant_sigma : ndarray, shape (c,)
    """

    gram: Array
    log_determinant: float
    freedom: int
    constant_sigma: Array

    def scaled(self, sigma: float) -> Fitted:
        """The same with all noises ``sigma`` times as large."""
        return replace(
            self,
            gram=self.gram / sigma**2,
            log_determinant=self.log_determinant + 2.0 * self.freedom * float(np.log(sigma)),
        )

    def constants(self) -> tuple[Array, Array]:
        """Most likely constants (s, T, c), and their covariance (s, T, c, c)."""
        information = self.gram[..., 1:, 1:] + np.diag(self.constant_sigma**-2.0)
        covariance = np.linalg.inv(information)
        found = -np.einsum("stij,stj->sti", covariance, self.gram[..., 1:, 0])
        return np.asarray(found), np.asarray(covariance)

    def by_stretch(self, scales: Array = ONE) -> Array:
        """-ln p of each stretch but for what the noises alone make, shape (s, T).

        Parameters
        ----------
        scales : ndarray, shape (k,), optional
            By which all noises are multiplied: the shape is then (k, s, T).
        """
        gram = self.gram if scales is ONE else self.gram / scales[:, None, None, None, None] ** 2
        square = gram[..., 0, 0]
        if not len(self.constant_sigma):
            return np.asarray(0.5 * square)
        scale = self.constant_sigma
        information = gram[..., 1:, 1:] * np.outer(scale, scale) + np.eye(len(scale))
        cross = gram[..., 1:, 0] * scale
        lower = np.linalg.cholesky(information)
        solved = np.linalg.solve(information, cross[..., None])[..., 0]
        log_lower = np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
        return np.asarray(0.5 * (square - np.sum(cross * solved, axis=-1)) + log_lower)

    def totals(self, scales: Array) -> Array:
        """-ln p of all with all noises so many times as large, but for a constant, (k, T)."""
        noises_alone = 0.5 * self.log_determinant + self.freedom * np.log(scales)
        return np.asarray(self.by_stretch(scales).sum(axis=1) + noises_alone[:, None])

    def total(self) -> Array:
        """-ln p of all, but for a constant, shape (T,)."""
        return np.asarray(self.by_stretch().sum(axis=0) + 0.5 * self.log_determinant)


def fit(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
) -> Fitted:
    """Fit positions with one pair of noises.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        What the acceleration adds on each leg, and what each constant adds to that; legs as in
        :class:`Columns`.
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
        Of each measurement.

    Returns
    -------
    Fitted
    """
    shape = delta_position_m.shape
    gram = np.zeros((len(positions.start), shape[1], shape[2], shape[2]))
    log_determinant, freedom = 0.0, 0
    for axes, factor, measured in _factors(positions, sigma_a_m_s2, variance_m2):
        log_determinant += len(axes) * factor.log_determinant
        freedom += len(axes) * measured
        data = np.zeros((len(axes), 1, shape[2], len(positions.measurement_m)))
        data[:, 0, 0] = np.nan_to_num(positions.measurement_m[:, axes].T)
        square = factor.precision[:, 0] * np.sum(data[:, 0, 0] ** 2, axis=0)
        gram[..., 0, 0] += np.add.reduceat(square, positions.start)[:, None]
        dp, dv = (_picked(part, axes) for part in (delta_position_m, delta_velocity_m_s))
        rows, explained = factor.whiten(Columns(data, dp, dv))
        for at, (begin, end) in enumerate(_stretches(positions)):
            own, less = rows[..., 2 * begin : 2 * end - 2], explained[..., 2 * begin : 2 * end]
            gram[at] += (own @ np.swapaxes(own, -1, -2)).sum(axis=0)
            gram[at] -= (less @ np.swapaxes(less, -1, -2)).sum(axis=0)
    return Fitted(gram, log_determinant, freedom, positions.constant_sigma)


def _picked(parts: Array, axes: list[int]) -> Array:
    """Some axes, without a copy where they are all."""
    return parts if axes == list(range(len(parts))) else parts[axes]


def _stretches(positions: Positions) -> Iterator[tuple[int, int]]:
    return pairwise([*positions.start.tolist(), len(positions.measurement_m)])


def _factors(
    positions: Positions, sigma_a_m_s2: float, variance_m2: Array
) -> Iterator[tuple[list[int], Factor, int]]:
    """Factors of the chain, each with the axes that it serves, and their degrees of freedom.

    An axis that is measured at the same times as another shares its factor.
    """
    known = np.isfinite(positions.measurement_m)
    left = list(range(known.shape[1]))
    states = len(known)
    while left:
        axes = [axis for axis in left if np.array_equal(known[:, axis], known[:, left[0]])]
        precision = positions.initial.copy()
        # a stretch that this axis hardly measures is held by its start, and says nothing
        few = np.add.reduceat(known[:, axes[0]].astype(int), positions.start) < 2
        used = known[:, axes[0]] & ~np.repeat(few, np.diff([*positions.start, states]))
        precision[:, 0] += np.where(used, 1.0 / variance_m2, 0.0)
        precision[positions.start[few]] += 1.0
        said = (precision > 0.0) & ((precision > positions.initial) | (positions.initial > HELD))
        factor = factorise(positions.chain, sigma_a_m_s2, precision)
        # where the start is as good as unknown, what is known of it does not count
        vague = float(np.sum(np.log(precision[(precision > 0.0) & ~said])))
        factor = replace(factor, log_determinant=factor.log_determinant + vague)
        yield axes, factor, int(np.count_nonzero(said)) - 2 * len(positions.start)
        left = [axis for axis in left if axis not in axes]


def centred(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    *,
    scaled: bool = False,
) -> tuple[Positions, Array, Array]:
    """The same data about a smooth path through them, from zero where a stretch starts.

    The likelihood is the same, but it is no longer a small difference of large squares.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + c, n)
        Changed in place.
    scaled : bool
        Whether the last constant is a scale of the positions: its signal becomes the path's.
    """
    measured = positions.measurement_m.copy()
    chain = positions.chain
    count = delta_position_m.shape[-1]
    of_leg = chain.end - 1 if count == len(chain.end) else slice(None)
    for axes, factor, _ in positions.smooth:
        dp, dv = (part[axes, :, 0] for part in (delta_position_m, delta_velocity_m_s))
        state = factor.solve(Columns(np.nan_to_num(measured[:, axes].T)[:, None], dp, dv))
        state[:, :, positions.start] = 0.0
        path, speed = state[..., 0], state[..., 1]
        measured[:, axes] -= path[:, 0].T
        way = (np.diff(path) - factor.length_s * speed[..., :-1])[..., of_leg]
        turn = np.diff(speed)[..., of_leg]
        # one path is taken out of all; a scale is of the path to which each input leads
        for part, leads in ((delta_position_m, way), (delta_velocity_m_s, turn)):
            part[axes, :, 0] -= leads[:, :1]
            if scaled:
                part[axes, :, -1] = leads
    return replace(positions, measurement_m=measured), delta_position_m, delta_velocity_m_s


def squares(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
    constants: Array,
) -> tuple[Array, Array]:
    """Expected square of each measurement's error given all data, summed over its axes.

    Parameters
    ----------
    positions : Positions
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, 1, 1 + c, n)
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    constants : ndarray, shape (s, c)
        Most likely ones.

    Returns
    -------
    square_m2 : ndarray, shape (m,)
    count : ndarray, shape (m,)
        Axes that were measured.
    """
    weight = np.concatenate([np.ones((len(constants), 1)), constants], axis=1)
    # of each leg, by the stretch in which it ends
    end = np.arange(1, len(variance_m2))
    if delta_position_m.shape[-1] < len(end):
        end = positions.chain.end
    of_leg = weight[np.searchsorted(positions.start, end, side="right") - 1]
    dp, dv = (
        np.einsum("akn,nk->an", part[:, 0], of_leg)
        for part in (delta_position_m, delta_velocity_m_s)
    )
    square = np.zeros(len(variance_m2))
    count = np.isfinite(positions.measurement_m).sum(axis=1)
    for axes, factor, _ in _factors(positions, sigma_a_m_s2, variance_m2):
        measured = positions.measurement_m[:, axes].T
        state = factor.solve(Columns(np.nan_to_num(measured), dp[axes], dv[axes]))
        error = measured - state[..., 0]
        spread = np.where(np.isnan(error), np.nan, factor.position_variance())
        square += np.nansum(error**2 + spread, axis=0)
    return square, count


def paired_products(
    positions: Positions,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    sigma_a_m_s2: float,
    variance_m2: Array,
    pairs: Iterable[tuple[Columns, Columns]],
) -> Array:
    """Products of pairs of other signals by stretch, with the constants' signals taken out.

    Parameters
    ----------
    positions : Positions
        Their measurements only say which of them there are.
    delta_position_m, delta_velocity_m_s : ndarray, shape (a, 1, 1 + c, n)
    sigma_a_m_s2 : float
    variance_m2 : ndarray, shape (m,)
    pairs : iterable
        Signals of shape (a, k, ...), a few at a time: they are long.

    Returns
    -------
    ndarray, shape (s, k of all)
    """
    states, stretches = len(variance_m2), list(_stretches(positions))
    constants = len(positions.constant_sigma)
    information = np.tile(np.diag(positions.constant_sigma**-2.0), (len(stretches), 1, 1))
    known: list[tuple[int, Factor, list[tuple[Array, Array]]]] = []
    for axes, factor, _ in _factors(positions, sigma_a_m_s2, variance_m2):
        for axis in axes:
            white = factor.whiten(
                Columns(
                    np.zeros((constants, states)),
                    delta_position_m[axis, 0, 1:],
                    delta_velocity_m_s[axis, 0, 1:],
                )
            )
            of_constants = [_part_of(white, stretch) for stretch in stretches]
            known.append((axis, factor, of_constants))
            information += [rows @ rows.T - less @ less.T for rows, less in of_constants]

    def products(pair: tuple[Columns, Columns]) -> Array:
        count = pair[0].measurement_m.shape[1]
        made = np.zeros((len(stretches), count))
        cross = np.zeros((2, *made.shape, constants))
        for axis, factor, of_constants in known:
            signals = [
                Columns(each.measurement_m[axis], each.delta_position_m[axis],
                        each.delta_velocity_m_s[axis])
                for each in pair
            ]  # fmt: skip
            white = [factor.whiten(each) for each in signals]
            root = np.sqrt(factor.precision[:, 0])
            measured = [root * each.measurement_m for each in signals]
            for at, (stretch, (rows, explained)) in enumerate(
                zip(stretches, of_constants, strict=True)
            ):
                here = slice(*stretch)
                parts = [_part_of(each, stretch) for each in white]
                by_part = np.einsum("kr,kr->k", *(each[:, here] for each in measured))
                for sign, both in zip((1.0, -1.0), zip(*parts, strict=True), strict=True):
                    by_part += sign * np.einsum("kr,kr->k", *both)
                made[at] += by_part
                for which, (own, less) in enumerate(parts):
                    cross[which, at] += own @ rows.T - less @ explained.T
        taken = np.linalg.solve(information, np.swapaxes(cross[1], 1, 2))
        return np.asarray(made - np.einsum("skc,sck->sk", cross[0], taken))

    return np.concatenate([products(pair) for pair in pairs], axis=1)


def _part_of(white: tuple[Array, Array], stretch: tuple[int, int]) -> tuple[Array, Array]:
    """Rows and what the states explain of one stretch."""
    begin, end = stretch
    return white[0][:, 2 * begin : 2 * end - 2], white[1][:, 2 * begin : 2 * end]
