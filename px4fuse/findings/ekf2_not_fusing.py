"""EKF2 did not use the source for horizontal position, or not all the time."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.findings.model import Detector, Finding, Found, Threshold, off_spans, step_share
from px4fuse.flight import Ekf2, FusionRecord, Unavailable

FUSING_SHARE_ERROR = Threshold(
    0.5, "of the segment", "below, EKF2's track is mostly not the source's"
)
FUSING_SHARE_WARNING = Threshold(0.98, "of the segment", "one second in a flight of a minute")
EV_START_INTERVAL = Threshold(0.2, "s", "EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp")
EV_STOP_INTERVAL = Threshold(0.4, "s", "two times EV_MAX_INTERVAL, ev_pos_control.cpp")
MAX_LATE = Threshold(0.1, "s", "older than that by the horizon, no sample is fused: RingBuffer.h")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.fusing, Unavailable):
        return
    share = step_share(ekf2.fusing["horizontal"], segment.start_s, segment.end_s)
    if not comparison.source.origin.is_vision:
        if comparison.source.name == "vehicle_mocap_odometry" and share == 0.0:
            yield Finding(
                "ekf2_not_fusing",
                "warning",
                "EKF2 never fuses motion capture (ATT_POS_MOCAP), and nothing else of external "
                "vision reached it: its track does not come from this source.",
                "Send the position as VISION_POSITION_ESTIMATE if EKF2 is to fuse it.",
                {"fusing_share": share},
            )
        return
    interval = 1.0 / comparison.source.rate_hz
    evidence: dict[str, float | str] = {"fusing_share": share, "source_interval_s": interval}
    if share >= FUSING_SHARE_WARNING.value:
        return
    if share >= FUSING_SHARE_ERROR.value:
        yield Finding(
            "ekf2_fusion_interrupted",
            "warning",
            f"EKF2 fused the source in only {share:.0%} of the segment; in between its track "
            "rests on its other sensors.",
            "Look at the gaps and rejections below; EKF2 (v1.14 and later) stops after "
            f"{EV_STOP_INTERVAL.value:g} s without a sample.",
            evidence,
            spans_s=off_spans(ekf2.fusing["horizontal"], segment.start_s, segment.end_s),
        )
        return
    why, remedy = _cause(comparison, interval)
    often = f"fused the source in only {share:.0%} of the segment"
    yield Finding(
        "ekf2_not_fusing",
        "error",
        f"EKF2 {often if share else 'never fused the source in this segment'}: {why}.",
        remedy,
        evidence,
    )


def _cause(comparison: Comparison, interval: float) -> tuple[str, str]:
    """Why EKF2 does not fuse a source with this interval (s), and the remedy."""
    control = comparison.flight.log.parameters.get("EKF2_EV_CTRL")
    mask = comparison.flight.log.parameters.get("EKF2_AID_MASK")
    if control is not None and not int(control) & 1:
        return (
            f"EKF2_EV_CTRL is {control:.0f}, bit 0 (horizontal position) is not set",
            f"Set EKF2_EV_CTRL to {int(control) | 1}.",
        )
    if control is None and mask is not None and not int(mask) & 8:
        return (
            f"EKF2_AID_MASK is {mask:.0f}, bit 3 (vision position) is not set",
            f"Set EKF2_AID_MASK to {int(mask) | 8}.",
        )
    age, horizon = _age_s(comparison), _horizon_s(comparison)
    if age > horizon + MAX_LATE.value:
        return (
            f"its samples arrive {age:.2f} s after their stamps, and EKF2 keeps no more than "
            f"{horizon:.2f} s",
            "Check the source's clock (stamps that are too early look late), then raise "
            "EKF2_DELAY_MAX (v1.15 and later).",
        )
    # the rate of a reconstructed source is the logger's, not its own
    own_rate = control is not None and not comparison.source.origin.reconstructed
    if own_rate and interval > EV_START_INTERVAL.value:
        return (
            f"its samples come every {interval:.2f} s, and EKF2 (v1.14 and later) starts only when "
            f"they are less than {EV_START_INTERVAL.value:g} s apart and stops after "
            f"{EV_STOP_INTERVAL.value:g} s",
            "Send the UWB position at 10 Hz; 5 Hz starts only thanks to jitter.",
        )
    return "the log does not show why", "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."


def _age_s(comparison: Comparison) -> float:
    """Time (s) from a sample's stamp to its arrival, less what EKF2 takes off; NaN if unknown."""
    ekf2 = comparison.flight.ekf2
    record = ekf2.record if isinstance(ekf2, Ekf2) else None
    if not isinstance(record, FusionRecord) or record.vision_age_s.empty:
        return float("nan")
    age = record.vision_age_s.loc[comparison.segment.start_s : comparison.segment.end_s]
    delay_ms = comparison.flight.log.parameters.get("EKF2_EV_DELAY", 0.0)
    return float(age.median() + delay_ms * 1e-3)


def _horizon_s(comparison: Comparison) -> float:
    ekf2 = comparison.flight.ekf2
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.horizon_s, Unavailable):
        return float("nan")
    return ekf2.horizon_s


DETECTOR = Detector(
    _detect,
    {"ekf2_not_fusing": ("--mistake ekf2-off",)},
    names={
        "ekf2_not_fusing": "EKF2 that never used the positions",
        "ekf2_fusion_interrupted": "EKF2 that stopped fusing for a time",
    },
)
