"""Each finding about filters, the log and the loop at the edges of its thresholds.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

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
    analysis,
    at_rate,
    axis,
    hiding,
    log,
    made,
    named,
    only,
    positions,
    severity,
    source,
    statement,
    tried,
)

from px4fuse.ekf2.model import Model
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.heading import HeadingError, HeadingPart
from px4fuse.filter.heading import turned as together
from px4fuse.filter.signals import Segment
from px4fuse.findings import (
    Finding,
    by_root,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    hidden_errors,
    imu,
    missing,
    recording,
    since,
    source_frame,
    source_intervals,
    source_positions,
)
from px4fuse.findings.causes import by_cause
from px4fuse.findings.model import moments, share_on, spans_at
from px4fuse.flight import FusionRecord, Reset, Unavailable
from px4fuse.origin import ALIGNED, GNSS, KEPT, MOTION_CAPTURE, REBUILT, RECEIVED
from px4fuse.recording import Dropout


def steps(*pairs: tuple[float, float], column: str = "horizontal") -> dict[str, Any]:
    """EKF2 whose fusion flag changes at these times."""
    time, value = zip(*pairs, strict=True)
    return {"fusing": pd.DataFrame({column: value}, index=list(time), dtype=float)}


def one_of(name: str, level: Any = "error", caused_by: str | None = None) -> Finding:
    return Finding(name, level, "It is.", "Do.", caused_by=caused_by)


# ---------------------------------------------------------------- words, times and order


@pytest.mark.parametrize(
    ("spans", "said"),
    [
        ((), ""), (((1.0, 1.0),) * 3, "1.0 s, 1.0 s, 1.0 s"),
        (((1.0, 1.0), (2.0, 2.0), (3.0, 3.0), (4.0, 5.0)), "from 1.0 s to 5.0 s"),
        (((0.0, 0.05),), "0.0 s"), (((0.0, 0.06),), "0.0 s to 0.1 s"),
    ],
)  # fmt: skip
def test_when_a_finding_shows(spans: Any, said: str) -> None:
    assert replace(one_of("x"), spans_s=spans).when == said


def test_the_share_of_a_step_function_counts_its_first_value_before_it_begins() -> None:
    flag, whole = pd.Series([1.0, 0.0, 1.0], index=[20.0, 30.0, 80.0]), Segment(10.0, 110.0, "")
    assert share_on(flag, whole) == 0.5
    assert share_on(flag, Segment(25.0, 35.0, "")) == 0.5
    assert spans_at(0.0, flag, whole) == ((30.0, 80.0),)
    assert spans_at(1.0, flag, whole) == ((10.0, 30.0), (80.0, 110.0))
    assert spans_at(0.0, flag, Segment(40.0, 50.0, "")) == ((40.0, 50.0),)


def test_of_one_rank_the_order_is_that_of_the_names_and_information_comes_last() -> None:
    order = by_cause([
        one_of("ekf2_resets", "info"), one_of("no_motion", "warning"),
        one_of("ekf2_instance_switch", "warning"), one_of("source_gap", "warning"),
    ])  # fmt: skip
    assert [each.id for each in order] == [
        "source_gap", "ekf2_instance_switch", "no_motion", "ekf2_resets"
    ]  # fmt: skip


def test_what_follows_stands_behind_its_cause() -> None:
    first, other = one_of("kf_variance_overstated"), one_of("no_motion", "info")
    follows = one_of("kf_variance_overstated", caused_by="kf_variance_overstated")
    assert by_root([first, follows, other]) == [[first, follows], [other]]


# ---------------------------------------------------------------- EKF2


def test_only_what_happens_in_the_segment_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ekf2_resets, "continuous_state", lambda *_: (None, "resets undone"))
    switches = tuple((time, 1) for time in (-np.inf, 10.0, 10.5, 110.0, 110.1))
    resets = (
        Reset(10.0, "position", (9.0, 0.0, 0.0)), Reset(10.5, "position", (3.0, 0.0, -4.0)),
        Reset(40.0, "velocity", (9.0, 0.0, 0.0)), Reset(50.0, "position", (0.0, 0.0, 0.0)),
        Reset(110.0, "position", (0.0, 0.0, 1.0)), Reset(110.1, "position", (9.0, 0.0, 0.0)),
    )  # fmt: skip
    reset, switch = ekf2_resets.detect(analysis(ekf2={"instances": switches, "resets": resets}))
    assert switch.evidence == {"count": 2, "at_s": 10.5}
    assert reset.evidence == {"count": 2, "largest_m": 5.0, "at_s": 10.5}
    assert "2 times (1 horizontally), by up to 5.00 m at 10.5 s. In the" in reset.message
    assert reset.message.endswith(" comparison: resets undone.")
    lost = tuple(Dropout(at, 1.0) for at in (8.9, 9.0, 50.0, 110.0, 110.1))
    finding = only(recording.dropouts, analysis(log=log(dropouts=(*lost, Dropout(60.0, 0.5)))))
    assert finding.evidence == {"count": 4, "total_s": 3.5}
    assert "3.50 s in all, the longest 1.00 s" in finding.message


@pytest.mark.parametrize(
    ("until_s", "expected"),
    [
        (108.0, {}), (107.9, {"ekf2_fusion_interrupted": "warning"}),
        (60.0, {"ekf2_fusion_interrupted": "warning"}), (59.9, {"ekf2_not_fusing": "error"}),
    ],
)  # fmt: skip
def test_fusion_that_stops(until_s: float, expected: dict[str, str]) -> None:
    one = analysis(ekf2=steps((0.0, 1.0), (until_s, 0.0)))
    assert named(ekf2_not_fusing.detect, one) == expected
    for finding in ekf2_not_fusing.detect(one):
        assert f"fused the source in only {(until_s - 10.0) / 100.0:.0%}" in finding.message
        if finding.id == "ekf2_fusion_interrupted":
            # before that release it goes on for seven seconds
            assert "EKF2 (v1.14 and later) stops after 0.4 s without a sample" in finding.remedy
            assert finding.spans_s == ((until_s, 110.0),)


def never(rate_hz: float = 5.0, age_s: float | None = None, **parts: Any) -> Any:
    """EKF2 that never fuses, fed by samples of this age, at a horizon of 0.2 s."""
    record: Any = NONE
    if age_s is not None:
        age = pd.Series([9.0, age_s, age_s, age_s, 9.0], index=[9.0, 20.0, 30.0, 40.0, 111.0])
        record = made(FusionRecord, vision_age_s=age)
    horizon, parameters = parts.pop("horizon_s", 0.2), parts.pop("parameters", {})
    ekf2 = {**steps((0.0, 0.0)), "record": record, "horizon_s": horizon}
    fed = source(rate_hz=rate_hz, **parts)
    return analysis(ekf2=ekf2, log=log(parameters=parameters), source=fed)


UNKNOWN = "the log does not show why"


@pytest.mark.parametrize(
    ("one", "says", "remedy"),
    [
        (never(parameters={"EKF2_EV_CTRL": 14.0}), "EKF2_EV_CTRL is 14, bit 0", "to 15."),
        (never(parameters={"EKF2_EV_CTRL": 15.0, "EKF2_AID_MASK": 1.0}), UNKNOWN, "EKF2_EV_CTRL"),
        (never(parameters={"EKF2_AID_MASK": 1.0}), "EKF2_AID_MASK is 1, bit 3", "to 9."),
        (never(parameters={"EKF2_AID_MASK": 9.0}), UNKNOWN, "EKF2_EV_CTRL"),
        (never(2.0), UNKNOWN, "EKF2_EV_CTRL"),  # such a release has no limit
        (never(2.0, parameters={"EKF2_EV_CTRL": 15.0}), "come every 0.50 s", "10 Hz"),
        (never(2.0, parameters={"EKF2_EV_CTRL": 15.0}, origin=KEPT), UNKNOWN, "Check"),
        (never(5.0, parameters={"EKF2_EV_CTRL": 15.0}), UNKNOWN, "Check"),
        (never(age_s=0.29), UNKNOWN, "Check"), (never(age_s=5.0, horizon_s=NONE), UNKNOWN, "Check"),
        (never(age_s=0.31), "arrive 0.31 s after their stamps, and EKF2 keeps no more than 0.20 s",
         "EKF2_DELAY_MAX"),
        (never(age_s=0.28, parameters={"EKF2_EV_DELAY": 50.0}), "arrive 0.33 s", "EKF2_DELAY_MAX"),
    ],
)  # fmt: skip
def test_why_ekf2_does_not_fuse(one: Any, says: str, remedy: str) -> None:
    finding = only(ekf2_not_fusing.detect, one)
    assert finding.severity == "error"
    assert "never fused the source in this segment" in finding.message
    assert says in finding.message
    assert remedy in finding.remedy


def rejected(count: int, of: int) -> pd.DataFrame:
    return pd.DataFrame(
        {"rejected": np.arange(of) < count}, index=20.0 + np.arange(of), dtype=float
    )


@pytest.mark.parametrize(
    ("count", "of", "expected"),
    [(1, 100, "warning"), (1, 101, None), (20, 100, "error"), (19, 100, "warning")],
)
def test_rejections(count: int, of: int, expected: str | None) -> None:
    """Of the horizontal vector, so that the first axis speaks for both."""
    axes = axis("north", ekf2_innovations=rejected(count, of)), axis("east")
    axes[1].ekf2_innovations = rejected(9, 9)
    level = analysis(ekf2={"gate": 5.0}, axes=axes)
    down = analysis(ekf2={"gate": 5.0}, axes=(axis("down", ekf2_innovations=rejected(count, of)),))
    for one, what, remedy in (
        (level, "for horizontal position (outside 5 √S)", "Not replayed: no topic for it."),
        (down, "for height", "widen EKF2_EVP_GATE last."),
    ):
        assert severity(ekf2_rejecting.detect, one) == expected
        for finding in ekf2_rejecting.detect(one):
            assert finding.spans_s == moments(20.0 + np.arange(count))
            assert what in finding.message
            assert finding.remedy.endswith(remedy)


def test_what_ends_rejections_is_the_cause_of_the_innovations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(since, "remedy_words", lambda _, changes, helps, **__: (f"{changes}", True))
    frame = axis("north", ekf2_innovations=rejected(5, 10))
    model = made(Model, inputs=SimpleNamespace(settings=dict.fromkeys(PARAMETERS, 1.0)))

    def remedy(*causes: Any) -> str:
        one = analysis(ekf2={"gate": 5.0}, axes=(frame,), ekf2_model=model, causes=causes)
        return only(ekf2_rejecting.detect, one).remedy

    noise, delay = {"EKF2_EVP_NOISE": 0.3}, {"EKF2_EV_DELAY": 90.0}
    assert remedy(tried("ekf2", noise), tried("ekf2", delay, explains=0.4)) == str(noise)
    assert remedy(tried("ekf2", delay)) == str(delay)
    assert remedy(tried("ekf2", {"outliers_left_out": 5.0})).startswith("Remove the outliers")
    for none in ((), (tried("ekf2", noise, explains=0.4),), (tried("kf", {"sigma_z_m": 1.0}),)):
        assert remedy(*none).endswith("widen EKF2_EVP_GATE last.")


# ---------------------------------------------------------------- errors and truth


def test_hidden_errors_are_told_of_the_worst_axis_first() -> None:
    ekf2 = axis("east", ekf2=statement(0.49), ekf2_truth=against_truth(25.0, 1.0))
    finding = only(hidden_errors.detect, analysis(axes=(hiding(), ekf2)))
    assert finding.message.startswith("Innovations small, errors large: ")
    assert "our filter claims σ 0.2 m along north and errs by 0.40 m RMS" in finding.message
    assert "EKF2 claims σ 0.2 m along east and errs by 1.00 m RMS (mean NEES 25" in finding.message
    assert finding.evidence["filter"] == "ekf2"
    assert finding.evidence["ekf2_sigma_p_m"] == pytest.approx(0.2)
    assert finding.remedy == hidden_errors.REMEDIES["shared"]
    just = axis("east", ekf2=statement(0.5), ekf2_truth=against_truth(25.0))
    alone = only(hidden_errors.detect, analysis(axes=(just,)))
    assert alone.message.startswith("Innovations consistent, errors not: ")
    assert alone.remedy == hidden_errors.REMEDIES["ekf2"]
    drifts = only(hidden_errors.detect, analysis(axes=(hiding(),), source=source(origin=DRIFTING)))
    assert drifts.remedy == hidden_errors.REMEDIES["drift"]


@pytest.mark.parametrize(("left", "frame"), [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("drifts", [False, True])
def test_what_a_turn_and_shift_of_the_frame_leaves(left: float, frame: bool, drifts: bool) -> None:
    """On a circle of 5 m: a shift, and an error that changes sign from sample to sample."""
    time = np.arange(20.0, 100.0, 0.1)
    angle = 0.2 * np.pi * time
    true = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    own = true + np.array([0.0, np.sqrt(1.0 - left**2)])
    own[::2, 0] += left
    own[1::2, 0] -= left
    own[0] = np.nan  # unknown there
    axes = [
        axis(name, ekf2=statement(), ekf2_truth=against_truth(9.0),
             truth=pd.DataFrame({"position_m": true[:, at]}, index=time),
             ekf2_state=pd.DataFrame({"position_m": own[:, at]}, index=time))
        for at, name in enumerate(("north", "east"))
    ]  # fmt: skip
    moves = source(origin=DRIFTING if drifts else RECEIVED)
    finding = only(hidden_errors.detect, analysis(axes=tuple(axes), source=moves))
    assert finding.evidence["position_rmse_horizontal_m"] == pytest.approx(1.0, rel=0.01)
    assert finding.evidence["position_rmse_aligned_m"] == pytest.approx(left, rel=0.01)
    assert ("Most of it is how the source's frame lies" in finding.message) is frame
    assert ("and the filter follows it" in finding.message) is (drifts and not frame)
    assert (finding.remedy == hidden_errors.REMEDIES["frame"]) is frame


# ---------------------------------------------------------------- the log


@pytest.mark.parametrize(
    ("ends", "segment", "spans"),
    [
        ((10.2, 109.97), (10.0, 110.0), [(10.0, 10.2), (39.99, 42.0)]),
        ((10.2, 109.97), (42.0, 110.0), []), ((10.2, 109.97), (10.2, 39.9), []),
        ((10.0, 109.9), (10.0, 110.0), [(39.99, 42.0), (109.9, 110.0)]),
    ],
)  # fmt: skip
def test_when_the_imu_is_missing(ends: Any, segment: Any, spans: Any) -> None:
    """Inside, at the ends by more than a moment, and not outside the segment."""
    time = np.concatenate([np.arange(ends[0], 40.0, 0.01), np.arange(42.0, ends[1], 0.01)])
    found = imu._spans(pd.DataFrame(index=time), Segment(*segment, ""))
    assert len(found) == len(spans)
    assert not spans or np.allclose(found, spans, atol=0.02)


@pytest.mark.parametrize(
    ("imu_hz", "attitude_hz", "expected"),
    [(49.1, 9.9, []), (48.9, 9.9, [100.0]), (49.1, 9.7, [20.0])],
)
def test_topics_that_were_logged_too_slowly(
    imu_hz: float, attitude_hz: float, expected: list[float]
) -> None:
    flight = {"imu": at_rate(imu_hz), "attitude": at_rate(attitude_hz)}
    for info, says in (
        (log(), "into etc/logging/logger_topics.txt"),
        (log(format="MAVLink tlog", has_ulog=False), "at {:g} Hz (MAV_CMD_SET"),
        (log(format="MAVLink tlog"), "-r {:g} in PX4's console)"),
    ):
        found = list(imu.rates(analysis(flight=flight, log=info).flight))
        assert [finding.evidence["needed_hz"] * 2.0 for finding in found] == expected
        assert all(says.format(hz) in f.remedy for f, hz in zip(found, expected, strict=True))


def test_a_rate_that_is_just_enough_is_enough() -> None:
    assert 0.98 * (32.0 / 0.98) == 32.0
    assert not imu.too_slow(at_rate(32.0), 32.0 / 0.98)
    assert imu.too_slow(at_rate(32.0), 1.001 * 32.0 / 0.98)


@pytest.mark.parametrize(
    ("damage", "flying", "severity", "said"),
    [
        (("it is cut", "9 bytes are lost"), True, "warning", "It is cut. 9 bytes are lost."),
        (("track.csv is cut",), False, "warning", "track.csv is cut."),
        ((), True, "info", "The log ends in flight, after 60.0 s: the landing is not in it."),
        ((), False, None, ""),
    ],
)
def test_what_is_not_in_a_log_is_said(
    damage: tuple[str, ...], flying: bool, severity: str | None, said: str
) -> None:
    info = log(damage=damage, ends_in_flight=flying, bytes=100, bytes_read=91)
    found = list(recording.loss(analysis(log=info).flight))
    assert [(one.severity, one.message) for one in found] == ([(severity, said)] if said else [])
    for one in found:
        assert one.evidence == {"lost_bytes": 9, "ends_in_flight": float(flying)}


def test_a_recording_says_what_it_holds() -> None:
    for has_ulog, frame in ((True, pd.DataFrame()), (False, NONE)):
        info = log(format="MAVLink tlog", has_ulog=has_ulog)
        one = only(recording.estimators, analysis(log=info, ekf2={"variance": frame}))
        assert (" and variances" in one.message) is isinstance(frame, pd.DataFrame)
        assert ("--mavlink" in one.remedy) is has_ulog
        assert named(recording.estimators, analysis(log=info)) == {}
    assert named(recording.estimators, analysis(ekf2={"variance": NONE})) == {}


@pytest.mark.parametrize(
    ("rate_hz", "name", "decimated"),
    [
        (4.0, "estimator_visual_odometry_aligned", False),
        (4.1, "estimator_visual_odometry_aligned", True),
        (6.6, "estimator_visual_odometry_aligned", True),
        (6.7, "estimator_visual_odometry_aligned", False),
        (2.0, "estimator_aid_src_ev_pos", True), (5.0, "ekf2_state_plus_innovation", True),
    ],
)  # fmt: skip
def test_positions_that_the_logger_thinned(rate_hz: float, name: str, decimated: bool) -> None:
    lacks = (
        Unavailable("another", "no", "Do."),
        Unavailable("it", "it was off", "Do.", source="vehicle_visual_odometry"),
    )
    profile = log(parameters={"SDLOG_PROFILE": 2.0})
    for origin in (ALIGNED, KEPT, REBUILT):
        of = source(name=name, origin=origin, rate_hz=rate_hz)
        found = list(missing.source_as_sent(analysis(source=of, missing=lacks, log=profile)))
        assert [one.id for one in found] == ["source_not_logged", "source_decimated"][
            : 1 + decimated
        ]
        assert "as it arrived (it was off); " in found[0].message
        assert all("SDLOG_PROFILE to 130 " in each.remedy for each in found)
        for each in found[1:]:
            limit = each.evidence["logger_limit_hz"]
            assert f"own limit for it ({limit:g} Hz)" in each.message
            assert rate_hz == pytest.approx(limit, rel=0.35)
    for origin, tracks in (
        (RECEIVED, ()), (MOTION_CAPTURE, ()), (GNSS, ()),
        (ALIGNED, (SimpleNamespace(origin=RECEIVED),)),
    ):  # fmt: skip
        one = analysis(source=source(name=name, origin=origin), flight={"positions": tracks})
        assert named(missing.source_as_sent, one) == {}
    unknown = missing.source_as_sent(analysis(source=source(name=name, origin=ALIGNED)))
    assert "(it is not in this log)" in next(unknown).message


@pytest.mark.parametrize(("rate_hz", "least_s"), [(2.0, 2.5), (10.0, 1.0)])
def test_a_silent_source(rate_hz: float, least_s: float) -> None:
    """Five intervals, and a second at least."""
    for gap_s, there in ((least_s, False), (least_s + 0.25, True)):
        time = np.concatenate([np.arange(10.0, 20.5, 0.5), [20.0 + gap_s, 20.5 + gap_s]])
        one = analysis(axes=(axis(),), source=source(rate_hz=rate_hz))
        one.lines[0].measurement_time_s = time
        found = list(source_intervals.gaps(one))
        assert [each.evidence for each in found] == [
            {"count": 1, "longest_s": gap_s, "at_s": 20.0}
        ] * there
        said = f"more than {least_s:.1f} s, the longest time {gap_s:.1f} s at 20.0 s"
        assert all(said in each.message for each in found)


def test_the_range_of_the_motion_leaves_out_a_twentieth_at_either_end() -> None:
    moving = positions(10.0 + np.arange(100))
    moving["east_m"] = np.repeat([-9.0, -1.0, -0.5, 0.0, 0.5, 1.0, 9.0], [3, 4, 3, 80, 3, 4, 3])
    outside = positions([5.0, 111.0], 99.0)
    comparison = analysis(source=source(samples=pd.concat([moving, outside])))
    assert source_positions.motion_range_m(comparison) == 2.0


# ---------------------------------------------------------------- frames


def test_what_is_poorly_known_of_a_files_place_is_told_with_its_option() -> None:
    placed = SimpleNamespace(
        warnings=("the frame fits as well as ned: give --position-frame ned.", "the yaw is weak.")
    )
    frame, yaw = source_frame.placement(analysis(source=source(alignment=placed)))
    assert (frame.severity, yaw.severity) == ("error", "warning")
    assert frame.message == "uwb: The frame fits as well as ned."
    assert frame.remedy == "Give --position-frame ned."
    assert yaw.message == "uwb: The yaw is weak."
    assert "where you know them" in yaw.remedy


@pytest.mark.parametrize(("until_s", "expected"), [(60.0, "warning"), (60.1, "info")])
def test_a_frame_that_is_not_north(until_s: float, expected: str) -> None:
    frd = source(frame="FRD")
    one = analysis(source=frd, ekf2=steps((0.0, 1.0), (until_s, 0.0), column="yaw"))
    finding = only(source_frame.detect, one)
    assert finding.severity == expected
    assert ("EKF2 fused its yaw" in finding.message) is (expected == "info")
    assert ("Send the position in NED" in finding.remedy) is (expected == "warning")
    assert severity(source_frame.detect, analysis(source=frd)) == "warning"
    assert severity(source_frame.detect, analysis()) is None
    for has_ulog in (True, False):
        one = analysis(source=frd, ekf2={"fusing": NONE}, log=log(has_ulog=has_ulog))
        finding = only(source_frame.detect, one)
        assert finding.severity == "info"
        assert ("the ULog says" in finding.remedy) is has_ulog


def turned(*degrees: float, sigma_deg: float = 1.0, p: float = 1.0) -> HeadingError:
    parts = (HeadingPart(10.0 * n, 10.0 * n + 10.0, d, sigma_deg) for n, d in enumerate(degrees))
    return together(tuple(parts), p, "positions")


def test_a_turn_is_told_with_its_interval_and_undone_by_its_opposite() -> None:
    finding = only(source_frame.detect, analysis(heading=turned(20.0, sigma_deg=2.0)))
    assert finding.id == "source_frame_turned"
    assert "turned by +20° ± 4° (clockwise" in finding.message
    assert "Turn the positions by -20°" in finding.remedy
    aligned = source(name="estimator_visual_odometry_aligned")
    for has_ulog in (True, False):
        one = analysis(heading=turned(20.0), source=aligned, log=log(has_ulog=has_ulog))
        assert only(source_frame.detect, one).id == "ekf2_heading_wrong"
        assert ("EKF2_EV_CTRL bit 3" in only(source_frame.detect, one).remedy) is has_ulog


def test_a_heading_that_drifts_is_told_from_end_to_end() -> None:
    finding = only(source_frame.detect, analysis(heading=turned(2.0, 30.0, p=0.0)))
    assert finding.id == "ekf2_heading_wrong"
    assert "lies at +2° from 0 to 10 s and at +30° from 10 to 20 s" in finding.message
    assert "by the positions and the IMU" in finding.message
    assert finding.remedy.startswith("Calibrate the magnetometer")
    assert finding.evidence["from_deg"] == 2.0
    assert finding.evidence["p"] == 1e-300
    by = replace(turned(2.0, 30.0, p=0.001), by="orientation")
    finding = only(source_frame.detect, analysis(heading=by))
    assert "by the source's own orientation" in finding.message
    assert finding.evidence["p"] == 0.001


# ---------------------------------------------------------------- limits


def decimated(logged: int) -> Any:
    frame = pd.DataFrame(index=range(logged))
    axes = (axis(ekf2_innovations=frame, replay=SimpleNamespace(updates=range(100))),)
    return analysis(ekf2={"innovation_topics": ("topic",)}, axes=axes)


def beside_vision(name: str, first: float) -> Any:
    fed = source(name=name, origin=MOTION_CAPTURE)
    return analysis(ekf2=steps((0.0, first), (100.0, 0.0)), source=fed)


def without_imu(gap_s: float, rate_hz: float) -> Any:
    axes = (axis(replay=SimpleNamespace(input_gap_s=gap_s)),)
    return analysis(axes=axes, flight={"imu": at_rate(rate_hz)})


def moved(extent_m: float) -> Any:
    samples = positions(10.0 + np.arange(100), np.repeat([0.0, extent_m], 50))
    return analysis(source=source(samples=samples))


FUSED, FRAME = ekf2_not_fusing.detect, source_frame.detect
EDGES = [
    (missing.innovations, decimated(75), None), (missing.innovations, decimated(74), "info"),
    # motion capture; with external vision beside it, it is an independent reference
    (FUSED, beside_vision("vehicle_mocap_odometry", 0.0), "warning"),
    (FUSED, beside_vision("vehicle_mocap_odometry", 1.0), None),
    (FUSED, beside_vision("GPS", 0.0), None),
    *((hidden_errors.detect, analysis(axes=(hiding(nis, nees),)), expected)
      for nis, nees, expected in (
          (1.0, 4.0, "warning"), (1.0, 3.99, None), (1.49, 4.0, "warning"), (1.5, 4.0, None),
          (1.0, 15.9, "warning"), (1.0, 16.0, "error"), (1.0, None, None))),
    *((imu.gaps, without_imu(gap_s, rate_hz), expected) for gap_s, rate_hz, expected in (
        (0.2, 100.0, None), (0.201, 100.0, "warning"), (0.499, 4.0, None),
        (0.501, 4.0, "warning"))),
    (source_positions.motion, moved(0.5), None), (source_positions.motion, moved(0.499), "warning"),
    *((FRAME, analysis(heading=heading), expected) for heading, expected in (
        (turned(5.0), "warning"), (turned(4.9), None), (turned(14.9), "warning"),
        (turned(15.0), "error"), (turned(8.0, sigma_deg=2.0), "warning"),
        (turned(7.9, sigma_deg=2.0), None), (turned(0.0, 14.9, p=0.0), "warning"),
        (turned(0.0, 15.0, p=0.0), "error"))),
    (FRAME, analysis(heading=turned(20.0), source=source(origin=KEPT)), None),
]  # fmt: skip


@pytest.mark.parametrize(("detect", "one", "expected"), EDGES)
def test_from_where_on_it_is_a_finding(detect: Any, one: Any, expected: str | None) -> None:
    assert severity(detect, one) == expected
