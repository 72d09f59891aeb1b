"""Whether the errors of successive positions hang together: a slow error beside the white noise.

A slow error of first order, c_k = ρ c_(k-1) + √(1 - ρ²) σ_c w, ρ = exp(-Δt/τ), is a third state of
the filter that the measurement sees: z = p + c + v. Its likelihood over a grid of σ_c, τ, white
noise and SIGMA_A, less that without it, is what the slow error explains. A low pass makes errors
hang together too, but its positions lag as well: then earlier stamps fit better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.likelihood import Preintegrated, preintegrate
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.smoothing import middle_of
from px4fuse.flight import Unavailable

# Grid: τ, and both noises and SIGMA_A over those of greatest likelihood without a slow error
TAUS_S = np.geomspace(0.15, 20.0, 9)
WHITE_FACTORS = np.array([0.2, 0.4, 0.55, 0.7, 0.85, 1.0, 1.15])
SLOW_FACTORS = np.array([0.3, 0.5, 0.75, 1.0, 1.4, 2.0])
SIGMA_A_FACTORS = np.array([0.25, 0.5, 0.75, 1.0, 1.5])
# Shares of the lag of a low pass by which the stamps are tried earlier
LAGS = (0.5, 1.0, 1.5)


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
    middle = middle_of(axes, "slow errors of the source")
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
        return _score(legs, bad, sigma_a, white, slow, tau)

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


def _score(
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
