"""Faults of the IMU (bias, clipping, gaps, low rate), and roll or pitch beyond PX4's limits."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.hypotheses import MIN_BIAS_M_S2, BiasScaleJumpFit
from px4fuse.filter.signals import Segment, cut_to_segment, imu_gaps
from px4fuse.findings.model import MAX_MOMENT_S, Found, error, finding, warning
from px4fuse.flight import Columns, Ekf2, Flight, sample_rate
from px4fuse.record import Span

BIAS_ERROR_M_S2 = 0.3  # m/s²; a position error of 0.15 m after 1 s
TILT_DEG_PER_M_S2 = float(np.degrees(1.0 / 9.80665))  # tilt with the effect of a bias of 1 m/s²
MIN_IMU_GAP_S = 0.2  # s in total; two prediction steps
MIN_IMU_RATE_HZ = 50.0  # Hz; 5 IMU samples per DT of 0.1 s, and a margin against aliasing
MIN_ATTITUDE_RATE_HZ = 10.0  # Hz; PX4 logs 20 Hz by default, 0.1 s of a tilt can be interpolated
MAX_CLIPPED_S = 0.1  # s; one prediction step, a touch-down clips one or two samples
MIN_CLIPPING_PAUSE_S = 2.0  # s; a longer pause separates two spans
RATE_MARGIN = 0.98  # measured stream rates are slightly below the requested rate


def detect(analysis: Analysis) -> Found:
    """Detect all faults of the IMU and of the attitude."""
    yield from tumbling(analysis)
    yield from bias(analysis)
    yield from clipping(analysis)
    yield from gaps(analysis)
    yield from rates(analysis.flight)


def bias(analysis: Analysis) -> Found:
    """Detect an accelerometer bias.

    The estimate from the positions is used if there is one. EKF2's estimate replaces it otherwise,
    and for the down axis.
    """
    found, of_ekf2 = analysis.bias_scale_jump_fit, _ekf2_bias(analysis)
    if isinstance(found, BiasScaleJumpFit) and found.has_bias:
        forward, right, size = found.forward_bias, found.right_bias, found.bias.value
        message = (
            f"The accelerometer is biased by {forward.value:+.2f} m/s² forward and "
            f"{right.value:+.2f} m/s² right. The bias is estimated from the positions "
            f"(± {1.96 * forward.sigma:.2f} m/s²); a tilt error of "
            f"{size * TILT_DEG_PER_M_S2:.1f}° has the same effect. KF has no state for it."
        )
        if of_ekf2 is not None:
            message += (
                f" EKF2 estimates {of_ekf2[0]:+.2f} m/s² forward and {of_ekf2[1]:+.2f} m/s² right."
            )
        yield finding(
            "error" if size >= BIAS_ERROR_M_S2 else "warning",
            "accelerometer_bias",
            message,
            "Calibrate the accelerometers and the level horizon at the temperature of the flight. "
            "A larger SIGMA_A only hides the bias.",
            {"bias_m_s2": size, "sigma_m_s2": found.bias.sigma},
        )
    elif of_ekf2 is not None:
        # horizontally the estimate from the positions is better than that of EKF2
        size = float(
            np.linalg.norm(of_ekf2[2:] if isinstance(found, BiasScaleJumpFit) else of_ekf2)
        )
        if size >= MIN_BIAS_M_S2:
            yield warning(
                "accelerometer_bias",
                f"EKF2 estimates an accelerometer bias of {size:.2f} m/s² ({of_ekf2[0]:+.2f} "
                f"forward, {of_ekf2[1]:+.2f} right, {of_ekf2[2]:+.2f} down). KF has no state for "
                "it and needs a larger SIGMA_A.",
                "Calibrate the accelerometers at the temperature of the flight.",
                {"bias_m_s2": size},
            )


def _ekf2_bias(analysis: Analysis) -> list[float] | None:
    """Median accelerometer bias that EKF2 estimates: forward, right, down (m/s²)."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2) or not isinstance(ekf2.accelerometer_bias, pd.DataFrame):
        return None
    inside = cut_to_segment(ekf2.accelerometer_bias, analysis.segment)[Columns.SPECIFIC_FORCE]
    return None if inside.empty else [float(median) for median in inside.median()]


def tumbling(analysis: Analysis) -> Found:
    """Detect roll or pitch beyond the limits of PX4's failure detector."""
    if spans := analysis.segment.cut(analysis.flight.tumble_spans):
        end_s = max(spans[0][0] - 1.0, 0.0)
        yield error(
            "attitude_failure",
            "Roll or pitch exceeded the limits of PX4's failure detector (FD_FAIL_R, FD_FAIL_P) at "
            f"{spans[0][0]:.1f} s. Data after that time do not represent normal flight.",
            f"Analyse the flight up to then: --end {end_s:.1f}. Check the other findings for the "
            "time before.",
            {"total_s": sum(end - start for start, end in spans)},
            spans,
        )


def clipping(analysis: Analysis) -> Found:
    """Detect accelerometer samples at the end of the range."""
    imu = analysis.flight.imu
    if not isinstance(imu, pd.DataFrame) or "clipped" not in imu:
        return
    inside = cut_to_segment(imu, analysis.segment)
    time_s = inside.index[inside["clipped"] > 0.0].to_numpy()
    total_s = len(time_s) / sample_rate(imu)
    if total_s > MAX_CLIPPED_S:
        bursts = np.split(time_s, np.flatnonzero(np.diff(time_s) > MIN_CLIPPING_PAUSE_S) + 1)
        yield warning(
            "accelerometer_clipping",
            f"The accelerometer was clipped in {len(time_s)} samples ({total_s:.2f} s). Motion "
            "beyond its range is lost. Height and vertical velocity are affected first, and the "
            "error looks like a bias.",
            "Check propellers, motors and mounting for vibration or impacts. Analyse a segment "
            "without clipping (--start, --end).",
            {"count": len(time_s), "total_s": total_s},
            tuple((float(each[0]), float(each[-1])) for each in bursts),
        )


def gaps(analysis: Analysis) -> Found:
    """Detect IMU gaps longer than two prediction steps and two IMU intervals."""
    gap_s, imu = next(iter(analysis.axes.values())).replay.input_gap_s, analysis.flight.imu
    interval_s = 1.0 / sample_rate(imu) if isinstance(imu, pd.DataFrame) else 0.0
    if gap_s > max(MIN_IMU_GAP_S, 2.0 * interval_s):
        is_mavlink = analysis.flight.log.format.startswith("MAVLink")
        yield warning(
            "imu_gap",
            f"IMU samples are missing for {gap_s:.2f} s of the segment. In the gap KF increases Q "
            "to the variance of the measured acceleration.",
            f"{'Record on a link without message loss' if is_mavlink else 'Use a faster SD card'}, "
            "or analyse a segment without the gap (--start, --end).",
            {"total_s": gap_s},
            _gap_spans(imu, analysis.segment) if isinstance(imu, pd.DataFrame) else (),
        )


def _gap_spans(imu: pd.DataFrame, segment: Segment) -> tuple[Span, ...]:
    """Spans without IMU samples in the segment, also at its ends."""
    time_s = imu.index.to_numpy()
    gap = imu_gaps(time_s)
    missing = list(zip(time_s[:-1][gap].tolist(), time_s[1:][gap].tolist(), strict=True))
    outside = ((segment.start_s, float(time_s[0])), (float(time_s[-1]), segment.end_s))
    missing += [(start, end) for start, end in outside if end - start > MAX_MOMENT_S]
    inside = (span for span in missing if span[1] > segment.start_s and span[0] < segment.end_s)
    return tuple(sorted(inside))


def too_slow(samples: pd.DataFrame, needed_hz: float) -> bool:
    """Return True if the sample rate is more than 2 % below the needed rate."""
    return sample_rate(samples) < RATE_MARGIN * needed_hz


def rates(flight: Flight) -> Found:
    """Detect IMU or attitude below the rate that the acceleration in NED needs."""
    log = flight.log
    for part, name, default, needed_hz in (
        (flight.imu, "imu", "sensor_combined", MIN_IMU_RATE_HZ),
        (flight.attitude, "attitude", "vehicle_attitude", MIN_ATTITUDE_RATE_HZ),
    ):
        topic = flight.streams[name].topics[0] if name in flight.streams else default
        if isinstance(part, pd.DataFrame) and too_slow(part, needed_hz):
            rate_hz, wanted_hz = sample_rate(part), 2.0 * needed_hz
            action = f"Add 16 to SDLOG_PROFILE (bit 4, high rate: {topic} at full rate)."
            if log.format.startswith("MAVLink"):
                action = f"Request {topic} at {wanted_hz:g} Hz (MAV_CMD_SET_MESSAGE_INTERVAL)."
                if log.has_ulog:
                    action = (
                        f"Request {topic} at {wanted_hz:g} Hz (PX4 console: mavlink stream -d "
                        f"DEVICE -s {topic} -r {wanted_hz:g}), or add the ULog (--mavlink)."
                    )
            yield warning(
                "imu_rate_too_low",
                f"{topic} was logged at {rate_hz:.1f} Hz, but the acceleration needs "
                f"{needed_hz:g} Hz. Motion between samples is lost, and vibration is aliased.",
                action,
                {"rate_hz": rate_hz, "needed_hz": needed_hz, "topic": topic},
            )
