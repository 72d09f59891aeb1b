"""The magnetometer as EKF2 fuses it: all three axes, with the fields of earth and body as states.

Samples between two events are fused together at the later one, as their mean: the attitude error
hardly changes in between. So they make no intervals of their own.

Sources: PX4-Autopilot ``EKF/aid_sources/magnetometer`` (``mag_fusion.cpp``: fuseMag;
``mag_control.cpp``: R and its floor), ``EKF/covariance.cpp`` (process noise of the fields).
"""

from typing import NamedTuple

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.ekf2.stretches import BODY_FIELD, EARTH_FIELD, THETA, Sensed
from px4fuse.trajectory.rotation import skew

MIN_SD_GAUSS = 0.01
EYE = np.eye(3)
CROSS = skew(EYE).reshape(3, 9)  # v @ CROSS is [v]×


class Samples(NamedTuple):
    """Means of the samples that are fused at each event; shape (E, ...), or (E, S, ...).

    ``value`` and ``turn`` are as :class:`~px4fuse.ekf2.stretches.Sensed` has them, a velocity as of
    the event; ``number`` is how many EKF2 had, and ``noise`` R of one.
    """

    value: Array
    turn: Array
    number: Array
    noise: Array


def gather(sensed: Sensed, end: IntArray, gained_m_s: Array | None = None) -> Samples:
    """Samples by the event at which they are fused; ``end`` is the step of each event.

    ``gained_m_s`` is of :class:`~px4fuse.ekf2.stretches.Stretch`, for a velocity.
    """
    event = np.searchsorted(end, sensed.step)
    inside, size = event < len(end), len(end)
    event = event[inside]
    count = np.maximum(np.bincount(event, minlength=size), 1)

    def mean(rows: Array) -> Array:
        total = np.zeros((size, *rows.shape[1:]))
        np.add.at(total, event, rows[inside])
        return np.asarray((total.T / count).T)

    value, turn, noise = map(mean, (sensed.value, sensed.turn, sensed.noise))
    if gained_m_s is not None:
        value = value + np.einsum("eab,eb->ea", turn, gained_m_s[end])
    number = np.bincount(event, sensed.samples[inside], size)
    return Samples(value, turn, np.asarray(number, float), noise)


def fuse_field(
    x: Array, P: Array, told: Samples, noise_gauss: Array, gate: Array
) -> tuple[Array, Array, Array]:
    """State and covariance of S variants after the field samples of one event.

    And innovation (gauss), its variance for a single sample and whether it was fused, of shape
    (3, S, 3); NaN where there was no sample.
    """
    R = np.maximum(noise_gauss, MIN_SD_GAUSS) ** 2
    return fuse_mean(x, P, told, R, gate, EARTH_FIELD, BODY_FIELD)


def fuse_mean(
    x: Array, P: Array, told: Samples, R: Array, gate: Array, rows: slice, own: slice | None = None
) -> tuple[Array, Array, Array]:
    """State and covariance of S variants after the mean of some samples, as :func:`fuse_field`.

    Parameters
    ----------
    told : Samples
        Of one event.
    R, gate : ndarray, shape (S,)
        Variance of one sample, and its gate in standard deviations.
    rows : slice
        States that are measured in the body (NED).
    own : slice, optional
        States that are the body's own, and are measured with them.
    """
    state, number = x[:, rows], told.number
    of_state, of_turn = ((each @ CROSS).reshape(-1, 3, 3) for each in (state, x[:, THETA]))
    H = np.zeros((len(x), told.value.shape[-1], x.shape[1]))
    H[:, :, THETA] = told.turn @ of_state
    H[:, :, rows] = told.turn @ (EYE - of_turn)
    seen = (H[:, :, rows] @ state[:, :, None])[:, :, 0]
    if own is not None:
        H[:, :, own] = EYE
        seen += x[:, own]
    nu, HP = told.value - seen, H @ P
    S = HP @ H.transpose(0, 2, 1)
    diagonal = S.reshape(len(S), -1)[:, :: nu.shape[1] + 1]  # a view
    found = np.empty((3, *nu.shape))
    found[0], found[1] = nu, diagonal + R[:, None]
    there = number > 0.0
    taken = there & (nu * nu <= gate[:, None] ** 2 * found[1]).all(axis=1)
    found[2] = taken[:, None]
    found[:, ~there] = np.nan
    diagonal += np.where(there, R / np.maximum(number, 1.0), 1.0)[:, None]
    K = (np.linalg.inv(S) @ HP).transpose(0, 2, 1) * taken[:, None, None]
    x = x + (K @ nu[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + P.transpose(0, 2, 1)), found
