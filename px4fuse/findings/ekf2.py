"""What EKF2 did with the source: nothing, not all the time, or with jumps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import Comparison
from px4fuse.filter.signals import within
from px4fuse.findings.model import Finding, step_share, times
from px4fuse.findings.thresholds import (
    ACCELEROMETER_BIAS,
    EV_START_INTERVAL,
    EV_STOP_INTERVAL,
    FUSING_SHARE_ERROR,
    FUSING_SHARE_WARNING,
    REJECTED_SHARE_ERROR,
    REJECTED_SHARE_WARNING,
)
from px4fuse.flight import EXTERNAL_VISION_RUNGS, SPECIFIC_FORCE_COLUMNS, Ekf2, Unavailable


def ekf2_unavailable(analysis: Analysis) -> Iterator[Finding]:
    """There is no EKF2 to compare with."""
    comparison = analysis.comparison
    ekf2 = comparison.flight.ekf2
    if isinstance(ekf2, Unavailable):
        yield Finding(
            "ekf2_unavailable",
            "warning",
            f"Nothing to compare with: {ekf2.reason}. The report holds our filter alone.",
            ekf2.remedy,
        )


def ekf2_not_fusing(analysis: Analysis) -> Iterator[Finding]:
    """EKF2 did not use the source for horizontal position, or not all the time."""
    comparison = analysis.comparison
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.fusing, Unavailable):
        return
    if comparison.source.rung not in EXTERNAL_VISION_RUNGS:
        fused = step_share(ekf2.fusing["horizontal"], segment.start_s, segment.end_s)
        if comparison.source.name == "vehicle_mocap_odometry" and fused == 0.0:
            yield Finding(
                "ekf2_not_fusing",
                "warning",
                "EKF2 never fuses motion capture (ATT_POS_MOCAP), and nothing else of external "
                "vision reached it: its track does not come from this source.",
                "Send the position as VISION_POSITION_ESTIMATE if EKF2 is to fuse it.",
                {"fusing_share": fused},
            )
        return
    share = step_share(ekf2.fusing["horizontal"], segment.start_s, segment.end_s)
    interval = 1.0 / comparison.source.rate_hz
    parameters = comparison.flight.log.parameters
    evidence: dict[str, float | str] = {"fusing_share": share, "source_interval_s": interval}
    if share >= FUSING_SHARE_WARNING.value:
        return
    if share >= FUSING_SHARE_ERROR.value:
        yield Finding(
            "ekf2_fusion_interrupted",
            "warning",
            f"EKF2 fused the source in {share:.0%} of the segment only; in between its track "
            "rests on its other sensors.",
            "Look at the gaps and rejections below; EKF2 stops after 0.4 s without a sample.",
            evidence,
        )
        return
    why, remedy = "the log does not show why", "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."
    control = parameters.get("EKF2_EV_CTRL")
    mask = parameters.get("EKF2_AID_MASK")
    if control is not None and not int(control) & 1:
        why = f"EKF2_EV_CTRL is {control:.0f}, bit 0 (horizontal position) is not set"
        remedy = f"Set EKF2_EV_CTRL to {int(control) | 1}."
    elif control is None and mask is not None and not int(mask) & 8:
        why = f"EKF2_AID_MASK is {mask:.0f}, bit 3 (vision position) is not set"
        remedy = f"Set EKF2_AID_MASK to {int(mask) | 8}."
    elif (
        control is not None
        and not comparison.source.reconstructed  # else its rate is the logger's, not its own
        and interval > EV_START_INTERVAL.value
    ):
        why = (
            f"its samples come every {interval:.2f} s, and EKF2 (v1.14 and later) starts only when "
            f"they are less than {EV_START_INTERVAL.value:g} s apart and stops after "
            f"{EV_STOP_INTERVAL.value:g} s"
        )
        remedy = "Send the UWB position at 10 Hz; 5 Hz starts only thanks to jitter."
    yield Finding(
        "ekf2_not_fusing",
        "error",
        (
            "EKF2 never fused the source in this segment"
            if share == 0
            else f"EKF2 fused the source in only {share:.0%} of the segment"
        )
        + f": {why}.",
        remedy,
        evidence,
    )


def ekf2_rejecting(analysis: Analysis) -> Iterator[Finding]:
    """EKF2's gate threw measurements away."""
    comparison = analysis.comparison
    # a rejection is of the horizontal vector, so one horizontal axis speaks for all
    horizontal = [r for r in comparison.axes if r.axis.name != "down"][:1]
    for result in (*horizontal, *(r for r in comparison.axes if r.axis.name == "down")):
        frame = result.ekf2_innovations
        if isinstance(frame, Unavailable):
            continue
        known = frame["rejected"].dropna()
        if known.empty:
            continue
        share = float(known.mean())
        if share < REJECTED_SHARE_WARNING.value:
            continue
        what = "height" if result.axis.name == "down" else "horizontal position"
        yield Finding(
            "ekf2_rejecting",
            "error" if share >= REJECTED_SHARE_ERROR.value else "warning",
            f"EKF2 rejected {share:.1%} of the source's samples for {what} (outside "
            f"{_gate(comparison):g} √S): outliers, a noise set too small, or a late clock.",
            "First make EKF2_EVP_NOISE the source's own noise, then remove outliers (line of "
            "sight) and check the clock; widen EKF2_EVP_GATE last.",
            {"rejected_share": share, "count": float(len(frame)), "axis": result.axis.name},
        )


def _gate(comparison: Comparison) -> float:
    ekf2 = comparison.flight.ekf2
    return ekf2.gate if isinstance(ekf2, Ekf2) else float("nan")


def resets(analysis: Analysis) -> Iterator[Finding]:
    """EKF2's output jumped, or another instance took over."""
    comparison = analysis.comparison
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable):
        return
    inside = [
        r
        for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position" and any(r.delta)
    ]
    sizes = [float(np.linalg.norm(r.delta)) for r in inside]
    if inside:
        largest = inside[int(np.argmax(sizes))]
        horizontal = sum(any(r.delta[:2]) for r in inside)
        said = next((note for note in comparison.notes if note.startswith("EKF2 resets")), "")
        yield Finding(
            "ekf2_resets",
            "warning" if horizontal else "info",
            f"EKF2 reset its position {times(len(inside))} ({horizontal} horizontal), by up to "
            f"{max(sizes):.2f} m at {largest.time_s:.1f} s. In the comparison: {said[5:]}.",
            "Look for the gap or rejection at that time."
            if horizontal
            else "A height reset at take-off is usual; in mid-flight look for a change of the "
            "height source.",
            {"count": float(len(inside)), "largest_m": max(sizes), "at_s": largest.time_s},
        )
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        yield Finding(
            "ekf2_instance_switch",
            "warning",
            f"The primary EKF2 instance changed {times(len(switches))}, first at "
            f"{switches[0]:.1f} s; each part of the comparison uses the one in charge.",
            "Compare the IMUs (vehicle_imu_status); set EKF2_MULTI_IMU to 1 for a lab flight.",
            {"count": float(len(switches)), "at_s": switches[0]},
        )


def accelerometer_bias(analysis: Analysis) -> Iterator[Finding]:
    """EKF2 found a large accelerometer bias, which our filter takes for acceleration."""
    comparison = analysis.comparison
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.accelerometer_bias, Unavailable):
        return
    inside = within(ekf2.accelerometer_bias, segment)
    if inside.empty:
        return
    bias = inside[SPECIFIC_FORCE_COLUMNS].median().to_numpy()
    size = float(np.linalg.norm(bias))
    if size < ACCELEROMETER_BIAS.value:
        return
    yield Finding(
        "accelerometer_bias",
        "warning",
        f"EKF2 takes an accelerometer bias of {size:.2f} m/s² off ({bias[0]:+.2f} forward, "
        f"{bias[1]:+.2f} right, {bias[2]:+.2f} down), which our filter integrates: it needs a "
        "larger SIGMA_A for that.",
        "Calibrate the accelerometers, at the temperature of the flight.",
        {"bias_m_s2": size},
    )
