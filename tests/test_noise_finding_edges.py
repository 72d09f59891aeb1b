"""Findings about noises, closures and the story of a flight at the edges of their thresholds.

The limits are written out here, so that one that is changed must be changed here as well.
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
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HeldOutCheck, Noise
from px4fuse.findings import Finding, hidden_errors, loops, noises, since
from px4fuse.findings.causes import group_by_cause
from px4fuse.findings.noises import _is_default
from px4fuse.findings.story import story
from px4fuse.loop.model import Closure, Loop

MOVING = source(samples=positions(np.arange(0.0, 120.0), np.arange(120.0)))
HOVERING = source(samples=positions(np.arange(0.0, 120.0)))
ODOMETRY = source(samples=MOVING.samples, origin=DRIFTING)
RIGHT = Noise(1.0, 0.9, 1.1)


@pytest.fixture(autouse=True)
def no_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a replay would be made with stands in its place."""

    said, tried_out = noises.remedy.format_kf_remedy, list[Settings]()

    def words(of: Any, changes: Any, more: str = "", unseen_nats: float | None = None) -> str:
        typed = said(of, changes, more).removeprefix("px4fuse compare LOG ").removesuffix(".")
        changed = tried_out[-1]
        return f"[{typed}|{changed.sigma_z_m:g}|{changed.sigma_a_m_s2:g}|{unseen_nats}]."

    monkeypatch.setattr(noises.remedy, "format_kf_remedy", words)
    monkeypatch.setattr(noises.remedy, "filter_errors_m", lambda _, new: tried_out.append(new))


# ---------------------------------------------------------------- SIGMA_Z and SIGMA_A


@pytest.mark.parametrize(
    ("chosen", "asked", "expected"),
    [
        (1.5, Noise(1.0, 0.99, 1.01), ("warning", 1.5)), (1.49, Noise(1.0, 0.99, 1.01), None),
        (3.99, RIGHT, ("warning", 3.99)), (4.0, RIGHT, ("error", 4.0)),
        (0.25, RIGHT, ("error", 4.0)), (0.251, RIGHT, ("warning", 1.0 / 0.251)),
        # beyond one and a half times the interval's reach, in ratios
        (8.0, Noise(1.0, 0.25, 4.0), None), (8.1, Noise(1.0, 0.25, 4.0), ("error", 8.1)),
        (0.125, Noise(1.0, 0.25, 4.0), None), (0.124, Noise(1.0, 0.25, 4.0), ("error", 8.1)),
        # bounded from above, or not at all
        (0.75, Noise(None, None, 0.5), ("warning", 1.5)), (0.4, Noise(None, None, 0.5), None),
        (0.1, Noise(None, None, 0.5), None), (9.0, Noise(None, None, None), None),
        (0.1, Noise(1.0, None, 2.0), None), (9.0, Noise(1.0, 0.5, None), None),
        # one that came with the program is advice
        (0.1, Noise(0.033, 0.032, 0.034), ("info", 3.03)),
        (0.101, Noise(0.033, 0.032, 0.034), ("warning", 3.06)),
    ],
)  # fmt: skip
def test_a_setting_that_is_off(chosen: float, asked: Noise, expected: Any) -> None:
    off = noises.setting_deviation("sigma_z_m", chosen, asked)
    if off is None or expected is None:
        assert off is expected
        return
    assert (off.severity, off.size) == (expected[0], pytest.approx(expected[1], rel=0.01))


def test_both_settings_are_told_together_the_worse_one_first() -> None:
    held = made(HeldOutCheck, gain_nats=0.25)
    fitted = tuned(Noise(0.5, 0.45, 0.55), Noise(0.1, 0.09, 0.11), held_out=held)
    worse, other = noises.deviating_settings(analysis(source=MOVING, tuning=fitted))
    assert (worse.id, worse.caused_by) == ("sigma_a_large", None)
    assert (other.id, other.caused_by) == ("sigma_z_large", "sigma_a_large")
    assert worse.severity == "error"
    assert worse.remedy == other.remedy == "[--sigma-a 0.1 --sigma-z 0.5|0.5|0.1|0.25]."
    assert worse.evidence["factor"] == pytest.approx(10.0)
    assert "10 times too large: the innovations (horizontal) ask for 0.1 m/s²" in worse.message
    small = tuned(Noise(2.0, 1.9, 2.1), Noise(9.0, 8.9, None), held_out=held)
    worse, _ = noises.deviating_settings(analysis(source=MOVING, tuning=small))
    assert "times too small: the innovations (horizontal) ask for 9 m/s². The" in worse.message
    assert named(noises.deviating_settings, analysis(source=MOVING)) == {}


def test_a_noise_that_is_only_bounded_is_typed_as_no_less_than_5_mm() -> None:
    bounded = tuned(Noise(None, None, 0.0021))
    finding = only(noises.deviating_settings, analysis(source=MOVING, tuning=bounded))
    assert finding.remedy == "[--sigma-z 0.005|0.005|1|None]."
    assert "is at least 480 times too large" in finding.message
    assert "ask for at most 0.0021 m. The" in finding.message
    known = analysis(source=MOVING, tuning=tuned(Noise(0.00211, 0.002, 0.0022)))
    assert only(noises.deviating_settings, known).remedy == "[--sigma-z 0.00211|0.00211|1|None]."


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({"source": MOVING}, ["sigma_a_large", "sigma_z_small"]),
        ({"source": HOVERING}, ["sigma_z_small"]),  # hardly seen without motion
        ({"source": ODOMETRY}, ["sigma_z_small"]),  # may be followed as closely as one likes
        ({"source": MOVING, "axes": (hiding(),)}, ["sigma_z_small"]),
        ({"source": ODOMETRY, "settings": Settings(1.0, 0.1)}, []),  # nor is that then advice
        ({"source": MOVING, "axes": (hiding(),), "settings": Settings(1.0, 0.1)},
         ["sigma_z_small"]),
        ({"source": MOVING, "axes": (axis(ekf2=statement(), ekf2_truth=against_truth(9.0)),)},
         ["sigma_a_large", "sigma_z_small"]),
    ],
)  # fmt: skip
def test_where_innovations_tell_less(parts: dict[str, Any], expected: list[str]) -> None:
    asked = 3.0 * (parts.get("settings") or CHOSEN).sigma_z_m
    fitted = tuned(Noise(asked, 0.9 * asked, 1.1 * asked), Noise(0.1, 0.09, 0.11))
    assert list(named(noises.deviating_settings, analysis(tuning=fitted, **parts))) == expected


def following(gain: float, *, growth: float = 0.05, **parts: Any) -> Any:
    """A filter whose median gain is this one in its second half; 4 updates a second."""
    index = 10.0 + 0.25 * np.arange(40)
    updates = pd.DataFrame({"gain_position": gain, "prior_position_variance_m2": 1.0}, index=index)
    updates.iloc[:19] = [0.9, 9.0]
    updates["gain_position"] *= [1.0] * 20 + [0.5] * 9 + [1.0] * 2 + [2.0] * 9
    after = pd.Series(1.0 / (1.0 + growth), index=index)
    after.iloc[20] = 1e-9  # one of them is an outlier
    both = pd.concat([after, pd.Series(7.0, index=index[:-1] + 0.1)]).sort_index()
    replay = SimpleNamespace(updates=updates, steps=both.to_frame("position_variance_m2"))
    slow = {"verdict": "variance understated", "lag1_autocorrelation": 0.31, **parts}
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
def test_a_process_noise_that_is_forgotten(one: Any, expected: str | None) -> None:
    assert severity(noises.process_noise_near_zero, analysis(axes=(one,))) == expected


def test_a_forgotten_process_noise_is_told_with_how_slow_the_filter_is() -> None:
    slower = following(0.01)
    slower.axis.name = "east"
    finding = only(noises.process_noise_near_zero, analysis(axes=(following(0.05), slower)))
    assert finding.remedy == "Raise SIGMA_A."
    assert "(5.0% in variance), the gain is 0.050, and the filter needs 5 s" in finding.message
    assert finding.evidence["response_s"] == pytest.approx(5.0)
    for asked, more in (
        (Noise(2.3456, 2.0, 3.0), " [--sigma-a 2.35|1|2.35|None]."), (Noise(None, None, 3.0), ""),
    ):  # fmt: skip
        one = analysis(axes=(following(0.05),), tuning=tuned(None, asked))
        assert only(noises.process_noise_near_zero, one).remedy == f"Raise SIGMA_A.{more}"


# ---------------------------------------------------------------- variances


def kf(nis: float, name: str = "north", **parts: Any) -> Any:
    verdict = "variance understated" if nis > 1.0 else "variance overstated"
    return axis(name, kf=statement(nis, **{"verdict": verdict, **parts}))


def test_a_variance_that_is_off() -> None:
    for nis, expected in (
        (1.563, "warning"), (1.56, None), (3.99, "warning"), (4.0, "error"), (0.25, "error"),
        (0.251, "warning"), (0.641, None), (0.639, "warning"),
    ):  # fmt: skip
        assert severity(noises.variances, analysis(axes=(kf(nis),))) == expected, nis
    assert severity(noises.variances, analysis(axes=(kf(9.0, verdict="consistent"),))) is None


def test_one_finding_for_the_horizontal_axes_with_the_vertical_one_behind() -> None:
    axes = (kf(2.0), kf(3.0, "east"), kf(9.0, "down"), kf(0.1, "aisle"))
    found = tuple(noises.variances(analysis(axes=axes)))
    assert [(one.id, one.caused_by, one.evidence["axis"]) for one in found] == [
        ("kf_variance_overstated", None, "aisle"), ("kf_variance_understated", None, "east"),
        ("kf_variance_understated", "kf_variance_understated", "down"),
    ]  # fmt: skip
    assert "understated 1.73 times in σ along east (mean NIS 3, consistent" in found[1].message
    assert group_by_cause(found) == found


def test_of_what_is_overstated_a_source_that_drifts_or_the_truth_forbids_to_lower_it() -> None:
    for nis, forbidden, level in ((0.2, True, "info"), (5.0, False, "error")):
        finding = only(noises.variances, analysis(axes=(kf(nis),), source=ODOMETRY))
        assert (finding.remedy == noises.AGAINST_DRIFT) is forbidden
        assert finding.severity == level
    for owner, there in (("kf", True), ("ekf2", False)):
        worse = {owner: statement(), f"{owner}_truth": against_truth(9.0)}
        finding = only(noises.variances, analysis(axes=(kf(0.2), axis("east", **worse))))
        assert (finding.remedy == noises.AGAINST_TRUTH) is there
        assert finding.evidence["cause"] == "elsewhere"


def test_our_own_noises_are_the_programs() -> None:
    for chosen, level in (
        ({}, "warning"), ({"sigma_z_m": 0.11}, "error"), ({"sigma_a_m_s2": 0.51}, "error"),
    ):  # fmt: skip
        one = analysis(axes=(kf(5.0),), settings=Settings(**chosen))
        assert severity(noises.variances, one) == level


def fused(noise_m: float, nis: float = 5.0, name: str = "north", **parts: Any) -> Any:
    """EKF2 that used this noise."""
    frame = pd.DataFrame({"observation_variance_m2": [9.0, noise_m**2, noise_m**2, 0.0]})
    verdict = "variance understated" if nis > 1.0 else "variance overstated"
    ekf2 = statement(nis, **{"verdict": verdict, **parts})
    return axis(name, ekf2=ekf2, ekf2_innovations=frame)


@pytest.mark.parametrize(
    ("flown", "used_m", "default"),
    [({}, 0.1, True), ({"EKF2_EVP_NOISE": 0.1}, 0.1, True), ({"EKF2_EVP_NOISE": 0.11}, 0.1, False),
     ({}, 0.124, True), ({}, 0.126, False), ({}, 0.081, True), ({}, 0.079, False)],
)  # fmt: skip
def test_ekf2s_noise_is_the_programs_unless_the_sender_chose_another(flown, used_m, default):
    assert _is_default(analysis(log=log(parameters=flown)), "ekf2", fused(used_m)) is default


@pytest.mark.parametrize(
    ("owner", "change", "kind", "says"),
    [
        ("kf", {"sigma_z_m": 2.0}, "measurement noise", "[--sigma-z 2|2|1|None]."),
        ("kf", {"sigma_a_m_s2": 0.3}, "process noise", "[--sigma-a 0.3|1|0.3|None]."),
        ("kf", {"sigma_a_m_s2": 0.3, "sigma_z_m": 2.0}, "measurement noise",
         "[--sigma-a 0.3 --sigma-z 2|2|0.3|None]."),
        ("kf", {"outliers_left_out": 9.0}, "outliers",
         "Remove the outliers (line of sight, anchor survey) rather than raise a noise for them."),
        ("kf", {"outliers_left_out": 9.0, "sigma_z_m": 2.0}, "outliers",
         "rather than raise a noise for them, and type px4fuse compare LOG --sigma-z 2."),
        ("kf", {"clock_offset_s": -0.25}, "clock", "Type px4fuse compare LOG --clock-offset -0.2"),
        ("kf", {"turned_deg": -20.0}, "frame",
         "Turn the positions by -20° before they are sent."),
        ("ekf2", {"outliers_left_out": 9.0}, "outliers", "Remove the outliers"),
        ("ekf2", {"EKF2_EV_DELAY": 90.0}, "clock", "{EKF2_EV_DELAY: 90 ms|delay_helps}"),
        ("ekf2", {"EKF2_EVP_NOISE": 0.3}, "measurement noise", "NOISE: 0.3 m|noise_helps}"),
        ("ekf2", {"EKF2_EVP_GATE": 5.0}, "gate", "{EKF2_EVP_GATE: 5 SD|rejects_less}"),
        ("ekf2", {"EKF2_ACC_NOISE": 0.35}, "process noise",
         "{EKF2_ACC_NOISE: 0.35 m/s^2|noise_helps}"),
    ],
)  # fmt: skip
def test_what_a_cause_asks_for(owner, change, kind, says, monkeypatch) -> None:
    def words(_: Any, changes: Any, helps: Any, *, fallback_remedy: str) -> str:
        ((name, value),) = changes.items()
        return f"{{{name}: {value:g} {PARAMETERS[name].unit}|{helps.__name__}}}"

    monkeypatch.setattr(since.remedy, "format_ekf2_remedy", words)
    model = SimpleNamespace(inputs=SimpleNamespace(settings=dict.fromkeys(PARAMETERS, 1.0)))
    # what explains less, and what explains the other way, is none
    causes = (tried(owner, {"sigma_z_m": 7.0}, explains=0.4), tried(owner, change),
              tried(owner, {"sigma_z_m": 7.0}, explains=1.6))  # fmt: skip
    one = axis("north", **{owner: statement(9.0, "variance understated")})
    finding = only(noises.variances, analysis(axes=(one,), causes=causes, ekf2_model=model))
    assert says in finding.remedy
    assert finding.evidence["cause"] == kind


def test_without_a_cause_what_was_tried_is_said() -> None:
    little = tried("kf", {"sigma_z_m": 7.0}, explains=0.4)
    causes = (little, tried("kf", {"sigma_z_m": 2.0}, "east"),
              tried("kf", {"clock_offset_s": 0.2}, explains=0.1))  # fmt: skip
    finding = only(noises.variances, analysis(axes=(kf(9.0),), causes=causes))
    assert finding.evidence["cause"] == "elsewhere"
    assert finding.remedy == (
        f"{noises.NOT_EXPLAINED} The nearest: SIGMA_Z is 1 instead of 7 m (replayed: mean NIS 9 "
        "→ 3.7)."
    )
    assert only(noises.variances, analysis(axes=(kf(9.0),))).remedy == noises.UNKNOWN_NOISE
    known = analysis(axes=(kf(9.0),), tuning=tuned())
    assert only(noises.variances, known).remedy == noises.NOT_EXPLAINED


def test_a_noise_below_what_the_rate_can_show_is_a_bound() -> None:
    for high, typed in ((0.0001, 0.005), (0.02, 0.02)):
        one = analysis(
            axes=(kf(0.2),), tuning=tuned(Noise(None, None, high)),
            causes=(tried("kf", {"sigma_z_m": typed}, before=0.2),),
        )  # fmt: skip
        finding = only(noises.variances, one)
        assert f"rate can show. [--sigma-z {typed}, and less SIGMA_A|{typed}|" in finding.remedy
        assert finding.evidence["sigma_z_asked_m"] == high
        assert finding.evidence["sigma_z_asked_is_upper_bound"] == 1.0


@pytest.mark.parametrize(
    ("one", "asked", "parameters", "says"),
    [
        (fused(0.1), Noise(0.3, 0.2, 0.4), {},
         "EKF2 takes it to be 0.1 m: set EKF2_EVP_NOISE to 0.3 m. Not replayed: no topic for it."),
        (fused(0.1, name="down"), Noise(0.3, 0.2, 0.4), {}, "is of horizontal position."),
        (fused(0.1), Noise(0.124, 0.12, 0.13), {}, "0.1 m: that is not it. Look at the clock (E"),
        (fused(0.1, 0.2), Noise(0.081, 0.08, 0.09), {}, "0.1 m: that is not it. Look at the clock"),
        # less noise where the sender reports more: its variances must not be used
        (fused(0.3, 0.2), Noise(0.1, 0.09, 0.11), {"EKF2_EVP_NOISE": 0.1},
         "set EKF2_EVP_NOISE to 0.1 m and EKF2_EV_NOISE_MD to 1."),
        (fused(0.3, 0.2), Noise(0.1, 0.09, 0.11), {"EKF2_EVP_NOISE": 0.25},
         "set EKF2_EVP_NOISE to 0.1 m. Not"),
        # PX4's least, and a bound
        (fused(0.3, 0.2), Noise(0.002, 0.001, 0.003), {}, "set EKF2_EVP_NOISE to 0.01 m. Not"),
        (fused(0.1), Noise(None, None, 0.2), {}, "noise is 0.2 m, EKF2 takes it to be 0.1 m: set"),
    ],
)  # fmt: skip
def test_what_is_asked_of_an_ekf2_that_cannot_be_replayed(one, asked, parameters, says) -> None:
    tuning = {**tuned(asked), "down": tuned(asked)["horizontal"]}
    flown = analysis(axes=(one,), log=log(parameters=parameters), tuning=tuning)
    assert says in only(noises.variances, flown).remedy


# ---------------------------------------------------------------- the loop and the drift


def closure(
    gnc: float | None = 1.0, *, accepted: bool = True, where: str = "landing", p: float = 0.5
) -> Closure:
    return Closure(
        time_1_s=10.0, time_2_s=90.0, sigma_m=0.1, source=where, distance_m=3.0, d2=25.0,
        degrees_of_freedom=2, p=p, accepted=accepted, weight_gnc=gnc,
    )  # fmt: skip


def loop(*closures: Closure, **parts: Any) -> Loop:
    """A loop with these properties, which are computed of others in a real one."""
    return made(Loop, closures=closures, **parts)


@pytest.mark.parametrize(
    ("closures", "expected"),
    [
        ((closure(0.5),), []), ((closure(None),), []),
        ((closure(0.49), closure()), ["loop_closure_doubtful"]),
        ((closure(0.0), closure(0.0), closure()), ["loop_drift_understated"]),
        ((closure(0.49),), ["loop_drift_understated"]),
        ((closure(0.0, accepted=False), closure()), ["false_loop_closure"]),
        ((closure(0.0, accepted=False),), ["loop_drift_understated", "false_loop_closure"]),
    ],
)  # fmt: skip
def test_closures(closures: tuple[Closure, ...], expected: list[str]) -> None:
    found = list(loops.closures(loop(*closures, is_end_assumed=False)))
    assert [finding.id for finding in found] == expected
    if expected == ["loop_drift_understated"]:
        dropped = sum((each.weight_gnc or 0.0) < 0.5 for each in closures)
        assert found[0].evidence == {"dropped": dropped, "closures": len(closures)}


def closing(gap_m: float | None, length_m: float = 50.0) -> Loop:
    return loop(closure_error_m=gap_m, path_length_m=length_m)


def test_what_may_drift_is_told_with_its_scatter_and_its_loop() -> None:
    finding = only(hidden_errors.detect, analysis(source=ODOMETRY))
    assert finding.evidence == {"source": "uwb"}
    assert finding.message.endswith("not where the vehicle was.")
    for noise, bound, value in (
        (Noise(0.02, 0.01, 0.03), "", 0.02), (Noise(None, None, 0.04), "at most ", 0.04)
    ):  # fmt: skip
        one = analysis(source=ODOMETRY, tuning=tuned(noise), loop=closing(1.25))
        finding = only(hidden_errors.detect, one)
        assert f"it scatters by {bound}{value} m" in finding.message
        assert finding.evidence["short_term_noise_m"] == value
        assert "misses by 1.25 m after 50 m." in finding.message
    assert named(hidden_errors.detect, analysis(source=MOVING)) == {}
    unclosed = only(hidden_errors.detect, analysis(source=ODOMETRY, loop=closing(None)))
    assert "misses" not in unclosed.message


# ---------------------------------------------------------------- the story


def flight_of(ours: Any, **parts: Any) -> Any:
    one = analysis(axes=(ours,), **{"source": MOVING, **parts})
    one.main = ours
    return one


def along(ekf2_nis: float, kf_nis: float, name: str = "aisle", **parts: Any) -> Any:
    ekf2, ours = (
        statement(nis, "consistent" if nis == 1.0 else "off") for nis in (ekf2_nis, kf_nis)
    )
    frame = pd.DataFrame({"position_m": [0.0]}, index=[10.0])
    usual = {"ekf2_state": frame, "difference": NONE}
    return axis(name, ekf2=ekf2, kf=ours, **{**usual, **parts})


def test_without_truth_both_are_judged_by_their_innovations() -> None:
    difference = made(Difference, position_rmse_m=0.05)
    (said,) = story(flight_of(along(1.0, 1.0, difference=difference)), ())
    assert said == (
        "Along the aisle ours and EKF2 are 5 cm apart (RMS), and the log has no truth: by their "
        "own innovations both are honest about it."
    )
    (said,) = story(flight_of(along(0.25, 4.0, difference=difference)), ())
    assert said.endswith(
        "by its own innovations EKF2 is 2 times too modest, our filter is 2 times too sure of "
        "itself."
    )
    mute = axis(
        "aisle", ekf2=NONE, kf=statement(1.0), ekf2_state=made(pd.DataFrame), difference=difference
    )
    (said,) = story(flight_of(mute), ())
    assert said.endswith(
        "by its own innovations EKF2 cannot be judged, since the log has no innovations or too "
        "few, our filter is honest about it."
    )
    (said,) = story(flight_of(along(0.25, 4.0), source=ODOMETRY), ())
    assert said.endswith("both follow uwb, which may drift.")


def judged(nis: float, **parts: Any) -> Any:
    return along(1.0, nis, ekf2_truth=against_truth(1.0), kf_truth=against_truth(1.0), **parts)


def test_since_is_said_of_a_cause_alone() -> None:
    change = {"sigma_z_m": 3.0}
    for explains, told in ((1.0, True), (0.5, True), (1.5, True), (0.49, False), (1.51, False)):
        causes = (tried("kf", change, "aisle", explains=explains),)
        said = story(flight_of(judged(9.0), causes=causes), ())[0]
        assert (", since SIGMA_Z is 1 instead of 3 m (replayed: mean NIS 9 → " in said) is told
        assert (
            said.endswith("too sure of itself, which nothing that was tried explains.") is not told
        )
    # of another axis, another filter, or another number
    for other in (tried("kf", change), tried("ekf2", change, "aisle"),
                  tried("kf", change, "aisle", "nees")):  # fmt: skip
        said = story(flight_of(judged(9.0), causes=(other,)), ())[0]
        assert said.endswith("3 times too sure of itself.")


def test_the_same_cause_of_both_is_told_once_and_its_finding_is_not_repeated() -> None:
    change = {"outliers_left_out": 38.0}
    causes = (tried("kf", change, "aisle"), tried("ekf2", change, "aisle", before=4.0))
    both = along(4.0, 9.0, ekf2_truth=against_truth(1.0), kf_truth=against_truth(1.0))
    one = flight_of(both, causes=causes)
    outliers = Finding("source_outliers", "error", "So.", "Do.", headline="Outliers")
    first, *more = story(one, (outliers,))
    assert "since 38 positions are outliers (replayed: mean NIS 4 → 1); our filter was" in first
    assert first.endswith("too sure of itself, for the same reason (replayed: mean NIS 9 → 1).")
    assert more == []


def test_why_ekf2_differs_is_told_where_no_cause_explains_it() -> None:
    change = {"sigma_z_m": 3.0}
    why = made(Why, cause="The rest is the noise.")
    for share, owner, told in ((0.5, "kf", True), (0.49, "kf", False), (0.9, "ekf2", False)):
        apart = replace(
            tried(owner, change, "aisle", "apart"), before=0.5, after=0.2, explains=share
        )
        one = flight_of(judged(9.0), causes=(tried("kf", change, "aisle"), apart),
                        why={"aisle": why})  # fmt: skip
        _, second = story(one, ())
        wanted = (
            "Put right in our filter, that brings both from 50 cm to 20 cm apart (RMS, replayed)."
        )
        assert second == (wanted if told else "The rest is the noise.")


def test_an_error_beyond_its_claim_has_its_own_causes() -> None:
    hides = along(1.0, 1.0, ekf2_truth=against_truth(1.0), kf_truth=against_truth(16.0))
    causes = (tried("kf", {"clock_offset_s": -0.25}, "aisle", "nees", before=16.0),)
    said = story(flight_of(hides, causes=causes), ())[0]
    assert said.endswith(", since the stamps are 0.25 s late (replayed: errors of 4 → 1 σ).")


def test_what_weighs_most_is_told_in_order() -> None:
    def found(name: str, level: Any = "error", **parts: Any) -> Finding:
        return Finding(name, level, "So.", "Do.", headline=f"It is {name}", **parts)

    why = made(Why, cause="The rest is the noise.")
    one = flight_of(along(1.0, 1.0), why={"aisle": why})
    told = story(one, (found("ekf2_resets"), found("no_motion", "info"), found("imu_gap")))
    assert told[1:] == ("It is imu_gap.", "The rest is the noise.")
    spans = ((20.0, 30.0),)
    told = story(one, (found("imu_gap", spans_s=spans),))
    assert told[1] == "It is imu_gap (20.0 s to 30.0 s)."
    dated = found("imu_gap", spans_s=spans, evidence={"at_s": 20.0})
    assert story(one, (dated,))[1] == "It is imu_gap."
    follows = found("imu_gap", caused_by="logger_dropouts")
    assert "imu_gap" not in "".join(story(one, (found("logger_dropouts"), follows)))
    looped = flight_of(along(1.0, 1.0), loop=closing(1.0, 200.0))
    assert story(looped, ())[1] == (
        "The odometry fails to close its loop by 1.0 m after 200 m (0.5%)."
    )
    assert len(story(flight_of(along(1.0, 1.0), loop=closing(None)), ())) == 1


def test_a_smaller_noise_that_the_truth_denies_is_no_cause() -> None:
    denied = replace(tried("kf", {"sigma_z_m": 0.5}, "aisle", before=0.2), denied_by_truth=True)
    one = flight_of(judged(0.2), causes=(denied,))
    assert story(one, ())[0].endswith("too modest, as its errors against the truth ask for.")
    finding = only(noises.variances, analysis(axes=(kf(0.2, "aisle"),), causes=(denied,)))
    assert (finding.remedy, finding.severity) == (noises.AGAINST_TRUTH, "info")
    assert finding.evidence["cause"] == "elsewhere"


def test_of_noise_that_no_setting_stands_for_no_setting_is_the_cause() -> None:
    causes = (tried("kf", {"sigma_z_m": 3.0}, "aisle"),)
    one = flight_of(judged(9.0), causes=causes)
    for name, level, told in (
        ("source_coloured", "warning", False), ("source_coloured", "info", True),
        ("source_outliers", "warning", True),
    ):  # fmt: skip
        found = Finding(name, level, "So.", "Do.", headline="It is so")  # type: ignore[arg-type]
        said = story(one, (found,))[0]
        assert (", since SIGMA_Z" in said) is told
        assert told or said.endswith("3 times too sure of itself.")
    # a clock that is off stays one, unless what smooths makes it late
    clock = (tried("kf", {"clock_offset_s": 0.25}, "aisle"),)
    shaped = Finding("source_coloured", "warning", "So.", "Do.", headline="It is so")
    assert ", since the stamps" in story(flight_of(judged(9.0), causes=clock), (shaped,))[0]
    smoothed = Finding("source_smoothed", "warning", "So.", "Do.", headline="It is so")
    assert "since" not in story(flight_of(judged(9.0), causes=clock), (smoothed,))[0]


@pytest.mark.parametrize(
    ("owner", "change", "said"),
    [
        ("kf", {"outliers_left_out": 1.0}, "1 position is an outlier"),
        ("kf", {"outliers_left_out": 2.0}, "2 positions are outliers"),
        # what was applied to ours is still missing to EKF2
        ("kf", {"clock_offset_s": 0.25}, "the stamps are 0.15 s early"),
        ("kf", {"clock_offset_s": 0.05}, "the stamps are 0.05 s late"),
        ("ekf2", {"clock_offset_s": 0.25}, "the stamps are 0.25 s early"),
        ("kf", {"turned_deg": -20.0}, "the positions are turned by +20°"),
        ("kf", {"sigma_a_m_s2": 0.3, "sigma_z_m": 0.2},
         "SIGMA_A is 1 instead of 0.3 m/s² and SIGMA_Z is 1 instead of 0.2 m"),
        ("ekf2", {"EKF2_EV_DELAY": 90.0, "EKF2_DELAY_MAX": 250.0},
         "EKF2_EV_DELAY is 7 instead of 90 ms"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_words(owner: Any, change: dict[str, float], said: str) -> None:
    model = SimpleNamespace(inputs=SimpleNamespace(settings=dict.fromkeys(PARAMETERS, 7.0)))
    one = analysis(settings=replace(CHOSEN, clock_offset_s=0.1), ekf2_model=model)
    assert since.format_change(one, tried(owner, change)) == said
