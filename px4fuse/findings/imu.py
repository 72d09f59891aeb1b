"""What is wrong with the IMU, bias, clipping, gaps, too low a rate; and a vehicle that tumbled."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import MIN_BIAS_M_S2, BiasScaleJumpFit
from px4fuse.filter.signals import Segment, imu_gaps, within
from px4fuse.findings.model import MOMENT_S, Found, finding, warning
from px4fuse.flight import Columns, Ekf2, Flight, sample_rate
from px4fuse.record import Span

BIAS_ERROR_M_S2 = 0.3  # as SIGMA_A tripled; 0.15 m after one second
TILT_DEG_PER_M_S2 = float(np.degrees(1.0 / 9.80665))
IMU_GAP_TOTAL_S = 0.2  # two prediction steps
MIN_IMU_RATE_HZ = 50.0  # 5 IMU samples per DT of 0.1 s, and 10 with margin for aliasing
MIN_ATTITUDE_RATE_HZ = 10.0  # PX4's default is 20 Hz; slerp bridges 0.1 s of a tilt
MAX_CLIPPED_S = 0.1  # a prediction step; a touch-down clips a sample or two
MIN_CLIPPING_PAUSE_S = 2.0  # clipped samples further apart are told as two times
RATE_MARGIN = 0.98  # a stream set to a rate runs a little below it


def detect(analysis: Analysis) -> Found:
    """All of them."""
    yield from tumbling(analysis)
    yield from bias(analysis)
    yield from clipping(analysis)
    yield from gaps(analysis)
    yield from rates(analysis.flight)


def bias(analysis: Analysis) -> Found:
    """The accelerometer reads too much or too little all the time.

    Our own estimate is from the positions: a bias that is taken for acceleration moves the
    innovations in a way that nothing else does. EKF2's stands in where there is none, and for the
    down axis.
    """
    found, of_ekf2 = analysis.bias_scale_jump_fit, _ekf2_bias(analysis)
    if isinstance(found, BiasScaleJumpFit) and found.has_bias:
        forward, right, size = found.forward_bias, found.right_bias, found.bias.value
        yield finding(
            "error" if size >= BIAS_ERROR_M_S2 else "warning",
            "accelerometer_bias",
            {"bias_m_s2": size, "sigma_m_s2": found.bias.sigma},
            case=True,
            forward=forward.value,
            right=right.value,
            within=1.96 * forward.sigma,
            tilt_deg=size * TILT_DEG_PER_M_S2,
            ekf2=of_ekf2,
            and_ekf2=of_ekf2 is not None,
        )
    elif of_ekf2 is not None:
        # horizontally ours is the better estimate, where there is one
        size = float(
            np.linalg.norm(of_ekf2[2:] if isinstance(found, BiasScaleJumpFit) else of_ekf2)
        )
        if size >= MIN_BIAS_M_S2:
            yield warning("accelerometer_bias", {"bias_m_s2": size}, case=False, ekf2=of_ekf2)


def _ekf2_bias(analysis: Analysis) -> list[float] | None:
    """Median of what EKF2 subtracts, forward, right and down (m/s²)."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2) or not isinstance(ekf2.accelerometer_bias, pd.DataFrame):
        return None
    inside = within(ekf2.accelerometer_bias, analysis.segment)[Columns.SPECIFIC_FORCE]
    return None if inside.empty else [float(median) for median in inside.median()]


def tumbling(analysis: Analysis) -> Found:
    """PX4's failure detector found the attitude beyond its limits."""
    if spans := analysis.segment.cut(analysis.flight.tumble_spans):
        yield finding(
            "error",
            "vehicle_tumbled",
            {"total_s": sum(end - start for start, end in spans)},
            spans,
            end_s=max(spans[0][0] - 1.0, 0.0),
        )


def clipping(analysis: Analysis) -> Found:
    """The accelerometer was at the end of its range."""
    imu = analysis.flight.imu
    if not isinstance(imu, pd.DataFrame) or "clipped" not in imu:
        return
    inside = within(imu, analysis.segment)
    time_s = inside.index[inside["clipped"] > 0.0].to_numpy()
    total_s = len(time_s) / sample_rate(imu)
    if total_s > MAX_CLIPPED_S:
        bursts = np.split(time_s, np.flatnonzero(np.diff(time_s) > MIN_CLIPPING_PAUSE_S) + 1)
        yield warning(
            "accelerometer_clipped",
            {"count": len(time_s), "total_s": total_s},
            tuple((float(each[0]), float(each[-1])) for each in bursts),
        )


def gaps(analysis: Analysis) -> Found:
    """Missing for longer than two steps of prediction and of the IMU."""
    gap_s, imu = next(iter(analysis.axes.values())).replay.input_gap_s, analysis.flight.imu
    interval_s = 1.0 / sample_rate(imu) if isinstance(imu, pd.DataFrame) else 0.0
    if gap_s > max(IMU_GAP_TOTAL_S, 2.0 * interval_s):
        yield warning(
            "imu_gap",
            {"total_s": gap_s},
            _gap_spans(imu, analysis.segment) if isinstance(imu, pd.DataFrame) else (),
            recorded=analysis.flight.log.format.startswith("MAVLink"),
        )


def _gap_spans(imu: pd.DataFrame, segment: Segment) -> tuple[Span, ...]:
    """From when to when the IMU is missing, at the ends of the segment too."""
    time_s = imu.index.to_numpy()
    gap = imu_gaps(time_s)
    missing = list(zip(time_s[:-1][gap].tolist(), time_s[1:][gap].tolist(), strict=True))
    outside = ((segment.start_s, float(time_s[0])), (float(time_s[-1]), segment.end_s))
    missing += [(start, end) for start, end in outside if end - start > MOMENT_S]
    inside = (span for span in missing if span[1] > segment.start_s and span[0] < segment.end_s)
    return tuple(sorted(inside))


def too_slow(samples: pd.DataFrame, needed_hz: float) -> bool:
    """Whether samples come at a lower rate than is needed."""
    return sample_rate(samples) < RATE_MARGIN * needed_hz


def rates(flight: Flight) -> Found:
    """IMU or attitude, below the rate that the acceleration needs."""
    for part, name, default, needed_hz in (
        (flight.imu, "imu", "sensor_combined", MIN_IMU_RATE_HZ),
        (flight.attitude, "attitude", "vehicle_attitude", MIN_ATTITUDE_RATE_HZ),
    ):
        topic = flight.streams[name].topics[0] if name in flight.streams else default
        if isinstance(part, pd.DataFrame) and too_slow(part, needed_hz):
            rate_hz = sample_rate(part)
            streamed = "streamed" if flight.log.has_ulog else "sent"
            how = streamed if flight.log.format.startswith("MAVLink") else "logged"
            yield warning(
                "logging_rate_low",
                {"rate_hz": rate_hz, "needed_hz": needed_hz, "topic": topic},
                case=how,
                asked_hz=2.0 * needed_hz,
            )
