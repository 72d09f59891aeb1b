"""Each finding about the position source at the edges of its thresholds.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from findings_tools import (
    NONE,
    ages,
    analysis,
    at_rate,
    jump,
    late,
    log,
    made,
    named,
    only,
    positions,
    severity,
    source,
    tuned,
    with_bias,
)

from px4fuse.ekf2.model import Model
from px4fuse.filter.causes import Explained
from px4fuse.filter.hypotheses import Estimate
from px4fuse.filter.settings import Settings
from px4fuse.filter.smoothing import Smoothing
from px4fuse.filter.tuning import Noise
from px4fuse.findings import (
    accelerometer_bias,
    companion_not_synchronised,
    ekf2_ev_delay_wrong,
    source_clock,
    source_jumps,
    source_outliers,
    source_samples_lost,
    source_scale_wrong,
    source_smoothed,
    source_stamps,
    source_stamps_of_arrival,
    source_thinned,
    source_variance_wrong,
)
from px4fuse.flight import SPECIFIC_FORCE_COLUMNS
from px4fuse.origin import ALIGNED, KEPT, MOTION_CAPTURE


def bias_of_ekf2(*bias: float) -> dict[str, Any]:
    """EKF2's bias in the segment, and another one outside it."""
    rows = [[9.0] * 3, bias, bias, bias, [9.0] * 3]
    index = [9.0, 10.0, 50.0, 110.0, 111.0]
    return {"accelerometer_bias": pd.DataFrame(rows, index=index, columns=SPECIFIC_FORCE_COLUMNS)}


@pytest.mark.parametrize(
    ("bias", "sigma_m_s2", "expected"),
    [
        (0.2, 0.01, "warning"), (0.199, 0.01, None), (0.3, 0.01, "error"), (0.299, 0.01, "warning"),
        (0.25, 0.0625, "warning"), (0.25, 0.0626, None),
    ],
)  # fmt: skip
def test_an_accelerometer_bias(bias: float, sigma_m_s2: float, expected: str | None) -> None:
    for signed in (bias, -bias):
        one = analysis(explained=with_bias(signed, sigma_m_s2))
        assert severity(accelerometer_bias, one) == expected


def test_an_accelerometer_bias_is_told_with_its_interval_and_tilt_and_what_ekf2_says() -> None:
    one = analysis(explained=with_bias(0.3, 0.05, -0.4), ekf2=bias_of_ekf2(0.1, -0.2, 0.0))
    finding = only(accelerometer_bias, one)
    assert "+0.30 m/s² too much forward and -0.40 right (± 0.10)" in finding.message
    assert "off by 2.9° does the same" in finding.message  # 0.5 of 9.80665 m/s²
    assert "EKF2 subtracts +0.10 forward, -0.20 right." in finding.message
    assert finding.evidence == {"bias_m_s2": 0.5, "sigma_m_s2": 0.05}


@pytest.mark.parametrize(
    ("bias", "explained", "expected"),
    [
        ((0.2, 0.0, 0.0), NONE, "warning"), ((0.199, 0.0, 0.0), NONE, None),
        ((0.0, 0.0, 0.2), with_bias(0.0), "warning"),
        ((0.5, 0.5, 0.1), with_bias(0.0), None),  # horizontally our estimate is the better one
    ],
)  # fmt: skip
def test_ekf2s_bias_counts_where_there_is_none_of_ours(
    bias: tuple[float, ...], explained: Any, expected: str | None
) -> None:
    one = analysis(explained=explained, ekf2=bias_of_ekf2(*bias))
    assert severity(accelerometer_bias, one) == expected
    outside = bias_of_ekf2(*bias)["accelerometer_bias"].iloc[[0, 4]]
    one = analysis(explained=explained, ekf2={"accelerometer_bias": outside})
    assert severity(accelerometer_bias, one) is None


def clock_map(method: str = "TIMESYNC", distinct: int | None = None, jitter_s: float = 0.02) -> Any:
    return SimpleNamespace(method=method, distinct_stamps=distinct, jitter_s=jitter_s, pairs=600)


def test_only_a_time_of_arrival_makes_our_track_late_as_well() -> None:
    late = analysis(source=source(clock_map=clock_map("arrival time")))
    own = analysis(source=source(clock_map=clock_map("receive time")))
    assert "so that its track is late" in only(companion_not_synchronised, late).message
    assert "the sender's own stamps" in only(companion_not_synchronised, own).message
    assert named(companion_not_synchronised, analysis(source=source(clock_map=clock_map()))) == {}


@pytest.mark.parametrize(
    ("jitter_s", "distinct", "expected"),
    [(0.010, 2, ["source_stamps_constant"]),
     (0.011, 2, ["source_stamps_constant", "source_receipt_jitter"]), (0.5, None, [])],
)  # fmt: skip
def test_stamps_that_never_change(
    jitter_s: float, distinct: int | None, expected: list[str]
) -> None:
    one = analysis(source=source(clock_map=clock_map(distinct=distinct, jitter_s=jitter_s)))
    assert list(named(source_stamps, one)) == expected


def test_the_jitter_of_receipt_is_told_in_milliseconds_and_metres() -> None:
    one = analysis(source=source(clock_map=clock_map(distinct=1, jitter_s=0.0126)))
    constant, jitter = source_stamps.DETECTOR.detect(one)
    assert "only 1 value:" in constant.message
    assert "jitters by 13 ms: at 1 m/s that is an error of 0.013 m" in jitter.message


@pytest.mark.parametrize(
    ("ekf2", "expected"),
    [
        (ages(20, 0), "warning"), (ages(19, 0), None),  # 20 samples at least
        (ages(20, 0, wrong=1), "warning"), (ages(20, 0, wrong=2), None),  # 95 %
        (ages(10, 20), "warning"), (ages(9, 20), None), (ages(20, 10), "warning"),
        (ages(20, 9), None),  # 10 on either side
        (ages(20, 20, wrong=1), "warning"), (ages(20, 20, wrong=2), None),
        (ages(20, 20, 0.02), "warning"), (ages(20, 20, 0.0199), None),
        (ages(20, 20, 0.1), "error"), (ages(20, 20, 0.0999), "warning"),
        (ages(0, 30, 0.00099), "warning"), (ages(0, 30, 0.001), None),
    ],
)  # fmt: skip
def test_stamps_of_arrival(ekf2: dict[str, Any], expected: str | None) -> None:
    assert severity(source_stamps_of_arrival, analysis(ekf2=ekf2)) == expected
    assert severity(source_stamps_of_arrival, analysis(ekf2=ekf2, source=source(
        origin=KEPT))) is None  # fmt: skip


def test_stamps_of_arrival_end_at_the_first_true_one() -> None:
    one = analysis(ekf2=ages(12, 20, 0.05))
    finding = only(source_stamps_of_arrival, one)
    assert finding.evidence == {"until_s": 32.0, "latency_s": 0.05}
    assert finding.spans_s == ((20.0, 32.0),)
    assert source_stamps_of_arrival.stamps_of_arrival_end_s(one) == 32.0
    assert source_stamps_of_arrival.stamps_of_arrival_end_s(analysis(ekf2=ages(30, 0))) is None


def at_multiples(multiples: list[int], base_s: float = 0.125, **parts: Any) -> Any:
    time = 10.0 + np.concatenate([[0.0], base_s * np.cumsum(multiples)])
    return analysis(source=source(samples=positions(time), **parts))


@pytest.mark.parametrize(
    ("multiples", "expected"),
    [
        ([1, 1, 2] * 20, "warning"),  # a quarter of the samples is missing
        ([1, 1, 2] * 19 + [1, 1, 1], None),
        ([1, 2] * 25, "warning"), ([1, 2] * 24 + [1], None),  # 50 intervals at least
        ([2, 3] * 30, "error"),  # 0.31 s apart: EKF2 does not start
        ([2] * 54 + [3] * 6, "error"), ([2] * 55 + [3] * 5, None),  # a tenth is of each
        ([1] * 50 + [2] * 35 + [4] * 15, "error"), ([1] * 50 + [2] * 34 + [4] * 16, None),
    ],
)  # fmt: skip
def test_thinned_positions(multiples: list[int], expected: str | None) -> None:
    assert severity(source_thinned, at_multiples(multiples)) == expected


def test_thinned_positions_are_told_with_both_rates() -> None:
    finding = only(source_thinned, at_multiples([1, 2] * 30))
    assert finding.evidence["rate_hz"] == pytest.approx(1.0 / 0.1875)
    assert finding.evidence["source_rate_hz"] == pytest.approx(8.0)
    assert finding.evidence["lost_share"] == pytest.approx(1.0 / 3.0)
    assert "at 5.3 Hz, at whole multiples of 0.125 s: of a source of 8 Hz 33%" in finding.message
    slow = only(source_thinned, at_multiples([2, 3] * 30))
    assert "starts only below 0.2 s apart" in slow.message
    assert "starts only" not in finding.message


def test_the_intervals_of_what_others_made_tell_nothing() -> None:
    for parts in ({"clock_map": clock_map()}, {"origin": ALIGNED}):
        assert severity(source_thinned, at_multiples([1, 2] * 30, **parts)) is None
    assert severity(source_thinned, at_multiples([1, 2] * 30, origin=MOTION_CAPTURE)) is not None


def test_the_interval_that_all_are_multiples_of_is_sought_within_its_jitter() -> None:
    found = source_thinned._base(np.array([1.0, 1.0, 2.0]))
    assert found is not None
    assert found[0] == 1.0
    # a quarter of the usual interval is looked at, a fifth is not
    for parts, there in ((4, True), (5, False)):
        found = source_thinned._base(np.array([1.0] * 5 + [1.0 + 1.0 / parts] * 2))
        assert (found is not None) is there
    for off, there in ((0.058, True), (0.062, False)):
        # of multiples of a second, by so much off at random, root mean square
        jitter = off * np.tile([1.0, -1.0], 15)
        found = source_thinned._base(np.sort(np.full(30, 1.0) + jitter))
        assert (found is not None and found[0] == pytest.approx(1.0)) is there


@pytest.mark.parametrize(
    ("singles", "expected"), [(47, "info"), (48, None)]  # with two lost in one interval
)  # fmt: skip
def test_single_samples_that_were_lost(singles: int, expected: str | None) -> None:
    time = 10.0 + 0.25 * np.cumsum([0] + [1] * singles + [2])
    for parts, says in (
        ({"clock_map": clock_map()}, expected), ({"clock_map": None}, None),
        ({"clock_map": clock_map("arrival time")}, None),
        ({"clock_map": clock_map(distinct=2)}, None),
    ):  # fmt: skip
        one = analysis(source=source(samples=positions(time), **parts))
        assert severity(source_samples_lost, one) == says


def test_a_gap_is_not_counted_as_single_lost_samples() -> None:
    for longest, lost in ((5.0, 4.0), (5.1, None)):  # of 0.25 s each
        time = 10.0 + 0.25 * np.cumsum([0.0] + [1.0] * 20 + [longest])
        one = analysis(source=source(samples=positions(time), clock_map=clock_map()))
        found = list(source_samples_lost.DETECTOR.detect(one))
        assert [finding.evidence["lost"] for finding in found] == ([] if lost is None else [lost])
    assert "(4 samples of 25 at one per 0.25 s)" in only(
        source_samples_lost,
        analysis(source=source(
            samples=positions(10.0 + 0.25 * np.cumsum([0.0] + [1.0] * 20 + [5.0])),
            clock_map=clock_map(),
        )),
    ).message  # fmt: skip


@pytest.mark.parametrize(
    ("gain", "lag_s", "expected"),
    [(12.0, 0.05, "warning"), (11.9, 0.05, None), (12.0, 0.049, None), (12.0, 0.0999, "warning"),
     (12.0, 0.1, "error")],
)  # fmt: skip
def test_smoothing(gain: float, lag_s: float, expected: str | None) -> None:
    found = Smoothing(0.5, lag_s, gain, 0.1)
    assert severity(source_smoothed, analysis(smoothing=found)) == expected
    for parts in ({"orientation": object()}, {"origin": KEPT}):
        assert severity(source_smoothed, analysis(smoothing=found, source=source(**parts))) is None


@pytest.mark.parametrize(
    ("size", "expected"),
    [(0.199, None), (0.2, "warning"), (0.499, "warning"), (0.5, "error")],
)
def test_jumps(size: float, expected: str | None) -> None:
    one = analysis(explained=made(Explained, jumps=(jump(0.0, size), jump(0.1, 0.0))))
    assert severity(source_jumps, one) == expected


def test_the_largest_of_several_jumps_is_told() -> None:
    jumps = (jump(0.3, 0.0, at_s=30.0), jump(0.6, 0.8, at_s=60.0), jump(0.1, 0.0, at_s=90.0))
    finding = only(source_jumps, analysis(explained=made(Explained, jumps=jumps)))
    assert finding.evidence == {"count": 2.0, "size_m": 1.0, "at_s": 60.0, "sigma_m": 0.02}
    assert "jumps 2 times and stays there, by 1.00 m (± 0.04) at 60.0 s" in finding.message
    assert finding.spans_s == ((30.0, 30.0), (60.0, 60.0))
    stamps = analysis(explained=made(Explained, jumps=jumps), ekf2=ages(20, 20))
    assert named(source_jumps, stamps) == {}  # a moving vehicle's positions jump where those do


@pytest.mark.parametrize(
    ("scale", "sigma_share", "expected"),
    [
        (0.12, 0.01, "warning"), (0.119, 0.01, None), (0.15, 0.01, "error"),
        (0.149, 0.01, "warning"), (0.1875, 0.0625, "error"), (0.187, 0.0625, None),
    ],
)  # fmt: skip
def test_a_wrong_scale(scale: float, sigma_share: float, expected: str | None) -> None:
    for signed, word in ((scale, "long"), (-scale, "short")):
        found = made(Explained, scale=Estimate(signed, sigma_share))
        one = analysis(explained=found, flight={"imu": at_rate(49.1)})
        assert severity(source_scale_wrong, one) == expected
        if expected:
            finding = only(source_scale_wrong, one)
            assert f"too {word} (± {1.96 * sigma_share:.0%})" in finding.message
            assert finding.evidence["scale"] == 1.0 + signed
        assert severity(source_scale_wrong, analysis(
            explained=found, flight={"imu": at_rate(48.9)})) is None  # fmt: skip
        drifts = {"flight": {"imu": at_rate(100.0)}, "source": source(orientation=object())}
        assert severity(source_scale_wrong, analysis(explained=found, **drifts)) is None


@pytest.mark.parametrize(
    ("outliers", "count", "expected"),
    [(3, 600, "warning"), (3, 601, None), (3, 150, "error"), (3, 151, "warning"), (2, 100, None)],
)
def test_outliers(outliers: int, count: int, expected: str | None) -> None:
    times = np.arange(outliers) + 20.0
    assert severity(source_outliers, analysis(
        tuning=tuned(outlier_time_s=times, count=count))) == expected  # fmt: skip


def test_what_follows_a_jump_for_six_seconds_is_no_outlier() -> None:
    times = np.array([19.9, 20.0, 25.9, 26.0, 27.0])
    for jumps, first in (((), 19.9), ((jump(1.0, 0.0, at_s=20.0),), 19.9)):
        one = analysis(
            tuning=tuned(outlier_time_s=times, count=100), explained=made(Explained, jumps=jumps)
        )
        finding = only(source_outliers, one)
        assert finding.evidence["count"] == (3.0 if jumps else 5.0)
        assert finding.evidence["first_s"] == first
        assert (" and more)" in finding.message) is not bool(jumps)
        assert ("at 19.9, 26.0, 27.0 s" in finding.message) is bool(jumps)


@pytest.mark.parametrize(
    ("reported", "noise", "expected"),
    [
        (3.0, 2.0, "warning"), (2.0, 3.0, "warning"), (1.41, 1.0, None), (1.42, 1.0, "warning"),
        (1.0, 1.41, None), (1.0, 1.42, "warning"), (1.73, 1.0, "warning"), (1.74, 1.0, "error"),
        (1.0, 1.74, "error"),
    ],
)  # fmt: skip
def test_a_variance_that_the_source_states_wrongly(
    reported: float, noise: float, expected: str | None
) -> None:
    stated = source(samples=positions(np.arange(0.0, 120.0), variance_m2=reported**2))
    fitted, smoothing = Noise(noise, 0.99 * noise, 1.01 * noise), Smoothing(0.0, 0.0, 0.0, noise)
    one = analysis(source=stated, tuning=tuned(fitted), smoothing=smoothing)
    assert severity(source_variance_wrong, one) == expected
    if expected:
        finding = only(source_variance_wrong, one)
        assert finding.evidence["variance_factor"] == pytest.approx((reported / noise) ** 2)
        assert finding.evidence["reported_sigma_m"] == pytest.approx(reported)
        assert f"too {'large' if reported > noise else 'small'}" in finding.message
    # not outside the interval, no interval, nothing known of smoothing, odometry
    for other in (
        {"tuning": tuned(Noise(noise, 0.1, 9.0))}, {"tuning": tuned(Noise(noise, None, 9.0))},
        {"tuning": tuned(Noise(None, None, 9.0))}, {"smoothing": NONE}, {"tuning": {}},
        {"tuning": tuned(Noise(noise, 0.1, None))},
        {"source": source(samples=stated.samples, orientation=object())},
    ):  # fmt: skip
        parts = {"source": stated, "tuning": tuned(fitted), "smoothing": smoothing, **other}
        assert severity(source_variance_wrong, analysis(**parts)) is None


def test_a_variance_that_nobody_stated_is_not_judged() -> None:
    silent = source(samples=positions(np.arange(0.0, 120.0)))
    one = analysis(source=silent, tuning=tuned(), smoothing=Smoothing(0.0, 0.0, 0.0, 0.1))
    assert severity(source_variance_wrong, one) is None


@pytest.fixture
def no_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_clock, "filter_errors_m", lambda *_: None)


@pytest.mark.parametrize(
    ("offset_s", "sigma_s", "expected"),
    [(0.03, 0.001, None), (0.031, 0.001, "warning"), (0.1, 0.001, "warning"),
     (0.101, 0.001, "error"), (0.0625, 0.0208, "warning"), (0.0625, 0.0209, None)],
)  # fmt: skip
@pytest.mark.usefixtures("no_truth")
def test_a_clock_offset(offset_s: float, sigma_s: float, expected: str | None) -> None:
    for signed in (offset_s, -offset_s):
        assert severity(source_clock, analysis(clock=late(signed, sigma_s))) == expected
    for parts in ({"clock": late(0.2, determinable=False)},
                  {"clock": late(0.2), "source": source(origin=KEPT)},
                  {"clock": late(0.2), "smoothing": Smoothing(0.5, 0.2, 99.0, 0.1)},
                  {"clock": late(0.2), "ekf2": ages(20, 20)}):  # fmt: skip
        assert severity(source_clock, analysis(**parts)) is None


@pytest.mark.usefixtures("no_truth")
def test_a_clock_offset_is_told_with_what_was_applied() -> None:
    applied = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0, clock_offset_s=-0.05)
    finding = only(source_clock, analysis(clock=late(-0.1, applied_s=-0.05), settings=applied))
    assert "late by 0.100 s against the IMU (95 % 0.080 to 0.110 s)" in finding.message
    assert "an error of 0.10 m" in finding.message
    assert "--clock-offset -0.150." in finding.remedy
    told = {"offset_s": -0.15, "interval_low_s": -0.16, "interval_high_s": -0.13}
    assert finding.evidence == pytest.approx(told)
    early = only(source_clock, analysis(clock=late(0.1)))
    assert "early by 0.100 s against the IMU (95 % 0.090 to 0.120 s)" in early.message
    placed = source(alignment=SimpleNamespace(clock_offset_s=2.0))
    finding = only(source_clock, analysis(clock=late(0.1), source=placed))
    assert "--clock-offset 2.100." in finding.remedy


@pytest.mark.parametrize(("p", "there"), [(0.005, False), (0.0049, True), (None, False)])
@pytest.mark.usefixtures("no_truth")
def test_a_clock_offset_that_changes(p: float | None, there: bool) -> None:
    found = list(source_clock.DETECTOR.detect(analysis(clock=late(0.1, change_p=p))))
    assert [one.id for one in found] == ["source_clock_changes" if there else "source_clock_offset"]
    if there:
        assert "-0.10 s at the beginning, +0.30 s at the end" in found[0].message
        assert found[0].evidence["change_p"] == p


@pytest.mark.parametrize(("after_m", "there"), [(1.005, True), (1.0051, False), (0.5, True)])
def test_a_clock_offset_that_the_truth_contradicts_is_not_told(
    monkeypatch: pytest.MonkeyPatch, after_m: float, there: bool
) -> None:
    def errors_m(_: Any, shifted: Settings) -> tuple[float, float]:
        assert shifted.clock_offset_s == 0.123  # as it is typed
        return 1.0, after_m

    monkeypatch.setattr(source_clock, "filter_errors_m", errors_m)
    found = list(source_clock.DETECTOR.detect(analysis(clock=late(0.12345))))
    assert bool(found) is there
    if there:
        assert f"position error 1.000 → {after_m:.3f} m (replayed)" in found[0].remedy


def test_what_a_clock_offset_asks_of_ekf2(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay is what the stamps are late by, with what was applied: 150 ms."""
    asked: list[float] = []
    effect = SimpleNamespace(before=1.0, after=2.0, words=lambda: "it helps")

    def delay(_model: Model, late_ms: float) -> dict[str, float]:
        asked.append(late_ms)
        return {"EKF2_EV_DELAY": late_ms}

    monkeypatch.setattr(source_clock, "filter_errors_m", lambda *_: None)
    monkeypatch.setattr(source_clock, "delay_change", delay)
    monkeypatch.setattr(source_clock, "replayed", lambda *_: [effect])
    monkeypatch.setattr(source_clock, "delay_helps", lambda before, after: before < after)
    applied = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0, clock_offset_s=-0.05)
    for fed, helps in (("uwb", True), ("another", False)):
        inputs = SimpleNamespace(vision=SimpleNamespace(source=fed))
        one = analysis(
            clock=late(-0.1, applied_s=-0.05),
            settings=applied,
            ekf2_model=made(Model, inputs=inputs),
        )
        remedy = only(source_clock, one).remedy
        assert ("; for EKF2 set EKF2_EV_DELAY to 150 ms: it helps." in remedy) is helps
    assert asked == pytest.approx([150.0])
    monkeypatch.setattr(source_clock, "delay_helps", lambda *_: False)
    one = analysis(clock=late(-0.1), ekf2_model=made(
        Model, inputs=SimpleNamespace(vision=SimpleNamespace(source="uwb"))))  # fmt: skip
    assert "EKF2" not in only(source_clock, one).remedy


@pytest.mark.parametrize(
    ("delay_ms", "sigma_s", "expected"),
    [(30.0, 0.001, "warning"), (29.0, 0.001, None), (40.0, 0.01, "warning"), (39.0, 0.01, None)],
)
def test_a_wrong_delay(delay_ms: float, sigma_s: float, expected: str | None) -> None:
    flown = log(parameters={"EKF2_EV_DELAY": delay_ms})
    one = analysis(log=flown, clock=late(0.0, sigma_s))
    assert severity(ekf2_ev_delay_wrong, one) == expected
    for parts in ({"clock": late(0.0, determinable=False)}, {"log": log()},
                  {"source": source(origin=KEPT)}):  # fmt: skip
        other = {"log": flown, "clock": late(0.0, sigma_s), **parts}
        assert severity(ekf2_ev_delay_wrong, analysis(**other)) is None


def test_the_delay_that_the_data_ask_for_is_told_with_what_was_applied() -> None:
    applied = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0, clock_offset_s=-0.02)
    flown = log(parameters={"EKF2_EV_DELAY": 0.0})
    finding = only(
        ekf2_ev_delay_wrong,
        analysis(log=flown, clock=late(-0.1, applied_s=-0.02), settings=applied),
    )
    assert "the data ask for 120 ms (95 % 100 to 130)" in finding.message
    assert finding.remedy == "Set EKF2_EV_DELAY to 120 ms. Not replayed: no topic for it."
    assert finding.evidence["asked_ms"] == pytest.approx(120.0)


@pytest.mark.parametrize(
    ("offset_s", "interval_s", "delay_ms", "says", "remedy"),
    [
        (0.0, (-0.01, 0.01), 50.0, "ask for 0 ms (95 % -10 to 10)", "EKF2_EV_DELAY to 0 ms"),
        (-0.02, (-0.04, 0.0), 100.0, "ask for 20 ms", "EKF2_EV_DELAY to 0 ms"),
        (0.05, (0.04, 0.07), 0.0, "early by 50 ms (95 % 40 to 70)", "stamps that are early"),
        (-0.301, (-0.4, -0.2), 0.0, "ask for 301 ms", "PX4 allows 300 ms"),
        (-0.3, (-0.4, -0.2), 0.0, "ask for 300 ms", "EKF2_EV_DELAY to 300 ms"),
    ],
)  # fmt: skip
def test_a_delay_stays_in_px4s_range(
    offset_s: float, interval_s: tuple[float, float], delay_ms: float, says: str, remedy: str
) -> None:
    flown = log(parameters={"EKF2_EV_DELAY": delay_ms})
    finding = only(
        ekf2_ev_delay_wrong, analysis(log=flown, clock=late(offset_s, interval_s=interval_s))
    )
    assert says in finding.message
    assert remedy in finding.remedy


@pytest.mark.parametrize(
    ("asked_ms", "flown_ms", "remedy"),
    [(0.4, 0.0, "no parameter"), (0.4, 9.0, "to 0 ms"), (0.6, 0.0, "to 1 ms")],
)
def test_a_delay_is_set_in_whole_milliseconds(
    asked_ms: float, flown_ms: float, remedy: str
) -> None:
    assert remedy in ekf2_ev_delay_wrong.delay_remedy(analysis(), asked_ms, flown_ms)
