"""States of a filter whose gains are known, all steps at once.

With the gains given, x = Fx + [Δp, Δv] and x = x + K(z - Hx) are linear in what drives them: a
triangular system with three bands below the diagonal. LAPACK solves it for many signals at once,
by the very recursion from front to back.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from px4fuse.arrays import Array


def driven(
    length_s: Array,
    gain: Array,
    delta_position_m: Array,
    delta_velocity_m_s: Array,
    measured_m: Array,
    start: Array,
) -> tuple[Array, Array]:
    """Run one filter over k signals.

    Parameters
    ----------
    length_s : ndarray, shape (n,)
        Of each step.
    gain : ndarray, shape (n, 2)
        K at the end of each step, zero where nothing is fused.
    delta_position_m, delta_velocity_m_s : ndarray, shape (n, k)
        What the acceleration adds in each step.
    measured_m : ndarray, shape (n, k)
        Finite; at will where nothing is fused.
    start : ndarray, shape (2, k)
        Position and velocity.

    Returns
    -------
    prior_m : ndarray, shape (n, k)
        Predicted position at the end of each step.
    state : ndarray, shape (n + 1, 2, k)
        Position and velocity at the start and after each step.
    """
    count, width = delta_position_m.shape
    k0, k1 = gain.T
    bands = np.zeros((4, 2 * count))
    # p = (1 - K₀)(p + dt v + Δp) + K₀ z,  v = v + Δv + K₁(z - (p + dt v + Δp))
    bands[2, 0:-2:2] = k0[1:] - 1.0
    bands[1, 1:-1:2] = (k0[1:] - 1.0) * length_s[1:]
    bands[3, 0:-2:2] = k1[1:]
    bands[2, 1:-1:2] = k1[1:] * length_s[1:] - 1.0
    pushed = delta_position_m.copy()
    pushed[0] += start[0] + length_s[0] * start[1]
    right = np.empty((width, count, 2))
    right[..., 0] = ((1.0 - k0[:, None]) * pushed + k0[:, None] * measured_m).T
    right[..., 1] = (delta_velocity_m_s + k1[:, None] * (measured_m - pushed)).T
    right[:, 0, 1] += start[1]
    after, _ = lapack.dtbtrs(bands, right.reshape(width, -1).T, uplo="L", diag="U", overwrite_b=1)
    state = np.concatenate([start[None], after.reshape(count, 2, width)])
    prior = state[:-1, 0] + length_s[:, None] * state[:-1, 1] + delta_position_m
    return prior, state
