"""Each finding about the position source and the IMU at the edges of its thresholds.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

from functools import partial
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

from px4fuse.comparison import remedy as remedies
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.whatif import WhatIf
from px4fuse.filter.causes import Explained
from px4fuse.filter.coloured import Coloured
from px4fuse.filter.hypotheses import Estimate
from px4fuse.filter.settings import Settings
from px4fuse.filter.smoothing import Smoothing
from px4fuse.filter.tuning import Noise
from px4fuse.findings import (
    imu,
    source_clock,
    source_intervals,
    source_noise,
    source_positions,
    source_stamps,
)
from px4fuse.flight import SPECIFIC_FORCE_COLUMNS
from px4fuse.origin import ALIGNED, KEPT, MOTION_CAPTURE

MOVING = positions(np.arange(0.0, 120.0), np.arange(120.0))
ODOMETRY = {"source": source(orientation=object(), samples=MOVING)}
MADE_OF_EKF2 = {"source": source(origin=KEPT, samples=MOVING)}


def bias_of_ekf2(*bias: float) -> dict[str, Any]:
    """EKF2's bias in the segment, and another one outside it."""
    rows = [[9.0] * 3, bias, bias, bias, [9.0] * 3]
    index = [9.0, 10.0, 50.0, 110.0, 111.0]
    return {"accelerometer_bias": pd.DataFrame(rows, index=index, columns=SPECIFIC_FORCE_COLUMNS)}


def clock_map(method: str = "TIMESYNC", distinct: int | None = None, jitter_s: float = 0.02) -> Any:
    return SimpleNamespace(method=method, distinct_stamps=distinct, jitter_s=jitter_s, pairs=600)


def at_multiples(multiples: list[int], base_s: float = 0.125, **parts: Any) -> Any:
    time = 10.0 + np.concatenate([[0.0], base_s * np.cumsum(multiples)])
    return analysis(source=source(samples=positions(time), **parts))


def low_pass(gain: float, lag_s: float, **parts: Any) -> Any:
    usual = {"smoothing": Smoothing(0.5, lag_s, gain, 0.1), "clock": late(0.0)}
    return analysis(**{**usual, **parts})


def slow(gain: float, lag: float, slow_m: float = 0.1) -> Coloured:
    return Coloured(tau_s=1.0, slow_m=slow_m, white_m=0.1, gain_nats=gain, lag_nats=lag)


def repeating(again: int, count: int, moved_m: float = 5.0) -> Any:
    """So many of the positions are the one before."""
    each = np.arange(count + 1.0)
    each[-again:] = each[-again - 1]
    return analysis(
        source=source(samples=positions(np.linspace(10.0, 110.0, count + 1),
                                        moved_m * each / each.max()))
    )  # fmt: skip


def steps(*sizes: Any, **parts: Any) -> Any:
    return analysis(explained=made(Explained, jumps=sizes), **parts)


def scaled(value: float, sigma: float = 0.01, imu_hz: float = 49.1, **parts: Any) -> Any:
    found = made(Explained, scale=Estimate(value, sigma), jumps=())
    usual = {"explained": found, "flight": {"imu": at_rate(imu_hz)}, "clock": late(0.0)}
    return analysis(**{**usual, **parts})


def outlying(outliers: int, count: int) -> Any:
    return analysis(tuning=tuned(outlier_time_s=np.arange(outliers) + 20.0, count=count))


def stating(reported: float, noise: float, interval: Any = None, **parts: Any) -> Any:
    """A source that reports a standard deviation, and has this one."""
    low, high = interval or (0.99 * noise, 1.01 * noise)
    states = source(samples=positions(np.arange(0.0, 120.0), variance_m2=reported**2))
    usual = {"smoothing": Smoothing(0.0, 0.0, 0.0, noise), "source": states,
             "tuning": tuned(Noise(noise, low, high), count=100)}  # fmt: skip
    return analysis(**{**usual, **parts})


def delayed(delay_ms: float | None, clock: Any, **parts: Any) -> Any:
    flown = {} if delay_ms is None else {"EKF2_EV_DELAY": delay_ms}
    return analysis(log=log(parameters=flown), clock=clock, **parts)


@pytest.fixture(autouse=True)
def no_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remedies, "filter_errors_m", lambda *_: None)


BIAS, JUMPS, SCALE = imu.bias, source_positions.jumps, source_positions.scale
ARRIVALS, THINNED, CLOCK = source_stamps.arrivals, source_intervals.thinning, source_clock.detect


def wrong_delay(one: Any) -> Any:
    return source_clock.delay(one, one.clock)


STATED = source_positions.stated_variance
EDGES = [
    *((BIAS, analysis(explained=with_bias(sign * bias, sigma)), expected)
      for sign in (1.0, -1.0)
      for bias, sigma, expected in (
          (0.2, 0.01, "warning"), (0.199, 0.01, None), (0.3, 0.01, "error"),
          (0.299, 0.01, "warning"), (0.25, 0.0625, "warning"), (0.25, 0.0626, None))),
    # EKF2's bias where there is none of ours; horizontally our estimate is the better one
    *((BIAS, analysis(explained=ours, ekf2=bias_of_ekf2(*bias)), expected)
      for bias, ours, expected in (
          ((0.2, 0.0, 0.0), NONE, "warning"), ((0.199, 0.0, 0.0), NONE, None),
          ((0.0, 0.0, 0.2), with_bias(0.0), "warning"), ((0.5, 0.5, 0.1), with_bias(0.0), None))),
    *((ARRIVALS, analysis(ekf2=ekf2), expected) for ekf2, expected in (
        (ages(20, 0), "warning"), (ages(19, 0), None),  # 20 samples at least
        (ages(20, 0, wrong=1), "warning"), (ages(20, 0, wrong=2), None),  # 95 %
        (ages(10, 20), "warning"), (ages(9, 20), None), (ages(20, 10), "warning"),
        (ages(20, 9), None),  # 10 on either side
        (ages(20, 20, wrong=1), "warning"), (ages(20, 20, wrong=2), None),
        (ages(20, 20, 0.02), "warning"), (ages(20, 20, 0.0199), None),
        (ages(20, 20, 0.1), "error"), (ages(20, 20, 0.0999), "warning"),
        (ages(0, 30, 0.00099), "warning"), (ages(0, 30, 0.001), None))),
    (ARRIVALS, analysis(ekf2=ages(20, 20), **MADE_OF_EKF2), None),
    *((THINNED, at_multiples(multiples), expected) for multiples, expected in (
        ([1, 1, 2] * 20, "warning"), ([1, 1, 2] * 19 + [1, 1, 1], None),  # a quarter is missing
        ([1, 2] * 25, "warning"), ([1, 2] * 24 + [1], None),  # 50 intervals at least
        ([2, 3] * 30, "error"),  # 0.31 s apart: EKF2 does not start
        ([2] * 54 + [3] * 6, "error"), ([2] * 55 + [3] * 5, None),  # a tenth is of each
        ([1] * 50 + [2] * 35 + [4] * 15, "error"), ([1] * 50 + [2] * 34 + [4] * 16, None))),
    # the intervals of what others made tell nothing
    (THINNED, at_multiples([1, 2] * 30, clock_map=clock_map()), None),
    (THINNED, at_multiples([1, 2] * 30, origin=ALIGNED), None),
    (THINNED, at_multiples([1, 2] * 30, origin=MOTION_CAPTURE), "warning"),
    # single losses, two of them in one interval
    *((source_intervals.losses, at_multiples([1] * singles + [3], 0.25, **parts), expected)
      for singles, parts, expected in (
          (96, {"clock_map": clock_map()}, "info"), (97, {"clock_map": clock_map()}, None),
          (47, {"clock_map": None}, None), (47, {"clock_map": clock_map("arrival time")}, None),
          (47, {"clock_map": clock_map(distinct=2)}, None))),
    *((source_positions.smoothing, low_pass(gain, lag_s), expected) for gain, lag_s, expected in (
        (12.0, 0.05, "warning"), (11.9, 0.05, None), (12.0, 0.049, None),
        (12.0, 0.0999, "warning"), (12.0, 0.1, "error"))),
    # errors that hang together without a lag are slow, not smoothed
    *((source_positions.smoothing, low_pass(99.0, 1.0, coloured=slow(99.0, lag)), expected)
      for lag, expected in ((3.9, None), (4.0, "error"))),
    *((source_noise.slow, analysis(coloured=slow(gain, lag)), expected)
      for gain, lag, expected in (
          (8.0, 3.9, "warning"), (7.9, 0.0, None), (99.0, 4.0, None))),
    *((source_noise.repeats, repeating(again, count), expected) for again, count, expected in (
        (10, 200, "warning"), (9, 100, None), (10, 201, None), (30, 100, "error"),
        (29, 100, "warning"))),
    (source_noise.repeats, repeating(50, 100, moved_m=0.5), None),
    *((source_noise.detect, analysis(coloured=slow(99.0, 0.0), **parts), None)
      for parts in (ODOMETRY, MADE_OF_EKF2)),
    (JUMPS, steps(jump(0.0, 0.9), coloured=slow(0.0, 0.0, 0.2)), None),
    (JUMPS, steps(jump(0.0, 1.0), coloured=slow(0.0, 0.0, 0.2)), "error"),
    (SCALE, scaled(0.5, coloured=slow(0.0, 0.0)), None),
    (SCALE, scaled(0.5, ekf2=ages(20, 20)), None),
    (source_positions.detect, low_pass(99.0, 1.0, **ODOMETRY), None),
    (source_positions.detect, low_pass(99.0, 1.0, **MADE_OF_EKF2), None),
    *((JUMPS, steps(jump(0.0, size), jump(0.1, 0.0)), expected) for size, expected in (
        (0.199, None), (0.2, "warning"), (0.499, "warning"), (0.5, "error"))),
    # a moving vehicle's positions jump where the stamps do
    (JUMPS, steps(jump(0.0, 1.0), ekf2=ages(20, 20)), None),
    *((SCALE, scaled(sign * scale, sigma), expected)
      for sign in (1.0, -1.0)
      for scale, sigma, expected in (
          (0.12, 0.01, "warning"), (0.119, 0.01, None), (0.15, 0.01, "error"),
          (0.149, 0.01, "warning"), (0.1875, 0.0625, "error"), (0.187, 0.0625, None))),
    (SCALE, scaled(0.5, imu_hz=48.9), None),
    # stamps that could not be judged may be late
    *((which, of(clock=clock), expected)
      for which, of in ((SCALE, partial(scaled, 0.5)),
                        (source_positions.smoothing, partial(low_pass, 99.0, 1.0)))
      for clock, expected in ((NONE, None), (late(0.0, determinable=False), "error"))),
    (SCALE, scaled(0.5, smoothing=Smoothing(0.5, 1.0, 99.0, 0.1)), None),
    *((source_positions.detect, scaled(0.5, **parts), None) for parts in (ODOMETRY, MADE_OF_EKF2)),
    *((source_positions.outliers, outlying(outliers, count), expected)
      for outliers, count, expected in (
          (3, 600, "warning"), (3, 601, None), (3, 150, "error"), (3, 151, "warning"),
          (2, 100, None))),
    *((STATED, stating(reported, noise), expected) for reported, noise, expected in (
        (3.0, 2.0, "warning"), (2.0, 3.0, "warning"), (1.41, 1.0, None), (1.42, 1.0, "warning"),
        (1.0, 1.41, None), (1.0, 1.42, "warning"), (1.73, 1.0, "warning"), (1.74, 1.0, "error"),
        (1.0, 1.74, "error"))),
    # inside the interval, no interval, nothing known of smoothing, nothing stated, odometry
    *((STATED, stating(3.0, 1.0, interval), None) for interval in (
        (0.1, 9.0), (None, 9.0), (0.1, None))),
    (STATED, stating(3.0, 1.0, tuning=tuned(Noise(None, None, 9.0))), None),
    (STATED, stating(3.0, 1.0, tuning={}), None), (STATED, stating(3.0, 1.0, smoothing=NONE), None),
    (STATED, stating(np.nan, 1.0), None),
    (source_positions.detect, stating(3.0, 1.0, **ODOMETRY), None),
    *((CLOCK, analysis(clock=late(sign * offset_s, sigma_s)), expected)
      for sign in (1.0, -1.0)
      for offset_s, sigma_s, expected in (
          (0.03, 0.001, None), (0.031, 0.001, "warning"), (0.1, 0.001, "warning"),
          (0.101, 0.001, "error"), (0.0625, 0.0208, "warning"), (0.0625, 0.0209, None))),
    *((CLOCK, analysis(**{"clock": late(0.2), **parts}), None) for parts in (
        {"clock": late(0.2, determinable=False)}, MADE_OF_EKF2, {"ekf2": ages(20, 20)},
        {"smoothing": Smoothing(0.5, 0.2, 99.0, 0.1)})),
    *((wrong_delay, delayed(delay_ms, late(0.0, sigma_s)), expected)
      for delay_ms, sigma_s, expected in (
          (30.0, 0.001, "warning"), (29.0, 0.001, None), (40.0, 0.01, "warning"),
          (39.0, 0.01, None), (None, 0.001, None))),
    (CLOCK, delayed(90.0, late(0.0, determinable=False)), None),
    (CLOCK, delayed(90.0, late(0.0), **MADE_OF_EKF2), None),
]  # fmt: skip


@pytest.mark.parametrize(("detect", "one", "expected"), EDGES)
def test_from_where_on_it_is_a_finding(detect: Any, one: Any, expected: str | None) -> None:
    assert severity(detect, one) == expected


def test_an_accelerometer_bias_is_told_with_its_interval_and_tilt_and_what_ekf2_says() -> None:
    one = analysis(explained=with_bias(0.3, 0.05, -0.4), ekf2=bias_of_ekf2(0.1, -0.2, 0.0))
    finding = only(imu.bias, one)
    assert "+0.30 m/s² too much forward and -0.40 right (± 0.10)" in finding.message
    assert "off by 2.9° does the same" in finding.message  # 0.5 of 9.80665 m/s²
    assert "EKF2 subtracts +0.10 forward, -0.20 right." in finding.message
    assert finding.evidence == {"bias_m_s2": 0.5, "sigma_m_s2": 0.05}
    outside = bias_of_ekf2(9.0, 9.0, 9.0)["accelerometer_bias"].iloc[[0, 4]]
    assert named(imu.bias, analysis(ekf2={"accelerometer_bias": outside})) == {}


@pytest.mark.parametrize(
    ("clock", "expected"),
    [(clock_map(distinct=2, jitter_s=0.010), ["source_stamps_constant"]),
     (clock_map("receive time", 2, 0.011), ["source_stamps_constant", "source_receipt_jitter"]),
     (clock_map(jitter_s=0.5), []), (clock_map("arrival time"), ["companion_not_synchronised"])],
)  # fmt: skip
def test_what_a_recordings_stamps_tell(clock: Any, expected: list[str]) -> None:
    assert list(named(source_stamps.detect, analysis(source=source(clock_map=clock)))) == expected


def test_stamps_are_told_with_what_stands_in_for_them() -> None:
    of = source(clock_map=clock_map(distinct=1, jitter_s=0.0126))
    constant, jitter = source_stamps.detect(analysis(source=of))
    assert "only 1 value:" in constant.message
    assert "jitters by 13 ms: at 1 m/s that is an error of 0.013 m" in jitter.message
    for method, said in (
        ("arrival time", "so that its track is late"), ("receive time", "the sender's own stamps"),
    ):  # fmt: skip
        one = analysis(source=source(clock_map=clock_map(method)))
        assert said in only(source_stamps.detect, one).message


def test_stamps_of_arrival_end_at_the_first_true_one() -> None:
    one = analysis(ekf2=ages(12, 20, 0.05))
    finding = only(source_stamps.arrivals, one)
    assert finding.evidence == {"until_s": 32.0, "latency_s": 0.05}
    assert finding.spans_s == ((20.0, 32.0),)
    assert source_stamps.until_synchronised(one) == (32.0, 0.05)
    assert source_stamps.until_synchronised(analysis(ekf2=ages(30, 0))) is None


def test_thinned_positions_are_told_with_both_rates() -> None:
    finding = only(source_intervals.thinning, at_multiples([1, 2] * 30))
    told = {"rate_hz": 1.0 / 0.1875, "source_rate_hz": 8.0, "lost_share": 1.0 / 3.0}
    assert finding.evidence == pytest.approx(told)
    assert "at 5.3 Hz, at whole multiples of 0.125 s: of a source of 8 Hz 33%" in finding.message
    slow = only(source_intervals.thinning, at_multiples([2, 3] * 30))
    assert "starts only below 0.2 s apart" in slow.message
    assert "starts only" not in finding.message


def test_the_interval_that_all_are_multiples_of_is_sought_within_its_jitter() -> None:
    def base(intervals: Any) -> float | None:
        found = source_intervals._base(np.array(intervals))
        return None if found is None else found[0]

    assert base([1.0, 1.0, 2.0]) == 1.0
    # a quarter of the usual interval is looked at, a fifth is not
    assert base([1.0] * 5 + [1.25] * 2) is not None
    assert base([1.0] * 5 + [1.2] * 2) is None
    for off, there in ((0.058, True), (0.062, False)):
        # of multiples of a second, by so much off at random, root mean square
        found = base(np.sort(1.0 + off * np.tile([1.0, -1.0], 15)))
        assert (found == pytest.approx(1.0)) if there else found is None


def test_a_gap_is_not_counted_as_single_lost_samples() -> None:
    for longest, lost in ((5.0, [4]), (5.1, [])):  # of 0.25 s each
        one = at_multiples([1.0] * 20 + [longest], 0.25, clock_map=clock_map())  # type: ignore[list-item]
        found = list(source_intervals.losses(one))
        assert [finding.evidence["lost"] for finding in found] == lost
        assert all("(4 samples of 25 at one per 0.25 s)" in each.message for each in found)


def test_the_largest_of_several_jumps_is_told() -> None:
    sizes = (jump(0.3, 0.0, at_s=30.0), jump(0.6, 0.8, at_s=60.0), jump(0.1, 0.0, at_s=90.0))
    finding = only(source_positions.jumps, steps(*sizes))
    assert finding.evidence == {"count": 2, "size_m": 1.0, "at_s": 60.0, "sigma_m": 0.02}
    assert "jumps 2 times and stays there, by 1.00 m (± 0.04) at 60.0 s" in finding.message
    assert finding.spans_s == ((30.0, 30.0), (60.0, 60.0))


def test_a_scale_and_a_variance_are_told_with_their_side() -> None:
    for signed, word in ((0.2, "long"), (-0.2, "short")):
        finding = only(source_positions.scale, scaled(signed))
        assert f"20% too {word} (± 2%)" in finding.message
        assert finding.evidence["scale"] == 1.0 + signed
    for reported, word in ((2.0, "large"), (0.5, "small")):
        finding = only(source_positions.stated_variance, stating(reported, 1.0))
        assert f"4 times too {word}." in finding.message
        assert finding.evidence["variance_factor"] == pytest.approx(reported**2)
        assert finding.evidence["reported_sigma_m"] == pytest.approx(reported)


@pytest.mark.parametrize(
    ("jumps", "count", "says"),
    [((), 5, " s and more)"), ((jump(1.0, 0.0, at_s=20.0),), 3, "at 19.9, 26.0, 27.0 s)")],
)
def test_what_follows_a_jump_for_six_seconds_is_no_outlier(
    jumps: Any, count: int, says: str
) -> None:
    outliers = tuned(outlier_time_s=np.array([19.9, 20.0, 25.9, 26.0, 27.0]), count=100)
    finding = only(source_positions.outliers, steps(*jumps, tuning=outliers))
    assert (finding.evidence["count"], finding.evidence["first_s"]) == (count, 19.9)
    assert says in finding.message


# ---------------------------------------------------------------- clock and delay

APPLIED = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0, clock_offset_s=-0.05)


def test_a_clock_offset_is_told_with_what_was_applied() -> None:
    one = analysis(clock=late(-0.1, applied_s=-0.05), settings=APPLIED)
    finding = only(source_clock.detect, one)
    assert "late by 0.100 s against the IMU (95 % 0.080 to 0.110 s)" in finding.message
    assert "an error of 0.10 m" in finding.message
    assert "--clock-offset -0.150." in finding.remedy
    told = {"offset_s": -0.15, "interval_low_s": -0.16, "interval_high_s": -0.13}
    assert finding.evidence == pytest.approx(told)
    early = only(source_clock.detect, analysis(clock=late(0.1)))
    assert "early by 0.100 s against the IMU (95 % 0.090 to 0.120 s)" in early.message
    placed = source(alignment=SimpleNamespace(clock_offset_s=2.0))
    finding = only(source_clock.detect, analysis(clock=late(0.1), source=placed))
    assert "--clock-offset 2.100." in finding.remedy


@pytest.mark.parametrize(("p", "there"), [(0.005, False), (0.0049, True), (None, False)])
def test_a_clock_offset_that_changes(p: float | None, there: bool) -> None:
    found = only(source_clock.detect, analysis(clock=late(0.1, change_p=p)))
    assert found.id == ("source_clock_changes" if there else "source_clock_offset")
    if there:
        assert "-0.10 s at the beginning, +0.30 s at the end" in found.message
        assert found.evidence["change_p"] == p


@pytest.mark.parametrize(("after_m", "there"), [(1.005, True), (1.0051, False), (0.5, True)])
def test_a_clock_offset_that_the_truth_contradicts_is_not_told(
    monkeypatch: pytest.MonkeyPatch, after_m: float, there: bool
) -> None:
    def errors_m(_: Any, shifted: Settings) -> tuple[float, float]:
        assert shifted.clock_offset_s == 0.123  # as it is typed
        return 1.0, after_m

    monkeypatch.setattr(remedies, "filter_errors_m", errors_m)
    found = list(source_clock.detect(analysis(clock=late(0.12345))))
    said = f"position error 1.000 → {after_m:.3f} m (replayed)"
    assert [said in each.remedy for each in found] == [True] * there


def test_what_a_clock_offset_asks_of_ekf2(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay is what the stamps are late by, with what was applied: 150 ms."""
    found = made(WhatIf, replayed=1.0, whatif=(2.0,))
    monkeypatch.setattr(
        remedies, "delay_change", lambda _, late_ms: {"EKF2_EV_DELAY": round(late_ms)}
    )
    monkeypatch.setattr(source_clock, "what_if", lambda *_: found)
    monkeypatch.setattr(remedies, "effect_words", lambda *both: f"it helps {both}")
    for fed, helps, there in (("uwb", True, True), ("another", True, False), ("uwb", False, False)):
        monkeypatch.setattr(
            remedies, "delay_helps", lambda *both, h=helps: both == (1.0, 2.0) and h
        )
        model = made(Model, inputs=SimpleNamespace(received=SimpleNamespace(source=fed)))
        clock = late(-0.1, applied_s=-0.05)
        one = analysis(clock=clock, settings=APPLIED, ekf2_model=model)
        remedy = only(source_clock.detect, one).remedy
        assert ("; for EKF2 set EKF2_EV_DELAY to 150 ms: it helps (1.0, 2.0)." in remedy) is there
        assert ("EKF2" in remedy) is there


@pytest.mark.parametrize(
    ("clock", "delay_ms", "says", "remedy"),
    [
        # with what was applied
        (late(-0.1, applied_s=-0.02), 0.0, "the data ask for 120 ms (95 % 100 to 130):",
         "Set EKF2_EV_DELAY to 120 ms. Not replayed: no topic for it."),
        (late(0.0, interval_s=(-0.01, 0.01)), 50.0, "ask for 0 ms (95 % -10 to 10)",
         "Set EKF2_EV_DELAY to 0 ms. Not replayed: no topic for it."),
        (late(-0.02, interval_s=(-0.04, 0.0)), 100.0, "ask for 20 ms", "EKF2_EV_DELAY to 0 ms"),
        (late(0.05, interval_s=(0.04, 0.07)), 0.0, "early by 50 ms (95 % 40 to 70), for which",
         "stamps that are early"),
        (late(-0.301, interval_s=(-0.4, -0.2)), 0.0, "ask for 301 ms", "PX4 allows 300 ms"),
        (late(-0.3, interval_s=(-0.4, -0.2)), 0.0, "ask for 300 ms", "EKF2_EV_DELAY to 300 ms"),
    ],
)  # fmt: skip
def test_a_delay_stays_in_px4s_range(clock: Any, delay_ms: float, says: str, remedy: str) -> None:
    finding = only(wrong_delay, delayed(delay_ms, clock))
    assert says in finding.message
    assert remedy in finding.remedy
    assert finding.evidence["asked_ms"] == pytest.approx(-1e3 * clock.offset_s)


@pytest.mark.parametrize(
    ("asked_ms", "flown_ms", "remedy"),
    [(0.4, 0.0, "no parameter"), (0.4, 9.0, "to 0 ms"), (0.6, 0.0, "to 1 ms")],
)
def test_a_delay_is_set_in_whole_milliseconds(
    asked_ms: float, flown_ms: float, remedy: str
) -> None:
    assert remedy in source_clock.delay_remedy(analysis(), asked_ms, flown_ms)
