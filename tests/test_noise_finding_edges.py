"""Detectors of noises, loops and drift at the limits of their thresholds.

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

from px4fuse.comparison.rerun_effects import Rerun, RunStatistics
from px4fuse.convention.model import Convention, OrientationConvention
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.findings import cause_text, hidden_errors, loops, noises
from px4fuse.findings.ekf2_settings import detect_wrong_noise
from px4fuse.findings.model import group_by_cause
from px4fuse.findings.noises import _has_default_noises
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS, MODEL_PARAMETERS
from px4fuse.flight.model import AS_RECEIVED_ORIGIN, GNSS_ORIGIN
from px4fuse.loop.model import Loop, LoopClosure, TrueFinalPose
from px4fuse.report.tuning import list_tuning_advice

MOVING = source(samples=positions(np.arange(0.0, 120.0), np.arange(120.0)))
HOVERING = source(samples=positions(np.arange(0.0, 120.0)))
ODOMETRY = source(samples=MOVING.samples, origin=DRIFTING)
RIGHT = NoiseEstimate(1.0, 0.9, 1.1)


def trial(
    change: dict[str, float], after: float = 1.0, owner: Any = "kf", kind: str = "noises"
) -> Rerun:
    """Make a re-run that changes the mean NIS from 16 to ``after``."""
    before, after_change = RunStatistics(nis_mean=16.0), RunStatistics(nis_mean=after)
    return Rerun(
        filter=owner, axis="north", kinds=(kind,), change=change, before=before, after=after_change
    )


# ---------------------------------------------------------------- SIGMA_Z and SIGMA_A


@pytest.mark.parametrize(
    ("chosen", "estimate", "expected"),
    [
        (1.5, NoiseEstimate(1.0, 0.99, 1.01), ("warning", 1.5)),
        (1.49, NoiseEstimate(1.0, 0.99, 1.01), None),
        (3.99, RIGHT, ("warning", 3.99)), (4.0, RIGHT, ("error", 4.0)),
        (0.25, RIGHT, ("error", 4.0)), (0.251, RIGHT, ("warning", 1.0 / 0.251)),
        # beyond the 95 % interval, widened 1.5 times on a log scale
        (8.0, NoiseEstimate(1.0, 0.25, 4.0), None),
        (8.1, NoiseEstimate(1.0, 0.25, 4.0), ("error", 8.1)),
        (0.125, NoiseEstimate(1.0, 0.25, 4.0), None),
        (0.124, NoiseEstimate(1.0, 0.25, 4.0), ("error", 8.1)),
        # bounded from above, or not at all
        (0.75, NoiseEstimate(None, None, 0.5), ("warning", 1.5)),
        (0.4, NoiseEstimate(None, None, 0.5), None),
        (0.1, NoiseEstimate(None, None, 0.5), None), (9.0, NoiseEstimate(None, None, None), None),
        (0.1, NoiseEstimate(1.0, None, 2.0), None), (9.0, NoiseEstimate(1.0, 0.5, None), None),
        # a default setting is one level less severe
        (0.1, NoiseEstimate(0.033, 0.032, 0.034), ("note", 3.03)),
        (0.101, NoiseEstimate(0.033, 0.032, 0.034), ("warning", 3.06)),
    ],
)  # fmt: skip
def test_kf_noise_of_1_5_times_the_estimate_is_a_warning(
    chosen: float, estimate: NoiseEstimate, expected: Any
) -> None:
    off = noises.find_setting_deviation("sigma_z_m", chosen, estimate)
    if off is None or expected is None:
        assert off is expected
        return
    assert (off.severity, off.factor) == (expected[0], pytest.approx(expected[1], rel=0.01))


UNTESTED_SIGMA_Z, UNTESTED_SIGMA_A = (
    f"Do not change this setting alone: it is estimated together with {other}, and no re-run "
    "confirmed the estimate."
    for other in ("SIGMA_A", "SIGMA_Z")
)
SIGMA_A_TO_0_1, BOTH = {"sigma_a_m_s2": 0.1}, {"sigma_a_m_s2": 0.1, "sigma_z_m": 0.5}


@pytest.mark.parametrize(
    ("trials", "expected"),
    [
        ((trial(SIGMA_A_TO_0_1),),
         [("sigma_a_too_large", "error", "Set SIGMA_A to 0.1 m/s² (--sigma-a 0.1)."),
          ("sigma_z_too_large", "warning", UNTESTED_SIGMA_Z)]),
        ((trial(BOTH), trial(SIGMA_A_TO_0_1, 9.0)),
         [(name, level, "Set SIGMA_A to 0.1 m/s² (--sigma-a 0.1) and SIGMA_Z to 0.5 m (--sigma-z "
           "0.5).")
          for name, level in (("sigma_a_too_large", "error"), ("sigma_z_too_large", "warning"))]),
        # a re-run that improves nothing: the other setting is the cause
        ((trial(SIGMA_A_TO_0_1, 9.0),),
         [("sigma_z_too_large", "warning", UNTESTED_SIGMA_Z),
          ("sigma_a_too_large", "note", noises.NO_IMPROVEMENT_ACTION)]),
    ],
)  # fmt: skip
def test_kf_noise_setting_that_improves_the_rerun_is_recommended(
    trials: Any, expected: Any
) -> None:
    fitted = tuned(NoiseEstimate(0.5, 0.45, 0.55), NoiseEstimate(0.1, 0.09, 0.11))
    cause, other = noises.detect_wrong_settings(
        analysis(source=MOVING, tuning=fitted, reruns=trials)
    )
    assert [(one.id, one.severity, one.remedy) for one in (cause, other)] == expected
    assert (cause.caused_by, other.caused_by) == (None, cause.id)


@pytest.mark.parametrize(
    ("nis_mean", "rmse_m", "expected"),
    [
        (0.78, None, ("error", UNTESTED_SIGMA_A)),
        (0.78, 0.3, ("note", noises.NO_IMPROVEMENT_ACTION)),
        (0.5, None, ("note", noises.NO_IMPROVEMENT_ACTION)),
    ],
)
def test_wrong_noise_has_severity_note_if_rerun_is_no_better(
    nis_mean: float, rmse_m: float | None, expected: tuple[str, str]
) -> None:
    """A re-run shows no improvement if σ is consistent before and the position error unknown."""
    as_flown = RunStatistics(innovations=100, nis_mean=nis_mean, position_rmse_m=rmse_m)
    rerun = replace(trial(SIGMA_A_TO_0_1), before=as_flown, after=as_flown)
    fitted = tuned(None, NoiseEstimate(0.1, 0.09, 0.11))
    finding = only(
        noises.detect_wrong_settings, analysis(source=MOVING, tuning=fitted, reruns=(rerun,))
    )
    assert (finding.severity, finding.remedy) == expected


def test_report_on_wrong_kf_noise_states_ratio_to_fitted_noise() -> None:
    fitted = tuned(NoiseEstimate(0.5, 0.45, 0.55), NoiseEstimate(0.1, 0.09, 0.11))
    worse, _ = noises.detect_wrong_settings(analysis(source=MOVING, tuning=fitted))
    assert worse.evidence["factor"] == pytest.approx(10.0)
    assert worse.message == (
        "SIGMA_A is 10 times too large: KF follows the noise of single positions. SIGMA_A is 1 "
        "m/s²; "
        "its maximum-likelihood estimate is 0.1 m/s² (95 % 0.09 to 0.11 m/s²). KF's gain is too "
        "large."
    )
    small = tuned(NoiseEstimate(2.0, 1.9, 2.1), NoiseEstimate(9.0, 8.9, None))
    worse, _ = noises.detect_wrong_settings(analysis(source=MOVING, tuning=small))
    assert (
        "too small: KF lags behind the positions. SIGMA_A is 1 m/s²; its maximum-likelihood "
        "estimate is 9 m/s². KF's gain is too small." in worse.message
    )
    assert named(noises.detect_wrong_settings, analysis(source=MOVING)) == {}


@pytest.mark.parametrize(
    ("origin", "sigma_z_m", "expected"),
    [
        (GNSS_ORIGIN, 0.2, {"GNSS"}), (GNSS_ORIGIN, 3.0, {"Action"}),
        (AS_RECEIVED_ORIGIN, 0.2, {"Action"}),
    ],
)  # fmt: skip
def test_noise_fit_does_not_advise_smaller_noise_for_gnss(
    origin: Any, sigma_z_m: float, expected: set[str]
) -> None:
    fitted = tuned(NoiseEstimate(sigma_z_m, 0.9 * sigma_z_m, 1.1 * sigma_z_m), biases_fitted=False)
    flight = analysis(
        source=source(samples=MOVING.samples, origin=origin), log=log(autopilot="ArduPilot")
    )
    assert dict(list_tuning_advice(flight, fitted)).keys() == expected


def test_kf_measurement_noise_above_estimated_bound_is_reported() -> None:
    bounded = tuned(NoiseEstimate(None, None, 0.0021))
    finding = only(noises.detect_wrong_settings, analysis(source=MOVING, tuning=bounded))
    assert finding.remedy == UNTESTED_SIGMA_Z
    assert finding.title.startswith("SIGMA_Z is at least 480 times too large")
    assert "estimate is at most 0.0021 m. KF's" in finding.message


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
def test_kf_noise_is_not_called_too_large_for_odometry(
    parts: dict[str, Any], expected: list[str]
) -> None:
    estimate = 3.0 * (parts.get("settings") or CHOSEN).sigma_z_m
    fitted = tuned(
        NoiseEstimate(estimate, 0.9 * estimate, 1.1 * estimate), NoiseEstimate(0.1, 0.09, 0.11)
    )
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
    return axis(kf=statement(4.0, **slow), kf_run=replay)


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (following(0.1), "error"), (following(0.101), None),  # 2.5 s
        (following(0.1, lag1_autocorrelation=0.3), "error"),
        (following(0.1, lag1_autocorrelation=0.29), None),
        (following(0.1, verdict="consistent"), None),
        (axis(kf=NONE, kf_run=SimpleNamespace(updates=None)), None),
    ],
)  # fmt: skip
def test_near_zero_q_with_white_innovations_is_not_reported(one: Any, expected: str | None) -> None:
    assert severity(noises.detect_process_noise_near_zero, analysis(axes=(one,))) == expected


def test_report_on_near_zero_process_noise_states_response_time() -> None:
    slower = following(0.01)
    slower.axis.name = "east"
    finding = only(noises.detect_process_noise_near_zero, analysis(axes=(following(0.05), slower)))
    assert finding.remedy == "Increase SIGMA_A (--sigma-a)."
    assert finding.title.startswith("Process noise SIGMA_A is almost zero (1 m/s²): KF ignores")
    assert "decreases to 0.05, so KF needs 5 s" in finding.message
    assert finding.evidence["response_s"] == pytest.approx(5.0)
    one = analysis(axes=(following(0.05),), tuning=tuned(None, NoiseEstimate(2.3456, 2.0, 3.0)),
                   reruns=(trial({"sigma_a_m_s2": 2.35}),))  # fmt: skip
    finding = only(noises.detect_process_noise_near_zero, one)
    assert finding.title == "SIGMA_A is 2.3 times too small: KF ignores new positions"
    assert finding.remedy == "Set SIGMA_A to 2.35 m/s² (--sigma-a 2.35)."


# ---------------------------------------------------------------- variances


def kf(nis: float, name: str = "north", **parts: Any) -> Any:
    verdict = "overconfident" if nis > 1.0 else "underconfident"
    return axis(name, kf=statement(nis, **{"verdict": verdict, **parts}))


def test_mean_nis_per_axis_of_4_or_0_25_is_reported_as_error() -> None:
    for nis, expected in (
        (3.99, "warning"), (4.0, "error"), (0.25, "error"), (0.251, "warning"),
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


def test_report_on_inconsistent_filter_combines_north_and_east() -> None:
    axes = (kf(0.1, "aisle"), kf(2.0), kf(3.0, "east"), kf(9.0, "down"))
    found = tuple(noises.detect_inconsistent_variances(analysis(axes=axes)))
    assert [(one.id, one.caused_by, one.evidence["axis"]) for one in found] == [
        ("kf_underconfident", None, "aisle"), ("kf_overconfident", None, "east"),
        ("kf_overconfident", "kf_overconfident", "down"),
    ]  # fmt: skip
    assert found[1].title == "KF is overconfident along east: σ is 1.73 times too small"
    main = analysis(axes=(kf(2.0), kf(3.0, "east")))
    assert only(noises.detect_inconsistent_variances, main).evidence["axis"] == "north"
    assert "The mean NIS is 3, expected 0.80 to 1.20" in found[1].message
    assert group_by_cause(found) == found


def test_smaller_noise_on_odometry_is_not_recommended() -> None:
    for nis, is_kept, level in ((0.2, True, "note"), (5.0, False, "error")):
        finding = only(
            noises.detect_inconsistent_variances, analysis(axes=(kf(nis),), source=ODOMETRY)
        )
        assert (finding.remedy == noises.KEEP_NOISE_BECAUSE_OF_DRIFT_ACTION) is is_kept
        assert finding.severity == level
    for owner, there in (("kf", True), ("ekf2", False)):
        worse = {owner: statement(), f"{owner}_truth": against_truth(9.0)}
        finding = only(
            noises.detect_inconsistent_variances, analysis(axes=(kf(0.2), axis("east", **worse)))
        )
        assert (finding.remedy == noises.KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION) is there
        assert finding.evidence["cause"] == "elsewhere"


def test_inconsistent_filter_with_default_noise_is_only_warning() -> None:
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
def test_used_ekf2_noise_within_25_percent_counts_as_px4_default(flown, used_m, default):
    assert (
        _has_default_noises(analysis(log=log(parameters=flown)), "ekf2", fused(used_m)) is default
    )


@pytest.mark.parametrize(
    ("owner", "change", "kind", "action"),
    [
        ("kf", {"sigma_z_m": 2.0}, "measurement noise", "Set SIGMA_Z to 2 m (--sigma-z 2)."),
        ("kf", {"sigma_a_m_s2": 0.3, "sigma_z_m": 2.0}, "measurement noise",
         "Set SIGMA_A to 0.3 m/s² (--sigma-a 0.3) and SIGMA_Z to 2 m (--sigma-z 2)."),
        ("kf", {"outliers_left_out": 9.0}, "outliers",
         "Ensure line of sight from tag to anchors, or remove outliers before sending."),
        ("kf", {"outliers_left_out": 9.0, "sigma_z_m": 2.0}, "outliers",
         "before sending. Set SIGMA_Z to 2 m (--sigma-z 2)."),
        ("kf", {"clock_offset_s": -0.25}, "clock",
         "Subtract 0.250 s from the timestamp of each position before sending."),
        ("kf", {"clock_offset_s": 0.25}, "clock",
         "Add 0.250 s to the timestamp of each position before sending."),
        ("kf", {"turned_deg": -20.0}, "frame",
         "Rotate the positions by -20° before they are sent."),
        ("kf", {"bias_forward_m_s2": 0.5, "bias_right_m_s2": 0.1}, "accelerometer",
         "Calibrate the accelerometer and the level horizon."),
        ("ekf2", {"EKF2_EV_DELAY": 90.0}, "clock", "Set EKF2_EV_DELAY to 90 ms."),
        ("ekf2", {"EKF2_EVP_NOISE": 0.3}, "measurement noise", "Set EKF2_EVP_NOISE to 0.3 m."),
        ("ekf2", {"EKF2_EVP_GATE": 5.0}, "gate", "Set EKF2_EVP_GATE to 5 SD."),
        ("ekf2", {"EKF2_ACC_NOISE": 0.35}, "process noise", "Set EKF2_ACC_NOISE to 0.35 m/s²."),
    ],
)  # fmt: skip
def test_change_that_explains_inconsistency_in_rerun_is_advised(
    owner, change, kind, action
) -> None:
    # changes that explain less than 0.5 or more than 1.5 are not causes
    causes = (tried(owner, {"sigma_z_m": 7.0}, explained_fraction=0.4), tried(owner, change),
              tried(owner, {"sigma_z_m": 7.0}, explained_fraction=1.6))  # fmt: skip
    one = axis("north", **{owner: statement(9.0, "overconfident")})
    finding = only(noises.detect_inconsistent_variances, analysis(axes=(one,), reruns=causes))
    assert finding.remedy.endswith(action)
    assert finding.evidence["cause"] == kind


def test_kf_noise_that_does_not_reduce_nis_is_not_recommended() -> None:
    change = {"sigma_z_m": 2.0}
    for after, action in (
        (1.0, "Set SIGMA_Z to 2 m (--sigma-z 2)."),
        (9.0, noises.UNEXPLAINED_SIGMA_ACTION),
    ):
        one = analysis(axes=(kf(9.0),), tuning=tuned(), reruns=(
            tried("kf", change), trial(change, after), trial(change, 9.0, "ekf2")))  # fmt: skip
        assert only(noises.detect_inconsistent_variances, one).remedy == action


def test_unexplained_kf_inconsistency_advises_to_check_imu() -> None:
    causes = (tried("kf", {"sigma_z_m": 7.0}, explained_fraction=0.4),
              tried("kf", {"sigma_z_m": 2.0}, "east"))  # fmt: skip
    one = analysis(axes=(kf(9.0),), reruns=causes, tuning=tuned())
    finding = only(noises.detect_inconsistent_variances, one)
    assert (finding.evidence["cause"], finding.remedy) == (
        "elsewhere",
        noises.UNEXPLAINED_SIGMA_ACTION,
    )
    unknown = only(noises.detect_inconsistent_variances, analysis(axes=(kf(9.0),)))
    assert unknown.remedy == noises.UNKNOWN_NOISE_ACTION


def test_smaller_gnss_noise_is_advised_only_if_nees_is_small() -> None:
    receiver = source(samples=MOVING.samples, origin=GNSS_ORIGIN)
    rerun = tried("kf", {"sigma_z_m": 0.2}, before=0.2)
    for nees, is_reduced in ((0.2, True), (1.0, False)):
        narrow = axis(kf=statement(0.2, "underconfident"), kf_truth=against_truth(nees))
        one = analysis(axes=(narrow,), source=receiver, reruns=(rerun,))
        finding = only(noises.detect_inconsistent_variances, one)
        assert finding.severity == "note"
        assert finding.remedy.startswith("Set SIGMA_Z to 0.2 m" if is_reduced else "Do not reduce")


def test_smaller_kf_noise_that_increases_nees_is_not_advised() -> None:
    contradicted = tried("kf", {"sigma_z_m": 0.5}, before=0.2)
    contradicted = replace(contradicted, after=replace(contradicted.after, nees_mean=4.0))
    one = analysis(axes=(kf(0.2),), reruns=(contradicted,))
    finding = only(noises.detect_inconsistent_variances, one)
    assert (finding.remedy, finding.severity) == (noises.KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION, "note")
    assert finding.evidence["cause"] == "elsewhere"


@pytest.mark.parametrize(
    ("one", "estimate", "parameters", "text"),
    [
        (fused(0.1), NoiseEstimate(0.3, 0.2, 0.4), {},
         "Set EKF2_EVP_NOISE to 0.3 m. EKF2 used a measurement noise of 0.1 m."),
        (fused(0.1), NoiseEstimate(0.124, 0.12, 0.13), {},
         "Keep EKF2's measurement noise (0.1 m): its estimate (0.12 m) does not explain the wrong"),
        # EKF2 is overconfident although its noise is larger than the estimate
        (fused(0.1), NoiseEstimate(0.03, 0.02, 0.04), {},
         "Keep EKF2's measurement noise (0.1 m): its estimate (0.03 m) does not explain the wrong"),
        (axis(ekf2=statement(5.0, "overconfident"),
              ekf2_innovations=pd.DataFrame({"observation_variance_m2": [np.nan]})),
         NoiseEstimate(0.3, 0.2, 0.4), {}, noises.UNEXPLAINED_SIGMA_ACTION),
        (fused(0.1, 0.2), NoiseEstimate(0.081, 0.08, 0.09), {},
         "Keep EKF2's measurement noise (0.1 m): it"),
        # a smaller noise than the sender reports: its variances must not be used
        (fused(0.3, 0.2), NoiseEstimate(0.1, 0.09, 0.11), {"EKF2_EVP_NOISE": 0.1},
         "Set EKF2_EV_NOISE_MD to 1. EKF2"),
        (fused(0.3, 0.2), NoiseEstimate(0.1, 0.09, 0.11), {"EKF2_EVP_NOISE": 0.25},
         "Set EKF2_EVP_NOISE to 0.1 m. EKF2"),
        # PX4's minimum, and a bound
        (fused(0.3, 0.2), NoiseEstimate(0.002, 0.001, 0.003), {},
         "Set EKF2_EVP_NOISE to 0.01 m. EKF2"),
        (fused(0.1), NoiseEstimate(None, None, 0.2), {},
         "Set EKF2_EVP_NOISE to 0.2 m. EKF2 used a measurement noise of 0.1 m."),
    ],
)  # fmt: skip
def test_overconfident_ekf2_without_replay_gets_noise_advice(
    one, estimate, parameters, text
) -> None:
    flown = analysis(axes=(one,), log=log(parameters=parameters), tuning=tuned(estimate))
    assert only(noises.detect_inconsistent_variances, flown).remedy.startswith(text)


# ---------------------------------------------------------------- noise of EKF2


@pytest.mark.parametrize(
    ("flown_m", "kind", "rejected", "expected"),
    [
        (0.02, "uwb", 0.55,
         ("ekf2_noise_too_small", "error",
          "EKF2_EVP_NOISE is 5 times too small: EKF2 rejects 55 % of the positions")),
        (0.02, "uwb", 0.04,
         ("ekf2_noise_too_small", "error", "EKF2_EVP_NOISE is 5 times too small")),
        (0.06, "uwb", 0.0,
         ("ekf2_noise_too_small", "warning", "EKF2_EVP_NOISE is 1.67 times too small")),
        (0.5, "uwb", 0.0, ("ekf2_noise_too_large", "error", "EKF2_EVP_NOISE is 5 times too large")),
        # a too large noise does not cause rejections
        (0.5, "uwb", 0.2, ("ekf2_noise_too_large", "error", "EKF2_EVP_NOISE is 5 times too large")),
        # PX4's default: not chosen, so the title names the sensor
        (0.1, "uwb", 0.0,
         ("ekf2_noise_too_small", "error", "UWB noise is 4 times the noise setting of EKF2")),
        (0.5, "gnss", 0.44,
         ("ekf2_noise_too_small", "error",
          "GNSS noise is 4 times the noise setting of EKF2: EKF2 rejects 44 % of the positions")),
    ],
)  # fmt: skip
def test_report_on_wrong_default_noise_names_position_sensor(
    flown_m: float, kind: str, rejected: float, expected: tuple[str, str, str]
) -> None:
    aid = GNSS_POS if kind == "gnss" else EV_POS
    estimate_m = 4.0 * flown_m if flown_m == MODEL_PARAMETERS[aid.noise].default else 0.1
    outcome = RunStatistics(nis_mean=16.0 if estimate_m > flown_m else 0.1)
    change = {aid.noise: estimate_m}
    rerun = Rerun(filter="ekf2", axis="north", kinds=("noise",), change=change, before=outcome,
                  after=RunStatistics(nis_mean=1.0))  # fmt: skip
    settings = {aid.noise: flown_m, "EKF2_EV_NOISE_MD": 0.0}
    received = SimpleNamespace(variance_m2=np.zeros((9, 3)))
    inputs = SimpleNamespace(aid=aid, settings=settings, received_positions=received)
    model = SimpleNamespace(inputs=inputs)
    result = axis("north", rejected_fraction=rejected)
    origin = GNSS_ORIGIN if kind == "gnss" else AS_RECEIVED_ORIGIN
    one = analysis(
        axes=(result,), reruns=(rerun,), ekf2_model=model, source=source(origin=origin),
        settings=Settings(1.0, flown_m),
    )  # fmt: skip
    finding = only(detect_wrong_noise, one)
    assert (finding.id, finding.severity, finding.title) == expected
    assert finding.remedy == f"Set {aid.noise} to {estimate_m:.3g} m."
    received.variance_m2[:] = 9.0
    if kind == "uwb" and estimate_m < flown_m:
        rerun.change["EKF2_EV_NOISE_MD"] = 1.0
        assert (
            "the σ that UWB reports (EKF2_EV_NOISE_MD 0)" in only(detect_wrong_noise, one).message
        )
    # innovations outside their band after the change, or a change of EKF2_ACC_NOISE
    worse = replace(rerun, after=RunStatistics(nis_mean=2.0))
    other = replace(rerun, kinds=("process noise",))
    for trials in ((worse,), (other,), ()):
        assert not [*detect_wrong_noise(analysis(axes=(result,), reruns=trials, ekf2_model=model))]


# ---------------------------------------------------------------- the loop and the drift


def closure(
    gnc: float | None = 1.0, *, accepted: bool = True, where: str = "landing", p: float = 0.5
) -> LoopClosure:
    return LoopClosure(
        time_1_s=10.0, time_2_s=90.0, sigma_m=0.1, source=where, distance_m=3.0, d2=25.0,
        degrees_of_freedom=2, p=p, accepted=accepted, weight_gnc=gnc,
    )  # fmt: skip


def loop(*closures: LoopClosure, **parts: Any) -> Loop:
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
def test_loop_closure_with_small_gnc_weight_is_reported(
    closures: tuple[LoopClosure, ...], expected: list[str]
) -> None:
    found = list(
        loops.detect_inconsistent_closures(loop(*closures, is_landing_place_assumed=False))
    )
    assert [finding.id for finding in found] == expected
    if expected == ["loop_drift_too_small"]:
        dropped = sum((each.weight_gnc or 0.0) < 0.5 for each in closures)
        assert found[0].evidence == {"dropped": dropped, "closures": len(closures)}


def closing(gap_m: float | None, length_m: float = 50.0, end: Any = NONE, **parts: Any) -> Loop:
    usual = {"is_absolute_track": False}
    return loop(closure_error_m=gap_m, path_length_m=length_m, true_end=end, **usual | parts)


def test_report_on_possible_odometry_drift_has_closure_error() -> None:
    finding = only(hidden_errors.detect, analysis(source=ODOMETRY))
    assert finding.evidence == {"source": "uwb"}
    assert finding.message.endswith("innovations do not show the drift.")
    for noise, bound, value in (
        (NoiseEstimate(0.02, 0.01, 0.03), "", 0.02),
        (NoiseEstimate(None, None, 0.04), "at most ", 0.04)
    ):  # fmt: skip
        one = analysis(source=ODOMETRY, tuning=tuned(noise), loop=closing(1.25))
        finding = only(hidden_errors.detect, one)
        assert f"position noise (1 σ) is {bound}{value} m, without the drift" in finding.message
        assert finding.evidence["short_term_noise_m"] == value
        assert "closure error is 1.25 m after a path of 50 m." in finding.message
    assert named(hidden_errors.detect, analysis(source=MOVING)) == {}
    unclosed = only(hidden_errors.detect, analysis(source=ODOMETRY, loop=closing(None)))
    assert "closure error" not in unclosed.message


@pytest.mark.parametrize("heading_error_deg", [0.0, 90.0])
def test_loop_command_is_advised_only_if_orientation_is_right(heading_error_deg: float) -> None:
    orientation = OrientationConvention(
        verdict="determined", heading_error_deg=heading_error_deg, tilt_difference_deg=0.1
    )
    convention = Convention(verdict="determined", orientation=orientation)
    one = analysis(source=ODOMETRY, loop=closing(1.25), convention=convention)
    remedy = only(hidden_errors.detect, one).remedy
    assert ("px4fuse loop LOG" in remedy) is (heading_error_deg == 0.0)
    assert (loops.find_usable_loop(one) is None) is (heading_error_deg != 0.0)


END = TrueFinalPose(displacement_m={"forward": 0.0, "right": 0.0, "down": 0.0}, sigma_m=0.1,
              source="given", assumed=False)  # fmt: skip


@pytest.mark.parametrize(
    ("loop", "size"),
    [
        (closing(1.42, 88.0, END), "loop closure error 1.42 m, 1.6 % of a path of 88 m"),
        # the landing place is only assumed, or the track does not drift
        (closing(1.42, 88.0, replace(END, assumed=True)), None),
        (closing(1.42, 88.0, END, is_absolute_track=True), None),
        (closing(1.42, 88.0, NONE), None),
        (NONE, None),
    ],
)  # fmt: skip
def test_odometry_drift_report_states_loop_closure_error(loop: Any, size: str | None) -> None:
    one = analysis(axes=(hiding(nees=25.0),), source=ODOMETRY, loop=loop)
    finding = only(hidden_errors.detect, one)
    assert (finding.id, finding.severity) == ("source_drift", "error")
    assert finding.title == f"VIO drifts: {size or 'position RMSE 0.40 m against ground truth'}"
    assert finding.remedy.startswith(hidden_errors.DRIFT_REMEDY)
    assert ("px4fuse loop LOG" in finding.remedy) is (loop is not NONE)
    assert ("closure_error_m" in finding.evidence) is (size is not None)


@pytest.mark.parametrize(
    ("owner", "change", "expected"),
    [
        ("kf", {"outliers_left_out": 1.0}, "1 outlier removed"),
        ("kf", {"outliers_left_out": 2.0}, "2 outliers removed"),
        # relative to the offset in use (0.1 s) for KF, absolute for EKF2
        ("kf", {"clock_offset_s": 0.25}, "timestamps corrected (0.15 s early)"),
        ("kf", {"clock_offset_s": 0.05}, "timestamps corrected (0.05 s late)"),
        ("ekf2", {"clock_offset_s": 0.25}, "timestamps corrected (0.25 s early)"),
        ("kf", {"turned_deg": -20.0}, "positions rotated in yaw by -20°"),
        ("kf", {"sigma_a_m_s2": 0.3, "sigma_z_m": 0.2},
         "SIGMA_A 0.3 m/s² instead of 1 m/s² and SIGMA_Z 0.2 m instead of 1 m"),
        ("ekf2", {"EKF2_EV_DELAY": 90.0, "EKF2_DELAY_MAX": 250.0},
         "EKF2_EV_DELAY 90 ms instead of 7 ms"),
    ],
)  # fmt: skip
def test_changed_setting_text_contains_old_and_new_value(
    owner: Any, change: dict[str, float], expected: str
) -> None:
    model = SimpleNamespace(inputs=SimpleNamespace(settings=dict.fromkeys(MODEL_PARAMETERS, 7.0)))
    one = analysis(settings=replace(CHOSEN, clock_offset_s=0.1), ekf2_model=model)
    assert cause_text.format_change(one, tried(owner, change)) == expected


def test_measurement_noise_without_rerun_advises_default_value() -> None:
    request = SimpleNamespace(sigma_z_m=0.3, sigma_a_m_s2=None)
    one = analysis(request=request, reruns=())
    default_text = "To test the default value, run again without --sigma-z."
    assert noises.format_setting_action(one, "sigma_z_m") == default_text
    assert noises.format_setting_action(one, "sigma_a_m_s2").startswith("Do not change")
