"""True motion in closed form: a smooth path, and the attitude that a quadrotor needs for it.

Velocity changes by ramps Δv · S(x), x = (t - start) / length, with the quintic S = 6x⁵ - 15x⁴ +
10x³, so acceleration is continuous and jerk bounded. A slow deviation of a few sines is added in
the air. Thrust is along the body z axis and there is no drag, so the direction of the specific
force a - g determines the attitude (Mellinger and Kumar 2011, eq. 6 to 8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import constants

from px4fuse.arrays import Array, IntArray
from px4fuse.errors import SettingsError
from px4fuse.simulation.mistakes import Mistakes
from px4fuse.simulation.scenario import CORNER_S, START_STOP_S, Scenario

# s; time on the ground before take-off and after landing
GROUND_S = 6.0
CLIMB_M_S = 0.75
CLIMB_RAMP_S = 1.5
# s; a log of this length has 70 MB
MAX_FLIGHT_S = 3600.0
# s; fade-in and fade-out of the slow deviation after take-off and before landing
FADE_S = 3.0
# s; time of a 180° turn at the end of the aisle with --yaw follow
TURN_ROUND_S = 4.0
WANDER_PERIODS_S = (3.0, 20.0)
WANDER_SINES = 4


def _quintic(x: Array) -> tuple[Array, Array, Array, Array]:
    """Return S(x), which rises from 0 to 1, and its three derivatives."""
    square, slope, complement = x * x, x * (1.0 - x), 1.0 - x
    value = square * x * (6.0 * square - 15.0 * x + 10.0)
    return (
        value,
        30.0 * slope**2,
        60.0 * x * complement * (complement - x),
        60.0 * (1.0 - 6.0 * x * complement),
    )


@dataclass(frozen=True)
class Ramps:
    """Sequence of velocity changes.

    Attributes
    ----------
    start_s, length_s : ndarray, shape (n,)
    change : ndarray, shape (n, k)
        Velocity change of each ramp.
    """

    start_s: Array
    length_s: Array
    change: Array

    @classmethod
    def of(cls, ramps: Sequence[tuple[float, float, Array]]) -> Ramps:
        """Return ramps from tuples of start, length and change."""
        start, length, change = zip(*ramps, strict=True)
        return cls(np.array(start), np.array(length), np.array(change))

    def at(self, time_s: Array) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, acceleration and jerk, shape (n, k), starting at rest at 0."""
        velocity_before = np.cumsum(self.change, axis=0) - self.change
        # displacement of a whole ramp: half its length times its change, plus the previous velocity
        position_gained = (
            velocity_before[:-1] * np.diff(self.start_s)[:, None]
            + self.change[:-1] * (np.diff(self.start_s) - self.length_s[:-1] / 2.0)[:, None]
        )
        position_before = np.vstack(
            [np.zeros((1, self.change.shape[1])), np.cumsum(position_gained, 0)]
        )
        at = np.maximum(np.searchsorted(self.start_s, time_s, side="right") - 1, 0)
        length = self.length_s[at]
        time_in_ramp = time_s - self.start_s[at]
        x = np.clip(time_in_ramp / length, 0.0, 1.0)
        integral = length * (x * x) ** 2 * (x * x - 3.0 * x + 2.5)
        integral += np.maximum(time_in_ramp - length, 0.0)
        step, first, second, _ = _quintic(x)
        # take() is several times faster than indexing
        change, before = self.change.take(at, axis=0), velocity_before.take(at, axis=0)
        return (
            position_before.take(at, axis=0)
            + before * time_in_ramp[:, None]
            + change * integral[:, None],
            before + change * step[:, None],
            change * (first / length)[:, None],
            change * (second / length**2)[:, None],
        )


@dataclass(frozen=True)
class Sines:
    """Sums of sines with the same angular frequencies on every axis.

    Attributes
    ----------
    pulsation_rad_s : ndarray, shape (m,)
    sine, cosine : ndarray, shape (m, k)
        Amplitudes.
    """

    pulsation_rad_s: Array
    sine: Array
    cosine: Array

    @classmethod
    def draw(
        cls, rng: np.random.Generator, rms: Array, periods_s: tuple[float, float], count: int
    ) -> Sines:
        """Draw sines with log-uniform periods and random phases, and a given RMS per axis."""
        low, high = np.log(periods_s)
        pulsation = 2.0 * np.pi / np.exp(rng.uniform(low, high, count))
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, len(rms)))
        amplitude = rms * np.sqrt(2.0 / count)
        return cls(pulsation, amplitude * np.cos(phase), amplitude * np.sin(phase))

    def at(self, time_s: Array, orders: int = 1) -> list[Array]:
        """Return the value and ``orders`` - 1 derivatives, each of shape (n, k)."""
        angle = np.outer(time_s, self.pulsation_rad_s)
        basis = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
        amplitudes = [np.concatenate([self.sine, self.cosine])]
        omega = self.pulsation_rad_s[:, None]
        for _ in range(orders - 1):
            # d/dt (s sin ωt + c cos ωt) = -ωc sin ωt + ωs cos ωt
            sine, cosine = np.split(amplitudes[-1], 2)
            amplitudes.append(np.concatenate([-omega * cosine, omega * sine]))
        return np.split(basis @ np.hstack(amplitudes), orders, axis=1)


@dataclass(frozen=True)
class State:
    """True state at n times, NED; shape (n, 3) unless noted.

    Attributes
    ----------
    position_m, velocity_m_s, acceleration_m_s2, jerk_m_s3 : ndarray
    yaw_rad, yaw_rate_rad_s : ndarray, shape (n,)
    """

    position_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    jerk_m_s3: Array
    yaw_rad: Array
    yaw_rate_rad_s: Array


@dataclass(frozen=True)
class Motion:
    """Planned flight.

    Attributes
    ----------
    path, yaw : Ramps
        Position, shape (n, 3); yaw, whose "velocity" is the angle, shape (m, 1).
    wander : Sines
        Slow deviation from the path.
    take_off_s, touch_down_s, duration_s : float
    """

    path: Ramps
    yaw: Ramps
    wander: Sines
    take_off_s: float
    touch_down_s: float
    duration_s: float

    def at(self, time_s: Array) -> State:
        """Return the true state at given times (s from the first data)."""
        position, velocity, acceleration, jerk = self.path.at(time_s)
        w = self.wander.at(time_s, 4)
        e, inside = self._wander_fade(time_s)
        # product rule (Leibniz) while the deviation fades in or out
        d = [part[inside] for part in w]
        velocity[inside] += e[1] * d[0]
        acceleration[inside] += 2 * e[1] * d[1] + e[2] * d[0]
        jerk[inside] += 3 * e[1] * d[2] + 3 * e[2] * d[1] + e[3] * d[0]
        yaw, yaw_rate = self.yaw.at(time_s)[1:3]
        return State(
            position_m=position + e[0] * w[0],
            velocity_m_s=velocity + e[0] * w[1],
            acceleration_m_s2=acceleration + e[0] * w[2],
            jerk_m_s3=jerk + e[0] * w[3],
            yaw_rad=yaw[:, 0],
            yaw_rate_rad_s=yaw_rate[:, 0],
        )

    def _wander_fade(self, time_s: Array) -> tuple[tuple[Array, Array, Array, Array], IntArray]:
        """Return the fade factor, (n, 1), its derivatives at m indices, (m, 1), and the indices."""
        rise = np.clip((time_s - self.take_off_s) / FADE_S, 0.0, 1.0)
        fall = np.clip((time_s - self.touch_down_s) / FADE_S + 1.0, 0.0, 1.0)
        inside = np.flatnonzero((rise * (1.0 - rise) > 0.0) | (fall * (1.0 - fall) > 0.0))
        # at most one of fade-in and fade-out is active
        down = fall[inside] > 0.0
        sign = np.where(down, -1.0, 1.0)
        _, *derivatives = _quintic(np.where(down, fall[inside], rise[inside]))
        first, second, third = (
            (sign * part / FADE_S**order)[:, None] for order, part in enumerate(derivatives, 1)
        )
        size = _quintic(rise)[0] - _quintic(fall)[0]
        return (size[:, None], first, second, third), inside


@dataclass(frozen=True)
class Attitude:
    """Attitude, and the angular rate and specific force that an ideal IMU measures.

    Attributes
    ----------
    body_to_ned : ndarray, shape (n, 3, 3)
        Columns are the body axes, FRD.
    angular_rate_rad_s : ndarray, shape (n, 3)
        Body FRD.
    specific_force_m_s2 : ndarray, shape (n, 3)
        Body FRD: along the z axis only.
    """

    body_to_ned: Array
    angular_rate_rad_s: Array
    specific_force_m_s2: Array


def attitude(state: State) -> Attitude:
    """Return the attitude whose thrust gives the acceleration, and its closed-form rates."""
    gravity = np.array([0.0, 0.0, constants.g])
    down = gravity - state.acceleration_m_s2  # opposite to thrust
    size = np.sqrt(np.einsum("ij,ij->i", down, down))[:, None]
    z = down / size
    z_rate = -state.jerk_m_s3 / size
    z_rate -= z * np.einsum("ij,ij->i", z, z_rate)[:, None]
    c, s = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
    zx, zy, zz = z.T
    # n = z × [cos ψ, sin ψ, 0], along the body's y axis
    n = np.stack([-zz * s, zz * c, zx * s - zy * c], axis=1)
    ux, uy, uz = z_rate.T
    n_rate = np.stack([-uz * s, uz * c, ux * s - uy * c], axis=1)
    n_rate += state.yaw_rate_rad_s[:, None] * np.stack([-zz * c, -zz * s, zx * c + zy * s], axis=1)
    n_size = np.sqrt(np.einsum("ij,ij->i", n, n))
    y = n / n_size[:, None]
    x = np.cross(y, z)
    # from dR/dt = R [ω]×
    rate = np.stack(
        [
            -np.einsum("ij,ij->i", z_rate, y),
            np.einsum("ij,ij->i", z_rate, x),
            -np.einsum("ij,ij->i", n_rate, x) / n_size,
        ],
        axis=1,
    )
    force = np.zeros_like(z)
    force[:, 2] = -size[:, 0]
    return Attitude(np.stack([x, y, z], axis=2), rate, force)


def plan(scenario: Scenario, mistakes: Mistakes, rng: np.random.Generator) -> Motion:
    """Plan a flight: ground, climb, hover, aisle or square, hover, descent, ground.

    Raises
    ------
    SettingsError
        The open end of the loop is too large, or the flight would be too long.
    """
    ramps = _Plan(GROUND_S, scenario.heading_deg)
    climb = min(CLIMB_M_S, scenario.altitude_m / 2.0)
    rise_s = scenario.altitude_m / climb
    up = np.array([0.0, 0.0, -climb])
    ramps.change(up, CLIMB_RAMP_S, rise_s)
    ramps.change(-up, CLIMB_RAMP_S, CLIMB_RAMP_S / 2.0 + scenario.pause_s)
    if scenario.kind == "aisle":
        _fly_aisle(ramps, scenario, 0.0 if mistakes.no_motion else scenario.speed_m_s)
    else:
        _fly_loop(ramps, scenario, mistakes)
    ramps.change(-up, CLIMB_RAMP_S, rise_s)
    touch_down_s = ramps.centre_s + CLIMB_RAMP_S / 2.0
    if touch_down_s > MAX_FLIGHT_S:
        raise SettingsError(
            f"This flight would take {touch_down_s:.0f} s; the simulation is limited to "
            f"{MAX_FLIGHT_S:g} s. Reduce --passes or --length."
        )
    ramps.change(up, CLIMB_RAMP_S, 0.0)
    return Motion(
        path=Ramps.of(ramps.path),
        yaw=Ramps.of(ramps.yaw),
        wander=Sines.draw(rng, np.full(3, scenario.wander_m), WANDER_PERIODS_S, WANDER_SINES),
        take_off_s=GROUND_S,
        touch_down_s=touch_down_s,
        duration_s=float(np.ceil(touch_down_s + GROUND_S)),
    )


class _Plan:
    """Ramps under construction, placed by their centres: speed × time between centres is exact."""

    def __init__(self, start_s: float, heading_deg: float) -> None:
        self.centre_s = start_s + CLIMB_RAMP_S / 2.0
        self.path: list[tuple[float, float, Array]] = []
        # the nose points along the heading before the first data
        self.yaw = [(-1.0, 1.0, np.radians([heading_deg]))]

    def change(self, velocity: Array, length_s: float, then_s: float) -> None:
        """Change velocity about the current time, then advance to the next centre."""
        self.path.append((self.centre_s - length_s / 2.0, length_s, velocity))
        self.centre_s += then_s

    def turn(self, angle_rad: float, start_s: float, length_s: float) -> None:
        self.yaw.append((start_s, length_s, np.array([angle_rad])))


def direction(heading_deg: float) -> Array:
    """Return a horizontal unit vector, NED, shape (3,)."""
    heading = np.radians(heading_deg)
    return np.array([np.cos(heading), np.sin(heading), 0.0])


def _fly_aisle(ramps: _Plan, scenario: Scenario, speed_m_s: float) -> None:
    velocity = speed_m_s * direction(scenario.heading_deg)
    nose_follows_path = scenario.nose_follows_path and speed_m_s > 0.0
    pause_s = max(scenario.pause_s, TURN_ROUND_S) if nose_follows_path else scenario.pause_s
    ramps.centre_s += START_STOP_S / 2.0
    for number in range(scenario.passes):
        way = velocity if number % 2 == 0 else -velocity
        ramps.change(way, START_STOP_S, scenario.length_m / scenario.speed_m_s)
        stopped_s = ramps.centre_s + START_STOP_S / 2.0
        ramps.change(-way, START_STOP_S, START_STOP_S + pause_s)
        if nose_follows_path and number < scenario.passes - 1:
            ramps.turn(np.pi, stopped_s, TURN_ROUND_S)


def _fly_loop(ramps: _Plan, scenario: Scenario, mistakes: Mistakes) -> None:
    speed = 0.0 if mistakes.no_motion else scenario.speed_m_s
    last_m = scenario.length_m - mistakes.open_end_m
    if last_m < scenario.speed_m_s * CORNER_S:
        raise SettingsError(
            f"--mistake open-end={mistakes.open_end_m:g}: the last side would be {last_m:g} m. "
            f"Use at most {scenario.length_m - scenario.speed_m_s * CORNER_S:g} m."
        )
    sides = 4 * scenario.passes
    before = np.zeros(3)
    ramps.centre_s += START_STOP_S / 2.0
    for side in range(sides):
        velocity = speed * direction(scenario.heading_deg + 90.0 * side)
        length_s = CORNER_S if side else START_STOP_S
        if side and scenario.nose_follows_path and speed > 0.0:
            ramps.turn(np.pi / 2.0, ramps.centre_s - CORNER_S / 2.0, CORNER_S)
        metres = last_m if side == sides - 1 else scenario.length_m
        ramps.change(velocity - before, length_s, metres / scenario.speed_m_s)
        before = velocity
    ramps.change(-before, START_STOP_S, START_STOP_S + scenario.pause_s)
