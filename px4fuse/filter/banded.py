"""The states of a filter over a whole flight, as one banded system of equations.

Given the acceleration, what is known of the states x_k = [p, v] at the measurements is a sum of
squares: each leg's x_{k+1} - Fx_k - [Δp, Δv] over its Q, and each measurement's z - p over its
variance. Its matrix A has three bands below the diagonal, so that LAPACK factorises a flight in a
millisecond; the marginal likelihood of the measurements, which is that of the filter's innovations
(Schweppe 1965), follows from log|A| and the squares that remain at the minimum. Signals that enter
linearly (data, or what a bias would add to them) are columns: the factorisation does not depend on
them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from px4fuse.arrays import Array, BoolArray

# Position noise of a leg that is always there, over a measurement's and over its own: Q has an
# inverse, also that of a single step, which is of rank one, or without process noise
LEAST_SHARE = 1e-5
# A determinant below this share of its terms is their rounding
SINGULAR = 1e-12


@dataclass(frozen=True)
class BandedSystem:
    """The normal equations of all states, factorised.

    Attributes
    ----------
    precision : ndarray, shape (m, 2)
        Of the measured position (1/m²) and of the velocity, whose measured value is zero (s²/m²);
        0 where there is none.
    length_s : ndarray, shape (m - 1,)
        Between any two states.
    inverse : ndarray, shape (3, m - 1)
        Q⁻¹ by elements 00, 01, 11; zero where a stretch begins.
    root : ndarray, shape (m - 1,)
        1/√Q₁₁, as Q⁻¹ has it but for rounding; zero where a stretch begins.
    bands, lower : ndarray, shape (4, 2m)
        Bands of A and of its Cholesky factor.
    log_determinant : float
        ln|A| + Σ ln|Q| - Σ ln precision: twice the part of -ln p that no signal enters.
    """

    precision: Array
    length_s: Array
    inverse: Array
    root: Array
    bands: Array
    lower: Array
    log_determinant: float

    def whiten(self, measured_m: Array, dp: Array, dv: Array) -> tuple[Array, Array]:
        """Signals such that the products under the inverse covariance are a difference of two.

        Those of the rows, less those of what the states explain, and of the measurements over
        their sigma besides, which most signals have none of.

        Parameters
        ----------
        measured_m : ndarray, shape (..., m)
        dp, dv : ndarray, shape (..., m - 1)
            Δp (m) and Δv (m/s) of the legs; any value where a stretch begins.

        Returns
        -------
        rows : ndarray, shape (..., 2m - 2)
            Legs over their covariance's root, two for each, zero where a stretch begins.
        explained : ndarray, shape (..., 2m)
        """
        i00, i01, _ = self.inverse
        # Q⁻¹ = UᵀU; where a stretch begins it is zero
        u00 = np.sqrt(i00)
        u01 = np.divide(i01, u00, out=np.zeros_like(i01), where=u00 > 0.0)
        rows = np.empty((*dp.shape, 2))
        np.add(u00 * dp, u01 * dv, out=rows[..., 0])
        np.multiply(self.root, dv, out=rows[..., 1])
        right = self._right(measured_m, dp, dv)
        explained, _ = lapack.dtbtrs(self.lower, right.T, uplo="L", overwrite_b=1)
        return rows.reshape(*dp.shape[:-1], -1), explained.T.reshape(*dp.shape[:-1], -1)

    def solve(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """Most likely states: position and velocity, shape (..., m, 2); arguments of `whiten`."""
        right = self._right(measured_m, dp, dv)
        state, _ = lapack.dpbtrs(self.lower, right.T, lower=1, overwrite_b=1)
        return np.asarray(state.T.reshape(*dp.shape[:-1], -1, 2))

    def _right(self, measured_m: Array, dp: Array, dv: Array) -> Array:
        """The right side of the normal equations, shape (columns, 2m)."""
        i00, i01, i11 = self.inverse
        right = np.zeros((*dp.shape[:-1], len(self.precision), 2))
        right[..., 0] = self.precision[:, 0] * measured_m
        g0, g1 = i00 * dp + i01 * dv, i01 * dp + i11 * dv
        right[..., 1:, 0] += g0
        right[..., 1:, 1] += g1
        right[..., :-1, 0] -= g0
        right[..., :-1, 1] -= g1 + g0 * self.length_s
        return right.reshape(-1, 2 * len(self.precision))

    def position_variance(self) -> Array:
        """Variance of each state's position given all data (m²), shape (m,).

        The information about a state is what all before it and what all after it leave of its own
        block of A: the Cholesky factor's blocks from either end (Fraser and Potter 1969).
        """
        # A with its rows and columns in reverse
        turned, size = np.zeros_like(self.bands), self.bands.shape[1]
        for below in range(4):
            turned[below, : size - below] = self.bands[below, : size - below][::-1]
        behind, _ = lapack.dpbtrf(turned, lower=1, overwrite_ab=1)
        (a, c), b = (self.lower[0, at::2] for at in (0, 1)), self.lower[1, 0::2]
        # of the reverse, each block has the velocity first
        (d, f), e = (behind[0, at::2][::-1] for at in (0, 1)), behind[1, 0::2][::-1]
        p00 = a**2 + e**2 + f**2 - self.bands[0, 0::2]
        p01 = a * b + d * e - self.bands[1, 0::2]
        p11 = b**2 + c**2 + d**2 - self.bands[0, 1::2]
        return np.asarray(p11 / (p00 * p11 - p01**2))


def factorise(length_s: Array, noise: Array, joined: BoolArray, precision: Array) -> BandedSystem:
    """Factorise the normal equations of the states at the measurements.

    Parameters
    ----------
    length_s : ndarray, shape (m - 1,)
        Of each leg.
    noise : ndarray, shape (3, m - 1)
        Its Q by elements 00, 01, 11.
    joined : ndarray of bool, shape (m - 1,)
        False where a stretch begins that knows nothing of what was before.
    precision : ndarray, shape (m, 2)
        Of the measured positions, 1/m², 0 for one that is not used, and of the velocities around
        zero.

    Raises
    ------
    numpy.linalg.LinAlgError
        A stretch has too few measurements for a position and a velocity.
    """
    q00, q01, q11 = noise
    measured = precision[:, 0]
    least = LEAST_SHARE**2 * (1.0 / np.median(measured[measured > 0.0]) + q00)
    # of a single step Q has no inverse but for that, which rounding would hide
    product = q00 * q11
    own = product - q01**2
    determinant = np.where(own > SINGULAR * product, own, 0.0) + least * q11
    inverse = np.where(joined, np.stack([q11, -q01, q00 + least]) / determinant, 0.0)
    i00, i01, i11 = inverse
    slope = i00 * length_s
    cross = slope + i01
    # A = Σ precision + [-F I]ᵀ Q⁻¹ [-F I]; by columns, as LAPACK keeps bands
    columns = np.zeros((len(precision), 2, 4))
    position, velocity = columns[:, 0], columns[:, 1]
    position[:, 0], velocity[:, 0] = precision.T
    position[1:, 0] += i00
    position[1:, 1] = i01
    velocity[1:, 0] += i11
    position[:-1, 0] += i00
    position[:-1, 1] += cross
    velocity[:-1, 0] += (cross + i01) * length_s + i11
    position[:-1, 2], position[:-1, 3] = -i00, -i01
    velocity[:-1, 1], velocity[:-1, 2] = -cross, -(i01 * length_s + i11)
    bands = columns.reshape(-1, 4).T
    lower, broken = lapack.dpbtrf(bands, lower=1)
    if broken:
        raise np.linalg.LinAlgError("a stretch has too few measurements")
    log_determinant = (
        2.0 * np.sum(np.log(lower[0]))
        + np.sum(np.log(determinant[joined]))
        - np.sum(np.log(precision[precision > 0.0]))
    )
    root = np.where(joined, 1.0 / np.sqrt(q11), 0.0)
    return BandedSystem(precision, length_s, inverse, root, bands, lower, float(log_determinant))
