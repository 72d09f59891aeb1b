"""True motion of a simulated flight: a smooth path, and the attitude of a quadrotor on this path.

Velocity changes are quintic ramps, so the acceleration is continuous. Thrust is along the body z
axis, so the specific force determines roll and pitch (Mellinger and Kumar 2011, eq. 6 to 8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import constants
from scipy.interpolate import BPoly, PPoly

from px4fuse.core.arrays import Array
from px4fuse.errors import SettingsError

from .faults import FaultSizes
from .scenario import CORNER_DURATION_S, SPEED_RAMP_DURATION_S, Scenario

# Time (s) on the ground before take-off and after landing
TIME_ON_GROUND_S = 6.0
# Maximum climb and descent rate (m/s)
MAX_CLIMB_RATE_M_S = 0.75
# Duration (s) of each change of the climb rate
CLIMB_RAMP_DURATION_S = 1.5
# Maximum flight time (s), to limit the size of the log
MAX_FLIGHT_S = 3600.0
# Time (s) in which the path deviation grows after take-off, and shrinks before landing
PATH_DEVIATION_RAMP_DURATION_S = 3.0
# Time (s) of a 180° turn at the end of the straight path with --yaw follow
TURN_ROUND_DURATION_S = 4.0
# Minimum distance (s) of the breakpoints of piecewise polynomials
MIN_POLYNOMIAL_BREAKPOINT_DISTANCE_S = 1e-9
# Range of the periods (s) of the slow deviation from the path, a sum of sines
DEVIATION_PERIOD_RANGE_S = (3.0, 20.0)
# Number of sines in a slow path deviation or sensor error
SLOW_ERROR_SINE_COUNT = 4


def _sum_ramps(ramps: Sequence[tuple[float, float, Array]]) -> PPoly:
    """Return a function of time that is constant between quintic ramps.

    ``ramps`` are tuples of start (s), duration (s) and change. The function starts at zero.
    """
    start_s, duration_s, change = (np.array(values) for values in zip(*ramps, strict=True))
    # Values between the ramps: 0 before the first ramp, then the sums of the changes
    value_after_ramp = np.concatenate([0.0 * change[:1], np.cumsum(change, axis=0)])
    end_s = start_s + duration_s
    # Breakpoints: 1 s before the first ramp, start and end of each ramp, 1 s after the last ramp.
    # The values there are v0, v0, v1, v1, v2, ...: each value is that at the end of a ramp and at
    # the start of the next ramp
    times_s = np.r_[start_s[0] - 1.0, np.column_stack([start_s, end_s]).ravel(), end_s[-1] + 1.0]
    # If two ramps meet, keep only one of the two equal breakpoints
    is_used = np.diff(times_s, prepend=-np.inf) > MIN_POLYNOMIAL_BREAKPOINT_DISTANCE_S
    values = np.repeat(value_after_ramp, 2, axis=0)[is_used]
    # With velocity and acceleration 0 at all breakpoints, the polynomials are quintic
    derivatives = np.stack([values, 0.0 * values, 0.0 * values], axis=1)
    return PPoly.from_bernstein_basis(BPoly.from_derivatives(times_s[is_used], derivatives))


def _differentiate(ramp_function: PPoly, time_s: Array, orders: Sequence[int]) -> list[Array]:
    """Return derivatives of a function of :func:`_sum_ramps`, one array for each order.

    The arrays have the shape (times, components of the function). Order -1 is the integral.
    """
    clipped_times_s = np.clip(time_s, *ramp_function.x[[0, -1]])
    return [ramp_function.derivative(order)(clipped_times_s) for order in orders]


@dataclass(frozen=True)
class Sines:
    """Sum of m sines on each of k axes: angular frequencies (m,), and amplitudes (m, k)."""

    angular_frequency_rad_s: Array
    sine: Array
    cosine: Array

    @classmethod
    def draw(
        cls, rng: np.random.Generator, rms_by_axis: Array, period_range_s: tuple[float, float]
    ) -> Sines:
        """Draw random sines: log-uniform periods, random phases, and one RMS for each axis."""
        low, high = np.log(period_range_s)
        angular_frequency = 2.0 * np.pi / np.exp(rng.uniform(low, high, SLOW_ERROR_SINE_COUNT))
        phase = rng.uniform(0.0, 2.0 * np.pi, (SLOW_ERROR_SINE_COUNT, len(rms_by_axis)))
        amplitude = rms_by_axis * np.sqrt(2.0 / SLOW_ERROR_SINE_COUNT)
        return cls(angular_frequency, amplitude * np.cos(phase), amplitude * np.sin(phase))

    def compute_values(self, time_s: Array, array_count: int = 1) -> list[Array]:
        """Return the oscillation (sum of sines) of each axis, then its time derivatives.

        The result contains ``array_count`` arrays with the shape (times, axes).
        """
        # Shapes for t times, m sines and k axes: basis (t, 2m), with sin and cos of each angle;
        # amplitudes (2m, k)
        angle = np.outer(time_s, self.angular_frequency_rad_s)
        basis = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
        amplitudes = [np.concatenate([self.sine, self.cosine])]
        omega = self.angular_frequency_rad_s[:, None]
        for _ in range(array_count - 1):
            # d/dt (s sin ωt + c cos ωt) = -ωc sin ωt + ωs cos ωt
            sine, cosine = np.split(amplitudes[-1], 2)
            amplitudes.append(np.concatenate([-omega * cosine, omega * sine]))
        # One matrix product gives the values and all derivatives
        return np.split(basis @ np.hstack(amplitudes), array_count, axis=1)


@dataclass(frozen=True)
class TrueState:
    """True state at n times: vectors (NED), shape (n, 3), and yaw and yaw rate, shape (n,)."""

    position_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    jerk_m_s3: Array
    yaw_rad: Array
    yaw_rate_rad_s: Array


@dataclass(frozen=True)
class Motion:
    """True motion of a flight: velocity (NED) and yaw (rad) as functions of time.

    ``path_deviation`` is a slow deviation (m) of the position from the planned path.
    """

    velocity: PPoly
    yaw: PPoly
    path_deviation: Sines
    take_off_s: float
    touch_down_s: float
    duration_s: float

    def compute_true_state(self, time_s: Array) -> TrueState:
        """Return the true state at times in seconds from the first sample."""
        position, velocity, acceleration, jerk = _differentiate(
            self.velocity, time_s, (-1, 0, 1, 2)
        )
        yaw_rad, yaw_rate_rad_s = _differentiate(self.yaw, time_s, (0, 1))
        # factor on the deviation from the path: 1 in the air and 0 on the ground
        path_deviation_ramp = _sum_ramps(
            [
                (self.take_off_s, PATH_DEVIATION_RAMP_DURATION_S, np.array([1.0])),
                (
                    self.touch_down_s - PATH_DEVIATION_RAMP_DURATION_S,
                    PATH_DEVIATION_RAMP_DURATION_S,
                    np.array([-1.0]),
                ),
            ]
        )
        # derivatives of the product factor · deviation (Leibniz rule)
        f0, f1, f2, f3 = _differentiate(path_deviation_ramp, time_s, range(4))
        d0, d1, d2, d3 = self.path_deviation.compute_values(time_s, 4)
        return TrueState(
            position_m=position + f0 * d0,
            velocity_m_s=velocity + f0 * d1 + f1 * d0,
            acceleration_m_s2=acceleration + f0 * d2 + 2.0 * f1 * d1 + f2 * d0,
            jerk_m_s3=jerk + f0 * d3 + 3.0 * (f1 * d2 + f2 * d1) + f3 * d0,
            yaw_rad=yaw_rad[:, 0],
            yaw_rate_rad_s=yaw_rate_rad_s[:, 0],
        )

    def compute_body_to_ned(self, time_s: Array) -> Array:
        """Return the true attitude, shape (n, 3, 3); the columns are the body axes, FRD."""
        return compute_attitude_and_imu(self.compute_true_state(time_s)).body_to_ned


@dataclass(frozen=True)
class AttitudeAndImu:
    """Attitude at n times, with the measurements of an ideal IMU.

    Attributes
    ----------
    body_to_ned : ndarray, shape (n, 3, 3)
        Columns are the body axes, FRD.
    angular_rate_rad_s : ndarray, shape (n, 3)
        Body FRD.
    specific_force_m_s2 : ndarray, shape (n, 3)
        Body FRD; only the z component (thrust) is not zero.
    """

    body_to_ned: Array
    angular_rate_rad_s: Array
    specific_force_m_s2: Array


def compute_attitude_and_imu(state: TrueState) -> AttitudeAndImu:
    """Return attitude, angular rate and specific force of a quadrotor in the true motion."""
    gravity = np.array([0.0, 0.0, constants.g])
    negative_thrust_acceleration_m_s2 = gravity - state.acceleration_m_s2
    specific_thrust_m_s2 = np.sqrt(
        _dot(negative_thrust_acceleration_m_s2, negative_thrust_acceleration_m_s2)
    )[:, None]
    # The thrust is along -z, so z = a/|a| with a = gravity - acceleration, and da/dt = -jerk.
    # dz/dt is da/dt / |a| without its component along z, because z keeps its length
    z = negative_thrust_acceleration_m_s2 / specific_thrust_m_s2
    body_z_derivative_per_s = -state.jerk_m_s3 / specific_thrust_m_s2
    body_z_derivative_per_s -= z * _dot(z, body_z_derivative_per_s)[:, None]
    forward_direction, right_direction = (
        np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        for angle in (state.yaw_rad, state.yaw_rad + np.pi / 2.0)
    )
    # Body y is the unit vector of u = z × f, with the horizontal forward direction f. The yaw rate
    # turns f to the right, so df/dt = yaw rate · right direction. By the product rule, du/dt =
    # dz/dt × f + yaw rate · z × right direction
    unnormalised_y = np.cross(z, forward_direction)
    unnormalised_y_derivative_per_s = np.cross(
        body_z_derivative_per_s, forward_direction
    ) + state.yaw_rate_rad_s[:, None] * np.cross(z, right_direction)
    unnormalised_y_length = np.sqrt(_dot(unnormalised_y, unnormalised_y))
    y = unnormalised_y / unnormalised_y_length[:, None]
    x = np.cross(y, z)
    # Each body axis e moves with de/dt = ω × e, so the angular rate in body axes is ω_x = -y ·
    # dz/dt, ω_y = x · dz/dt and ω_z = -x · dy/dt. Since x is perpendicular to y = u/|u|, x · dy/dt
    # = x · du/dt / |u|
    rate_rad_s = np.stack(
        [
            -_dot(body_z_derivative_per_s, y),
            _dot(body_z_derivative_per_s, x),
            -_dot(unnormalised_y_derivative_per_s, x) / unnormalised_y_length,
        ],
        axis=1,
    )
    specific_force_m_s2 = specific_thrust_m_s2 * np.array([0.0, 0.0, -1.0])
    return AttitudeAndImu(np.stack([x, y, z], axis=2), rate_rad_s, specific_force_m_s2)


def _dot(a: Array, b: Array) -> Array:
    """Return the dot products of two series of vectors, shape (n,)."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def plan_flight(scenario: Scenario, faults: FaultSizes, rng: np.random.Generator) -> Motion:
    """Plan a flight: ground, climb, hover, passes or laps, hover, descent, ground.

    Raises
    ------
    SettingsError
        The last side of the square is too short, or the flight takes too long.
    """
    flight_plan = _FlightBuilder(TIME_ON_GROUND_S, scenario.heading_deg)
    climb_rate_m_s = min(MAX_CLIMB_RATE_M_S, scenario.altitude_m / 2.0)
    climb_time_s = scenario.altitude_m / climb_rate_m_s
    climb_velocity_m_s = np.array([0.0, 0.0, -climb_rate_m_s])
    # distance = full velocity × time between the centres of the ramps in which the velocity
    # increases and decreases
    flight_plan.add_velocity_change(climb_velocity_m_s, CLIMB_RAMP_DURATION_S, climb_time_s)
    # the horizontal flight begins half a ramp and a pause after the centre of the ramp that ends
    # the climb
    flight_plan.add_velocity_change(
        -climb_velocity_m_s, CLIMB_RAMP_DURATION_S, CLIMB_RAMP_DURATION_S / 2.0 + scenario.pause_s
    )
    # without motion, the vehicle hovers for the same time
    speed_m_s = 0.0 if faults.no_motion else scenario.speed_m_s
    if scenario.kind == "aisle":
        _plan_aisle_passes(flight_plan, scenario, speed_m_s)
    else:
        _plan_square_laps(flight_plan, scenario, speed_m_s, faults.open_end_m)
    flight_plan.add_velocity_change(-climb_velocity_m_s, CLIMB_RAMP_DURATION_S, climb_time_s)
    touch_down_s = flight_plan.ramp_centre_s + CLIMB_RAMP_DURATION_S / 2.0
    if touch_down_s > MAX_FLIGHT_S:
        raise SettingsError(
            f"This flight would take {touch_down_s:.0f} s, but the simulation is limited to "
            f"{MAX_FLIGHT_S:g} s. Reduce --passes or --length."
        )
    flight_plan.add_velocity_change(climb_velocity_m_s, CLIMB_RAMP_DURATION_S, 0.0)
    return Motion(
        velocity=_sum_ramps(flight_plan.velocity_ramps),
        yaw=_sum_ramps(flight_plan.yaw_ramps),
        path_deviation=Sines.draw(rng, np.full(3, scenario.wander_m), DEVIATION_PERIOD_RANGE_S),
        take_off_s=TIME_ON_GROUND_S,
        touch_down_s=touch_down_s,
        duration_s=float(np.ceil(touch_down_s + TIME_ON_GROUND_S)),
    )


class _FlightBuilder:
    """Builder of a flight from velocity ramps and yaw ramps.

    ``ramp_centre_s`` is the centre of the next velocity ramp.
    """

    def __init__(self, climb_start_s: float, heading_deg: float) -> None:
        self.ramp_centre_s = climb_start_s + CLIMB_RAMP_DURATION_S / 2.0
        self.velocity_ramps: list[tuple[float, float, Array]] = []
        # initial yaw: a ramp that ends before the first sample
        self.yaw_ramps = [(-1.0, 1.0, np.radians([heading_deg]))]

    def add_velocity_change(
        self, velocity_change_m_s: Array, duration_s: float, time_to_next_ramp_s: float
    ) -> None:
        """Append a velocity ramp; the centre of the next ramp is ``time_to_next_ramp_s`` later."""
        self.velocity_ramps.append(
            (self.ramp_centre_s - duration_s / 2.0, duration_s, velocity_change_m_s)
        )
        self.ramp_centre_s += time_to_next_ramp_s


def compute_direction(heading_deg: float) -> Array:
    """Return the horizontal unit vector (NED) of a heading in degrees."""
    heading_rad = np.radians(heading_deg)
    return np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])


def _plan_aisle_passes(flight_plan: _FlightBuilder, scenario: Scenario, speed_m_s: float) -> None:
    """Add the passes along the aisle: accelerate, fly straight, stop, pause, and fly back."""
    velocity_m_s = speed_m_s * compute_direction(scenario.heading_deg)
    heading_follows_path = scenario.nose_follows_path and speed_m_s > 0.0
    pause_s = max(scenario.pause_s, TURN_ROUND_DURATION_S if heading_follows_path else 0.0)
    # ramp_centre_s is now the end of the pause. The first ramp starts then, so its centre is half a
    # ramp later
    flight_plan.ramp_centre_s += SPEED_RAMP_DURATION_S / 2.0
    for pass_index in range(scenario.passes):
        pass_velocity_m_s = velocity_m_s if pass_index % 2 == 0 else -velocity_m_s
        # Time between the centres of the start ramp and of the stop ramp. speed_m_s would not give
        # it, because it is 0 for a flight without motion: the vehicle then hovers for this time
        flight_plan.add_velocity_change(
            pass_velocity_m_s, SPEED_RAMP_DURATION_S, scenario.length_m / scenario.speed_m_s
        )
        # The vehicle turns after the end of the ramp in which it stops
        stop_time_s = flight_plan.ramp_centre_s + SPEED_RAMP_DURATION_S / 2.0
        flight_plan.add_velocity_change(
            -pass_velocity_m_s, SPEED_RAMP_DURATION_S, SPEED_RAMP_DURATION_S + pause_s
        )
        if heading_follows_path and pass_index < scenario.passes - 1:
            flight_plan.yaw_ramps.append((stop_time_s, TURN_ROUND_DURATION_S, np.array([np.pi])))


def _plan_square_laps(
    flight_plan: _FlightBuilder, scenario: Scenario, speed_m_s: float, open_end_m: float
) -> None:
    """Add laps along a square, with a turn to the right by 90° at each corner."""
    max_open_end_m = scenario.length_m - scenario.speed_m_s * CORNER_DURATION_S
    if open_end_m > max_open_end_m:
        raise SettingsError(
            f"--mistake open-end={open_end_m:g}: the distance from start to end of the path is too "
            f"large. Use at most {max_open_end_m:g} m."
        )
    side_count = 4 * scenario.passes
    previous_velocity_m_s = np.zeros(3)
    # ramp_centre_s is now the end of the pause. The first ramp starts then, so its centre is half a
    # ramp later
    flight_plan.ramp_centre_s += SPEED_RAMP_DURATION_S / 2.0
    for side_index in range(side_count):
        velocity_m_s = speed_m_s * compute_direction(scenario.heading_deg + 90.0 * side_index)
        ramp_duration_s = CORNER_DURATION_S if side_index else SPEED_RAMP_DURATION_S
        # The vehicle turns by 90° during the velocity change of the corner
        if side_index and scenario.nose_follows_path and speed_m_s > 0.0:
            turn_start_s = flight_plan.ramp_centre_s - CORNER_DURATION_S / 2.0
            flight_plan.yaw_ramps.append((turn_start_s, CORNER_DURATION_S, np.array([np.pi / 2.0])))
        is_last_side = side_index == side_count - 1
        side_length_m = scenario.length_m - (open_end_m if is_last_side else 0.0)
        # velocity_m_s is 0 for a flight without motion. The duration of a side is therefore
        # computed from the speed of the scenario
        flight_plan.add_velocity_change(
            velocity_m_s - previous_velocity_m_s,
            ramp_duration_s,
            side_length_m / scenario.speed_m_s,
        )
        previous_velocity_m_s = velocity_m_s
    flight_plan.add_velocity_change(
        -previous_velocity_m_s, SPEED_RAMP_DURATION_S, SPEED_RAMP_DURATION_S + scenario.pause_s
    )
