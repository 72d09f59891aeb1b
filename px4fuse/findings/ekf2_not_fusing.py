"""EKF2 did not use the source for horizontal position, or not all the time."""

from typing import Any

from px4fuse.comparison.model import Comparison
from px4fuse.findings.model import Found, error, fraction_on, spans_at, warning
from px4fuse.flight import Ekf2, FusionRecord, Unavailable

FUSING_SHARE_ERROR = 0.5  # of the segment: below, EKF2's track is mostly not the source's
FUSING_SHARE_WARNING = 0.98  # of the segment: one second in a flight of a minute
EV_START_INTERVAL_S = 0.2  # EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp
EV_STOP_INTERVAL_S = 0.4  # two times EV_MAX_INTERVAL, ev_pos_control.cpp
MAX_LATE_S = 0.1  # older than that by the horizon, no sample is fused: RingBuffer.h


def detect(analysis: Comparison) -> Found:
    """Fused in too small a share of the segment."""
    ekf2, segment, source = analysis.flight.ekf2, analysis.segment, analysis.source
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusing, Unavailable):
        return
    fusing = ekf2.fusing["horizontal"]
    share = fraction_on(fusing, segment)
    evidence = {"fusing_share": share, "source_interval_s": 1.0 / source.rate_hz}
    if not source.origin.is_vision:
        if source.name == "vehicle_mocap_odometry" and share == 0.0:
            yield warning("ekf2_not_fusing", {"fusing_share": share}, case="mocap")
    elif share < FUSING_SHARE_ERROR:
        case_name, facts = _find_cause(analysis, ekf2)
        frequency = "seldom" if share else "never"
        yield error("ekf2_not_fusing", evidence, case=case_name, headline=frequency, **facts)
    elif share < FUSING_SHARE_WARNING:
        spans = spans_at(0.0, fusing, segment)
        yield warning("ekf2_fusion_interrupted", evidence, spans, stop_s=EV_STOP_INTERVAL_S)


def _find_cause(analysis: Comparison, ekf2: Ekf2) -> tuple[str, dict[str, Any]]:
    """Why EKF2 does not fuse the source, in the word of its text and remedy, and their facts."""
    parameters, interval_s = analysis.flight.log.parameters, 1.0 / analysis.source.rate_hz
    control = parameters.get("EKF2_EV_CTRL")
    switch, bit, of = "EKF2_EV_CTRL", 0, "horizontal position"
    if control is None:  # before v1.14
        switch, bit, of = "EKF2_AID_MASK", 3, "vision position"
    value = parameters.get(switch)
    if value is not None and not int(value) >> bit & 1:
        wanted_value = int(value) | 1 << bit
        return "off", {
            "switch": switch,
            "value": value,
            "bit": bit,
            "of": of,
            "asked": wanted_value,
        }
    horizon_s, age_s = ekf2.horizon_s, _age_s(analysis, ekf2)
    if isinstance(horizon_s, float) and age_s > horizon_s + MAX_LATE_S:
        return "late", {"age_s": age_s, "horizon_s": horizon_s}
    # the rate of a reconstructed source is the logger's, not its own
    own_rate = control is not None and not analysis.source.origin.reconstructed
    if own_rate and interval_s > EV_START_INTERVAL_S:
        return "slow", {"start_s": EV_START_INTERVAL_S, "stop_s": EV_STOP_INTERVAL_S}
    return "unknown", {}


def _age_s(analysis: Comparison, ekf2: Ekf2) -> float:
    """Time (s) from a sample's stamp to its arrival, less what EKF2 takes off; NaN if unknown."""
    if not isinstance(ekf2.record, FusionRecord):
        return float("nan")
    age_s = ekf2.record.vision_age_s.loc[analysis.segment.start_s : analysis.segment.end_s]
    delay_ms = analysis.flight.log.parameters.get("EKF2_EV_DELAY", 0.0)
    return float(age_s.median() + delay_ms * 1e-3)
