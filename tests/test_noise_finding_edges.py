"""Detectors of noises and loops at the limits of their thresholds, and the summary of a flight.

The limits are repeated here, so a change of a threshold fails a test.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from findings_tools import (
    CHOSEN,
    DRIFTING,
    NONE,
    against_truth,
    analysis,
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
    tuned,
)

from px4fuse.comparison.model import Difference
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.consistency import classify_mean_nis
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HeldOutCheck, Noise
from px4fuse.findings import Finding, cause_text, hidden_errors, loops, noises
from px4fuse.findings.cause_grouping import group_by_cause
from px4fuse.findings.noises import _has_default_noises
from px4fuse.findings.summary import summarise
from px4fuse.loop.model import Closure, Loop

MOVING = source(samples=positions(np.arange(0.0, 120.0), np.arange(120.0)))
HOVERING = source(samples=positions(np.arange(0.0, 120.0)))
ODOMETRY = source(samples=MOVING.samples, origin=DRIFTING)
RIGHT = Noise(1.0, 0.9, 1.1)


@pytest.fixture(autouse=True)
def no_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the KF remedy by a text of its options and the settings of its re-run."""
    format_kf_remedy, rerun_settings = noises.remedy.format_kf_remedy, list[Settings]()

    def options_only(
        of: Any, changes: Any, more: str = "", held_out_nats: float | None = None
    ) -> str:
        text = format_kf_remedy(of, changes, more)
        typed = text.removeprefix("px4fuse compare LOG ").removesuffix(".")
        changed = rerun_settings[-1]
        return f"[{typed}|{changed.sigma_z_m:g}|{changed.sigma_a_m_s2:g}|{held_out_nats}]."

    monkeypatch.setattr(noises.remedy, "format_kf_remedy", options_only)
    monkeypatch.setattr(noises.remedy, "filter_errors_m", lambda _, new: rerun_settings.append(new))


# ---------------------------------------------------------------- SIGMA_Z and SIGMA_A


@pytest.mark.parametrize(
    ("chosen", "estimate", "expected"),
    [
        (1.5, Noise(1.0, 0.99, 1.01), ("warning", 1.5)), (1.49, Noise(1.0, 0.99, 1.01), None),
        (3.99, RIGHT, ("warning", 3.99)), (4.0, RIGHT, ("error", 4.0)),
        (0.25, RIGHT, ("error", 4.0)), (0.251, RIGHT, ("warning", 1.0 / 0.251)),
        # beyond the 95 % interval, widened 1.5 times on a log scale
        (8.0, Noise(1.0, 0.25, 4.0), None), (8.1, Noise(1.0, 0.25, 4.0), ("error", 8.1)),
        (0.125, Noise(1.0, 0.25, 4.0), None), (0.124, Noise(1.0, 0.25, 4.0), ("error", 8.1)),
        # bounded from above, or not at all
        (0.75, Noise(None, None, 0.5), ("warning", 1.5)), (0.4, Noise(None, None, 0.5), None),
        (0.1, Noise(None, None, 0.5), None), (9.0, Noise(None, None, None), None),
        (0.1, Noise(1.0, None, 2.0), None), (9.0, Noise(1.0, 0.5, None), None),
        # a default setting is one level less severe
        (0.1, Noise(0.033, 0.032, 0.034), ("note", 3.03)),
        (0.101, Noise(0.033, 0.032, 0.034), ("warning", 3.06)),
    ],
)  # fmt: skip
def test_setting_deviation_severity_at_limits(
    chosen: float, estimate: Noise, expected: Any
) -> None:
    off = noises.setting_deviation("sigma_z_m", chosen, estimate)
    if off is None or expected is None:
        assert off is expected
        return
    assert (off.severity, off.size) == (expected[0], pytest.approx(expected[1], rel=0.01))


def test_deviating_settings_lists_larger_deviation_first() -> None:
    held = made(HeldOutCheck, log_likelihood_gain_per_measurement=0.25)
    fitted = tuned(Noise(0.5, 0.45, 0.55), Noise(0.1, 0.09, 0.11), held_out=held)
    worse, other = noises.detect_wrong_settings(analysis(source=MOVING, tuning=fitted))
    assert (worse.id, worse.caused_by) == ("sigma_a_too_large", None)
    assert (other.id, other.caused_by) == ("sigma_z_too_large", "sigma_a_too_large")
    assert worse.severity == "error"
    assert worse.remedy == other.remedy == "[--sigma-a 0.1 --sigma-z 0.5|0.5|0.1|0.25]."
    assert worse.evidence["factor"] == pytest.approx(10.0)
    assert (
        "10 times too large. The maximum-likelihood estimate is 0.1 m/s² (horizontal; 95 %"
        in worse.message
    )
    small = tuned(Noise(2.0, 1.9, 2.1), Noise(9.0, 8.9, None), held_out=held)
    worse, _ = noises.detect_wrong_settings(analysis(source=MOVING, tuning=small))
    assert (
        "times too small. The maximum-likelihood estimate is 9 m/s² (horizontal). P"
        in worse.message
    )
    assert named(noises.detect_wrong_settings, analysis(source=MOVING)) == {}


def test_deviating_settings_bound_is_typed_as_at_least_5_mm() -> None:
    bounded = tuned(Noise(None, None, 0.0021))
    finding = only(noises.detect_wrong_settings, analysis(source=MOVING, tuning=bounded))
    assert finding.remedy == "[--sigma-z 0.005|0.005|1|None]."
    assert "is at least 480 times too large" in finding.message
    assert "estimate is at most 0.0021 m (horizontal). The" in finding.message
    known = analysis(source=MOVING, tuning=tuned(Noise(0.00211, 0.002, 0.0022)))
    assert only(noises.detect_wrong_settings, known).remedy == "[--sigma-z 0.00211|0.00211|1|None]."


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({"source": MOVING}, ["sigma_a_too_large", "sigma_z_too_small"]),
        ({"source": HOVERING}, ["sigma_z_too_small"]),  # SIGMA_A is not estimated without motion
        ({"source": ODOMETRY}, ["sigma_z_too_small"]),  # a source that may drift
        ({"source": MOVING, "axes": (hiding(),)}, ["sigma_z_too_small"]),
        ({"source": ODOMETRY, "settings": Settings(1.0, 0.1)}, []),  # drift: no finding of info
        ({"source": MOVING, "axes": (hiding(),), "settings": Settings(1.0, 0.1)},
         ["sigma_z_too_small"]),
        ({"source": MOVING, "axes": (axis(ekf2=statement(), ekf2_truth=against_truth(9.0)),)},
         ["sigma_a_too_large", "sigma_z_too_small"]),
    ],
)  # fmt: skip
def test_deviating_settings_drift_or_hidden_error_keep_noise(
    parts: dict[str, Any], expected: list[str]
) -> None:
    estimate = 3.0 * (parts.get("settings") or CHOSEN).sigma_z_m
    fitted = tuned(Noise(estimate, 0.9 * estimate, 1.1 * estimate), Noise(0.1, 0.09, 0.11))
    assert list(named(noises.detect_wrong_settings, analysis(tuning=fitted, **parts))) == expected


def following(gain: float, *, growth: float = 0.05, **parts: Any) -> Any:
    """Make a filter with this median gain in its second half, and 4 updates per second."""
    index = 10.0 + 0.25 * np.arange(40)
    updates = pd.DataFrame({"gain_position": gain, "prior_position_variance_m2": 1.0}, index=index)
    updates.iloc[:19] = [0.9, 9.0]
    updates["gain_position"] *= [1.0] * 20 + [0.5] * 9 + [1.0] * 2 + [2.0] * 9
    after = pd.Series(1.0 / (1.0 + growth), index=index)
    after.iloc[20] = 1e-9  # one measurement is an outlier
    both = pd.concat([after, pd.Series(7.0, index=index[:-1] + 0.1)]).sort_index()
    replay = SimpleNamespace(updates=updates, steps=both.to_frame("position_variance_m2"))
    slow = {"verdict": "overconfident", "lag1_autocorrelation": 0.31, **parts}
    return axis(kf=statement(4.0, **slow), replay=replay)


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (following(0.1), "error"), (following(0.101), None),  # 2.5 s
        (following(0.1, lag1_autocorrelation=0.3), "error"),
        (following(0.1, lag1_autocorrelation=0.29), None),
        (following(0.1, verdict="consistent"), None),
        (axis(kf=NONE, replay=SimpleNamespace(updates=None)), None),
    ],
)  # fmt: skip
def test_near_zero_process_noise_needs_slow_correlated_filter(
    one: Any, expected: str | None
) -> None:
    assert severity(noises.detect_process_noise_near_zero, analysis(axes=(one,))) == expected


def test_near_zero_process_noise_reports_response_time() -> None:
    slower = following(0.01)
    slower.axis.name = "east"
    finding = only(noises.detect_process_noise_near_zero, analysis(axes=(following(0.05), slower)))
    assert finding.remedy == "Increase SIGMA_A."
    assert "5.0 % between updates, and the gain falls to 0.050. KF needs 5 s" in finding.message
    assert finding.evidence["response_s"] == pytest.approx(5.0)
    for estimate, more in (
        (Noise(2.3456, 2.0, 3.0), " [--sigma-a 2.35|1|2.35|None]."), (Noise(None, None, 3.0), ""),
    ):  # fmt: skip
        one = analysis(axes=(following(0.05),), tuning=tuned(None, estimate))
        assert only(noises.detect_process_noise_near_zero, one).remedy == f"Increase SIGMA_A.{more}"


# ---------------------------------------------------------------- variances


def kf(nis: float, name: str = "north", **parts: Any) -> Any:
    verdict = "overconfident" if nis > 1.0 else "underconfident"
    return axis(name, kf=statement(nis, **{"verdict": verdict, **parts}))


def test_variances_severity_at_limits() -> None:
    for nis, expected in (
        (1.563, "warning"), (1.56, None), (3.99, "warning"), (4.0, "error"), (0.25, "error"),
        (0.251, "warning"), (0.641, None), (0.639, "warning"),
    ):  # fmt: skip
        assert (
            severity(noises.detect_inconsistent_variances, analysis(axes=(kf(nis),))) == expected
        ), nis
    assert (
        severity(
            noises.detect_inconsistent_variances, analysis(axes=(kf(9.0, verdict="consistent"),))
        )
        is None
    )


def test_variances_group_axes_with_vertical_as_consequence() -> None:
    axes = (kf(2.0), kf(3.0, "east"), kf(9.0, "down"), kf(0.1, "aisle"))
    found = tuple(noises.detect_inconsistent_variances(analysis(axes=axes)))
    assert [(one.id, one.caused_by, one.evidence["axis"]) for one in found] == [
        ("kf_underconfident", None, "aisle"), ("kf_overconfident", None, "east"),
        ("kf_overconfident", "kf_overconfident", "down"),
    ]  # fmt: skip
    assert found[1].title == "KF is overconfident along east: σ is 1.73 times too small"
    assert "The mean NIS is 3, expected 0.80 to 1.20 (horizontal axes)" in found[1].message
    assert group_by_cause(found) == found


def test_variances_underconfident_drift_or_error_keep_noise() -> None:
    for nis, is_kept, level in ((0.2, True, "note"), (5.0, False, "error")):
        finding = only(
            noises.detect_inconsistent_variances, analysis(axes=(kf(nis),), source=ODOMETRY)
        )
        assert (finding.remedy == noises.KEEP_NOISES_DRIFT) is is_kept
        assert finding.severity == level
    for owner, there in (("kf", True), ("ekf2", False)):
        worse = {owner: statement(), f"{owner}_truth": against_truth(9.0)}
        finding = only(
            noises.detect_inconsistent_variances, analysis(axes=(kf(0.2), axis("east", **worse)))
        )
        assert (finding.remedy == noises.KEEP_NOISES_TRUTH) is there
        assert finding.evidence["cause"] == "elsewhere"


def test_variances_default_settings_lower_severity() -> None:
    for chosen, level in (
        ({}, "warning"), ({"sigma_z_m": 0.11}, "error"), ({"sigma_a_m_s2": 0.51}, "error"),
    ):  # fmt: skip
        one = analysis(axes=(kf(5.0),), settings=Settings(**chosen))
        assert severity(noises.detect_inconsistent_variances, one) == level


def fused(noise_m: float, nis: float = 5.0, name: str = "north", **parts: Any) -> Any:
    """Make an axis on which EKF2 used this noise (m)."""
    frame = pd.DataFrame({"observation_variance_m2": [9.0, noise_m**2, noise_m**2, 0.0]})
    verdict = "overconfident" if nis > 1.0 else "underconfident"
    ekf2 = statement(nis, **{"verdict": verdict, **parts})
    return axis(name, ekf2=ekf2, ekf2_innovations=frame)


@pytest.mark.parametrize(
    ("flown", "used_m", "default"),
    [({}, 0.1, True), ({"EKF2_EVP_NOISE": 0.1}, 0.1, True), ({"EKF2_EVP_NOISE": 0.11}, 0.1, False),
     ({}, 0.124, True), ({}, 0.126, False), ({}, 0.081, True), ({}, 0.079, False)],
)  # fmt: skip
def test_is_default_ekf2_noise_unless_sender_reports_another(flown, used_m, default):
    assert (
        _has_default_noises(analysis(log=log(parameters=flown)), "ekf2", fused(used_m)) is default
    )


@pytest.mark.parametrize(
    ("owner", "change", "kind", "action"),
    [
        ("kf", {"sigma_z_m": 2.0}, "measurement noise", "[--sigma-z 2|2|1|None]."),
        ("kf", {"sigma_a_m_s2": 0.3}, "process noise", "[--sigma-a 0.3|1|0.3|None]."),
        (
            "kf",
            {"sigma_a_m_s2": 0.3, "sigma_z_m": 2.0},
            "measurement noise",
            "[--sigma-a 0.3 --sigma-z 2|2|0.3|None].",
        ),
        (
            "kf",
            {"outliers_left_out": 9.0},
            "outliers",
            "Remove the outliers (line of sight, anchor survey). Do not increase a noise",
        ),
        (
            "kf",
            {"outliers_left_out": 9.0, "sigma_z_m": 2.0},
            "outliers",
            "for outliers. Re-run with px4fuse compare LOG --sigma-z 2.",
        ),
        (
            "kf",
            {"clock_offset_s": -0.25},
            "clock",
            "Re-run with px4fuse compare LOG --clock-offset -0.2",
        ),
        (
            "kf",
            {"turned_deg": -20.0},
            "frame",
            "Rotate the positions by -20° before they are sent.",
        ),
        ("ekf2", {"outliers_left_out": 9.0}, "outliers", "Remove the outliers"),
        ("ekf2", {"EKF2_EV_DELAY": 90.0}, "clock", "{EKF2_EV_DELAY: 90 ms|delay_helps}"),
        ("ekf2", {"EKF2_EVP_NOISE": 0.3}, "measurement noise", "NOISE: 0.3 m|noise_helps}"),
        ("ekf2", {"EKF2_EVP_GATE": 5.0}, "gate", "{EKF2_EVP_GATE: 5 SD|rejects_less}"),
        (
            "ekf2",
            {"EKF2_ACC_NOISE": 0.35},
            "process noise",
            "{EKF2_ACC_NOISE: 0.35 m/s^2|noise_helps}",
        ),
    ],
)
def test_variances_cause_determines_action(owner, change, kind, action, monkeypatch) -> None:
    def changes_only(_: Any, changes: Any, helps: Any, *, fallback_remedy: str) -> str:
        ((name, value),) = changes.items()
        return f"{{{name}: {value:g} {PARAMETERS[name].unit}|{helps.__name__}}}"

    monkeypatch.setattr(cause_text.remedy, "format_ekf2_remedy", changes_only)
    model = SimpleNamespace(inputs=SimpleNamespace(settings=dict.fromkeys(PARAMETERS, 1.0)))
    # changes that explain less than 0.5 or more than 1.5 are not causes
    causes = (tried(owner, {"sigma_z_m": 7.0}, explained_fraction=0.4), tried(owner, change),
              tried(owner, {"sigma_z_m": 7.0}, explained_fraction=1.6))  # fmt: skip
    one = axis("north", **{owner: statement(9.0, "overconfident")})
    finding = only(
        noises.detect_inconsistent_variances, analysis(axes=(one,), causes=causes, ekf2_model=model)
    )
    assert action in finding.remedy
    assert finding.evidence["cause"] == kind


def test_variances_without_cause_report_closest_rerun() -> None:
    little = tried("kf", {"sigma_z_m": 7.0}, explained_fraction=0.4)
    causes = (little, tried("kf", {"sigma_z_m": 2.0}, "east"),
              tried("kf", {"clock_offset_s": 0.2}, explained_fraction=0.1))  # fmt: skip
    finding = only(noises.detect_inconsistent_variances, analysis(axes=(kf(9.0),), causes=causes))
    assert finding.evidence["cause"] == "elsewhere"
    assert finding.remedy == (
        f"{noises.NOT_EXPLAINED} Closest: re-run with SIGMA_Z 7 m instead of 1 m: mean NIS 9 → 3.7 "
        "(expected 1)."
    )
    assert (
        only(noises.detect_inconsistent_variances, analysis(axes=(kf(9.0),))).remedy
        == noises.UNKNOWN_NOISE
    )
    known = analysis(axes=(kf(9.0),), tuning=tuned())
    assert only(noises.detect_inconsistent_variances, known).remedy == noises.NOT_EXPLAINED


def test_variances_noise_too_small_to_estimate_is_a_bound() -> None:
    for high, typed in ((0.0001, 0.005), (0.02, 0.02)):
        one = analysis(
            axes=(kf(0.2),), tuning=tuned(Noise(None, None, high)),
            causes=(tried("kf", {"sigma_z_m": typed}, before=0.2),),
        )  # fmt: skip
        finding = only(noises.detect_inconsistent_variances, one)
        assert f"at this rate. [--sigma-z {typed}, and a smaller SIGMA_A|{typed}|" in finding.remedy
        assert finding.evidence["sigma_z_asked_m"] == high
        assert finding.evidence["sigma_z_asked_is_upper_bound"] == 1.0


@pytest.mark.parametrize(
    ("one", "estimate", "parameters", "text"),
    [
        (fused(0.1), Noise(0.3, 0.2, 0.4), {}, "EKF2 uses 0.1 m. Set EKF2_EVP_NOISE to 0.3 m. "),
        (fused(0.1, name="down"), Noise(0.3, 0.2, 0.4), {}, "covers horizontal position only."),
        (fused(0.1), Noise(0.124, 0.12, 0.13), {}, "0.1 m: this does not explain the deviation."),
        (
            fused(0.1, 0.2),
            Noise(0.081, 0.08, 0.09),
            {},
            "0.1 m: this does not explain the deviation.",
        ),
        # a smaller noise than the sender reports: its variances must not be used
        (
            fused(0.3, 0.2),
            Noise(0.1, 0.09, 0.11),
            {"EKF2_EVP_NOISE": 0.1},
            "Set EKF2_EVP_NOISE to 0.1 m and EKF2_EV_NOISE_MD to 1.",
        ),
        (
            fused(0.3, 0.2),
            Noise(0.1, 0.09, 0.11),
            {"EKF2_EVP_NOISE": 0.25},
            "Set EKF2_EVP_NOISE to 0.1 m. ",
        ),
        # PX4's minimum, and a bound
        (fused(0.3, 0.2), Noise(0.002, 0.001, 0.003), {}, "Set EKF2_EVP_NOISE to 0.01 m. "),
        (fused(0.1), Noise(None, None, 0.2), {}, "is 0.2 m, EKF2 uses 0.1 m. Set"),
    ],
)
def test_variances_ekf2_without_replay_compare_noises(one, estimate, parameters, text) -> None:
    tuning = {**tuned(estimate), "down": tuned(estimate)["horizontal"]}
    flown = analysis(axes=(one,), log=log(parameters=parameters), tuning=tuning)
    assert text in only(noises.detect_inconsistent_variances, flown).remedy


# ---------------------------------------------------------------- the loop and the drift


def closure(
    gnc: float | None = 1.0, *, accepted: bool = True, where: str = "landing", p: float = 0.5
) -> Closure:
    return Closure(
        time_1_s=10.0, time_2_s=90.0, sigma_m=0.1, source=where, distance_m=3.0, d2=25.0,
        degrees_of_freedom=2, p=p, accepted=accepted, weight_gnc=gnc,
    )  # fmt: skip


def loop(*closures: Closure, **parts: Any) -> Loop:
    """Make a loop with these properties."""
    return made(Loop, closures=closures, **parts)


@pytest.mark.parametrize(
    ("closures", "expected"),
    [
        ((closure(0.5),), []), ((closure(None),), []),
        ((closure(0.49), closure()), ["loop_closure_inconsistent"]),
        ((closure(0.0), closure(0.0), closure()), ["loop_drift_too_small"]),
        ((closure(0.49),), ["loop_drift_too_small"]),
        ((closure(0.0, accepted=False), closure()), ["false_loop_closure"]),
        ((closure(0.0, accepted=False),), ["loop_drift_too_small", "false_loop_closure"]),
    ],
)  # fmt: skip
def test_loop_closures_gnc_weight_determines_findings(
    closures: tuple[Closure, ...], expected: list[str]
) -> None:
    found = list(loops.detect_inconsistent_closures(loop(*closures, is_end_assumed=False)))
    assert [finding.id for finding in found] == expected
    if expected == ["loop_drift_too_small"]:
        dropped = sum((each.weight_gnc or 0.0) < 0.5 for each in closures)
        assert found[0].evidence == {"dropped": dropped, "closures": len(closures)}


def closing(gap_m: float | None, length_m: float = 50.0) -> Loop:
    return loop(closure_error_m=gap_m, path_length_m=length_m)


def test_drift_reports_short_term_noise_and_closure_error() -> None:
    finding = only(hidden_errors.detect, analysis(source=ODOMETRY))
    assert finding.evidence == {"source": "uwb"}
    assert finding.message.endswith("not the position error.")
    for noise, bound, value in (
        (Noise(0.02, 0.01, 0.03), "", 0.02), (Noise(None, None, 0.04), "at most ", 0.04)
    ):  # fmt: skip
        one = analysis(source=ODOMETRY, tuning=tuned(noise), loop=closing(1.25))
        finding = only(hidden_errors.detect, one)
        assert f"short-term noise is {bound}{value} m" in finding.message
        assert finding.evidence["short_term_noise_m"] == value
        assert "closure error is 1.25 m after 50 m." in finding.message
    assert named(hidden_errors.detect, analysis(source=MOVING)) == {}
    unclosed = only(hidden_errors.detect, analysis(source=ODOMETRY, loop=closing(None)))
    assert "closure error" not in unclosed.message


# ---------------------------------------------------------------- the summary


def flight_of(result: Any, **parts: Any) -> Any:
    """Make an analysis whose main axis is this one."""
    one = analysis(axes=(result,), **{"source": MOVING, **parts})
    one.main = result
    return one


def along(ekf2_nis: float, kf_nis: float, name: str = "aisle", **parts: Any) -> Any:
    """Make an axis on which EKF2 and KF have these mean NIS."""
    ekf2, kf_statement = (
        statement(nis, classify_mean_nis(nis, (1.0, 1.0))) for nis in (ekf2_nis, kf_nis)
    )
    frame = pd.DataFrame({"position_m": [0.0]}, index=[10.0])
    usual = {"ekf2_state": frame, "difference": NONE}
    return axis(name, ekf2=ekf2, kf=kf_statement, **{**usual, **parts})


def with_truth(kf_nis: float, **parts: Any) -> Any:
    """Make an axis with ground truth: EKF2 is consistent, KF has this mean NIS."""
    truths = {"ekf2_truth": against_truth(1.0), "kf_truth": against_truth(1.0)}
    return along(1.0, kf_nis, **{**truths, **parts})


KF_OVERCONFIDENT = (
    "Along the aisle KF has a position RMSE of 0.40 m and is overconfident: σ is 3 times too small."
)


def test_summary_without_truth_compares_innovations() -> None:
    difference = made(Difference, position_rms_m=0.05)
    (text,) = summarise(flight_of(along(1.0, 1.0, difference=difference)), ())
    assert text == (
        "Along the aisle KF and EKF2 differ by 0.050 m RMS. The log contains no ground truth. By "
        "its innovations along the aisle EKF2 is consistent. By its innovations along the aisle KF "
        "is consistent."
    )
    (text,) = summarise(flight_of(along(0.25, 4.0, difference=difference)), ())
    assert "EKF2 is underconfident: σ is 2 times too large." in text
    assert text.endswith("KF is overconfident: σ is 2 times too small.")
    mute = axis(
        "aisle", ekf2=NONE, kf=statement(1.0), ekf2_state=made(pd.DataFrame), difference=difference
    )
    (text,) = summarise(flight_of(mute), ())
    assert "EKF2 is not tested for consistency: the log has no innovations or too few." in text
    (text,) = summarise(flight_of(along(0.25, 4.0), source=ODOMETRY), ())
    assert text.endswith("Both filters follow uwb, which may drift.")


def test_summary_names_cause_only_after_rerun() -> None:
    change = {"sigma_z_m": 3.0}
    for explains, is_cause in ((1.0, True), (0.5, True), (1.5, True), (0.49, False), (1.51, False)):
        causes = (tried("kf", change, "aisle", explained_fraction=explains),)
        text = summarise(flight_of(with_truth(9.0), causes=causes), ())[0]
        rerun = "too small. Re-run with SIGMA_Z 3 m instead of 1 m: mean NIS 9 → "
        assert (rerun in text) is is_cause
        assert text.endswith("too small. No tested change explains this.") is not is_cause
    # re-runs of another axis, another filter, or for another statistic
    for other in (tried("kf", change), tried("ekf2", change, "aisle"),
                  tried("kf", change, "aisle", "nees")):  # fmt: skip
        text = summarise(flight_of(with_truth(9.0), causes=(other,)), ())[0]
        assert text.endswith(KF_OVERCONFIDENT)


def test_summary_cause_of_both_filters_does_not_repeat_finding() -> None:
    change = {"outliers_left_out": 38.0}
    causes = (tried("kf", change, "aisle"), tried("ekf2", change, "aisle", before=4.0))
    both = along(4.0, 9.0, ekf2_truth=against_truth(1.0), kf_truth=against_truth(1.0))
    one = flight_of(both, causes=causes)
    outliers = Finding("source_outliers", "error", "So.", "Do.", title="Outliers")
    first, *more = summarise(one, (outliers,))
    assert (
        "Re-run with 38 outliers removed: mean NIS 4 → 1 (expected 1). Along the aisle KF" in first
    )
    assert first.endswith("Re-run with 38 outliers removed: mean NIS 9 → 1 (expected 1).")
    assert more == []


def test_summary_difference_is_explained_by_cause_or_steps() -> None:
    change = {"sigma_z_m": 3.0}
    why = made(DifferenceExplanation, cause="The rest is the noise.")
    for share, owner, is_explained in (
        (0.5, "kf", True),
        (0.49, "kf", False),
        (0.9, "ekf2", False),
    ):
        difference = replace(
            tried(owner, change, "aisle", "difference"),
            before=0.5,
            after=0.2,
            explained_fraction=share,
        )
        one = flight_of(with_truth(9.0), causes=(tried("kf", change, "aisle"), difference),
                        difference_steps={"aisle": why})  # fmt: skip
        _, second = summarise(one, ())
        rerun = "Re-run of KF with this correction: difference KF - EKF2 0.50 → 0.20 m RMS."
        assert second == (rerun if is_explained else "The rest is the noise.")


def test_summary_hidden_error_uses_cause_of_nees() -> None:
    hides = along(1.0, 1.0, ekf2_truth=against_truth(1.0), kf_truth=against_truth(16.0))
    causes = (tried("kf", {"clock_offset_s": -0.25}, "aisle", "nees", before=16.0),)
    text = summarise(flight_of(hides, causes=causes), ())[0]
    assert "KF has a position RMSE of 0.40 m, but reports σ 0.10 m." in text
    assert text.endswith(
        "Re-run with timestamps corrected (0.25 s late): RMS of error / reported σ 4 → 1 (expected "
        "1)."
    )


def test_summary_lists_findings_by_weight() -> None:
    def found(name: str, level: Any = "error", **parts: Any) -> Finding:
        return Finding(name, level, "So.", "Do.", title=f"It is {name}", **parts)

    why = made(DifferenceExplanation, cause="The rest is the noise.")
    one = flight_of(along(1.0, 1.0), difference_steps={"aisle": why})
    texts = summarise(one, (found("ekf2_resets"), found("no_motion", "note"), found("imu_gap")))
    assert texts[1:] == ("It is imu_gap.", "The rest is the noise.")
    spans = ((20.0, 30.0),)
    texts = summarise(one, (found("imu_gap", spans_s=spans),))
    assert texts[1] == "It is imu_gap (20.0 s to 30.0 s)."
    dated = found("imu_gap", spans_s=spans, evidence={"at_s": 20.0})
    assert summarise(one, (dated,))[1] == "It is imu_gap."
    follows = found("imu_gap", caused_by="logger_dropouts")
    assert "imu_gap" not in "".join(summarise(one, (found("logger_dropouts"), follows)))
    looped = flight_of(along(1.0, 1.0), loop=closing(1.0, 200.0))
    assert summarise(looped, ())[1] == (
        "The odometry has a loop closure error of 1.00 m after 200 m (0.5 %)."
    )
    assert len(summarise(flight_of(along(1.0, 1.0), loop=closing(None)), ())) == 1


def test_summary_smaller_noise_contradicted_by_truth_is_no_cause() -> None:
    contradicted = replace(
        tried("kf", {"sigma_z_m": 0.5}, "aisle", before=0.2), contradicts_truth=True
    )
    one = flight_of(with_truth(0.2), causes=(contradicted,))
    assert summarise(one, ())[0].endswith(
        "too large. A smaller σ would be below the errors against ground truth."
    )
    finding = only(
        noises.detect_inconsistent_variances,
        analysis(axes=(kf(0.2, "aisle"),), causes=(contradicted,)),
    )
    assert (finding.remedy, finding.severity) == (noises.KEEP_NOISES_TRUTH, "note")
    assert finding.evidence["cause"] == "elsewhere"


def test_summary_noise_shape_finding_replaces_setting_as_cause() -> None:
    causes = (tried("kf", {"sigma_z_m": 3.0}, "aisle"),)
    one = flight_of(with_truth(9.0), causes=causes)
    for name, level, is_named in (
        ("source_noise_time_correlated", "warning", False),
        ("source_noise_time_correlated", "note", True),
        ("source_outliers", "warning", True),
    ):  # fmt: skip
        found = Finding(name, level, "So.", "Do.", title="It is so")  # type: ignore[arg-type]
        text = summarise(one, (found,))[0]
        assert ("Re-run with SIGMA_Z" in text) is is_named
        assert is_named or text.endswith(KF_OVERCONFIDENT)
    # a time offset stays a cause, unless a low pass delays the positions
    clock = (tried("kf", {"clock_offset_s": 0.25}, "aisle"),)
    shaped = Finding("source_noise_time_correlated", "warning", "So.", "Do.", title="It is so")
    with_offset = flight_of(with_truth(9.0), causes=clock)
    assert "Re-run with timestamps" in summarise(with_offset, (shaped,))[0]
    smoothed = Finding("source_low_pass_filtered", "warning", "So.", "Do.", title="It is so")
    assert "Re-run" not in summarise(with_offset, (smoothed,))[0]


@pytest.mark.parametrize(
    ("owner", "change", "expected"),
    [
        ("kf", {"outliers_left_out": 1.0}, "1 outlier removed"),
        ("kf", {"outliers_left_out": 2.0}, "2 outliers removed"),
        # relative to the offset in use (0.1 s) for KF, absolute for EKF2
        ("kf", {"clock_offset_s": 0.25}, "timestamps corrected (0.15 s early)"),
        ("kf", {"clock_offset_s": 0.05}, "timestamps corrected (0.05 s late)"),
        ("ekf2", {"clock_offset_s": 0.25}, "timestamps corrected (0.25 s early)"),
        ("kf", {"turned_deg": -20.0}, "positions rotated by -20°"),
        ("kf", {"sigma_a_m_s2": 0.3, "sigma_z_m": 0.2},
         "SIGMA_A 0.3 m/s² instead of 1 m/s² and SIGMA_Z 0.2 m instead of 1 m"),
        ("ekf2", {"EKF2_EV_DELAY": 90.0, "EKF2_DELAY_MAX": 250.0},
         "EKF2_EV_DELAY 90 ms instead of 7 ms"),
    ],
)  # fmt: skip
def test_format_change_names_old_and_new_value(
    owner: Any, change: dict[str, float], expected: str
) -> None:
    model = SimpleNamespace(inputs=SimpleNamespace(settings=dict.fromkeys(PARAMETERS, 7.0)))
    one = analysis(settings=replace(CHOSEN, clock_offset_s=0.1), ekf2_model=model)
    assert cause_text.format_change(one, tried(owner, change)) == expected
