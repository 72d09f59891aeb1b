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
    analysis,
    at_rate,
    log,
    made,
    named,
    only,
    positions,
    severity,
    source,
)
from msgspec import structs

from px4fuse.comparison.model import FILTERS, AgainstTruth, FilterSummary, UnjudgedFilter
from px4fuse.comparison.remedy import Effect
from px4fuse.ekf2.model import Model
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.heading import HeadingError, HeadingPart
from px4fuse.filter.heading import turned as together
from px4fuse.filter.signals import Segment
from px4fuse.findings import (
    ekf2_innovations_decimated,
    ekf2_instance_switch,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    errors_larger_than_claimed,
    imu_gap,
    innovations_need_ulog,
    log_damaged,
    logger_dropouts,
    logging_rate_low,
    no_motion,
    position_file_placement,
    source_frame_not_north,
    source_frame_turned,
    source_gap,
    source_not_logged,
)
from px4fuse.findings.causes import by_cause
from px4fuse.findings.model import (
    Finding,
    Threshold,
    moments,
    off_spans,
    sentence,
    step_share,
)
from px4fuse.flight import FusionRecord, Reset, Unavailable
from px4fuse.origin import ALIGNED, GNSS, KEPT, MOTION_CAPTURE, REBUILT, RECEIVED
from px4fuse.recording import Dropout

STATED = Consistency.__struct_fields__


def steps(*pairs: tuple[float, float], column: str = "horizontal") -> dict[str, Any]:
    """EKF2 whose fusion flag changes at these times."""
    time, value = zip(*pairs, strict=True)
    return {"fusing": pd.DataFrame({column: value}, index=list(time), dtype=float)}


def axis(name: str = "north", **parts: Any) -> Any:
    usual = {"ekf2_innovations": NONE, "truth": NONE, "ekf2_state": NONE}
    filters = {
        key: with_truth(parts.pop(key, NONE), parts.pop(f"{key}_truth", NONE)) for key in FILTERS
    }
    return SimpleNamespace(axis=SimpleNamespace(name=name), filters=filters, **usual | parts)


def with_truth(one: Any, truth: Any) -> Any:
    """A filter with its error; not judged where there is no statement."""
    if one is NONE:
        return UnjudgedFilter("it", "no topic for it", "Log it.", truth=truth)
    known = {name: getattr(one, name) for name in STATED if hasattr(one, name)}
    return made(FilterSummary, **known, truth=truth)


def statement(nis: float = 1.0, verdict: str = "consistent", **parts: Any) -> Any:
    """A filter with this mean NIS."""
    usual = {"lag1_autocorrelation": 0.0, "outside_gate": 0.0, "innovation_std_m": 0.3,
             "innovation_mean_m": 0.4}  # fmt: skip
    return made(Consistency, nis_mean=nis, nis_band=(0.8, 1.2), verdict=verdict,
                **{**usual, **parts})  # fmt: skip


# ---------------------------------------------------------------- words and times


def test_when_a_finding_shows() -> None:
    finding = Finding("x", "info", "It is.", "Do.")
    for spans, said in (
        (((1.0, 1.0),) * 3, "1.0 s, 1.0 s, 1.0 s"),
        (((1.0, 1.0), (2.0, 2.0), (3.0, 3.0), (4.0, 5.0)), "from 1.0 s to 5.0 s"),
        (((0.0, 0.05),), "0.0 s"), (((0.0, 0.06),), "0.0 s to 0.1 s"),
    ):  # fmt: skip
        assert replace(finding, spans_s=spans).when == said
    assert moments([1.0]) == ((1.0, 1.0),)
    assert sentence("track.csv is late") == "track.csv is late"
    assert sentence("the file track.csv is late") == "The file track.csv is late"


def test_the_share_of_a_step_function_counts_its_first_value_before_it_begins() -> None:
    flag = pd.Series([1.0, 0.0, 1.0], index=[20.0, 30.0, 80.0])
    assert step_share(flag, 10.0, 110.0) == 0.5
    assert step_share(flag, 25.0, 35.0) == 0.5
    assert off_spans(flag, 10.0, 110.0) == ((30.0, 80.0),)
    assert off_spans(1.0 - flag, 10.0, 110.0) == ((10.0, 30.0), (80.0, 110.0))


def test_of_one_rank_the_order_is_the_given_one_and_information_comes_last() -> None:
    def one(name: str, severity: Any) -> Finding:
        return Finding(name, severity, "It is.", "Do.")

    order = by_cause(
        [one("ekf2_resets", "info"), one("no_motion", "warning"), one("source_gap", "warning")]
    )
    assert [each.id for each in order] == ["source_gap", "no_motion", "ekf2_resets"]


# ---------------------------------------------------------------- EKF2


@pytest.mark.parametrize(("logged", "expected"), [(75, None), (74, "info")])
def test_innovations_that_were_logged_too_slowly(logged: int, expected: str | None) -> None:
    frame = pd.DataFrame(index=range(logged))
    axes = (axis(ekf2_innovations=frame, replay=SimpleNamespace(updates=range(100))),)
    one = analysis(ekf2={"innovation_topics": ("topic",)}, axes=axes)
    assert severity(ekf2_innovations_decimated, one) == expected
    if expected:
        assert "26% of what EKF2 did" in only(ekf2_innovations_decimated, one).message


def test_only_what_happens_in_the_segment_counts() -> None:
    switches = tuple((time, 1) for time in (-np.inf, 10.0, 10.5, 110.0, 110.1))
    finding = only(ekf2_instance_switch, analysis(ekf2={"instances": switches}))
    assert finding.evidence == {"count": 2.0, "at_s": 10.5}
    resets = (
        Reset(10.0, "position", (9.0, 0.0, 0.0)), Reset(10.5, "position", (3.0, 0.0, -4.0)),
        Reset(40.0, "velocity", (9.0, 0.0, 0.0)), Reset(50.0, "position", (0.0, 0.0, 0.0)),
        Reset(110.0, "position", (0.0, 0.0, 1.0)), Reset(110.1, "position", (9.0, 0.0, 0.0)),
    )  # fmt: skip
    notes = ("Another note", "EKF2 resets undone")
    finding = only(ekf2_resets, analysis(ekf2={"resets": resets}, notes=notes))
    assert finding.evidence == {"count": 2.0, "largest_m": 5.0, "at_s": 10.5}
    assert "2 times (1 horizontal), by up to 5.00 m at 10.5 s. In" in finding.message
    assert finding.message.endswith(" the comparison: resets undone.")
    lost = tuple(Dropout(at, 1.0) for at in (8.9, 9.0, 50.0, 110.0, 110.1))
    lost = (*lost, Dropout(60.0, 0.5))
    finding = only(logger_dropouts, analysis(log=log(dropouts=lost)))
    assert finding.evidence == {"count": 4.0, "total_s": 3.5}
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
    assert named(ekf2_not_fusing, one) == expected
    for finding in ekf2_not_fusing.DETECTOR.detect(one):
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
    ekf2 = {**steps((0.0, 0.0)), "record": record, "horizon_s": 0.2}
    parameters = parts.pop("parameters", {})
    return analysis(ekf2=ekf2, log=log(parameters=parameters), source=source(
        rate_hz=rate_hz, **parts))  # fmt: skip


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
        (never(age_s=0.29), UNKNOWN, "Check"),
        (never(age_s=0.31), "arrive 0.31 s after their stamps, and EKF2 keeps no more than 0.20 s",
         "EKF2_DELAY_MAX"),
        (never(age_s=0.28, parameters={"EKF2_EV_DELAY": 50.0}), "arrive 0.33 s", "EKF2_DELAY_MAX"),
    ],
)  # fmt: skip
def test_why_ekf2_does_not_fuse(one: Any, says: str, remedy: str) -> None:
    finding = only(ekf2_not_fusing, one)
    assert finding.severity == "error"
    assert "never fused the source in this segment" in finding.message
    assert says in finding.message
    assert remedy in finding.remedy


def test_without_a_horizon_no_sample_is_called_too_old() -> None:
    one = never(age_s=5.0)
    object.__setattr__(one.flight.ekf2, "horizon_s", NONE)
    assert UNKNOWN in only(ekf2_not_fusing, one).message


@pytest.mark.parametrize(
    ("name", "first", "expected"),
    [("vehicle_mocap_odometry", 0.0, "warning"), ("vehicle_mocap_odometry", 1.0, None),
     ("GPS", 0.0, None)],
)  # fmt: skip
def test_what_ekf2_never_fuses(name: str, first: float, expected: str | None) -> None:
    one = analysis(
        ekf2=steps((0.0, first), (100.0, 0.0)), source=source(name=name, origin=MOTION_CAPTURE)
    )
    assert severity(ekf2_not_fusing, one) == expected


def rejected(count: int, of: int) -> pd.DataFrame:
    flags = np.zeros(of)
    flags[:count] = 1.0
    return pd.DataFrame({"rejected": flags}, index=20.0 + np.arange(of))


@pytest.mark.parametrize(
    ("count", "of", "expected"),
    [(1, 100, "warning"), (1, 101, None), (20, 100, "error"), (19, 100, "warning")],
)
def test_rejections(count: int, of: int, expected: str | None) -> None:
    north = axis("north", ekf2_innovations=rejected(count, of))
    one = analysis(ekf2={"gate": 5.0}, axes=(north, axis("east", ekf2_innovations=rejected(9, 9))))
    assert severity(ekf2_rejecting, one) == expected
    down = analysis(ekf2={"gate": 5.0}, axes=(axis("down", ekf2_innovations=rejected(count, of)),))
    assert severity(ekf2_rejecting, down) == expected
    if expected:
        finding = only(ekf2_rejecting, one)
        assert finding.spans_s == moments(20.0 + np.arange(count))
        assert "for horizontal position (outside 5 √S)" in finding.message
        assert "Not replayed: no topic for it." in finding.remedy
        assert "for height" in only(ekf2_rejecting, down).message
        assert only(ekf2_rejecting, down).remedy == ekf2_rejecting.IN_ORDER


@pytest.mark.parametrize(
    ("wanted", "ends", "tried", "said"),
    [
        # by name, noise first, then the delay, then both; the wider gate always last
        ({"EKF2_EVP_NOISE": 0.3, "EKF2_EV_DELAY": 90.0}, "EKF2_EV_DELAY",
         [["EKF2_EVP_NOISE"], ["EKF2_EV_DELAY"], ["EKF2_EVP_NOISE", "EKF2_EV_DELAY"],
          ["EKF2_EVP_GATE"]], "Set EKF2_EV_DELAY to 90 ms: effect."),
        ({"EKF2_EVP_NOISE": 0.3, "EKF2_EV_DELAY": 0.0}, "nothing",
         [["EKF2_EVP_NOISE"], ["EKF2_EVP_GATE"]],
         "With what the data ask for (EKF2_EVP_NOISE to 0.3 m) the rejections remain: effect."),
        ({"EKF2_EVP_NOISE": 0.1}, "nothing", [["EKF2_EVP_GATE"]],
         "EKF2's parameters are what the data ask for."),
        ({}, "nothing", [["EKF2_EVP_GATE"]], "What EKF2 fused does not tell its noise here."),
    ],
)  # fmt: skip
def test_what_ends_rejections_is_tried_in_order(
    monkeypatch: pytest.MonkeyPatch, wanted: Any, ends: str, tried: list[list[str]], said: str
) -> None:
    seen: list[dict[str, float]] = []

    def replayed(_model: Model, *candidates: dict[str, float]) -> list[Effect]:
        seen.extend(candidates)
        summary = made_summary(0.1)
        return [Effect(changes, summary, summary) for changes in candidates]

    def made_summary(error: float) -> Any:
        return SimpleNamespace(position_rmse_to_truth_m=error)

    monkeypatch.setattr(ekf2_rejecting, "asked_of_ekf2", lambda *_: wanted)
    monkeypatch.setattr(ekf2_rejecting, "replayed", replayed)
    monkeypatch.setattr(Effect, "words", lambda _: "effect")
    turn = iter(seen)
    monkeypatch.setattr(ekf2_rejecting, "rejects_less", lambda *_: list(next(turn)) == [ends])
    flown = {"EKF2_EVP_NOISE": 0.1, "EKF2_EV_DELAY": 0.0, "EKF2_EVP_GATE": 5.0}
    model = made(Model, inputs=SimpleNamespace(settings=flown))
    frame = axis("north", ekf2_innovations=rejected(5, 10))
    one = analysis(ekf2={"gate": 5.0}, axes=(frame,), ekf2_model=model)
    remedy = only(ekf2_rejecting, one).remedy if ends != "nothing" else None
    if remedy is None:
        monkeypatch.setattr(ekf2_rejecting, "rejects_less", lambda *_: False)
        remedy = only(ekf2_rejecting, one).remedy
        assert remedy.endswith("A wider EKF2_EVP_GATE is no remedy; at 10: effect.")
    assert said in remedy
    assert [list(changes) for changes in seen] == tried
    assert seen[-1] == {"EKF2_EVP_GATE": 10.0}


# ---------------------------------------------------------------- errors and truth


def against_truth(nees: float, rmse_m: float = 0.4) -> AgainstTruth:
    return AgainstTruth(count=100, position_rmse_m=rmse_m, nees_position_mean=nees)


def hiding(nis: float = 1.0, nees: float = 4.0, name: str = "north", **parts: Any) -> Any:
    """Our filter, content with its innovations."""
    return axis(name, kf=statement(nis), kf_truth=against_truth(nees), **parts)


@pytest.mark.parametrize(
    ("nis", "nees", "expected"),
    [(1.0, 4.0, "warning"), (1.0, 3.99, None), (1.49, 4.0, "warning"), (1.5, 4.0, None),
     (1.0, 15.9, "warning"), (1.0, 16.0, "error")],
)  # fmt: skip
def test_errors_that_innovations_hide(nis: float, nees: float, expected: str | None) -> None:
    one = analysis(axes=(hiding(nis, nees),))
    assert severity(errors_larger_than_claimed, one) == expected
    unknown = axis(
        kf=statement(nis), kf_truth=structs.replace(against_truth(1.0), nees_position_mean=None)
    )
    assert severity(errors_larger_than_claimed, analysis(axes=(unknown,))) is None


def test_hidden_errors_are_told_of_the_worst_axis_first() -> None:
    ekf2 = axis("east", ekf2=statement(0.49), ekf2_truth=against_truth(25.0, 1.0))
    finding = only(errors_larger_than_claimed, analysis(axes=(hiding(), ekf2)))
    assert finding.message.startswith("Innovations small, errors large: ")
    assert "our filter claims σ 0.2 m along north and errs by 0.40 m RMS" in finding.message
    assert "EKF2 claims σ 0.2 m along east and errs by 1.00 m RMS (mean NEES 25" in finding.message
    assert finding.evidence["filter"] == "ekf2"
    assert finding.evidence["ekf2_sigma_p_m"] == pytest.approx(0.2)
    assert finding.remedy == errors_larger_than_claimed.REMEDIES["shared"]
    just = axis("east", ekf2=statement(0.5), ekf2_truth=against_truth(25.0))
    alone = only(errors_larger_than_claimed, analysis(axes=(just,)))
    assert alone.message.startswith("Innovations consistent, errors not: ")
    assert alone.remedy == errors_larger_than_claimed.REMEDIES["ekf2"]
    drifts = analysis(axes=(hiding(),), source=source(origin=DRIFTING))
    assert (
        only(errors_larger_than_claimed, drifts).remedy
        == (errors_larger_than_claimed.REMEDIES["drift"])
    )


@pytest.mark.parametrize(("left", "frame"), [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("drifts", [False, True])
def test_what_a_turn_and_shift_of_the_frame_leaves(left: float, frame: bool, drifts: bool) -> None:
    """On a circle of 5 m: a shift, and an error that changes sign from sample to sample."""
    time = np.arange(20.0, 100.0, 0.1)
    angle = 0.2 * np.pi * time
    true = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    shift = np.sqrt(1.0 - left**2)
    own = true + np.array([0.0, shift])
    own[::2, 0] += left
    own[1::2, 0] -= left
    own[0], time_own = np.nan, time  # unknown there
    axes = [
        axis(name, ekf2=statement(), ekf2_truth=against_truth(9.0),
             truth=pd.DataFrame({"position_m": true[:, at]}, index=time),
             ekf2_state=pd.DataFrame({"position_m": own[:, at]}, index=time_own))
        for at, name in enumerate(("north", "east"))
    ]  # fmt: skip
    moves = source(origin=DRIFTING if drifts else RECEIVED)
    finding = only(errors_larger_than_claimed, analysis(axes=tuple(axes), source=moves))
    assert finding.evidence["position_rmse_horizontal_m"] == pytest.approx(1.0, rel=0.01)
    assert finding.evidence["position_rmse_aligned_m"] == pytest.approx(left, rel=0.01)
    assert ("Most of it is how the source's frame lies" in finding.message) is frame
    assert ("and the filter follows it" in finding.message) is (drifts and not frame)
    assert (finding.remedy == errors_larger_than_claimed.REMEDIES["frame"]) is frame


# ---------------------------------------------------------------- the log


@pytest.mark.parametrize(
    ("gap_s", "rate_hz", "expected"),
    [(0.2, 100.0, None), (0.201, 100.0, "warning"), (0.499, 4.0, None), (0.501, 4.0, "warning")],
)
def test_a_gap_of_the_imu(gap_s: float, rate_hz: float, expected: str | None) -> None:
    axes = (axis(replay=SimpleNamespace(input_gap_s=gap_s)),)
    one = analysis(axes=axes, flight={"imu": at_rate(rate_hz)})
    assert severity(imu_gap, one) == expected


def test_when_the_imu_is_missing() -> None:
    """Inside, at the ends by more than a moment, and not outside the segment."""
    time = np.concatenate([np.arange(10.2, 40.0, 0.01), np.arange(42.0, 109.97, 0.01)])
    segment = Segment(10.0, 110.0, "")
    spans = imu_gap._spans(time, segment)
    assert np.allclose(spans, [(10.0, 10.2), (39.99, 42.0)], atol=0.02)
    assert imu_gap._spans(time, Segment(42.0, 110.0, "")) == ()
    assert imu_gap._spans(time, Segment(10.2, 39.9, "")) == ()
    (end,) = imu_gap._spans(np.arange(10.0, 109.9, 0.01), segment)
    assert end[1] == 110.0


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
        found = list(logging_rate_low.DETECTOR.detect(analysis(flight=flight, log=info)))
        assert [finding.evidence["needed_hz"] * 2.0 for finding in found] == expected
        assert all(says.format(hz) in f.remedy for f, hz in zip(found, expected, strict=True))


def test_a_rate_that_is_just_enough_is_enough() -> None:
    needed = 32.0 / 0.98
    assert 0.98 * needed == 32.0
    frame = at_rate(32.0)
    assert not logging_rate_low.too_slow(frame, Threshold(needed, "Hz", ""))
    assert logging_rate_low.too_slow(frame, Threshold(1.001 * needed, "Hz", ""))


def test_what_is_damaged_is_counted() -> None:
    for count, more in ((1, ""), (2, " (and 1 more such note)"), (3, " (and 2 more such notes)")):
        (dropped,) = log_damaged.DETECTOR.detect(
            analysis(log=log(notes=("4 samples dropped: late",) * count))
        )
        assert dropped.message == f"4 samples dropped: late{more}."
        assert dropped.evidence == {"notes": float(count)}


@pytest.mark.parametrize(
    ("damage", "flying", "severity", "said"),
    [
        (("it is cut", "9 bytes are lost"), True, "warning", "It is cut. 9 bytes are lost."),
        ((), True, "info", "The log ends in flight, after 60.0 s: the landing is not in it."),
        ((), False, None, ""),
    ],
)
def test_what_is_not_in_a_log_is_said(
    damage: tuple[str, ...], flying: bool, severity: str | None, said: str
) -> None:
    found = list(
        log_damaged.DETECTOR.detect(
            analysis(log=log(damage=damage, ends_in_flight=flying, bytes=100, bytes_read=91))
        )
    )
    assert [(one.severity, one.message) for one in found] == ([(severity, said)] if said else [])
    for one in found:
        assert one.evidence == {"lost_bytes": 9.0, "ends_in_flight": float(flying)}


def test_a_recording_says_what_it_holds() -> None:
    for has_ulog, frame in ((True, pd.DataFrame()), (False, NONE)):
        info = log(format="MAVLink tlog", has_ulog=has_ulog)
        one = only(innovations_need_ulog, analysis(log=info, ekf2={"variance": frame}))
        assert (" and variances" in one.message) is isinstance(frame, pd.DataFrame)
        assert ("--mavlink" in one.remedy) is has_ulog
        assert named(innovations_need_ulog, analysis(log=info)) == {}
    assert named(innovations_need_ulog, analysis(ekf2={"variance": NONE})) == {}


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
    wanted = "position source vehicle_visual_odometry"
    missing = (
        Unavailable("another", "no", "Do."),
        Unavailable(wanted, "it was off", "Do.", source="vehicle_visual_odometry"),
    )
    for origin in (ALIGNED, KEPT, REBUILT):
        one = analysis(
            source=source(name=name, origin=origin, rate_hz=rate_hz), missing=missing,
            log=log(parameters={"SDLOG_PROFILE": 2.0}),
        )  # fmt: skip
        found = {f.id: f for f in source_not_logged.DETECTOR.detect(one)}
        assert ("source_decimated" in found) is decimated
        assert "as it arrived (it was off); " in found["source_not_logged"].message
        assert all("SDLOG_PROFILE to 130 " in each.remedy for each in found.values())
        if decimated:
            limit = found["source_decimated"].evidence["logger_limit_hz"]
            assert f"own limit for it ({limit:g} Hz)" in found["source_decimated"].message
            assert rate_hz == pytest.approx(limit, rel=0.35)
    for origin, tracks in (
        (RECEIVED, ()), (MOTION_CAPTURE, ()), (GNSS, ()),
        (ALIGNED, (SimpleNamespace(origin=RECEIVED),)),
    ):  # fmt: skip
        one = analysis(source=source(name=name, origin=origin), flight={"positions": tracks})
        assert named(source_not_logged, one) == {}
    first = next(
        source_not_logged.DETECTOR.detect(analysis(source=source(name=name, origin=ALIGNED)))
    )
    assert "(it is not in this log)" in first.message


@pytest.mark.parametrize(
    ("rate_hz", "least_s"), [(2.0, 2.5), (10.0, 1.0)]
)  # five intervals, and a second at least
def test_a_silent_source(rate_hz: float, least_s: float) -> None:
    for gap_s, there in ((least_s, False), (least_s + 0.25, True)):
        time = np.concatenate([np.arange(10.0, 20.5, 0.5), [20.0 + gap_s, 20.5 + gap_s]])
        one = analysis(axes=(axis(),), source=source(rate_hz=rate_hz))
        one.lines[0].measurement_time_s = time
        assert bool(named(source_gap, one)) is there
        if there:
            finding = only(source_gap, one)
            assert finding.evidence == {"count": 1.0, "longest_s": gap_s, "at_s": 20.0}
            assert f"more than {least_s:.1f} s, the longest time {gap_s:.1f} s at 20.0 s" in (
                finding.message
            )


def test_the_range_of_the_motion_leaves_out_a_twentieth_at_either_end() -> None:
    east = np.zeros(100)
    east[:3], east[3:7], east[7:10] = -9.0, -1.0, -0.5
    east[-3:], east[-7:-3], east[-10:-7] = 9.0, 1.0, 0.5
    moving = positions(10.0 + np.arange(100))
    moving["east_m"] = east
    outside = positions([5.0, 111.0], 99.0)
    comparison = analysis(source=source(samples=pd.concat([moving, outside])))
    assert no_motion.motion_range_m(comparison) == 2.0


@pytest.mark.parametrize(("extent_m", "expected"), [(0.5, None), (0.499, "warning")])
def test_a_vehicle_that_hardly_moved(extent_m: float, expected: str | None) -> None:
    samples = positions(10.0 + np.arange(100), np.repeat([0.0, extent_m], 50))
    assert severity(no_motion, analysis(source=source(samples=samples))) == expected


def test_what_is_poorly_known_of_a_files_place_is_told_with_its_option() -> None:
    placed = SimpleNamespace(
        warnings=("the frame fits as well as ned: give --position-frame ned.", "the yaw is weak.")
    )
    frame, yaw = position_file_placement.DETECTOR.detect(analysis(source=source(alignment=placed)))
    assert (frame.severity, yaw.severity) == ("error", "warning")
    assert frame.message == "uwb: The frame fits as well as ned."
    assert frame.remedy == "Give --position-frame ned."
    assert yaw.message == "uwb: The yaw is weak."
    assert "where you know them" in yaw.remedy


# ---------------------------------------------------------------- frames


@pytest.mark.parametrize(("until_s", "expected"), [(60.0, "warning"), (60.1, "info")])
def test_a_frame_that_is_not_north(until_s: float, expected: str) -> None:
    frd = source(frame="FRD")
    one = analysis(source=frd, ekf2=steps((0.0, 1.0), (until_s, 0.0), column="yaw"))
    finding = only(source_frame_not_north, one)
    assert finding.severity == expected
    assert ("EKF2 fused its yaw" in finding.message) is (expected == "info")
    assert ("Send the position in NED" in finding.remedy) is (expected == "warning")
    assert severity(source_frame_not_north, analysis(source=frd)) == "warning"
    assert severity(source_frame_not_north, analysis()) is None
    for has_ulog in (True, False):
        one = analysis(source=frd, ekf2={"fusing": NONE}, log=log(has_ulog=has_ulog))
        finding = only(source_frame_not_north, one)
        assert finding.severity == "info"
        assert ("the ULog says" in finding.remedy) is has_ulog


def turned(*degrees: float, sigma_deg: float = 1.0, p: float = 1.0) -> HeadingError:
    parts = (HeadingPart(10.0 * n, 10.0 * n + 10.0, d, sigma_deg) for n, d in enumerate(degrees))
    return together(tuple(parts), p, "positions")


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        (turned(5.0), "warning"), (turned(4.9), None), (turned(14.9), "warning"),
        (turned(15.0), "error"), (turned(8.0, sigma_deg=2.0), "warning"),
        (turned(7.9, sigma_deg=2.0), None), (turned(0.0, 14.9, p=0.0), "warning"),
        (turned(0.0, 15.0, p=0.0), "error"),
    ],
)  # fmt: skip
def test_a_frame_that_is_turned(heading: HeadingError, expected: str | None) -> None:
    assert severity(source_frame_turned, analysis(heading=heading)) == expected
    made_of_ekf2 = source(origin=KEPT)
    assert severity(source_frame_turned, analysis(heading=heading, source=made_of_ekf2)) is None


def test_a_turn_is_told_with_its_interval_and_undone_by_its_opposite() -> None:
    finding = only(source_frame_turned, analysis(heading=turned(20.0, sigma_deg=2.0)))
    assert finding.id == "source_frame_turned"
    assert "turned by +20° ± 4° (clockwise" in finding.message
    assert "Turn the positions by -20°" in finding.remedy
    aligned = source(name="estimator_visual_odometry_aligned")
    for has_ulog in (True, False):
        one = analysis(heading=turned(20.0), source=aligned, log=log(has_ulog=has_ulog))
        assert only(source_frame_turned, one).id == "ekf2_heading_wrong"
        assert ("EKF2_EV_CTRL bit 3" in only(source_frame_turned, one).remedy) is has_ulog


def test_a_heading_that_drifts_is_told_from_end_to_end() -> None:
    finding = only(source_frame_turned, analysis(heading=turned(2.0, 30.0, p=0.0)))
    assert finding.id == "ekf2_heading_wrong"
    assert "lies at +2° from 0 to 10 s and at +30° from 10 to 20 s" in finding.message
    assert "by the positions and the IMU" in finding.message
    assert finding.remedy.startswith("Calibrate the magnetometer")
    assert finding.evidence["from_deg"] == 2.0
    assert finding.evidence["p"] == 1e-300
    by = replace(turned(2.0, 30.0, p=0.001), by="orientation")
    finding = only(source_frame_turned, analysis(heading=by))
    assert "by the source's own orientation" in finding.message
    assert finding.evidence["p"] == 0.001
