"""Whether the errors of successive positions hang together: a low pass, or a slow error.

A low pass of first order, z_k = (1 - ρ) u_k + ρ z_(k-1), makes the noise of successive positions
agree (correlation ρ) and the positions lag behind the motion. Undone, u_k = (z_k - ρ z_(k-1)) /
(1 - ρ), it gives back positions whose noise is white and which do not lag. So the likelihood of
what was sent is that of the filter on u, times the Jacobian (1 - ρ)^-n of undoing it, and ρ is
found by its maximum, the noises fitted at each. A clock that is late, the other reading of a lag,
is tried beside it.

A slow error of first order, c_k = ρ c_(k-1) + √(1 - ρ²) σ_c w, ρ = exp(-Δt/τ), is a third state of
the filter that the measurement sees: z = p + c + v. Its likelihood over a grid of σ_c, τ, white
noise and SIGMA_A, less that without it, is what the slow error explains. A low pass makes errors
hang together too, but its positions lag as well: then earlier stamps fit better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.likelihood import Preintegrated, innovations, preintegrate
from px4fuse.filter.model import INITIAL_COVARIANCE
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
LOW_PASS_SIGMA_A_FACTORS = np.geomspace(0.2, 2.5, 7)
LOW_PASS_SIGMA_Z_FACTORS = np.geomspace(0.5, 4.0, 9)
# Intervals longer than this many median ones begin anew: the low pass has forgotten
GAP_INTERVALS = 3.0
# Grid: τ, and both noises and SIGMA_A over those of greatest likelihood without a slow error
TAUS_S = np.geomspace(0.15, 20.0, 9)
WHITE_FACTORS = np.array([0.2, 0.4, 0.55, 0.7, 0.85, 1.0, 1.15])
SLOW_FACTORS = np.array([0.3, 0.5, 0.75, 1.0, 1.4, 2.0])
SIGMA_A_FACTORS = np.array([0.25, 0.5, 0.75, 1.0, 1.5])
# Shares of the lag of a low pass by which the stamps are tried earlier
LAGS = (0.5, 1.0, 1.5)


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
    middle = _middle(axes, "low pass in the source")
    if isinstance(middle, Unavailable):
        return middle
    time = middle[0].measurement_time_s
    bad = np.isin(time, outlier_time_s)
    level = (
        sigma_a_m_s2 * LOW_PASS_SIGMA_A_FACTORS[:, None],
        sigma_z_m * LOW_PASS_SIGMA_Z_FACTORS[None, :],
    )
    settings = replace(settings, input="imu")

    def score(correlation: float, offset_s: float) -> tuple[float, float]:
        moved = [replace(axis, measurement_time_s=time + offset_s) for axis in middle]
        return _low_pass_score(moved, settings, bad, correlation, level)

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


def _middle(axes: tuple[Axis, ...], what: str) -> list[Axis] | Unavailable:
    """The measurements in the middle of a flight, as many as are enough; why not where too few."""
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


def _low_pass_score(
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


@dataclass(frozen=True)
class Coloured:
    """A slow error beside the white noise of the positions.

    Attributes
    ----------
    tau_s : float
        Time in which it forgets itself.
    slow_m, white_m : float
        Standard deviations of both parts, per axis.
    gain_nats : float
        Log-likelihood above that of white noise alone.
    lag_nats : float
        What earlier stamps add to that: of a low pass, which lags.
    """

    tau_s: float
    slow_m: float
    white_m: float
    gain_nats: float
    lag_nats: float

    @property
    def share(self) -> float:
        """Share of the variance that is slow."""
        return self.slow_m**2 / (self.slow_m**2 + self.white_m**2)


def coloured(
    axes: tuple[Axis, ...],
    settings: Settings,
    *,
    sigma_a_m_s2: float,
    sigma_z_m: float,
    outlier_time_s: Array,
    lag_s: float,
) -> Coloured | Unavailable:
    """Look for a slow error of the source.

    Parameters
    ----------
    axes : tuple of Axis
        With the same measurement times.
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_a_m_s2, sigma_z_m : float
        Noises of greatest likelihood without a slow error.
    outlier_time_s : ndarray
        Measurements to leave out.
    lag_s : float
        Of the low pass that explains the innovations most.
    """
    middle = _middle(axes, "slow errors of the source")
    if isinstance(middle, Unavailable):
        return middle
    time = middle[0].measurement_time_s
    bad = np.isin(time, outlier_time_s)
    settings = replace(settings, input="imu")
    sigma_a = sigma_a_m_s2 * SIGMA_A_FACTORS[:, None, None, None]
    white = sigma_z_m * WHITE_FACTORS[None, :, None, None]
    slow = sigma_z_m * SLOW_FACTORS[None, None, :, None]

    def score_at(offset_s: float, slow: Array, tau: Array) -> Array:
        legs = [
            preintegrate(replace(axis, measurement_time_s=time + offset_s), settings)
            for axis in middle
        ]
        return _slow_score(legs, bad, sigma_a, white, slow, tau)

    plain = score_at(0.0, np.zeros(1), np.ones(1))
    score = score_at(0.0, slow, TAUS_S)
    earlier = min(score_at(-share * lag_s, slow, TAUS_S).min() for share in LAGS)
    _, at_white, at_slow, at_tau = np.unravel_index(np.argmin(score), score.shape)
    return Coloured(
        tau_s=float(TAUS_S[at_tau]),
        slow_m=float(sigma_z_m * SLOW_FACTORS[at_slow]),
        white_m=float(sigma_z_m * WHITE_FACTORS[at_white]),
        gain_nats=float(plain.min() - score.min()),
        lag_nats=float(score.min() - earlier),
    )


def _slow_score(
    legs: list[Preintegrated], bad: BoolArray, sigma_a: Array, white: Array, slow: Array, tau: Array
) -> Array:
    """-ln p of all axes but for a constant, over a grid of settings."""
    q, r, c, tau = np.broadcast_arrays(sigma_a**2, white**2, slow**2, tau)
    total = np.zeros(q.shape)
    for leg in legs:
        used = ~bad[-len(leg.measurement_m) :]
        p = np.full(q.shape, leg.initial.position_m)
        v = np.full(q.shape, leg.initial.velocity_m_s)
        e = np.zeros(q.shape)
        # P of position, velocity and slow error, by its elements
        pp, pv, vv = (np.full(q.shape, part) for part in INITIAL_COVARIANCE)
        pe, ve, ee = np.zeros(q.shape), np.zeros(q.shape), c.copy()
        for k, (dt, dp, dv, z) in enumerate(
            zip(leg.length_s.tolist(), leg.delta_position_m.tolist(),
                leg.delta_velocity_m_s.tolist(), leg.measurement_m.tolist(), strict=True)
        ):  # fmt: skip
            unit, fixed = leg.noise_unit[k], leg.noise_fixed[k]
            rho = np.exp(-dt / tau)
            p, v, e = p + dt * v + dp, v + dv, rho * e
            pp = pp + 2.0 * dt * pv + dt * dt * vv + q * unit[0] + fixed[0]
            pv = pv + dt * vv + q * unit[1] + fixed[1]
            vv = vv + q * unit[2] + fixed[2]
            pe, ve = rho * (pe + dt * ve), rho * ve
            ee = rho * rho * ee + (1.0 - rho * rho) * c
            if not used[k]:
                continue
            # H = [1, 0, 1]
            hp, hv, he = pp + pe, pv + ve, pe + ee
            s = hp + he + r
            nu = z - p - e
            total += 0.5 * (np.log(s) + nu * nu / s)
            kp, kv, ke = hp / s, hv / s, he / s
            p, v, e = p + kp * nu, v + kv * nu, e + ke * nu
            pp, pv, vv = pp - kp * hp, pv - kp * hv, vv - kv * hv
            pe, ve, ee = pe - kp * he, ve - kv * he, ee - ke * he
    return total
