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
    bands = np.zeros((4, 2 * count + 2))
    # p = (1 - K₀)(p + dt v + Δp) + K₀ z,  v = v + Δv + K₁(z - (p + dt v + Δp))
    bands[2, 0:-2:2] = k0 - 1.0
    bands[1, 1:-1:2] = (k0 - 1.0) * length_s
    bands[3, 0:-2:2] = k1
    bands[2, 1:-1:2] = k1 * length_s - 1.0
    # time last, as LAPACK takes them
    pushed, measured = (np.ascontiguousarray(each.T) for each in (delta_position_m, measured_m))
    right = np.empty((width, count + 1, 2))
    right[:, 0] = start.T
    right[:, 1:, 0] = pushed + k0 * (measured - pushed)
    right[:, 1:, 1] = delta_velocity_m_s.T + k1 * (measured - pushed)
    after, _ = lapack.dtbtrs(bands, right.reshape(width, -1).T, uplo="L", diag="U", overwrite_b=1)
    state = after.T.reshape(width, count + 1, 2)
    prior = state[:, :-1, 0] + length_s * state[:, :-1, 1] + pushed
    return prior.T, np.moveaxis(state, 0, -1)
