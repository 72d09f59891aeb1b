"""Detectors, except those of noises, at the limits of their thresholds.

The limits are repeated here, so a change of a threshold fails a test.
"""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from findings_tools import (
    DRIFTING,
    NONE,
    against_truth,
    ages,
    analysis,
    at_rate,
    axis,
    hiding,
    jump,
    late,
    log,
    made,
    named,
    only,
    positions,
    severity,
    source,
    statement,
    tried,
    tuned,
    with_bias,
)
from flights import given_placement

from px4fuse.comparison.flight_events import find_source_gaps
from px4fuse.comparison.rerun_effects import Rerun, RunStatistics
from px4fuse.filter.correlated_noise import SourceLowPass, TimeCorrelatedNoise
from px4fuse.filter.frame_rotation import HeadingError, HeadingErrorInPart
from px4fuse.filter.frame_rotation import combine_heading_parts as together
from px4fuse.filter.hypotheses import Estimate, SystematicErrors
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.finding import Finding, format_spans
from px4fuse.findings import (
    ekf2_fusion,
    ekf2_settings,
    ekf2_state,
    hidden_errors,
    imu,
    recording,
    source_clock,
    source_errors,
    source_frame,
    source_intervals,
    source_positions,
    source_stamps,
)
from px4fuse.findings.model import (
    SOURCE_GAP_CAUSE,
    SOURCE_TEXTS,
    UNKNOWN_CAUSE,
    compute_flag_fraction,
    find_spans_with_value,
    make_zero_length_spans,
    split_cause_groups,
)
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    AS_RECEIVED_ORIGIN,
    GNSS_ORIGIN,
    KEPT_BY_EKF2_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    REBUILT_FROM_INNOVATIONS_ORIGIN,
    ClockConversion,
    Columns,
    Dropout,
    Reset,
    Truth,
    Unavailable,
)


def with_fusion(*pairs: tuple[float, float], column: str = "horizontal") -> dict[str, Any]:
    """EKF2 fields with a fusion flag that changes at these times."""
    time, value = zip(*pairs, strict=True)
    return {"fusion_flags": pd.DataFrame({column: value}, index=list(time), dtype=float)}


def make_finding(name: str, level: Any = "error", caused_by: str | None = None) -> Finding:
    return Finding(name, level, "It is so.", "Do it.", caused_by=caused_by)


# ---------------------------------------------------------------- times and order


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ((), ""), (((1.0, 1.0),) * 3, "1.0 s, 1.0 s, 1.0 s"),
        (((1.0, 1.0), (2.0, 2.0), (3.0, 3.0), (4.0, 5.0)), "1.0 s to 5.0 s"),
        (((0.0, 0.05),), "0.0 s"), (((0.0, 0.06),), "0.0 s to 0.1 s"),
    ],
)  # fmt: skip
def test_fault_report_lists_times_of_occurrence(spans: Any, expected: str) -> None:
    assert format_spans(spans) == expected


def test_status_flag_before_first_sample_has_first_logged_value() -> None:
    flag, whole = pd.Series([1.0, 0.0, 1.0], index=[20.0, 30.0, 80.0]), Segment(10.0, 110.0, "")
    assert compute_flag_fraction(flag, whole) == 0.5
    assert compute_flag_fraction(flag, Segment(25.0, 35.0, "")) == 0.5
    assert find_spans_with_value(0.0, flag, whole) == ((30.0, 80.0),)
    assert find_spans_with_value(1.0, flag, whole) == ((10.0, 30.0), (80.0, 110.0))
    assert find_spans_with_value(0.0, flag, Segment(40.0, 50.0, "")) == ((40.0, 50.0),)


def test_fault_is_grouped_with_the_fault_that_caused_it() -> None:
    first, other = make_finding("kf_underconfident"), make_finding("no_motion", "note")
    follows = make_finding("kf_underconfident", caused_by="kf_underconfident")
    assert split_cause_groups([first, follows, other]) == [[first, follows], [other]]


# ---------------------------------------------------------------- EKF2


NO_GAP = SimpleNamespace(gaps=())


def test_ekf2_resets_outside_evaluated_segment_are_ignored() -> None:
    switches = tuple((time, 1) for time in (-np.inf, 10.0, 10.5, 110.0, 110.1))
    resets = (
        Reset(10.0, "position", (9.0, 0.0, 0.0)), Reset(10.5, "position", (3.0, 0.0, -4.0)),
        Reset(40.0, "velocity", (9.0, 0.0, 0.0)), Reset(50.0, "position", (0.0, 0.0, 0.0)),
        Reset(110.0, "position", (0.0, 0.0, 1.0)), Reset(110.1, "position", (9.0, 0.0, 0.0)),
    )  # fmt: skip
    one = analysis(ekf2={"primary_instances": switches, "resets": resets}, events=NO_GAP)
    reset, switch = ekf2_state.detect(one)
    assert switch.evidence == {"count": 2, "at_s": 10.5}
    # the reset of the height alone is not counted
    assert reset.evidence == {"count": 1, "largest_m": 5.0, "at_s": 10.5, "cause": UNKNOWN_CAUSE}


@pytest.mark.parametrize(
    ("reset", "gaps", "expected"),
    [
        # a height reset within 10 s of take-off is usual
        (Reset(30.0, "position", (0.0, 0.0, 1.0)), (), None),
        (Reset(30.1, "position", (0.0, 0.0, 1.0)), (), ("note", UNKNOWN_CAUSE)),
        (Reset(19.9, "position", (0.0, 0.0, 1.0)), (), ("note", UNKNOWN_CAUSE)),
        (Reset(30.0, "position", (1.0, 0.0, 1.0)), (), ("warning", UNKNOWN_CAUSE)),
        # up to 5 s after a gap in the source
        (Reset(65.0, "position", (1.0, 0.0, 0.0)), ((50.0, 60.0),), ("warning", SOURCE_GAP_CAUSE)),
        (Reset(65.1, "position", (1.0, 0.0, 0.0)), ((50.0, 60.0),), ("warning", UNKNOWN_CAUSE)),
    ],
)
def test_ekf2_height_reset_at_take_off_is_not_reported(
    reset: Reset, gaps: Any, expected: Any
) -> None:
    one = analysis(ekf2={"primary_instances": (), "resets": (reset,)},
                   flight={"airborne": ((20.0, 90.0),)},
                   events=SimpleNamespace(gaps=gaps))  # fmt: skip
    found = [(each.severity, each.evidence["cause"]) for each in ekf2_state.detect(one)]
    assert found == ([] if expected is None else [expected])


def test_log_dropouts_outside_evaluated_segment_are_ignored() -> None:
    lost = tuple(Dropout(at, 1.0) for at in (8.9, 9.0, 50.0, 110.0, 110.1))
    finding = only(
        recording.detect_dropouts, analysis(log=log(dropouts=(*lost, Dropout(60.0, 0.5))))
    )
    assert finding.evidence == {"count": 4, "total_s": 3.5}


@pytest.mark.parametrize(
    ("until_s", "expected"),
    [
        (108.0, {}), (107.9, {"ekf2_fusion_interrupted": "warning"}),
        (60.0, {"ekf2_fusion_interrupted": "warning"}), (59.9, {"ekf2_not_fusing": "error"}),
    ],
)  # fmt: skip
def test_ekf2_fusion_for_50_to_98_percent_of_time_is_a_warning(
    until_s: float, expected: dict[str, str]
) -> None:
    one = analysis(ekf2=with_fusion((0.0, 1.0), (until_s, 0.0)))
    assert named(ekf2_fusion.detect_position_fusion_faults, one) == expected
    for finding in ekf2_fusion.detect_position_fusion_faults(one):
        assert f"fused the UWB positions only {until_s - 10.0:.0f} % of the time" in finding.title
        assert finding.spans_s == ((until_s, 110.0),)


def never_fusing(rate_hz: float = 5.0, age_s: float | None = None, **parts: Any) -> Any:
    """Make a flight on which EKF2 never fuses; samples have this age, the horizon is 0.2 s."""
    if age_s is not None:
        ages = [9.0, age_s, age_s, age_s, 9.0]
        parts["status"] = pd.DataFrame({"age_s": ages}, index=[9.0, 20.0, 30.0, 40.0, 111.0])
    horizon, parameters = parts.pop("horizon_s", 0.2), parts.pop("parameters", {})
    ekf2 = {**with_fusion((0.0, 0.0)), "horizon_s": horizon}
    fed = source(rate_hz=rate_hz, **parts)
    return analysis(ekf2=ekf2, log=log(parameters=parameters), source=fed)


UNKNOWN = "The log does not show why EKF2 fused no position"


@pytest.mark.parametrize(
    ("flight", "reason", "remedy"),
    [
        (
            never_fusing(parameters={"EKF2_EV_CTRL": 14.0}),
            "EKF2_EV_CTRL is 14. Fusion of horizontal position is disabled: bit 0",
            "to 15.",
        ),
        (
            never_fusing(parameters={"EKF2_EV_CTRL": 15.0, "EKF2_AID_MASK": 1.0}),
            UNKNOWN,
            "ekf2 status",
        ),
        (
            never_fusing(parameters={"EKF2_AID_MASK": 1.0}),
            "EKF2_AID_MASK is 1. Fusion of external vision position is disabled: bit 3",
            "to 9.",
        ),
        (never_fusing(parameters={"EKF2_AID_MASK": 9.0}), UNKNOWN, "ekf2 status"),
        (never_fusing(2.0), UNKNOWN, "ekf2 status"),  # releases before v1.14 have no limit
        (
            never_fusing(2.0, parameters={"EKF2_EV_CTRL": 15.0}),
            "the positions come at 2 Hz",
            "10 Hz",
        ),
        (
            never_fusing(2.0, parameters={"EKF2_EV_CTRL": 15.0}, origin=KEPT_BY_EKF2_ORIGIN),
            UNKNOWN,
            "SDLOG_PROFILE",
        ),
        (never_fusing(5.0, parameters={"EKF2_EV_CTRL": 15.0}), UNKNOWN, "ekf2 status"),
        (never_fusing(age_s=0.29), UNKNOWN, "ekf2 status"),
        (never_fusing(age_s=1.0, horizon_s=NONE), UNKNOWN, "ekf2 status"),
        (never_fusing(age_s=5.0, horizon_s=NONE), "the positions are 5.00 s old", "TIMESYNC"),
        (never_fusing(age_s=-4.1), "the timestamps are 4.10 s in the future", "TIMESYNC"),
        (
            never_fusing(age_s=0.31),
            "0.31 s old at arrival. EKF2 fuses no position older than 0.20 s",
            "EKF2_DELAY_MAX to 350 ms",
        ),
        (
            never_fusing(age_s=0.28, parameters={"EKF2_EV_DELAY": 50.0}),
            "the positions are 0.33 s old",
            "EKF2_DELAY_MAX",
        ),
    ],
)
def test_report_on_ekf2_that_never_fuses_states_the_reason(
    flight: Any, reason: str, remedy: str
) -> None:
    finding = only(ekf2_fusion.detect_position_fusion_faults, flight)
    assert finding.severity == "error"
    assert finding.title.startswith("EKF2 never fused the UWB positions")
    assert reason in finding.message
    assert remedy in finding.remedy


def rejected(count: int, of: int) -> pd.DataFrame:
    return pd.DataFrame(
        {"rejected": np.arange(of) < count}, index=20.0 + np.arange(of), dtype=float
    )


@pytest.mark.parametrize(
    ("count", "of", "expected"),
    [(1, 100, "warning"), (1, 101, None), (20, 100, "error"), (19, 100, "warning")],
)
def test_severity_of_rejections_depends_on_rejected_percentage(
    count: int, of: int, expected: str | None
) -> None:
    """EKF2 rejects the horizontal vector, so the axis of largest motion is used."""
    axes = (
        axis("north", ekf2_innovations=rejected(count, of)),
        axis("east", ekf2_innovations=rejected(9, 9)),
    )
    level = analysis(ekf2={"gate": 5.0}, axes=axes)
    down = analysis(ekf2={"gate": 5.0}, axes=(axis("down", ekf2_innovations=rejected(count, of)),))
    for one, quantity, remedy in (
        (
            level,
            "of the positions. The rejected innovations are outside EKF2's gate of 5 √S",
            CHECK_FIRST,
        ),
        (down, "of the heights", CHECK_FIRST),
    ):
        assert severity(ekf2_settings.detect_rejections, one) == expected
        for finding in ekf2_settings.detect_rejections(one):
            assert finding.spans_s == make_zero_length_spans(20.0 + np.arange(count))
            assert quantity in finding.message
            assert finding.remedy.endswith(remedy)


def test_ekf2_noise_is_advised_if_rerun_halves_rejections() -> None:
    frame = rejected(20, 100)
    for after, improves, action in (
        (0.09, True, "Set EKF2_EVP_NOISE to 0.1 m."), (0.1, True, CHECK_FIRST),
        (0.09, False, CHECK_FIRST),
    ):  # fmt: skip
        trial = Rerun(
            filter="ekf2", axis="north", kinds=("noise",), change={"EKF2_EVP_NOISE": 0.1},
            before=RunStatistics(nis_mean=9.0, rejected_fraction=0.2),
            after=RunStatistics(nis_mean=1.0 if improves else 8.0, rejected_fraction=after),
        )  # fmt: skip
        one = analysis(ekf2={"gate": 5.0}, axes=(axis("north", ekf2_innovations=frame),),
                       reruns=(trial,))  # fmt: skip
        assert only(ekf2_settings.detect_rejections, one).remedy == action


CHECK_FIRST = (
    "Check the data link and the line of sight to the anchors. Then check EKF2_EV_DELAY and "
    "EKF2_EVP_NOISE. Increase EKF2_EVP_GATE only if no fault is found."
)


# ---------------------------------------------------------------- errors and truth


def test_too_small_sigma_is_reported_for_axis_of_largest_motion() -> None:
    ekf2 = axis("east", ekf2=statement(0.49), ekf2_truth=against_truth(25.0, 1.0))
    finding = only(hidden_errors.detect, analysis(axes=(axis(), hiding(name="down"), ekf2)))
    assert finding.title == (
        "Position errors that innovations do not show: KF error 2.0 times the reported σ, "
        "EKF2 error 5.0 times the reported σ"
    )
    assert finding.evidence["filter"] == "ekf2"
    # the axis of largest motion is preferred
    main = only(hidden_errors.detect, analysis(axes=(hiding(), ekf2)))
    assert main.evidence["filter"] == "kf"
    assert finding.evidence["ekf2_sigma_p_m"] == pytest.approx(0.2)
    # the time offset is unknown in this analysis
    time_offset_check = "A time offset of the positions is possible, but this log cannot show it: "
    assert finding.remedy.startswith(time_offset_check)
    check = finding.remedy
    assert check.endswith(f"{SOURCE_TEXTS['uwb'].slow_error_check}.")
    known = only(hidden_errors.detect, analysis(axes=(axis(), hiding()), time_offset=late(0.0)))
    assert known.remedy.startswith("Check the time offset of the positions (px4fuse sync LOG). ")
    # the error is EKF2's own only if the RMSE of KF is below 0.7 of it
    for kf_rmse_m, remedy in (
        (0.27, hidden_errors.EKF2_REMEDY),
        (0.28, check),
        (0.4, check),
    ):
        just = axis("east", kf=statement(2.0), kf_truth=against_truth(25.0, kf_rmse_m),
                    ekf2=statement(0.5), ekf2_truth=against_truth(25.0))  # fmt: skip
        alone = only(hidden_errors.detect, analysis(axes=(just,)))
        assert alone.remedy == remedy
    drifts = only(hidden_errors.detect, analysis(axes=(hiding(),), source=source(origin=DRIFTING)))
    assert drifts.remedy == hidden_errors.DRIFT_REMEDY


@pytest.mark.parametrize(("left", "frame"), [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("drifts", [False, True])
def test_frame_is_misaligned_if_alignment_halves_position_rmse(
    left: float, frame: bool, drifts: bool
) -> None:
    """Circle of 5 m with a shift and an error that changes its sign with each sample."""
    time = np.arange(20.0, 100.0, 0.1)
    angle = 0.2 * np.pi * time
    true = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    estimate = true + np.array([0.0, np.sqrt(1.0 - left**2)])
    estimate[::2, 0] += left
    estimate[1::2, 0] -= left
    estimate[0] = np.nan
    axes = [
        axis(name, ekf2=statement(), ekf2_truth=against_truth(9.0),
             truth=pd.DataFrame({"position_m": true[:, at]}, index=time),
             ekf2_state=pd.DataFrame({"position_m": estimate[:, at]}, index=time))
        for at, name in enumerate(("north", "east"))
    ]  # fmt: skip
    track = source(origin=DRIFTING if drifts else AS_RECEIVED_ORIGIN)
    finding = only(hidden_errors.detect, analysis(axes=tuple(axes), source=track))
    assert finding.evidence["position_rmse_horizontal_m"] == pytest.approx(1.0, rel=0.01)
    assert finding.evidence["position_rmse_aligned_m"] == pytest.approx(left, rel=0.01)
    assert (
        "The position frame is misaligned: horizontal position RMSE 1.00 m" in finding.message
    ) is frame
    assert (finding.id == "source_drift") is (drifts and not frame)
    if finding.id == "source_drift":
        assert finding.message.startswith(
            "VIO drifts: horizontal position RMSE 1.00 m before and 0.55 m after alignment (shift"
        )
    assert (finding.remedy == hidden_errors.FRAME_REMEDY) is frame


# ---------------------------------------------------------------- the log


@pytest.mark.parametrize(
    ("ends", "segment", "spans"),
    [
        ((10.2, 109.97), (10.0, 110.0), [(10.0, 10.2), (39.99, 42.0)]),
        ((10.2, 109.97), (42.0, 110.0), []), ((10.2, 109.97), (10.2, 39.9), []),
        ((10.0, 109.9), (10.0, 110.0), [(39.99, 42.0), (109.9, 110.0)]),
    ],
)  # fmt: skip
def test_imu_gaps_are_found_only_inside_evaluated_segment(
    ends: Any, segment: Any, spans: Any
) -> None:
    """Gaps at an end count if longer than 0.05 s; gaps outside the segment do not."""
    time = np.concatenate([np.arange(ends[0], 40.0, 0.01), np.arange(42.0, ends[1], 0.01)])
    found = imu._find_gap_spans(pd.DataFrame(index=time), Segment(*segment, ""))
    assert len(found) == len(spans)
    assert not spans or np.allclose(found, spans, atol=0.02)


@pytest.mark.parametrize(
    ("imu_hz", "attitude_hz", "expected"),
    [(49.1, 9.9, []), (48.9, 9.9, [100.0]), (49.1, 9.7, [20.0])],
)
def test_imu_rate_below_98_percent_of_required_is_reported(imu_hz, attitude_hz, expected) -> None:
    flight = {"imu": at_rate(imu_hz), "attitude": at_rate(attitude_hz)}
    for info, action in (
        (log(), "Set SDLOG_PROFILE to 17 "),
        (log(format="MAVLink tlog", writes_ulog=False), "at {:g} Hz (MAV_CMD_SET"),
        (log(format="MAVLink tlog"), "SET_MESSAGE_INTERVAL), or give the ULog"),
    ):
        found = list(imu.detect_low_rates(analysis(flight=flight, log=info).flight))
        assert [finding.evidence["needed_hz"] * 2.0 for finding in found] == expected
        assert all(action.format(hz) in f.remedy for f, hz in zip(found, expected, strict=True))


def test_report_states_why_positions_sent_to_ekf2_are_not_logged() -> None:
    lacks = (
        Unavailable("another", "no", "Do."),
        Unavailable("it", "it was disabled", "Do.", source="vehicle_visual_odometry"),
    )
    profile = log(parameters={"SDLOG_PROFILE": 2.0})
    for origin in (ALIGNED_BY_EKF2_ORIGIN, KEPT_BY_EKF2_ORIGIN, REBUILT_FROM_INNOVATIONS_ORIGIN):
        of = source(origin=origin)
        found = only(
            recording.detect_source_not_logged, analysis(source=of, missing=lacks, log=profile)
        )
        assert found.id == "source_not_logged"
        assert "Reason: it was disabled." in found.message
        assert "SDLOG_PROFILE to 130 " in found.remedy
    for origin, tracks in (
        (AS_RECEIVED_ORIGIN, ()), (MOTION_CAPTURE_ORIGIN, ()), (GNSS_ORIGIN, ()),
        (ALIGNED_BY_EKF2_ORIGIN, (SimpleNamespace(origin=AS_RECEIVED_ORIGIN),)),
    ):  # fmt: skip
        one = analysis(source=source(origin=origin), flight={"positions": tracks})
        assert named(recording.detect_source_not_logged, one) == {}


@pytest.mark.parametrize(("rate_hz", "least_s"), [(2.0, 2.5), (10.0, 1.0)])
def test_position_gap_above_1_s_and_five_intervals_is_reported(
    rate_hz: float, least_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    for gap_s, there in ((least_s, False), (least_s + 0.25, True)):
        monkeypatch.setattr(source_intervals, "describe_errors_after_gap", lambda *_: "Errors.")
        time = np.concatenate([np.arange(10.0, 20.5, 0.5), [20.0 + gap_s, 20.5 + gap_s]])
        gaps = find_source_gaps(time, rate_hz)
        one = analysis(
            axes=(axis(),), source=source(rate_hz=rate_hz), events=SimpleNamespace(gaps=gaps)
        )
        found = list(source_intervals.detect_source_gaps(one))
        assert [each.evidence for each in found] == [
            {"count": 1, "longest_s": gap_s, "at_s": 20.0}
        ] * there


def test_motion_range_omits_extreme_5_percent_of_positions() -> None:
    moving = positions(10.0 + np.arange(100))
    moving["east_m"] = np.repeat([-9.0, -1.0, -0.5, 0.0, 0.5, 1.0, 9.0], [3, 4, 3, 80, 3, 4, 3])
    outside = positions([5.0, 111.0], 99.0)
    comparison = analysis(source=source(samples=pd.concat([moving, outside])))
    assert source_positions.compute_motion_range_m(comparison) == 2.0


# ---------------------------------------------------------------- frames


def test_wrong_frame_of_position_file_is_reported_as_error() -> None:
    placed = SimpleNamespace(
        misplaced=("as good as ned: give --position-frame ned.",), warnings=("it is weak.",)
    )
    frame, yaw = source_frame.detect_uncertain_alignment(analysis(source=source(alignment=placed)))
    assert (frame.severity, yaw.severity) == ("error", "warning")
    assert frame.message == "As good as ned: give --position-frame ned."


@pytest.mark.parametrize(("until_s", "expected"), [(60.0, "warning"), (60.1, "note")])
def test_frd_frame_has_severity_note_if_ekf2_fuses_vision_yaw(
    until_s: float, expected: str
) -> None:
    frd = source(frame="FRD")
    one = analysis(source=frd, ekf2=with_fusion((0.0, 1.0), (until_s, 0.0), column="yaw"))
    finding = only(source_frame.detect, one)
    assert finding.severity == expected
    assert ("EKF2 fused the yaw of UWB" in finding.message) is (expected == "note")
    assert ("Send the position in NED" in finding.remedy) is (expected == "warning")
    assert severity(source_frame.detect, analysis(source=frd)) == "warning"
    assert severity(source_frame.detect, analysis()) is None
    finding = only(source_frame.detect, analysis(source=frd, ekf2={"fusion_flags": NONE}))
    assert finding.severity == "note"
    assert "Give the ULog" in finding.remedy


def heading_error(*degrees: float, sigma_deg: float = 1.0, p: float = 1.0) -> HeadingError:
    parts = (
        HeadingErrorInPart(10.0 * n, 10.0 * n + 10.0, d, sigma_deg) for n, d in enumerate(degrees)
    )
    return together(tuple(parts), p, "positions")


def test_report_on_misaligned_frame_contains_rotation_to_apply() -> None:
    finding = only(source_frame.detect, analysis(heading=heading_error(20.0, sigma_deg=2.0)))
    assert finding.id == "source_frame_misaligned"
    assert finding.title == "UWB positions are rotated by +20° relative to the IMU"
    assert "The rotation (± 4°, 95 %) is clockwise" in finding.message
    assert "Rotate the positions by -20°" in finding.remedy
    aligned = source(name="estimator_visual_odometry_aligned")
    one = analysis(heading=heading_error(20.0), source=aligned)
    assert only(source_frame.detect, one).id == "ekf2_heading_error"


def test_report_on_heading_drift_states_angles_at_start_and_end() -> None:
    drifting = heading_error(2.0, 30.0, p=0.0)
    for orientation in (object(), None):
        one = analysis(heading=drifting, source=source(orientation=orientation))
        finding = only(source_frame.detect, one)
        assert ("EKF2_EV_CTRL bit 3" in finding.remedy) is (orientation is not None)
    assert finding.title == "EKF2's heading drifts by +28° relative to the UWB positions"
    assert finding.id == "ekf2_heading_error"
    assert "+2° from 0 to 10 s and +30° from 10 to 20 s" in finding.message
    assert "estimated from positions and IMU" in finding.message
    assert (finding.evidence["from_deg"], finding.evidence["p"]) == (2.0, 1e-300)


@pytest.mark.parametrize("noise_is_wrong", [False, True])
@pytest.mark.parametrize("degrees", [(20.0,), (2.0, 30.0)])
def test_heading_error_due_to_gnss_noise_advises_its_correction(degrees, noise_is_wrong) -> None:
    """A re-run with another EKF2_GPS_P_NOISE makes EKF2's innovations consistent."""
    trial = tried("ekf2", {"EKF2_GPS_P_NOISE": 0.4})
    one = analysis(
        heading=heading_error(*degrees, p=0.0), source=source(origin=GNSS_ORIGIN),
        reruns=(replace(trial, kinds=("noise",)),) if noise_is_wrong else (),
    )  # fmt: skip
    finding = only(source_frame.detect, one)
    text = f"{finding.message} {finding.remedy}"
    assert ("magnetometer away" in text) is not noise_is_wrong
    assert ("Set EKF2_GPS_P_NOISE to 0.4 m" in finding.remedy) is noise_is_wrong


def test_heading_angles_are_printed_from_minus_180_to_180_deg() -> None:
    finding = only(source_frame.detect, analysis(heading=heading_error(170.0, 230.0, p=0.0)))
    assert "The heading error is +170° from 0 to 10 s and -130° from 10 to 20 s" in finding.message
    finding = only(source_frame.detect, analysis(heading=heading_error(340.0)))
    assert "rotated by -20°" in finding.title


# ---------------------------------------------------------------- limits


def motion_capture_flight(name: str, first: float) -> Any:
    fed = source(name=name, origin=MOTION_CAPTURE_ORIGIN)
    return analysis(ekf2=with_fusion((0.0, first), (100.0, 0.0)), source=fed)


def with_extent(extent_m: float) -> Any:
    samples = positions(10.0 + np.arange(100), np.repeat([0.0, extent_m], 50))
    return analysis(source=source(samples=samples))


FUSED, FRAME = ekf2_fusion.detect_position_fusion_faults, source_frame.detect
EDGES = [
    # motion capture is an independent reference if EKF2 fuses external vision
    (FUSED, motion_capture_flight("vehicle_mocap_odometry", 0.0), "warning"),
    (FUSED, motion_capture_flight("vehicle_mocap_odometry", 1.0), None),
    (FUSED, motion_capture_flight("GPS", 0.0), None),
    *(
        (hidden_errors.detect, analysis(axes=(hiding(nis, nees),)), expected)
        for nis, nees, expected in (
            (1.0, 4.0, "warning"),
            (1.0, 3.99, None),
            (1.49, 4.0, "warning"),
            (1.5, 4.0, None),
            (1.0, 15.9, "warning"),
            (1.0, 16.0, "error"),
            (1.0, None, None),
        )
    ),
    *(
        (
            imu.detect_imu_gaps,
            analysis(
                axes=(axis(kf_run=SimpleNamespace(input_gap_s=gap_s)),),
                flight={"imu": at_rate(rate_hz)},
            ),
            expected,
        )
        for gap_s, rate_hz, expected in (
            (0.2, 100.0, None),
            (0.201, 100.0, "warning"),
            (0.499, 4.0, None),
            (0.501, 4.0, "warning"),
        )
    ),
    (source_positions.detect_little_motion, with_extent(0.5), None),
    (source_positions.detect_little_motion, with_extent(0.499), "warning"),
    *(
        (FRAME, analysis(heading=heading), expected)
        for heading, expected in (
            (heading_error(5.0), "warning"),
            (heading_error(4.9), None),
            (heading_error(14.9), "warning"),
            (heading_error(15.0), "error"),
            (heading_error(8.0, sigma_deg=2.0), "warning"),
            (heading_error(7.9, sigma_deg=2.0), None),
            (heading_error(0.0, 14.9, p=0.0), "warning"),
            (heading_error(0.0, 15.0, p=0.0), "error"),
        )
    ),
    (
        FRAME,
        analysis(heading=heading_error(20.0), source=source(origin=KEPT_BY_EKF2_ORIGIN)),
        None,
    ),
]


# ---------------------------------------------------------------- the position source and the IMU

MOVING = positions(np.arange(0.0, 120.0), np.arange(120.0))
ODOMETRY = {"source": source(orientation=object(), samples=MOVING)}
REBUILT = {"source": source(origin=KEPT_BY_EKF2_ORIGIN, samples=MOVING)}


def bias_of_ekf2(*bias: float) -> dict[str, Any]:
    """EKF2 bias in the segment, and a larger one outside it."""
    rows = [[9.0] * 3, bias, bias, bias, [9.0] * 3]
    index = [9.0, 10.0, 50.0, 110.0, 111.0]
    return {"accelerometer_bias": pd.DataFrame(rows, index=index, columns=Columns.SPECIFIC_FORCE)}


def clock_map(method: str = "TIMESYNC", distinct: int | None = None, jitter_s: float = 0.02) -> Any:
    return ClockConversion("UNIX time", method, 600, 0.0, 0.0, jitter_s, "", distinct)


def at_intervals(multiples: list[int], base_s: float = 0.125, **parts: Any) -> Any:
    time = 10.0 + np.concatenate([[0.0], base_s * np.cumsum(multiples)])
    return analysis(source=source(samples=positions(time), **parts))


def low_pass(gain: float, lag_s: float, **parts: Any) -> Any:
    usual = {"source_low_pass": SourceLowPass(0.5, lag_s, gain, 0.1), "time_offset": late(0.0)}
    return analysis(**{**usual, **parts})


def slow(gain: float, lag: float, slow_m: float = 0.1) -> TimeCorrelatedNoise:
    return TimeCorrelatedNoise(
        1.0,
        1.0,
        np.inf,
        slow_m=slow_m,
        white_m=0.1,
        gain_nats=gain,
        low_pass_gain_nats=lag,
    )


def repeating(again: int, count: int, moved_m: float = 5.0, **parts: Any) -> Any:
    """Make positions of which the last `again` repeat the previous one."""
    each = np.arange(count + 1.0)
    each[-again:] = each[-again - 1]
    return analysis(
        source=source(samples=positions(np.linspace(10.0, 110.0, count + 1),
                                        moved_m * each / each.max()), **parts)
    )  # fmt: skip


def jumping(*sizes: Any, **parts: Any) -> Any:
    return analysis(systematic_errors=made(SystematicErrors, jumps=sizes), **parts)


def scaled(value: float, sigma: float = 0.01, imu_hz: float = 49.1, **parts: Any) -> Any:
    found = made(SystematicErrors, scale=Estimate(value, sigma), jumps=())
    usual = {
        "systematic_errors": found,
        "flight": {"imu": at_rate(imu_hz)},
        "time_offset": late(0.0),
    }
    return analysis(**{**usual, **parts})


def with_reported_sigma(reported: float, noise: float, interval: Any = None, **parts: Any) -> Any:
    """Make a source that reports one standard deviation (m) and has another one."""
    low, high = interval or (0.99 * noise, 1.01 * noise)
    states = source(samples=positions(np.arange(0.0, 120.0), variance_m2=reported**2))
    usual = {"source_low_pass": SourceLowPass(0.0, 0.0, 0.0, noise), "source": states,
             "tuning": tuned(NoiseEstimate(noise, low, high), count=100)}  # fmt: skip
    return analysis(**{**usual, **parts})


def delayed(delay_ms: float | None, clock: Any, **parts: Any) -> Any:
    flown = {} if delay_ms is None else {"EKF2_EV_DELAY": delay_ms}
    return analysis(log=log(parameters=flown), time_offset=clock, **parts)


BIAS, JUMPS, SCALE = (
    imu.detect_accelerometer_bias,
    source_positions.detect_jumps,
    source_positions.detect_scale_error,
)
ARRIVALS, DOWNSAMPLED, CLOCK = (
    source_stamps.detect_arrival_timestamps,
    source_intervals.detect_downsampling,
    source_clock.detect,
)


def wrong_delay(one: Any) -> Any:
    return source_clock.detect_wrong_delay(one, one.time_offset)


STATED = source_positions.detect_wrong_variance
SOURCE_EDGES = [
    *((BIAS, analysis(systematic_errors=with_bias(sign * bias, sigma)), expected)
      for sign in (1.0, -1.0)
      for bias, sigma, expected in (
          (0.2, 0.01, "warning"), (0.199, 0.01, None), (0.3, 0.01, "error"),
          (0.299, 0.01, "warning"), (0.25, 0.0625, "warning"), (0.25, 0.0626, None))),
    # EKF2's bias if the positions give none; horizontally that of the positions is better
    *((BIAS, analysis(systematic_errors=fit, ekf2=bias_of_ekf2(*bias)), expected)
      for bias, fit, expected in (
          ((0.2, 0.0, 0.0), NONE, "warning"), ((0.199, 0.0, 0.0), NONE, None),
          ((0.0, 0.0, 0.2), with_bias(0.0), "warning"), ((0.5, 0.5, 0.1), with_bias(0.0), None))),
    *((ARRIVALS, analysis(ekf2=ekf2), expected) for ekf2, expected in (
        (ages(20, 0), "warning"), (ages(19, 0), None),  # at least 20 samples
        (ages(20, 0, wrong=1), "warning"), (ages(20, 0, wrong=2), None),  # 95 %
        (ages(10, 20), "warning"), (ages(9, 20), None), (ages(20, 10), "warning"),
        (ages(20, 9), None),  # at least 10 on each side
        (ages(20, 20, wrong=1), "warning"), (ages(20, 20, wrong=2), None),
        (ages(20, 20, 0.02), "warning"), (ages(20, 20, 0.0199), None),
        (ages(20, 20, 0.1), "error"), (ages(20, 20, 0.0999), "warning"),
        (ages(0, 30, 0.00099), "warning"), (ages(0, 30, 0.001), None))),
    (ARRIVALS, analysis(ekf2=ages(20, 20), **REBUILT), None),
    *((DOWNSAMPLED, at_intervals(multiples), expected) for multiples, expected in (
        ([1, 1, 2] * 20, "warning"), ([1, 1, 2] * 19 + [1, 1, 1], None),  # 25 % missing
        ([1, 2] * 25, "warning"), ([1, 2] * 24 + [1], None),  # at least 50 intervals
        ([2, 3] * 30, "error"),  # intervals of 0.31 s: EKF2 does not start
        ([2] * 54 + [3] * 6, "error"), ([2] * 55 + [3] * 5, None),  # at least 10 % of each multiple
        ([1] * 50 + [2] * 35 + [4] * 15, "error"), ([1] * 50 + [2] * 34 + [4] * 16, None))),
    # mapped timestamps and topics rebuilt by EKF2 show nothing
    (DOWNSAMPLED, at_intervals([1, 2] * 30, clock_map=clock_map()), None),
    (DOWNSAMPLED, at_intervals([1, 2] * 30, origin=ALIGNED_BY_EKF2_ORIGIN), None),
    (DOWNSAMPLED, at_intervals([1, 2] * 30, origin=MOTION_CAPTURE_ORIGIN), "warning"),
    # two samples lost in one interval
    *((source_intervals.detect_lost_samples, at_intervals([1] * singles + [3], 0.25, **parts),
       expected)
      for singles, parts, expected in (
          (96, {"clock_map": clock_map()}, "note"), (97, {"clock_map": clock_map()}, None),
          (47, {"clock_map": None}, None), (47, {"clock_map": clock_map("arrival time")}, None),
          (47, {"clock_map": clock_map(distinct=2)}, None))),
    *((source_positions.detect_low_pass, low_pass(gain, lag_s), expected)
      for gain, lag_s, expected in (
        (6.0, 0.05, "warning"), (5.9, 0.05, None), (6.0, 0.049, None),
        (6.0, 0.0999, "warning"), (6.0, 0.1, "error"))),
    # correlated errors without a lag are not from a low pass
    *((source_positions.detect_low_pass,
       low_pass(99.0, 1.0, time_correlated_noise=slow(99.0, lag)), expected)
      for lag, expected in ((0.9, None), (1.0, "error"))),
    *((source_errors.detect_time_correlated_noise,
       analysis(time_correlated_noise=slow(gain, lag)), expected)
      for gain, lag, expected in (
          (5.0, 0.9, "warning"), (4.9, 0.0, None), (99.0, 1.0, None))),
    *((source_errors.detect_time_correlated_noise,
       analysis(time_correlated_noise=slow(99.0, 0.0, slow_m)), expected)
      for slow_m, expected in ((0.0049, None), (0.005, "warning"))),
    # the height of a frame that was fitted to EKF2's track contains EKF2's height error
    *((hidden_errors.detect, analysis(
        axes=(hiding(name="down"),),
        source=source(alignment=replace(given_placement(), yaw_sigma_deg=sigma_deg))), expected)
      for sigma_deg, expected in ((None, "warning"), (0.1, None))),
    *((source_errors.detect_repeated_positions, repeating(again, count), expected)
      for again, count, expected in (
        (10, 200, "warning"), (9, 100, None), (10, 201, None), (30, 100, "error"),
        (29, 100, "warning"))),
    (source_errors.detect_repeated_positions, repeating(50, 100, moved_m=0.5), None),
    *((source_errors.detect_noise_faults,
       analysis(time_correlated_noise=slow(99.0, 0.0), **parts), None)
      for parts in (ODOMETRY, REBUILT)),
    (JUMPS, jumping(jump(0.0, 0.9), time_correlated_noise=slow(0.0, 0.0, 0.2)), None),
    (JUMPS, jumping(jump(0.0, 1.0), time_correlated_noise=slow(0.0, 0.0, 0.2)), "error"),
    (SCALE, scaled(0.5, time_correlated_noise=slow(0.0, 0.0)), None),
    (SCALE, scaled(0.5, ekf2=ages(20, 20)), None),
    (source_positions.detect, low_pass(99.0, 1.0, **ODOMETRY), None),
    (source_positions.detect, low_pass(99.0, 1.0, **REBUILT), None),
    *((JUMPS, jumping(jump(0.0, size), jump(0.1, 0.0)), expected) for size, expected in (
        (0.199, None), (0.2, "warning"), (0.499, "warning"), (0.5, "error"))),
    # a step of the time offset also shifts the positions of a moving vehicle
    (JUMPS, jumping(jump(0.0, 1.0), ekf2=ages(20, 20)), None),
    *((SCALE, scaled(sign * scale, sigma), expected)
      for sign in (1.0, -1.0)
      for scale, sigma, expected in (
          (0.12, 0.01, "warning"), (0.119, 0.01, None), (0.15, 0.01, "error"),
          (0.149, 0.01, "warning"), (0.1875, 0.0625, "error"), (0.187, 0.0625, None))),
    (SCALE, scaled(0.5, imu_hz=48.9), None),
    (SCALE, scaled(0.5, source=source(origin=GNSS_ORIGIN)), None),
    # without an estimated time offset the timestamps may be late
    *((which, of(time_offset=clock), expected)
      for which, of in ((SCALE, partial(scaled, 0.5)),
                        (source_positions.detect_low_pass, partial(low_pass, 99.0, 1.0)))
      for clock, expected in ((NONE, None), (late(0.0, is_determinable=False), "error"))),
    (SCALE, scaled(0.5, source_low_pass=SourceLowPass(0.5, 1.0, 99.0, 0.1)), None),
    *((source_positions.detect, scaled(0.5, **parts), None) for parts in (ODOMETRY, REBUILT)),
    *((source_positions.detect_outliers,
       analysis(tuning=tuned(outlier_time_s=20.0 + np.arange(outliers), count=count)), expected)
      for outliers, count, expected in (
          (3, 600, "warning"), (3, 601, None), (3, 150, "error"), (3, 151, "warning"),
          (2, 100, None))),
    *((STATED, with_reported_sigma(reported, noise), expected) for reported, noise, expected in (
        (3.0, 2.0, "warning"), (2.0, 3.0, "warning"), (1.41, 1.0, None), (1.42, 1.0, "warning"),
        (1.0, 1.41, None), (1.0, 1.42, "warning"), (1.73, 1.0, "warning"), (1.74, 1.0, "error"),
        (1.0, 1.74, "error"))),
    # inside the interval, no interval, unknown low pass, no reported variance, odometry
    *((STATED, with_reported_sigma(3.0, 1.0, interval), None) for interval in (
        (0.1, 9.0), (None, 9.0), (0.1, None))),
    (STATED, with_reported_sigma(3.0, 1.0, tuning=tuned(NoiseEstimate(None, None, 9.0))), None),
    (STATED, with_reported_sigma(3.0, 1.0, tuning={}), None),
    (STATED, with_reported_sigma(3.0, 1.0, source_low_pass=NONE), None),
    (STATED, with_reported_sigma(np.nan, 1.0), None),
    (source_positions.detect, with_reported_sigma(3.0, 1.0, **ODOMETRY), None),
    *((CLOCK, analysis(time_offset=late(sign * offset_s, sigma_s)), expected)
      for sign in (1.0, -1.0)
      for offset_s, sigma_s, expected in (
          (0.03, 0.001, None), (0.031, 0.001, "warning"), (0.1, 0.001, "warning"),
          (0.101, 0.001, "error"), (0.0625, 0.0208, "warning"), (0.0625, 0.0209, None))),
    *((CLOCK, analysis(**{"time_offset": late(0.2), **parts}), None) for parts in (
        {"time_offset": late(0.2, is_determinable=False)}, REBUILT, {"ekf2": ages(20, 20)},
        {"source_low_pass": SourceLowPass(0.5, 0.2, 99.0, 0.1)})),
    *((wrong_delay, delayed(delay_ms, late(0.0, sigma_s)), expected)
      for delay_ms, sigma_s, expected in (
          (30.1, 0.001, "warning"), (30.0, 0.001, None), (40.0, 0.0133, "warning"),
          (39.0, 0.0133, None), (None, 0.001, None))),
    (CLOCK, delayed(90.0, late(0.0, is_determinable=False)), None),
    (CLOCK, delayed(90.0, late(0.0), **REBUILT), None),
]  # fmt: skip


def test_report_on_accelerometer_bias_states_95_percent_interval() -> None:
    one = analysis(systematic_errors=with_bias(0.3, 0.05, -0.4), ekf2=bias_of_ekf2(0.1, -0.2, 0.0))
    finding = only(imu.detect_accelerometer_bias, one)
    assert "tilt error of 2.9° has the same effect" in finding.message  # 0.5 of 9.80665 m/s²
    assert "EKF2's bias estimate is +0.10 m/s² forward and -0.20 m/s² right." in finding.message
    assert finding.evidence == {"bias_m_s2": 0.5, "sigma_m_s2": 0.05}
    outside = bias_of_ekf2(9.0, 9.0, 9.0)["accelerometer_bias"].iloc[[0, 4]]
    assert (
        named(imu.detect_accelerometer_bias, analysis(ekf2={"accelerometer_bias": outside})) == {}
    )


@pytest.mark.parametrize(
    ("clock", "expected"),
    [(clock_map(distinct=2, jitter_s=0.010), ["source_timestamps_constant"]),
     (clock_map("receive time", 2, 0.011),
      ["source_timestamps_constant", "source_timestamp_jitter"]),
     (clock_map(jitter_s=0.5), []), (clock_map("arrival time"), ["companion_not_synchronised"])],
)  # fmt: skip
def test_constant_jittery_or_unsynced_timestamps_are_reported(
    clock: Any, expected: list[str]
) -> None:
    assert list(named(source_stamps.detect, analysis(source=source(clock_map=clock)))) == expected


def test_arrival_timestamps_before_timesync_are_reported() -> None:
    one = analysis(ekf2=ages(12, 20, 0.05))
    finding = only(source_stamps.detect_arrival_timestamps, one)
    assert finding.evidence == {"until_s": 32.0, "latency_s": 0.05}
    assert finding.spans_s == ((20.0, 32.0),)
    assert source_stamps.find_timesync_convergence(one) == (32.0, 0.05)
    assert finding.remedy.endswith("(--start 32).")
    assert source_stamps.find_timesync_convergence(analysis(ekf2=ages(30, 0))) is None


@pytest.mark.parametrize(("growth_s", "severity"), [(0.05, None), (0.2, "warning")])
def test_growing_latency_of_positions_is_reported(growth_s: float, severity: str | None) -> None:
    time_s = np.arange(20.0, 60.0)
    record = ages(0, len(time_s))["record"]
    record.vision_age_s[:] = 0.03 + growth_s * np.linspace(0.0, 1.0, len(time_s))
    one = analysis(ekf2={"record": record, "horizon_s": NONE})
    findings = list(source_stamps.detect_varying_latency(one))
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    assert all("from 0.05 s to 0.21 s" in finding.message for finding in findings)


@pytest.mark.parametrize(("late_share", "is_reported"), [(0.05, True), (0.01, False), (1.0, False)])
def test_positions_too_late_for_ekf2_buffer_are_reported(late_share, is_reported) -> None:
    record = ages(0, 400)["record"]
    record.vision_age_s[:] = np.where(np.arange(400) % 100 < 100 * late_share, 0.31, 0.2)
    one = analysis(ekf2={"record": record, "horizon_s": 0.2})
    findings = list(source_stamps.detect_varying_latency(one))
    assert [finding.severity for finding in findings] == ["error"] * is_reported
    assert all(
        "0.30 s after their timestamp: 5 % in this flight" in finding.message
        for finding in findings
    )


def test_position_sample_interval_is_found_despite_jitter() -> None:
    def base(intervals: Any) -> float | None:
        found = source_intervals._find_period(np.array(intervals))
        return None if found is None else found[0]

    assert base([1.0, 1.0, 2.0]) == 1.0
    # divisors up to 4 are tested
    assert base([1.0] * 5 + [1.25] * 2) is not None
    assert base([1.0] * 5 + [1.2] * 2) is None
    for off, there in ((0.058, True), (0.062, False)):
        # intervals of 1 s with this RMS deviation
        found = base(np.sort(1.0 + off * np.tile([1.0, -1.0], 15)))
        assert (found == pytest.approx(1.0)) if there else found is None


def test_gap_above_5_intervals_is_not_counted_as_lost_samples() -> None:
    for longest, lost in ((5.0, [4]), (5.1, [])):  # intervals of 0.25 s
        one = at_intervals([1.0] * 20 + [longest], 0.25, clock_map=clock_map())  # type: ignore[list-item]
        assert [each.evidence["lost"] for each in source_intervals.detect_lost_samples(one)] == lost


def test_report_on_position_jumps_states_count_and_largest_jump() -> None:
    sizes = (jump(0.3, 0.0, at_s=30.0), jump(0.6, 0.8, at_s=60.0), jump(0.1, 0.0, at_s=90.0))
    finding = only(source_positions.detect_jumps, jumping(*sizes))
    assert finding.evidence == {"count": 2, "size_m": 1.0, "at_s": 60.0, "sigma_m": 0.02}
    assert finding.spans_s == ((30.0, 30.0), (60.0, 60.0))


def test_report_on_scale_error_states_if_distances_are_too_long() -> None:
    for signed, word in ((0.2, "long"), (-0.2, "short")):
        finding = only(source_positions.detect_scale_error, scaled(signed))
        assert finding.title == f"UWB distances are 20 % too {word}"
        assert "(± 2 %, 95 %)" in finding.message
    for reported, word in ((2.0, "large"), (0.5, "small")):
        finding = only(source_positions.detect_wrong_variance, with_reported_sigma(reported, 1.0))
        assert finding.title == f"The variance that UWB reports is 4 times too {word}"
        assert ("time-correlated errors" in finding.message) is (word == "large")


@pytest.mark.parametrize(("error_m", "expected"), [(1.41, "error"), (1.42, None)])
def test_reported_variance_close_to_true_error_is_no_fault(error_m, expected):
    time = np.arange(0.0, 120.0)
    axes = tuple(axis(name) for name in ("north", "east"))
    for each, direction in zip(axes, np.eye(3), strict=False):
        each.axis.measurement_time_s, each.axis.measurement_m = time, error_m * (-1.0) ** time
        each.axis.direction = direction
    flight = {"truth": Truth("still", positions(time))}
    subject = with_reported_sigma(2.0, 1.0, axes=axes, flight=flight)
    assert severity(source_positions.detect_wrong_variance, subject) == expected
    # a variance that is too small is reported in both cases
    subject = with_reported_sigma(0.5, 1.0, axes=axes, flight=flight)
    assert severity(source_positions.detect_wrong_variance, subject) == "error"


@pytest.mark.parametrize(
    ("jumps", "times_s"),
    [
        ((), (18.9, 19.0, 25.9, 26.0, 27.0)),
        ((jump(1.0, 0.0, at_s=20.0),), (18.9, 26.0, 27.0)),
    ],
)
def test_position_outliers_next_to_a_jump_are_ignored(jumps, times_s):
    outliers = tuned(outlier_time_s=np.array([18.9, 19.0, 25.9, 26.0, 27.0]), count=100)
    finding = only(source_positions.detect_outliers, jumping(*jumps, tuning=outliers))
    assert finding.evidence["count"] == len(times_s)
    assert finding.spans_s == tuple((time_s, time_s) for time_s in times_s)


def test_position_outlier_size_is_distance_to_ground_truth() -> None:
    time = np.arange(0.0, 120.0)
    truth = pd.DataFrame({"position_m": 0.0 * time}, index=time)
    for known, north_m, reference in (
        (truth, 3.0, "ground truth"),
        (NONE, 2.0, "the previous and next positions"),
    ):
        axes = tuple(axis(name, truth=known) for name in ("north", "east"))
        axes[0].axis.measurement_m = np.ones(120)
        axes[0].axis.measurement_m[[20, 30, 40]] = 3.0
        axes[1].axis.measurement_m[30] = 4.0
        outliers = tuned(outlier_time_s=np.array([20.0, 30.0, 40.0]), count=120)
        finding = only(source_positions.detect_outliers, analysis(axes=axes, tuning=outliers))
        assert finding.evidence["max_m"] == pytest.approx(np.hypot(north_m, 4.0))
        assert finding.title.startswith("3 of 120 UWB positions (2.5 %) are outliers of up to ")
        assert f"outliers to {reference}: {north_m:.2f} m" in finding.message


def test_outlier_report_counts_outliers_that_ekf2_rejected() -> None:
    innovations = pd.DataFrame({"rejected": np.zeros(120)}, index=np.arange(0.05, 120.0))
    innovations.iloc[[20, 40, 50], 0] = 1.0
    outliers = tuned(outlier_time_s=np.array([20.0, 30.0, 40.0]), count=120)
    for logged, is_counted in ((innovations, True), (innovations[::2], False)):
        one = analysis(axes=(axis(ekf2_innovations=logged),), tuning=outliers)
        message = only(source_positions.detect_outliers, one).message
        assert ("EKF2's gate rejected 2 of the 3 outliers." in message) == is_counted
        assert ("gate rejected" in message) == is_counted


# ---------------------------------------------------------------- clock and delay

APPLIED = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0, clock_offset_s=-0.05)


def test_recommended_time_offset_includes_the_applied_offset() -> None:
    one = analysis(time_offset=late(-0.1, applied_s=-0.05), settings=APPLIED)
    finding = only(source_clock.detect, one)
    assert finding.title == "Position timestamps are 0.10 s late"
    assert "0.100 s (95 % 0.080 to 0.110 s)" in finding.message
    assert "a position error of 0.10 m" in finding.message
    assert finding.remedy == "Subtract 0.100 s from the timestamp of each position."
    expected = {"offset_s": -0.15, "interval_low_s": -0.16, "interval_high_s": -0.13}
    assert finding.evidence == pytest.approx(expected)
    early = only(source_clock.detect, analysis(time_offset=late(0.1)))
    assert early.title == "Position timestamps are 0.10 s early"
    assert "0.100 s (95 % 0.090 to 0.120 s)" in early.message
    assert early.remedy.startswith("Add 0.100 s to ")
    placed = source(alignment=SimpleNamespace(clock_offset_s=2.0))
    finding = only(source_clock.detect, analysis(time_offset=late(0.1), source=placed))
    assert "--clock-offset 2.100." in finding.remedy


@pytest.mark.parametrize(("p", "there"), [(0.005, False), (0.0049, True), (None, False)])
def test_significant_change_of_time_offset_is_reported(p: float | None, there: bool) -> None:
    found = only(source_clock.detect, analysis(time_offset=late(0.1, change_p_value=p)))
    assert found.id == ("source_time_offset_changes" if there else "source_time_offset")
    if there:
        assert "from -0.10 s to +0.30 s" in found.title
        assert found.evidence["change_p_value"] == p


@pytest.mark.parametrize(("after_m", "there"), [(1.005, True), (1.0051, False), (0.5, True)])
def test_time_offset_correction_that_increases_rmse_is_rejected(after_m, there) -> None:
    shifted = rerun("kf", "time offset", {"clock_offset_s": 0.123}, after_m)
    one = analysis(time_offset=late(0.12345), reruns=(shifted,))
    assert severity(source_clock.detect, one) == ("error" if there else None)


def rerun(owner: Any, kind: str, change: dict[str, float], after_m: float) -> Rerun:
    """Make a re-run that changes the position RMSE from 1 m."""
    before, after = RunStatistics(position_rmse_m=1.0), RunStatistics(position_rmse_m=after_m)
    return Rerun(
        filter=owner, axis="north", kinds=(kind,), change=change, before=before, after=after
    )


@pytest.mark.parametrize(
    ("clock", "delay_ms", "text", "remedy"),
    [
        # plus the offset in use
        (
            late(-0.1, applied_s=-0.02),
            0.0,
            "the positions are 120 ms late. The 95 % interval is 100 to 130 ms",
            "Check EKF2_EV_DELAY.",
        ),
        (
            late(0.0, interval_s=(-0.01, 0.01)),
            50.0,
            "no significant delay. The 95 % interval is -10 to 10 ms",
            "Check EKF2_EV_DELAY.",
        ),
        (
            late(-0.02, interval_s=(-0.04, 0.0)),
            100.0,
            "no significant delay",
            "Check EKF2_EV_DELAY.",
        ),
        (
            late(0.02, interval_s=(0.0, 0.04)),
            100.0,
            "no significant delay. The 95 % interval is -40 to 0 ms",
            "Check EKF2_EV_DELAY.",
        ),
        (
            late(0.05, interval_s=(0.04, 0.07)),
            0.0,
            "EKF2_EV_DELAY cannot be negative",
            "Correct the position timestamps before sending.",
        ),
        (
            late(-0.301, interval_s=(-0.4, -0.2)),
            0.0,
            "EKF2_EV_DELAY cannot exceed 300 ms",
            "Correct the position timestamps before sending.",
        ),
        (late(-0.3, interval_s=(-0.4, -0.2)), 0.0, "300 ms late", "Check EKF2_EV_DELAY."),
    ],
)
def test_recommended_ekf2_delay_stays_in_px4_range(
    clock: Any, delay_ms: float, text: str, remedy: str
) -> None:
    finding = only(wrong_delay, delayed(delay_ms, clock))
    assert text in finding.message
    assert finding.remedy == remedy
    assert finding.evidence["asked_ms"] == pytest.approx(-1e3 * clock.offset_s)


@pytest.mark.parametrize(
    ("after_m", "remedy"),
    [
        (0.5, "Set EKF2_EV_DELAY to 120 ms."),
        (1.0, "Correct the position timestamps before sending."),
    ],
)
def test_ekf2_delay_is_recommended_only_if_rerun_reduces_rmse(after_m: float, remedy: str) -> None:
    trials = (rerun("ekf2", "delay", {"EKF2_EV_DELAY": 120.0}, after_m),)
    finding = only(wrong_delay, delayed(0.0, late(-0.12), reruns=trials))
    assert finding.remedy == remedy


def test_gnss_time_offset_report_names_receiver_delay_parameter() -> None:
    parameters = {"EKF2_GPS_DELAY": 110.0}
    one = analysis(
        time_offset=late(-0.05), source=source(origin=GNSS_ORIGIN), log=log(parameters=parameters)
    )
    finding = only(source_clock.detect, one)
    assert finding.message.endswith(" EKF2_GPS_DELAY is 110 ms; the estimate is 160 ms.")
    assert finding.remedy == "Check the delay of the GNSS receiver (EKF2_GPS_DELAY)."


@pytest.mark.parametrize(("detect", "one", "expected"), EDGES + SOURCE_EDGES)
def test_fault_severity_changes_at_each_detection_limit(
    detect: Any, one: Any, expected: str | None
) -> None:
    assert severity(detect, one) == expected


@pytest.mark.parametrize(("size", "is_reported"), [(5, True), (2, False), (1, False)])
def test_timestamps_in_bursts_are_reported_as_jitter(size: int, is_reported: bool) -> None:
    time_s = (0.25 * np.arange(40.0)[:, None] + 6e-4 * np.arange(size)).ravel()
    found = [*source_stamps.detect_bursts(analysis(source=source(samples=positions(time_s))))]
    assert [finding.id for finding in found] == ["source_timestamp_jitter"] * is_reported
    assert not is_reported or "bursts of 5, every 0.25 s" in found[0].message


def test_positions_that_odometry_sends_twice_are_reported() -> None:
    one = repeating(50, 100, orientation=object())
    assert named(source_errors.detect_noise_faults, one) == {"source_samples_repeated": "error"}


@pytest.mark.parametrize(
    ("detect", "data", "keys"),
    [
        (
            source_errors.detect_time_correlated_noise,
            analysis(time_correlated_noise=slow(99.0, 0.0)),
            {"tau_s", "low_s", "slow_m", "white_m", "gain_nats", "low_pass_gain_nats"},
        ),
        (
            source_positions.detect_low_pass,
            low_pass(99.0, 1.0),
            {"correlation", "lag_s", "gain_nats", "sigma_z_m"},
        ),
    ],
)
def test_evidence_of_fitted_noise_has_the_keys_of_results(
    detect: Any, data: Any, keys: set[str]
) -> None:
    """The fields of the fitted noise are keys of the results."""
    (found,) = detect(data)
    assert set(found.evidence) == keys
