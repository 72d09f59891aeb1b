"""First condition of EKF2 that a position source does not meet."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from findings_tools import NONE, analysis, made, moving, named, only, positions, source

from px4fuse.ekf2.fusion_conditions import UnfusedPositions, find_unmet_condition
from px4fuse.findings import ekf2_fusion
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS
from px4fuse.flight.model import GNSS_ORIGIN, POSITION_FILE_ORIGIN, AidLog, ClockConversion, Ekf2
from px4fuse.readers import read_log
from px4fuse.readers.px4_innovations import has_fused_aid

SPAN_S = (20.0, 60.0)
V114 = {"EKF2_EV_CTRL": 1.0, "EKF2_GPS_CTRL": 7.0}


def on(value: float) -> "pd.Series[float]":
    """Return a state that never changes."""
    return pd.Series([value], index=[0.0])


def attempt(
    rate_hz: float = 10.0, ekf2: Any = None, aid: Any = EV_POS, **parts: Any
) -> UnfusedPositions:
    parameters = parts.pop("parameters", V114)
    usual = {"status_flags": {}, "aids": {}, "record": NONE, "horizon_s": 0.2}
    track = source(rate_hz=rate_hz, **parts)
    return UnfusedPositions(made(Ekf2, **{**usual, **(ekf2 or {})}), track, aid, parameters, SPAN_S)


def with_quality(*values: float) -> dict[str, Any]:
    samples = moving(10.0)
    quality = np.resize(np.array(values), len(samples))
    return {"status": pd.DataFrame({"quality": quality}, index=samples.index),
            "parameters": {**V114, "EKF2_EV_QMIN": 50.0}}  # fmt: skip


def gnss(failed: int = 0, accuracy_m: float = 0.4, **parts: Any) -> UnfusedPositions:
    samples = moving(10.0).assign(north_m2=accuracy_m**2, down_m2=1.0)
    states = {"failed_checks": on(failed), **parts.pop("status_flags", {})}
    return attempt(
        aid=GNSS_POS, origin=GNSS_ORIGIN, samples=samples, ekf2={"status_flags": states}, **parts
    )


def with_gap(start_s: float, end_s: float) -> pd.DataFrame:
    samples = moving(10.0)
    return samples[(samples.index < start_s) | (samples.index > end_s)]


def rejecting(share: float) -> dict[str, Any]:
    time_s = np.arange(10.0, 70.0, 0.5)
    rejected = (np.arange(len(time_s)) % 10 < 10.0 * share).astype(float)
    samples = pd.DataFrame({"rejected": rejected}, index=time_s)
    return {"aids": {"ev_pos": made(AidLog, samples=samples)}}


def clock(name: str) -> ClockConversion:
    return ClockConversion(name, "arrival time", 100, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("tried", "name", "texts"),
    [
        (attempt(), None, ()),
        (attempt(parameters={"EKF2_EV_CTRL": 8.0}), "switch", ("is 8", "Set EKF2_EV_CTRL to 9")),
        (attempt(parameters={"EKF2_AID_MASK": 1.0}), "switch", ("Set EKF2_AID_MASK to 9",)),
        (attempt(name="vehicle_visual_odometry", frame="unknown"), "frame", ("pose_frame 1",)),
        (attempt(samples=with_gap(19.6, 40.0)), "gap", ("no position for 20.", "0.4 s after")),
        # v1.13 continues for 7 s
        (attempt(samples=with_gap(19.6, 24.0), parameters={"EKF2_AID_MASK": 8.0}), None, ()),
        (attempt(clock_map=clock("milliseconds")), "clock", ("in milliseconds", "microseconds")),
        (attempt(clock_map=clock("UNIX time in microseconds")), "clock", ("UNIX", "TIMESYNC")),
        (attempt(clock_map=clock("sender timestamps")), None, ()),
        (attempt(**with_quality(20.0)), "quality", ("is 20", "EKF2_EV_QMIN 50", "100 % of")),
        (attempt(**with_quality(0.0)), "quality", ("VISION_POSITION_ESTIMATE", "to 0")),
        # EKF2 needs several good samples in a row
        (attempt(**with_quality(20.0, 90.0, 90.0)), "quality", ("33 % of",)),
        (attempt(**with_quality(20.0, *[90.0] * 9)), None, ()),
        (attempt(4.0), "interval", ("come at 4 Hz", "0.2 s")),
        (attempt(4.0, parameters={"EKF2_AID_MASK": 8.0}), None, ()),
        (attempt(ekf2={"status_flags": {"tilt_align": on(0.0)}}), "alignment", ("tilt",)),
        (attempt(ekf2={"status_flags": {"yaw_align": on(0.0)}}), "alignment", ("EKF2_MAG_TYPE",)),
        (attempt(ekf2={"status_flags": {"yaw_align": on(0.0)}}, frame="FRD"), None, ()),
        (attempt(ekf2=rejecting(0.8)), "gate", ("rejects 78 %", "EKF2_EVP_GATE only if")),
        (attempt(ekf2=rejecting(0.4)), None, ()),
        (gnss(), None, ()),
        (gnss(parameters={"EKF2_GPS_CTRL": 2.0}), "switch", ("Set EKF2_GPS_CTRL to 3",)),
        (gnss(parameters={"EKF2_AID_MASK": 8.0}), "switch", ("Set EKF2_AID_MASK to 9",)),
        (gnss(0b1001, 5.0, parameters={**V114, "EKF2_REQ_EPH": 3.0}), "checks",
         ("3D fix (check failed 100 %", "limit EKF2_REQ_EPH 3 m")),
        # EKF2_GPS_CHECK without the bit of this check
        (gnss(0b10, parameters={**V114, "EKF2_GPS_CHECK": 0b10}), None, ()),
        (gnss(status_flags={"gnss_fault": on(1.0)}), "fault", ("EKF2_GPS_MODE",)),
        (gnss(status_flags={"yaw_align": on(0.0)}), "alignment", ("heading",)),
    ],
)  # fmt: skip
def test_unmet_ekf2_fusion_condition_is_reported_with_value(
    tried: UnfusedPositions, name: str | None, texts: tuple[str, ...]
) -> None:
    found = find_unmet_condition(tried)
    assert found.condition == (name or "")
    for text in texts:
        assert text in f"{found.fault} {found.reason} {found.action}"


def unfused(**parts: Any) -> Any:
    """Make a flight of v1.14 in which EKF2 never fuses external vision."""
    ekf2 = {"fusion_flags": pd.DataFrame({"horizontal": on(0.0)}), "horizon_s": 0.2}
    ekf2 |= parts.pop("ekf2", {})
    return analysis(ekf2=ekf2, source=source(**parts.pop("source", {})), **parts)


def test_ekf2_not_fusing_constant_positions_is_no_fusion_fault() -> None:
    still = unfused(source={"samples": positions(np.arange(0.0, 120.0, 0.1), 2.0)},
                    ekf2={"parameters": {"EKF2_EV_CTRL": 2.0}})  # fmt: skip
    assert named(ekf2_fusion.detect_position_fusion_faults, still) == {}


def test_position_file_not_sent_to_ekf2_is_no_fusion_fault() -> None:
    beside = unfused(
        source={"origin": POSITION_FILE_ORIGIN}, ekf2={"parameters": {"EKF2_EV_CTRL": 0.0}}
    )
    assert named(ekf2_fusion.detect_position_fusion_faults, beside) == {}
    # EKF2 received the same or another source
    beside.flight.positions = (beside.source, source())
    assert "EKF2_EV_CTRL to 1" in only(ekf2_fusion.detect_position_fusion_faults, beside).remedy


@pytest.mark.parametrize(
    ("valid_until_s", "expected"), [(109.0, {}), (90.0, "warning"), (40.0, "error")]
)
def test_position_that_ekf2_declares_invalid_is_reported(
    valid_until_s: float, expected: Any
) -> None:
    valid = pd.Series([1.0, 0.0], index=[0.0, valid_until_s])
    state = positions(np.arange(0.0, 120.0), 2e6)
    one = unfused(ekf2={"status_flags": {"xy_valid": valid}, "state": state, "fusion_flags": NONE},
                  flight={"truth": NONE})  # fmt: skip
    assert named(ekf2_fusion.detect_position_fusion_faults, one) == (
        {"ekf2_position_invalid": expected} if expected else {}
    )
    for finding in ekf2_fusion.detect_position_fusion_faults(one):
        assert "1999910 m" in finding.message or "1999960 m" in finding.message
        assert finding.spans_s == ((valid_until_s, 110.0),)


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("path", "source_name", "texts"),
    [
        ("cases/case19.ulg", "vehicle_visual_odometry", ("quality is 20", "EKF2_EV_QMIN 50")),
        ("cases/case10.ulg", "vehicle_visual_odometry", ("UNIX time", "UXRCE_DDS_SYNCT")),
        ("logs/conventions/quality_low.ulg", None, ("quality is 30", "EKF2_EV_QMIN 50")),
        ("logs/conventions/stamps_ms.ulg", None, ("in milliseconds", "microseconds")),
        ("logs/gps/main202603_gps_outage_flow.ulg", None, ("3D fix (check failed 96 %", "23.9 s")),
        ("logs/simulated/v1.16.1_aisle_nlos.ulg", None, ("no position for 8.2 s",)),
        ("logs/conventions/clean_uwb.ulg", None, ()),
        ("logs/flown/eg1_base.ulg", None, ()),
    ],
)
def test_unmet_ekf2_fusion_condition_is_found_in_real_log(
    path: str, source_name: str | None, texts: tuple[str, ...], shared_logs: Path
) -> None:
    flight = read_log(shared_logs.parent / path)
    compared = compare(flight, position_source=source_name)
    found = [
        one
        for one in ekf2_fusion.detect_position_fusion_faults(compared)
        if "condition" in one.evidence
    ]
    assert len(found) == bool(texts)
    for text in texts:
        assert text in f"{found[0].message} {found[0].remedy}"


def test_gnss_is_fused_if_flags_are_missing_and_xy_global_is_set() -> None:
    ekf2 = made(Ekf2, aids={}, status_flags={"xy_global": on(1.0)})
    assert has_fused_aid(ekf2)
    assert not has_fused_aid(ekf2, "baro_hgt")
    assert not has_fused_aid(made(Ekf2, aids={}, status_flags={"xy_global": on(0.0)}))
    # flags without an aiding source mean that EKF2 did not fuse it
    flags = {"xy_global": on(1.0), "tilt_align": on(1.0)}
    assert not has_fused_aid(made(Ekf2, aids={}, status_flags=flags))
