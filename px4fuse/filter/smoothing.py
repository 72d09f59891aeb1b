"""Whether a source low-pass filters its positions before it sends them.

A low pass of first order, z_k = (1 - ρ) u_k + ρ z_(k-1), makes the noise of successive positions
agree (correlation ρ) and the positions lag behind the motion. Undone, u_k = (z_k - ρ z_(k-1)) /
(1 - ρ), it gives back positions whose noise is white and which do not lag. So the likelihood of
what was sent is that of the filter on u, times the Jacobian (1 - ρ)^-n of undoing it, and ρ is
found by its maximum, the noises fitted at each. A clock that is late, the other reading of a lag,
is tried beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, too_few
from px4fuse.flight import Unavailable

MIN_MEASUREMENTS = 100
# Longer flights are judged by their middle, which is enough
MAX_MEASUREMENTS = 1000
# Correlations that are tried, from none on
CORRELATIONS = np.array([0.0, 0.2, 0.35, 0.5, 0.6, 0.7, 0.78, 0.85, 0.9, 0.94])
# Where no low pass up to here makes them more likely, there is none
FIRST_CORRELATIONS = 0.3
SIGMA_A_FACTORS = np.geomspace(0.2, 2.5, 7)
SIGMA_Z_FACTORS = np.geomspace(0.5, 4.0, 9)
# Intervals longer than this many median ones begin anew: the low pass has forgotten
GAP_INTERVALS = 3.0


@dataclass(frozen=True)
class Smoothing:
    """A low pass in the source.

    Attributes
    ----------
    correlation : float
        Of the noise of successive positions; 0 where there is no low pass.
    lag_s : float
        By how much positions come behind the motion: its time constant.
    gain_nats : float
        Log-likelihood above that of no low pass, with the stamps as they are or moved.
    sigma_z_m : float
        White noise of a single position before the low pass.
    """

    correlation: float
    lag_s: float
    gain_nats: float
    sigma_z_m: float


def smoothing(
    axes: tuple[Axis, ...],
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    clock_offset_s: float = 0.0,
) -> Smoothing | Unavailable:
    """Look for a low pass in the source.

    Parameters
    ----------
    axes : tuple of Axis
        With the same measurement times.
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_a_m_s2, sigma_z_m : float
        Noises of greatest likelihood without a low pass, around which both are searched.
    outlier_time_s : ndarray
        Measurements to leave out.
    clock_offset_s : float
        What would have to be added to the stamps if there were no low pass.
    """
    middle = middle_of(axes, "low pass in the source")
    if isinstance(middle, Unavailable):
        return middle
    time = middle[0].measurement_time_s
    bad = np.isin(time, outlier_time_s)
    level = sigma_a_m_s2 * SIGMA_A_FACTORS[:, None], sigma_z_m * SIGMA_Z_FACTORS[None, :]
    settings = replace(settings, input="imu")

    def score(correlation: float, offset_s: float) -> tuple[float, float]:
        moved = [replace(axis, measurement_time_s=time + offset_s) for axis in middle]
        return _score(moved, settings, bad, correlation, level)

    plain = score(0.0, 0.0)[0]
    if clock_offset_s:
        plain = min(plain, score(0.0, clock_offset_s)[0])
    found = plain, 0.0, sigma_z_m
    # from none on, for as long as more of it makes the positions more likely
    for correlation in CORRELATIONS[1:].tolist():
        here, sigma = score(correlation, 0.0)
        if here >= found[0] and (found[1] > 0.0 or correlation > FIRST_CORRELATIONS):
            break
        found = min(found, (here, correlation, sigma))
    # then between that and its neighbours
    place = int(np.searchsorted(CORRELATIONS, found[1]))
    around = CORRELATIONS[place - 1 : place + 2] if place else np.zeros(0)
    for correlation in ((around[:-1] + around[1:]) / 2.0).tolist():
        here, sigma = score(correlation, 0.0)
        found = min(found, (here, correlation, sigma))
    best, at, noise = found
    lag = -float(np.median(np.diff(time)) / np.log(at)) if at else 0.0
    return Smoothing(at, lag, plain - best, noise)


def middle_of(axes: tuple[Axis, ...], what: str) -> list[Axis] | Unavailable:
    """The measurements in the middle of a flight, as many as are enough; why not where too few.

    Parameters
    ----------
    axes : tuple of Axis
        With the same measurement times.
    what : str
        What is looked for in them, with the acceleration.
    """
    if isinstance(axes[0].acceleration, Unavailable):
        return axes[0].acceleration
    count = len(axes[0].measurement_time_s)
    if count < MIN_MEASUREMENTS:
        return too_few(what, count, MIN_MEASUREMENTS)
    first = max(0, (count - MAX_MEASUREMENTS) // 2)
    part = slice(first, first + MAX_MEASUREMENTS)
    return [
        replace(
            axis,
            measurement_time_s=axis.measurement_time_s[part],
            measurement_m=axis.measurement_m[part],
        )
        for axis in axes
    ]


def _score(
    axes: list[Axis],
    settings: Settings,
    bad: BoolArray,
    correlation: float,
    level: tuple[Array, Array],
) -> tuple[float, float]:
    """Least negative log-likelihood with a low pass undone, and the SIGMA_Z at it."""
    time = axes[0].measurement_time_s
    interval = np.diff(time, prepend=time[0])
    known = (interval < GAP_INTERVALS * np.median(interval[1:])) & (interval > 0.0)
    kept = np.where(known, correlation, 0.0)
    # what was undone with an outlier is one too
    skip = bad | (known & np.concatenate([[False], bad[:-1]]) & (correlation > 0.0))
    # the noise that was sent is √((1 - ρ)/(1 + ρ)) of that before
    sigma_z = level[1] * np.sqrt((1.0 + correlation) / (1.0 - correlation))
    total = np.zeros(np.broadcast(*level).shape)
    for axis in axes:
        sent = axis.measurement_m
        before = np.concatenate([sent[:1], sent[:-1]])
        undone = replace(axis, measurement_m=(sent - kept * before) / (1.0 - kept))
        legs = preintegrate(undone, settings)
        used = ~skip[-len(legs.measurement_m) :]
        nu, s = innovations(legs, level[0], sigma_z, ~used)
        jacobian = float(np.sum(np.log1p(-kept[-len(used) :][used])))
        score = np.log(2.0 * np.pi * s[used]) + nu[used] ** 2 / s[used]
        total += 0.5 * score.sum(axis=0) + jacobian
    row, column = np.unravel_index(np.argmin(total), total.shape)
    return float(total[row, column]), float(sigma_z[0, column])
