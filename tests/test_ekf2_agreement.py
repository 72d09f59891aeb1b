"""Agreement of a replay with the log: compared quantities and limits.

The limits are repeated here, so that a change in the code needs a change in the test.
"""

import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from findings_tools import NONE, made

from px4fuse.ekf2.replay import (
    CONSTANT_INNOVATIONS_REASON,
    AxisAgreement,
    Ekf2Replay,
    ReplayAgreement,
    _compare_axis,
    _compare_other_aids,
    _compute_heading_difference_deg,
    _judge_agreement,
    compare_with_log,
    is_inside_spans,
    judge_agreement_with_logged_rejections,
    logged_innovations,
    match_updates,
    subtract_states,
)
from px4fuse.flight.model import AidLog, Columns, Ekf2, FusionRecord, Unavailable

AID = ("estimator_aid_src_ev_pos",)


def replayed(fused_at: list[float], taken: list[float] | None = None) -> pd.DataFrame:
    index = pd.Index(fused_at if taken is None else taken)
    return pd.DataFrame({"fused_at_s": fused_at}, index=index)


def test_ekf2_replay_updates_are_matched_by_measurement_time():
    """An older topic has no measurement time, and repeats the last fusion for 0.5 s."""
    times = np.array([0.9, 0.9941, 1.0, 1.1059, 1.1061, 1.2, 1.3])
    found = match_updates(
        replayed([9.0, 9.0, 9.0], [1.0, 1.1, 1.2]), times, has_logged_measurement_times=True
    )
    assert found.tolist() == [-1, 0, 0, 1, -1, 2, -1]
    times = np.array([0.9998, 0.99995, 1.0, 1.5, 1.5001, 2.0, 2.4])
    found = match_updates(
        replayed([1.0, 2.0], [0.8, 1.8]), times, has_logged_measurement_times=False
    )
    assert found.tolist() == [-1, 0, 0, 0, -1, 1, 1]
    # a row within 2 ms of a fusion may still contain the previous innovation
    times = np.array([1.001, 1.003, 1.2, 2.0019, 2.0021])
    found = match_updates(
        replayed([1.0, 2.0], [0.8, 1.8]), times, has_logged_measurement_times=False
    )
    assert found.tolist() == [-1, 0, 0, -1, 1]


def test_ekf2_replay_evaluation_excludes_first_5_s_of_segments():
    replay = made(
        Ekf2Replay, stretches_s=((10.0, 30.0), (40.0, 60.0)), optical_flow_only_spans_s=()
    )
    evaluated_spans = replay.find_evaluated_spans()
    assert evaluated_spans == ((15.0, 30.0), (45.0, 60.0))
    # times with flow as the only aiding source, and the seconds after them, are excluded
    carried = made(Ekf2Replay, stretches_s=replay.stretches_s,
                   optical_flow_only_spans_s=((20.0, 23.0), (52.0, 58.0)))  # fmt: skip
    assert carried.find_evaluated_spans() == ((15.0, 20.0), (28.0, 30.0), (45.0, 52.0))
    times = np.array([15.0, 15.1, 29.9, 30.0, 45.0, 50.0, 60.0])
    assert is_inside_spans(times, evaluated_spans).tolist() == [
        False,
        True,
        True,
        False,
        False,
        True,
        False,
    ]


def agreeing(
    correlation: float = 1.0, s: float = 1.0, nis: float = 1.0, published_m: float = 0.0
) -> AxisAgreement:
    return AxisAgreement(
        innovation_correlation=correlation, innovation_rms_difference=0.0, s_ratio_median=s,
        s_ratio_p5=s, s_ratio_p95=s, nis_mean_logged=1.0, nis_mean_replayed=nis,
        position_rms_difference_m=published_m, velocity_rms_difference_m_s=0.0,
    )  # fmt: skip


@pytest.mark.parametrize(("axis", "logged", "replayed_share", "good", "expected"), [
    (agreeing(s=1.049), 0.0, 0.0, True, "have a correlation of 1.0000"),
    (agreeing(s=1.051), 0.0, 0.0, False, "is 1.05 times"),
    (agreeing(s=0.949), 0.0, 0.0, False, "is 0.95 times"),
    (agreeing(0.95), 0.0, 0.0, True, "a correlation of 0.9500"),
    (agreeing(published_m=0.09), 0.0, 0.0, True, "have a correlation of 1.0000"),
    (agreeing(published_m=0.11), 0.0, 0.0, False, "logged positions differ by 0.11 m"),
    # enough digits to show the excess
    (agreeing(published_m=0.1028), 0.0, 0.0, False, "differ by 0.103 m RMS (limit 0.1"),
    (agreeing(published_m=0.10004), 0.0, 0.0, False, "differ by 0.10004 m"),
    (agreeing(0.949), 0.0, 0.04, False, "a correlation of 0.9490, below"),
    # with many rejections, shares and NIS decide
    (agreeing(0.5), 0.1, 0.06, True, "rejected 6.0% of the samples, EKF2 rejected 10.0%"),
    (agreeing(0.5), 0.06, 0.1, True, "innovations are not compared one by one"),
    (agreeing(0.5), 0.25, 0.19, False, "limits "),
    (agreeing(0.5), 0.125, 0.1875, False, "limits "),
    (agreeing(0.5, nis=1.25), 0.1, 0.1, True, "mean NIS differs by 25%"),
    (agreeing(0.5, nis=1.26), 0.1, 0.1, False, "mean NIS differs by 26%"),
    (agreeing(0.5, nis=0.74), 0.1, 0.1, False, "mean NIS differs by 26%"),
])  # fmt: skip
def test_ekf2_replay_agrees_with_log_if_differences_are_small(
    axis, logged, replayed_share, good, expected
):
    for axes in ({"north": axis, "east": agreeing()}, {"north": agreeing(), "east": axis}):
        found, reason = _judge_agreement(axes, logged, replayed_share)
        assert found is good
        assert expected in reason


@pytest.mark.parametrize(("axis", "good"), [
    (agreeing(0.949), False), (agreeing(s=1.051), False), (agreeing(published_m=0.29), True),
    (agreeing(published_m=0.31), False),
])  # fmt: skip
def test_replay_with_logged_rejections_decides_agreement_verdict(axis, good):
    """The replay with logged rejections overrides the other verdict, good or bad."""
    own_gate = ReplayAgreement(
        north=agreeing(0.5), east=agreeing(0.5), ev_pos={}, samples=50,
        rejected_fraction_logged=0.2, rejected_fraction_replayed=0.2,
        decisions_same=0.9, published_rms_difference_m=0.0, good=not good, reason="so far",
    )  # fmt: skip
    logged_gate = replace(own_gate, north=agreeing(), east=axis, decisions_same=1.0,
                       rejected_fraction_replayed=0.3)  # fmt: skip
    found = judge_agreement_with_logged_rejections(own_gate, logged_gate)
    assert found.good is good
    assert found.reason.startswith("if the EKF2 replay rejects the same samples as in the log, ")
    assert (found.decisions_same, found.rejected_fraction_replayed) == (0.9, 0.2)
    assert found.axes == logged_gate.axes
    # above half of the positions the published position is not tested, but the correlation is
    mostly = replace(own_gate, rejected_fraction_logged=0.51)
    assert judge_agreement_with_logged_rejections(
        mostly, replace(logged_gate, east=agreeing(published_m=9.0))
    ).good
    refused = judge_agreement_with_logged_rejections(
        mostly, replace(logged_gate, east=agreeing(0.98))
    )
    assert not refused.good
    assert "0.9800" in refused.reason
    assert "rejected 51% of the positions and relied on the IMU" in refused.reason


def test_differences_of_ekf2_replay_from_log_equal_closed_form():
    s_log = np.full(101, 4.0)
    s = np.linspace(4.0, 8.0, 101)
    nu_log = np.tile([2.0, -2.0], 51)[:101]
    frame = {"innovation_east_m": nu_log, "innovation_variance_east_m2": s_log}
    model = pd.DataFrame({"innovation_east_m": nu_log + 0.5, "innovation_variance_east_m2": s})
    still = pd.DataFrame(0.0, index=pd.Index([16.0, 17.0]), columns=Columns.STATE)
    off = still.assign(**{Columns.STATE[1]: [3.0, 4.0], Columns.STATE[4]: 0.25})
    difference = subtract_states(off, still)
    found = _compare_axis("east", pd.DataFrame(frame), model, difference)
    assert found.innovation_correlation == pytest.approx(1.0)
    assert found.innovation_rms_difference == pytest.approx(0.5)
    ratios = found.s_ratio_p5, found.s_ratio_median, found.s_ratio_p95
    assert ratios == pytest.approx((1.05, 1.5, 1.95))
    assert found.nis_mean_logged == pytest.approx(1.0)
    assert found.nis_mean_replayed == pytest.approx(np.mean((nu_log + 0.5) ** 2 / s))
    assert found.position_rms_difference_m == pytest.approx(math.sqrt(12.5))
    assert found.velocity_rms_difference_m_s == pytest.approx(0.25)


def test_correlation_of_constant_innovations_is_unavailable():
    """np.corrcoef of a constant is NaN, with a warning."""
    index = pd.Index(10.0 + np.arange(30.0))
    columns = ["innovation_north_m", "innovation_east_m", "innovation_variance_north_m2",
               "innovation_variance_east_m2", "rejected"]  # fmt: skip
    updates = pd.DataFrame(0.1, index=index, columns=columns).assign(fused_at_s=index)
    axes = ("north", "east")
    columns = [f"{of}_{axis}" for of in ("innovation", "variance") for axis in axes]
    samples = pd.DataFrame(0.1, index=index, columns=columns)
    log = made(AidLog, samples=samples, axes=axes, topics=("estimator_aid_src_gnss_vel",),
               parameters={})  # fmt: skip
    ekf2 = made(Ekf2, aids={"gnss_vel": log})
    replay = SimpleNamespace(
        find_evaluated_spans=lambda: ((0.0, 99.0),), other_aid_updates={"gnss_vel": updates}
    )
    found = _compare_other_aids(ekf2, replay, pd.DataFrame())
    assert found == ({}, {"gnss_vel": CONSTANT_INNOVATIONS_REASON})


def test_ekf2_replay_heading_error_without_logged_state_is_none():
    delayed_state = pd.DataFrame(index=pd.Index([1.0]))
    ekf2 = made(Ekf2, record=made(FusionRecord, delayed_state=delayed_state))
    replay = SimpleNamespace(
        settings={"EKF2_MAG_NOISE": 0.05}, find_evaluated_spans=lambda: ((5.0, 9.0),)
    )
    assert _compute_heading_difference_deg(ekf2, replay) is None


def compared(
    count: int, *, varying: bool = True, states: int | None = None
) -> ReplayAgreement | Unavailable:
    """Return the agreement of a log and its own replay with this many evaluated samples.

    ``states``: number of logged states, from the start; None for one per innovation.
    """
    time = 10.0 + np.arange(count + 5.0)
    rng = np.random.default_rng(2)
    nu = rng.normal(0.0, 0.1, len(time)) if varying else np.full(len(time), 0.1)
    frame = pd.DataFrame(
        {"innovation_m": nu, "innovation_variance_m2": 0.01, "rejected": 0.0}, index=time
    )
    frame.loc[frame.index[-2:], "rejected"] = 1.0
    state = pd.DataFrame(0.0, index=time, columns=Columns.STATE)
    innovations = {"north": frame, "east": frame}
    ekf2 = made(
        Ekf2,
        aids={},
        status_flags={},
        innovations=innovations,
        innovation_topics=AID,
        state=state[:states],
    )
    updates = pd.DataFrame({"rejected": 0.0, "fused_at_s": time}, index=time)
    for axis in ("north", "east"):
        updates[f"innovation_{axis}_m"] = nu
        updates[f"innovation_variance_{axis}_m2"] = 0.01
    updates.loc[updates.index[-1], "rejected"] = 1.0
    replay = SimpleNamespace(
        updates=updates,
        published_state=state,
        find_evaluated_spans=lambda: ((14.5, 999.0),),
        settings={},
        other_aid_updates={},
        optical_flow_only_spans_s=(),
    )
    return compare_with_log(SimpleNamespace(ekf2=ekf2), replay)  # type: ignore[arg-type]


def test_ekf2_replay_agreement_with_log_needs_20_innovations():
    found = compared(20)
    assert found.samples == 20
    assert found.good
    shares = found.rejected_fraction_logged, found.rejected_fraction_replayed, found.decisions_same
    assert shares == pytest.approx((0.1, 0.05, 0.95))
    assert isinstance(few := compared(19), Unavailable)
    assert "only 19 innovations in the replayed time (at least 20" in few.reason
    assert isinstance(same := compared(20, varying=False), Unavailable)
    assert "are constant" in same.reason


def test_replay_agreement_without_logged_state_is_unavailable():
    assert isinstance(unknown := compared(20, states=1), Unavailable)
    assert unknown.reason == "EKF2's position is not logged in the replayed time"


def test_ekf2_innovations_logged_on_only_one_axis_are_dropped():
    frame = pd.DataFrame({"innovation_m": [0.1], "innovation_variance_m2": 0.1, "rejected": 0.0})
    for other in (NONE, frame.assign(rejected=np.nan)):
        ekf2 = made(
            Ekf2,
            status_flags={},
            innovations={"north": frame, "east": other},
            innovation_topics=AID,
        )
        assert logged_innovations(ekf2).empty
