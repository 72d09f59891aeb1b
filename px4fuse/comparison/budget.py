"""Difference budget: what makes our filter and EKF2 differ, by replaying with EKF2's choices.

Our filter is run again with one thing made like EKF2's, and again with everything but that one,
and each run's difference to EKF2 is compared with that of the filter as set. Effects overlap, so
neither shares of single causes nor their losses add up to what all of them do together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray
from px4fuse.comparison.comparison import AxisComparison, Comparison
from px4fuse.comparison.projection import MIN_COMMON_SAMPLES, observation_variance
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import Settings, timeline
from px4fuse.filter.likelihood import filtered, preintegrate
from px4fuse.filter.model import move
from px4fuse.filter.signals import AISLE, Axis, Segment, ned_acceleration, project_acceleration
from px4fuse.flight import (
    EXTERNAL_VISION_RUNGS,
    SPECIFIC_FORCE_COLUMNS,
    Ekf2,
    Flight,
    PositionTrack,
    Unavailable,
    sample_rate,
)

# Of the axes, those that the report shows where there is an aisle
REPORTED = (AISLE, "down")
# EKF2_ACC_NOISE (m/s²), the same in every release read, v1.9 to main (ekf2_params.c)
DEFAULT_ACC_NOISE_M_S2 = 0.35
# An attitude at this share of the IMU's rate is as good as at its full rate
FULL_RATE = 0.8
# Changes of the error smaller than this share of it are not worth a word
NOTABLE = 0.05
# Fused samples are stamped half a prediction earlier; beyond that, stamps agree to this (s)
STAMP_TOLERANCE_S = 2e-3


@dataclass(frozen=True)
class Fit:
    """How far one run of our filter is from EKF2 and from the truth, at EKF2's sample times.

    Root mean squares, in m and m/s; those against truth are None where there is none.
    """

    position_rms_m: float
    velocity_rms_m_s: float
    truth_position_rmse_m: float | None
    truth_velocity_rmse_m_s: float | None


@dataclass(frozen=True)
class Effect:
    """What one cause does.

    Attributes
    ----------
    made : str
        What was made like EKF2's, with its numbers.
    alone : Fit
        With this one made like EKF2's and all else as set.
    without : Fit or None
        With all but this one made like EKF2's; None where the cause is not one of EKF2's choices.
    position_share, velocity_share : float
        1 - (RMS after / RMS before)², of ``alone``; negative where it makes the difference larger.
    """

    made: str
    alone: Fit
    without: Fit | None
    position_share: float
    velocity_share: float


@dataclass(frozen=True)
class AgainstTruthBudget:
    """Which filter is closer to the truth.

    Attributes
    ----------
    kf_position_rmse_m, ekf2_position_rmse_m : float
    kf_velocity_rmse_m_s, ekf2_velocity_rmse_m_s : float or None
    reasons : tuple of str
        Sentences made from replays against the truth: position, then velocity.
    """

    kf_position_rmse_m: float
    ekf2_position_rmse_m: float
    kf_velocity_rmse_m_s: float | None
    ekf2_velocity_rmse_m_s: float | None
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Budget:
    """The difference budget of one axis.

    Attributes
    ----------
    count : int
        Samples of EKF2 that all runs are compared at.
    baseline : Fit
        The filter as set.
    causes : mapping from name to Effect or Unavailable
    together : Effect
        All causes made like EKF2's at once, so that ``alone`` is what is left over.
    clock : Effect or Unavailable
        The source's stamps moved by the clock offset found. EKF2 had the same wrong stamps, so it
        is not one of the causes.
    truth : AgainstTruthBudget or Unavailable
    """

    count: int
    baseline: Fit
    causes: Mapping[str, Effect | Unavailable]
    together: Effect
    clock: Effect | Unavailable
    truth: AgainstTruthBudget | Unavailable


@dataclass(frozen=True)
class Run:
    """What a replay of the budget depends on.

    Attributes
    ----------
    axis : Axis
    settings : Settings
    left_out : ndarray of bool, shape (n,)
        Measurements of the axis that are not fused.
    horizon_s : float
        The state at t knows measurements up to t - horizon.
    """

    axis: Axis
    settings: Settings
    left_out: BoolArray
    horizon_s: float = 0.0


@dataclass(frozen=True)
class Given:
    """What the causes look at.

    Attributes
    ----------
    flight : Flight
    ekf2 : Ekf2
    source : PositionTrack
    segment : Segment
    settings : Settings
        Of the comparison.
    axis : Axis
        Of the comparison.
    innovations : DataFrame or Unavailable
        EKF2's along the axis.
    corrected : DataFrame or Unavailable
        Acceleration in NED with EKF2's accelerometer bias taken off (m/s²).
    """

    flight: Flight
    ekf2: Ekf2
    source: PositionTrack
    segment: Segment
    settings: Settings
    axis: Axis
    innovations: pd.DataFrame | Unavailable
    corrected: pd.DataFrame | Unavailable


Change = Callable[[Run], Run]
Made = tuple[Change, str]


def budget(
    comparison: Comparison,
    clock: ClockOffset | Unavailable,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Budget | Unavailable]:
    """Difference budget of the aisle and down, or of all axes where there is no aisle.

    Parameters
    ----------
    comparison : Comparison
    clock : ClockOffset or Unavailable
    progress : callable
        Told what is being done.

    Returns
    -------
    mapping from axis name to Budget or Unavailable
    """
    results = {result.axis.name: result for result in comparison.axes}
    names = [name for name in REPORTED if name in results] if AISLE in results else list(results)
    corrected = _corrected_acceleration(comparison.flight)
    found = {}
    for name in names:
        progress(f"difference budget, {name}")
        found[name] = _axis_budget(comparison, clock, results[name], corrected)
    return found


def _axis_budget(
    comparison: Comparison,
    clock: ClockOffset | Unavailable,
    result: AxisComparison,
    corrected: pd.DataFrame | Unavailable,
) -> Budget | Unavailable:
    ekf2 = comparison.flight.ekf2
    if isinstance(ekf2, Unavailable):
        return ekf2
    if isinstance(result.ekf2_state, Unavailable):
        return result.ekf2_state
    if isinstance(result.difference, Unavailable):
        return result.difference
    given = Given(
        comparison.flight, ekf2, comparison.source, comparison.segment, comparison.settings,
        result.axis, result.ekf2_innovations, corrected,
    )  # fmt: skip
    start = Run(
        result.axis, comparison.settings, np.zeros(len(result.axis.measurement_m), dtype=bool)
    )
    inside = result.ekf2_state.loc[
        result.replay.steps.index[0] : result.replay.steps.index[-1]
    ].dropna()
    if len(inside) < MIN_COMMON_SAMPLES:
        return Unavailable(
            "difference budget", f"{len(inside)} common samples", "Analyse more of the log."
        )
    against = _Against(inside, result.truth)
    made = {name: cause(given) for name, cause in CAUSES.items()}
    changes = {name: part[0] for name, part in made.items() if not isinstance(part, Unavailable)}
    if not changes:
        return Unavailable(
            "difference budget",
            "the log tells none of EKF2's choices",
            "Use the ULog of a PX4 flight.",
        )
    baseline = against.fit(start)
    together = against.fit(_changed(start, changes.values()))

    def effect(name: str) -> Effect | Unavailable:
        part = made[name]
        if isinstance(part, Unavailable):
            return part
        others = [change for other, change in changes.items() if other != name]
        alone, without = against.fit(part[0](start)), against.fit(_changed(start, others))
        return _effect(part[1], baseline, alone, without)

    causes = {name: effect(name) for name in CAUSES}
    moved = _clock(clock)
    return Budget(
        count=len(inside),
        baseline=baseline,
        causes=causes,
        together=_effect(", ".join(changes), baseline, together, None),
        clock=moved
        if isinstance(moved, Unavailable)
        else _effect(moved[1], baseline, against.fit(moved[0](start)), None),
        truth=_verdict(against, baseline, causes, together, result.truth),
    )


def _effect(made: str, before: Fit, after: Fit, without: Fit | None) -> Effect:
    return Effect(
        made=made,
        alone=after,
        without=without,
        position_share=_share(before.position_rms_m, after.position_rms_m),
        velocity_share=_share(before.velocity_rms_m_s, after.velocity_rms_m_s),
    )


def _share(before: float, after: float) -> float:
    """Share of the mean square difference that is gone."""
    return 1.0 - (after / before) ** 2 if before > 0.0 else 0.0


def _changed(run: Run, changes: Iterable[Change]) -> Run:
    for change in changes:
        run = change(run)
    return run


def _corrected_acceleration(flight: Flight) -> pd.DataFrame | Unavailable:
    """Acceleration in NED from the specific force less EKF2's own bias estimate."""
    if isinstance(flight.ekf2, Unavailable):
        return flight.ekf2
    bias = flight.ekf2.accelerometer_bias
    if isinstance(bias, Unavailable):
        return bias
    if isinstance(flight.imu, Unavailable):
        return flight.imu
    imu = flight.imu.assign(
        **{
            column: flight.imu[column] - np.interp(flight.imu.index, bias.index, bias[column])
            for column in SPECIFIC_FORCE_COLUMNS
        }
    )
    return ned_acceleration(replace(flight, imu=imu))


# The causes: each looks at the log and says how a run is made like EKF2, or why it cannot be


def _measurement_variance(given: Given) -> Made | Unavailable:
    if (reason := _not_fused(given)) is not None:
        return reason
    if isinstance(given.innovations, pd.DataFrame):
        r = float(given.innovations["observation_variance_m2"].median())
    else:
        r = observation_variance(given.flight, given.source, given.axis, given.segment)
    if not r > 0.0:
        return Unavailable(
            "EKF2's measurement variance",
            "neither its observation variance nor EKF2_EVP_NOISE is in the log",
            "Record a ULog with SDLOG_PROFILE 129 (default and vision).",
        )
    sigma_z = float(np.sqrt(r))
    return (
        lambda run: replace(run, settings=replace(run.settings, sigma_z_m=sigma_z)),
        f"SIGMA_Z {sigma_z:.3g} m (√ of EKF2's median R), ours {given.settings.sigma_z_m:.3g} m",
    )


def _process_noise(given: Given) -> Made | Unavailable:
    """EKF2 adds (EKF2_ACC_NOISE · dt)² to the velocity variance at each prediction of length dt."""
    if given.flight.log.autopilot != "PX4":
        return Unavailable(
            "EKF2's process noise", f"{given.flight.log.autopilot} has no EKF2_ACC_NOISE", "None."
        )
    if given.settings.input != "imu":
        return Unavailable(
            "EKF2's process noise",
            "EKF2_ACC_NOISE is of the accelerometer, which this replay does not use",
            "Replay with --input imu.",
        )
    logged = given.flight.log.parameters.get("EKF2_ACC_NOISE")
    noise = DEFAULT_ACC_NOISE_M_S2 if logged is None else logged
    # per second: noise² dt of EKF2 is SIGMA_A² DT of ours
    sigma_a = noise * float(np.sqrt(given.ekf2.step_s / given.settings.dt_s))
    whence = "default, not in the log" if logged is None else "as logged"
    return (
        lambda run: replace(run, settings=replace(run.settings, sigma_a_m_s2=sigma_a)),
        f"SIGMA_A {sigma_a:.3g} m/s² (EKF2_ACC_NOISE {noise:.3g}, {whence}, per "
        f"{given.ekf2.step_s * 1e3:.3g} ms), ours {given.settings.sigma_a_m_s2:.3g} m/s²",
    )


def _delay(given: Given) -> Made | Unavailable:
    """EKF2 takes measurements to be EKF2_EV_DELAY older than their stamps.

    It subtracts half a prediction step more (estimator_interface.cpp), which fusing at the next
    prediction gives back on average, so that the half step is no delay.
    """
    if (reason := _not_fused(given)) is not None:
        return reason
    shift = _ekf2_shift_s(given)
    if isinstance(shift, Unavailable):
        return shift
    own = given.settings.clock_offset_s
    words = f"EKF2_EV_DELAY {abs(shift + own) * 1e3:.0f} ms"
    words += f", and without our clock offset of {own:+.3g} s" if own else ", ours 0"
    return lambda run: _shifted(run, shift), words


def _accelerometer_bias(given: Given) -> Made | Unavailable:
    if given.settings.input != "imu":
        return Unavailable(
            "EKF2 accelerometer bias",
            "this replay does not use the accelerometer",
            "Replay with --input imu.",
        )
    if isinstance(given.corrected, Unavailable):
        return given.corrected
    acceleration = project_acceleration(given.corrected, given.axis.direction, given.segment)
    if isinstance(acceleration, Unavailable):
        return acceleration
    bias = given.ekf2.accelerometer_bias
    assert isinstance(bias, pd.DataFrame)
    middle = bias[SPECIFIC_FORCE_COLUMNS].median()
    return (
        lambda run: replace(run, axis=replace(run.axis, acceleration=acceleration)),
        "median "
        + ", ".join(f"{value:+.3f}" for value in middle)
        + " m/s² (forward, right, down) taken off the IMU",
    )


def _rejected_samples(given: Given) -> Made | Unavailable:
    if (reason := _not_fused(given)) is not None:
        return reason
    if isinstance(given.innovations, Unavailable):
        return given.innovations
    shift = _ekf2_shift_s(given)
    if isinstance(shift, Unavailable):
        return shift
    rejected = given.innovations.index[given.innovations["rejected"] > 0].to_numpy()
    measured = given.axis.measurement_time_s + shift
    # an innovation belongs to the newest measurement that EKF2 can have had by its time
    fused = measured - given.ekf2.step_s / 2.0 - STAMP_TOLERANCE_S
    at = np.searchsorted(fused, rejected, side="right") - 1
    near = (at >= 0) & (rejected - fused[at] < float(np.median(np.diff(measured))))
    left_out = np.zeros(len(measured), dtype=bool)
    left_out[at[near]] = True
    unfused = _too_few(left_out)
    if unfused is not None:
        return unfused
    count = len(given.innovations)
    known = "" if count >= 0.9 * len(measured) else f"; the log has {count} innovations only"
    return (
        lambda run: replace(run, left_out=run.left_out | left_out),
        f"{np.count_nonzero(left_out)} of {len(measured)} measurements left out{known}",
    )


def _gaps_of_fusion(given: Given) -> Made | Unavailable:
    if (reason := _not_fused(given)) is not None:
        return reason
    fusing = given.ekf2.fusing
    if isinstance(fusing, Unavailable):
        return fusing
    steps = fusing[_fusing_column(given.axis)]
    time = given.axis.measurement_time_s
    at = np.clip(np.searchsorted(steps.index.to_numpy(), time, side="right") - 1, 0, None)
    left_out = steps.to_numpy()[at] == 0.0
    unfused = _too_few(left_out)
    if unfused is not None:
        return unfused
    return (
        lambda run: replace(run, left_out=run.left_out | left_out),
        f"{np.count_nonzero(left_out)} of {len(time)} measurements left out",
    )


def _fusion_horizon(given: Given) -> Made | Unavailable:
    """EKF2 fuses behind time and carries the result to now by the IMU.

    Its output predictor also smooths the corrections (EKF2_TAU_POS, EKF2_TAU_VEL), which is not
    replayed.
    """
    horizon = given.ekf2.horizon_s
    if isinstance(horizon, Unavailable):
        return horizon
    return (
        lambda run: replace(run, horizon_s=horizon),
        f"measurements act {horizon * 1e3:.0f} ms late, the IMU bridges that time",
    )


def _full_attitude_rate(given: Given) -> Unavailable:
    """Always unavailable: what the log lacks cannot be replayed, what it has is in use already."""
    what = "full attitude rate"
    imu, attitude = given.flight.imu, given.flight.attitude
    if isinstance(imu, Unavailable) or isinstance(attitude, Unavailable):
        return Unavailable(what, "no IMU or no attitude in the log", "Record both.")
    imu_hz, attitude_hz = sample_rate(imu), sample_rate(attitude)
    if attitude_hz >= FULL_RATE * imu_hz:
        return Unavailable(
            what, f"the attitude is logged at {attitude_hz:.0f} Hz and so used already", "None."
        )
    return Unavailable(
        what,
        f"the attitude is logged at {attitude_hz:.0f} Hz, the IMU at {imu_hz:.0f} Hz",
        "Record with SDLOG_PROFILE bit 4 (high rate).",
    )


CAUSES: Mapping[str, Callable[[Given], Made | Unavailable]] = {
    "measurement variance": _measurement_variance,
    "process noise": _process_noise,
    "delay": _delay,
    "accelerometer bias": _accelerometer_bias,
    "rejected samples": _rejected_samples,
    "gaps of fusion": _gaps_of_fusion,
    "fusion horizon": _fusion_horizon,
    "full attitude rate": _full_attitude_rate,
}


def _fusing_column(axis: Axis) -> str:
    return "vertical" if axis.name == "down" else "horizontal"


def _not_fused(given: Given) -> Unavailable | None:
    """Why EKF2 did not fuse this source, None where it did as far as the log tells."""
    if given.source.rung not in EXTERNAL_VISION_RUNGS:
        return Unavailable(
            "EKF2's use of the source",
            f"EKF2 does not fuse {given.source.name} as external vision",
            "Choose the source that EKF2 fused (--position-source).",
        )
    fusing = given.ekf2.fusing
    if isinstance(fusing, pd.DataFrame) and not fusing[_fusing_column(given.axis)].any():
        return Unavailable(
            "EKF2's use of the source",
            "EKF2 never fused external vision along this axis",
            "See EKF2_EV_CTRL (EKF2_AID_MASK and EKF2_HGT_MODE before v1.14).",
        )
    return None


def _ekf2_shift_s(given: Given) -> float | Unavailable:
    """What EKF2 added to the stamps (s), as seen from the stamps of our replay."""
    placed = given.source.alignment
    if placed is not None and placed.clock_offset_sigma_s is not None:
        return Unavailable(
            "EKF2's delay",
            "the file's clock was found by matching, which cannot tell EKF2's delay from its own",
            "Use the position as it was logged (--position-source).",
        )
    delay_ms = given.flight.log.parameters.get("EKF2_EV_DELAY")
    if delay_ms is None:
        return Unavailable(
            "EKF2's delay", "EKF2_EV_DELAY is not in the log", "Use the ULog of the flight."
        )
    return -delay_ms * 1e-3 - given.settings.clock_offset_s


def _too_few(left_out: BoolArray) -> Unavailable | None:
    fused = int(np.count_nonzero(~left_out))
    if fused >= MIN_COMMON_SAMPLES:
        return None
    return Unavailable(
        "EKF2's choice of samples",
        f"EKF2 used {fused} of {len(left_out)} measurements in the segment",
        "Choose a segment in which EKF2 fuses the source.",
    )


def _shifted(run: Run, seconds: float) -> Run:
    return replace(
        run, axis=replace(run.axis, measurement_time_s=run.axis.measurement_time_s + seconds)
    )


def _clock(clock: ClockOffset | Unavailable) -> Made | Unavailable:
    if isinstance(clock, Unavailable):
        return clock
    if not clock.determinable:
        return Unavailable(
            "clock offset", f"not determinable: {clock.reason}", "Fly clear starts and stops."
        )
    low, high = clock.interval_s
    if low <= 0.0 <= high:
        return Unavailable(
            "clock offset", "none: its 95 % interval includes zero", "None is needed."
        )
    offset = clock.offset_s
    return lambda run: _shifted(run, offset), (
        f"stamps moved by {offset:+.3f} s, which EKF2's were not"
    )


class _Against:
    """EKF2's track, and the truth at its times, which runs are compared with."""

    def __init__(self, ekf2: pd.DataFrame, truth: pd.DataFrame | Unavailable) -> None:
        self.time = ekf2.index.to_numpy()
        self.ekf2 = ekf2["position_m"].to_numpy(), ekf2["velocity_m_s"].to_numpy()
        self.truth: tuple[Array, Array] | None = None
        if isinstance(truth, pd.DataFrame):
            position, velocity = (
                np.interp(self.time, truth.index, truth[column], left=np.nan, right=np.nan)
                for column in ("position_m", "velocity_m_s")
            )
            self.truth = position, velocity

    def fit(self, run: Run) -> Fit:
        """How far a run is from both."""
        return self.distance(states_at(run, self.time))

    def distance(self, state: tuple[Array, Array]) -> Fit:
        """How far a position and a velocity are from both."""
        position, velocity = (_rms(a - b) for a, b in zip(state, self.ekf2, strict=True))
        true: list[float | None] = [None, None]
        if self.truth is not None:
            true = [_rms(a - b) for a, b in zip(state, self.truth, strict=True)]
        assert position is not None
        assert velocity is not None
        return Fit(position, velocity, true[0], true[1])


def _rms(error: Array) -> float | None:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def states_at(run: Run, times: Array) -> tuple[Array, Array]:
    """Position (m) and velocity (m/s) of a run, as :func:`px4fuse.filter.kalman.state_at`.

    Unlike there, before and after the measurements too: the filter then starts at rest at the
    first one's position, and is carried on by the input.

    Parameters
    ----------
    run : Run
    times : ndarray, shape (n,)
    """
    axis, left_out = _padded(run, float(times[0]), float(times[-1]))
    line = timeline(axis, run.settings)
    position, velocity = filtered(preintegrate(axis, run.settings), run.settings, left_out[1:])
    nodes = np.concatenate([[0], np.flatnonzero(line.measurement >= 0)])
    # what the input alone adds since the start
    dt, a = np.diff(line.time_s), line.acceleration_m_s2
    dv = np.concatenate([[0.0], np.cumsum(a * dt)])
    dp = np.concatenate([[0.0], np.cumsum(dv[:-1] * dt + a * dt**2 / 2.0)])
    at = np.clip(np.searchsorted(line.time_s, times, side="right") - 1, 0, len(dt) - 1)
    ahead = times - line.time_s[at]
    # from the newest measurement that is older than the horizon to now: x = Fx + Ba
    known = np.searchsorted(line.time_s[nodes], times - run.horizon_s, side="right") - 1
    known = np.clip(known, 0, None)
    node = nodes[known]
    since = times - line.time_s[node]
    input_p, input_v = move(dp[at], dv[at], a[at], ahead)
    return (
        position[known] + velocity[known] * since + input_p - dp[node] - dv[node] * since,
        velocity[known] + input_v - dv[node],
    )


def _padded(run: Run, start_s: float, end_s: float) -> tuple[Axis, BoolArray]:
    """The axis with measurements that are not fused at both ends where it does not reach them."""
    time, value, left_out = run.axis.measurement_time_s, run.axis.measurement_m, run.left_out
    if time[0] > start_s:
        time, value = np.insert(time, 0, start_s), np.insert(value, 0, value[0])
        left_out = np.insert(left_out, 0, True)
    if time[-1] < end_s:
        time, value = np.append(time, end_s), np.append(value, value[-1])
        left_out = np.append(left_out, True)
    return replace(run.axis, measurement_time_s=time, measurement_m=value), left_out


def _verdict(
    against: _Against,
    baseline: Fit,
    causes: Mapping[str, Effect | Unavailable],
    together: Fit,
    truth: pd.DataFrame | Unavailable,
) -> AgainstTruthBudget | Unavailable:
    if isinstance(truth, Unavailable):
        return truth
    ekf2 = against.distance(against.ekf2)
    if baseline.truth_position_rmse_m is None or ekf2.truth_position_rmse_m is None:
        return Unavailable("difference to truth", "no common samples", "Analyse more of the log.")
    known = {name: part.alone for name, part in causes.items() if isinstance(part, Effect)}
    reasons = [
        _reason("position", "m", lambda fit: fit.truth_position_rmse_m, baseline, ekf2, known,
                together),
        _reason("velocity", "m/s", lambda fit: fit.truth_velocity_rmse_m_s, baseline, ekf2, known,
                together),
    ]  # fmt: skip
    return AgainstTruthBudget(
        kf_position_rmse_m=baseline.truth_position_rmse_m,
        ekf2_position_rmse_m=ekf2.truth_position_rmse_m,
        kf_velocity_rmse_m_s=baseline.truth_velocity_rmse_m_s,
        ekf2_velocity_rmse_m_s=ekf2.truth_velocity_rmse_m_s,
        reasons=tuple(reason for reason in reasons if reason),
    )


def _reason(
    what: str,
    unit: str,
    error_of: Callable[[Fit], float | None],
    baseline: Fit,
    ekf2: Fit,
    known: Mapping[str, Fit],
    together: Fit,
) -> str:
    """Which filter is closer, and what moves our error when it is made like EKF2's."""
    ours, theirs = error_of(baseline), error_of(ekf2)
    if ours is None or theirs is None:
        return ""
    if abs(theirs - ours) < NOTABLE * ours:
        lead = f"In {what} both are equally close to the truth"
    else:
        closer = "Our filter is" if ours < theirs else "EKF2 is"
        lead = f"{closer} closer to the truth in {what}"
    lead += f": RMSE {ours:.3f} {unit} ours, {theirs:.3f} {unit} EKF2."
    changes = {
        name: error - ours for name, fit in known.items() if (error := error_of(fit)) is not None
    }
    notable = sorted(
        (name for name, change in changes.items() if abs(change) >= NOTABLE * ours),
        key=lambda name: -abs(changes[name]),
    )
    single = (
        "What a choice of EKF2's alone does to our error: "
        + ", ".join(f"{name} {changes[name]:+.3f} {unit}" for name in notable)
        if notable
        else f"No choice of EKF2's alone changes our error by {NOTABLE:.0%} or more"
    )
    last = error_of(together)
    assert last is not None
    return f"{lead} {single}; with all of them it is {last:.3f} {unit}."
