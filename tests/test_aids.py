"""EKF2's aiding sources: reading from logs of each release, and consistency tests."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from cli_tools import run, run_main
from exchange import replace
from findings_tools import NONE, SEGMENT, log, made, source
from flights import aisle_flight
from pypdf import PdfReader
from ulog_tools import gnss_log, seconds_of, stamps

from px4fuse.analysis import AidingSourceAnalysis, find_failed_checks
from px4fuse.comparison.model import FilterTracks
from px4fuse.ekf2.aids import AidResult, evaluate_aids
from px4fuse.errors import MissingDataError
from px4fuse.findings import ekf2_fusion, ekf2_state, find_aid_findings
from px4fuse.findings.ekf2_fusion import detect_aid_faults
from px4fuse.findings.model import CAUSE_KEY, INNOVATION_CHANGE_CAUSE, SOURCE_SENSOR_CAUSE
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.flight.model import AidLog, Ekf2, Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.readers.px4_positions import NO_FIX_ACTION
from px4fuse.results.reading import read_results

# --------------------------------------------------------------------------- evaluation

TIMES = np.arange(0.0, 60.0, 0.1)


def steps(*changes: tuple[float, float]) -> pd.Series:
    at, values = zip(*changes, strict=True)
    return pd.Series(values, index=pd.Index(at, name="time_s"))


def aid_log(
    *, sigma: float = 0.5, mean: float = 0.0, gate: float = 5.0, own: bool = True,
    enabled: pd.Series | None = None, **parameters: float,
) -> AidLog:  # fmt: skip
    """Return white innovations of standard deviation ``sigma``; reported √S 0.5, R half of S."""
    reported, axes = 0.5, ("north", "east")
    rng = np.random.default_rng(7)
    white = rng.normal(size=(len(TIMES), len(axes)))
    white = (white - white.mean(axis=0)) / white.std(axis=0)
    innovation = mean + sigma * white
    beyond = (np.abs(innovation) > gate * reported).any(axis=1).astype(float)
    columns: dict[str, Any] = {}
    for number, axis in enumerate(axes):
        columns[f"innovation_{axis}"] = innovation[:, number]
        columns[f"variance_{axis}"] = reported**2
        if own:
            columns[f"noise_{axis}"] = reported**2 / 2.0
            columns[f"ratio_{axis}"] = innovation[:, number] ** 2 / (gate * reported) ** 2
    if own:
        columns |= {"fused": 1.0 - beyond, "rejected": beyond}
    frame = pd.DataFrame(columns, index=pd.Index(TIMES, name="time_s"))
    return AidLog(("a_topic",), axes, frame, enabled, parameters)


def with_aids(**aids: AidLog) -> Flight:
    flight = aisle_flight(duration_s=60.0)
    return replace(flight, ekf2=replace(flight.ekf2, aids=aids))


def evaluate(log: AidLog, name: str = "gnss_pos") -> AidResult:
    return evaluate_aids(with_aids(**{name: log}))[name]


@pytest.mark.parametrize(("sigma", "verdict"), [
    (0.5, "consistent"), (0.58, "consistent"), (0.68, "overconfident"),
    (0.43, "consistent"), (0.37, "underconfident"),
])  # fmt: skip
def test_sensor_with_root_mean_nis_of_0_8_to_1_25_is_consistent(sigma, verdict) -> None:
    aid = evaluate(aid_log(sigma=sigma))
    assert aid.verdict == verdict
    assert aid.nis_mean == pytest.approx((sigma / 0.5) ** 2, rel=0.06)
    assert aid.axes["north"].sigma_ratio == pytest.approx(sigma / 0.5, rel=0.04)
    assert len(TIMES) - 5 < aid.axes["east"].samples <= len(TIMES)
    assert aid.axes["north"].s_sqrt_median == pytest.approx(0.5)


def test_aiding_source_with_large_mean_innovation_is_biased() -> None:
    assert evaluate(aid_log(mean=0.35)).verdict == "biased"
    assert evaluate(aid_log(mean=0.2)).verdict == "consistent"
    # small compared with √S: EKF2 hardly follows
    assert evaluate(aid_log(sigma=0.05, mean=0.09)).verdict == "underconfident"
    assert evaluate(aid_log(sigma=0.05, mean=0.11)).verdict == "biased"


def test_gap_of_disabled_aiding_source_is_not_reported() -> None:
    log = aid_log(enabled=steps((0.0, 1.0), (26.0, 0.0), (40.0, 1.0)))
    before_gap = log.samples.loc[:20.0]
    outage = evaluate(replace(log, samples=pd.concat([before_gap, log.samples.loc[40.0:]])))
    assert (outage.verdict, outage.longest_gap_s) == ("not_fused", (20.0, 40.0))
    # EKF2 disables the aiding source at once, so there is no gap
    enabled = steps((0.0, 1.0), (20.05, 0.0), (40.0, 1.0))
    given_up = evaluate(replace(log, samples=outage_free(log, 20.0, 40.0), enabled=enabled))
    assert given_up.verdict == "consistent"
    assert given_up.longest_gap_duration_s == pytest.approx(0.1, abs=0.01)
    assert given_up.enabled_fraction == pytest.approx(40.0 / 60.0, abs=0.02)


def outage_free(log: AidLog, start_s: float, end_s: float) -> pd.DataFrame:
    times = log.samples.index
    return log.samples[(times <= start_s) | (times >= end_s)]


def test_unfused_aiding_source_verdict_is_disabled_or_not_fused() -> None:
    log = aid_log()
    assert evaluate(replace(log, enabled=steps((0.0, 0.0)))).verdict == "disabled"
    few = evaluate(replace(log, samples=log.samples.iloc[::80], enabled=steps((0.0, 1.0))))
    assert (few.verdict, few.axes) == ("not_fused", {})
    three_hertz = pd.DataFrame(log.samples.iloc[:9])
    assert evaluate(replace(log, samples=three_hertz, enabled=steps((0.0, 1.0), (0.9, 0.0)))
                  ).verdict == "too few samples"  # fmt: skip


def test_samples_that_reset_ekf2_are_excluded_from_mean_nis() -> None:
    log = aid_log()
    samples = log.samples.copy()
    reset = samples.index[[100, 300]]
    for axis in log.axes:
        samples.loc[reset, f"innovation_{axis}"] = 0.0
        samples.loc[reset, f"variance_{axis}"] = samples[f"noise_{axis}"].iloc[0]
    aid = evaluate(replace(log, samples=samples))
    assert (aid.resets, aid.axes["north"].samples) == (2, evaluate(log).axes["north"].samples - 2)


def test_ekf2_gate_is_computed_from_test_ratio_or_parameter() -> None:
    assert evaluate(aid_log(gate=3.0)).gate == pytest.approx(3.0)
    assert evaluate(aid_log(own=False, EKF2_GPS_P_GATE=4.0)).gate == 4.0
    assert evaluate(aid_log(own=False, EKF2_GPS_P_GATE=0.0)).gate == 0.01
    assert evaluate(aid_log(own=False)).gate == AIDS["gnss_pos"].default_gate
    # without rejection flags the gate decides
    aid = evaluate(aid_log(own=False, sigma=1.0, EKF2_GPS_P_GATE=2.0))
    inside = 0.6827**2  # both axes within 1 σ
    assert aid.rejected_fraction == pytest.approx(1.0 - inside, abs=0.05)
    assert not aid.fused_logged


@pytest.mark.parametrize(("name", "parameters", "set_by"), [
    ("gnss_hgt", {"EKF2_GPS_P_NOISE": 0.5**0.5 / 3.0}, "EKF2_GPS_P_NOISE"),
    ("ev_yaw", {"EKF2_EVA_NOISE": 0.125}, "EKF2_EVA_NOISE"),
    ("gnss_pos", {"EKF2_GPS_P_NOISE": 0.5**1.5 / 1.019}, "EKF2_GPS_P_NOISE"),
    ("gnss_pos", {"EKF2_GPS_P_NOISE": 0.5**1.5 / 1.025},
     "the accuracy reported by the receiver"),
    ("mag", {"EKF2_MAG_NOISE": 0.05}, "EKF2_MAG_NOISE"),
    ("gnss_pos", {}, "the accuracy reported by the receiver"),
])  # fmt: skip
def test_aiding_source_report_names_its_noise_parameter(
    name: str, parameters: dict[str, float], set_by: str
) -> None:
    aid = evaluate(aid_log(**parameters), name)
    assert aid.noise == pytest.approx(0.5 * 0.5**0.5)
    assert aid.noise_from == set_by
    assert evaluate(aid_log(own=False, **parameters), name).noise_from == ""


def test_rarely_logged_aiding_source_is_unfused_after_longer_gap() -> None:
    """Rows of zeros are samples that EKF2 logged between two measurements."""
    log = aid_log(own=False, enabled=steps((0.0, 1.0)))
    decimated = replace(log, samples=log.samples.iloc[::10])
    for gap_s, verdict in ((7.6, "consistent"), (12.0, "not_fused")):
        samples = outage_free(decimated, 20.0, 20.0 + gap_s)
        assert evaluate(replace(decimated, samples=samples)).verdict == verdict


def test_aiding_source_fault_report_contains_sensor_and_times() -> None:
    log = aid_log()
    with_gap = replace(log, samples=outage_free(log, 20.0, 41.0), enabled=steps((0.0, 1.0)))
    found = evaluate_aids(with_aids(
        gnss_pos=with_gap, gnss_vel=with_gap, baro_hgt=aid_log(sigma=1.5), mag=aid_log(mean=-0.4),
        ev_pos=aid_log(sigma=9.0), rng_hgt=log,
    ))  # fmt: skip
    by_id = {one.id: one for one in find_aid_findings(found, aids_only())}
    assert set(by_id) == {"aid_not_fused", "aid_overconfident", "aid_innovation_bias"}
    assert "GNSS position, GNSS velocity" in by_id["aid_not_fused"].title
    assert by_id["aid_not_fused"].spans_s == ((20.0, 41.0),)
    assert "EKF2_BARO_NOISE" in by_id["aid_overconfident"].remedy
    assert by_id["aid_innovation_bias"].evidence["aid"] == "mag"
    assert by_id["aid_innovation_bias"].evidence["innovation_mean"] == pytest.approx(-0.4, abs=0.05)


@pytest.mark.parametrize(
    ("take_off_s", "height_error_m", "expected"),
    [
        ((), None, ("note", "EKF2 fused no sample of the barometer for 21 s")),
        ((9.9,), None, ("note", "EKF2 fused no sample of the barometer for 21 s")),
        ((10.1,), None, None),  # usual: the ground disturbs the pressure
        ((), 0.8, ("warning",
                   "EKF2 fused no sample of the barometer for 21 s: EKF2's height error is "
                   "0.80 m")),
    ],
)  # fmt: skip
def test_unfused_barometer_is_reported_only_with_height_error(
    take_off_s: tuple[float, ...], height_error_m: float | None, expected: Any
) -> None:
    log = aid_log()
    with_gap = replace(log, samples=outage_free(log, 20.0, 41.0), enabled=steps((0.0, 1.0)))
    barometer = {"baro_hgt": evaluate(with_gap, "baro_hgt")}
    found = detect_aid_faults(barometer, take_off_times_s=take_off_s, height_error_m=height_error_m)
    assert [(each.severity, each.title) for each in found] == ([expected] if expected else [])


@pytest.mark.parametrize(("error_m", "expected_m"), [(0.9, 0.9), (0.2, None)])
def test_ekf2_height_error_above_3_times_rmse_is_reported(
    error_m: float, expected_m: float | None
) -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    height_m = pd.Series(np.where(np.arange(600) % 2, 0.1, -0.1), time_s)
    height_m.loc[25.0:26.0] = error_m
    not_logged = Unavailable("σ", "not logged", "")
    ekf2 = FilterTracks(height_m.to_frame("position_m"), not_logged, not_logged)
    down = SimpleNamespace(
        tracks={"ekf2": ekf2},
        ekf2_tracks=ekf2,
        truth=pd.DataFrame({"position_m": 0.0}, index=time_s),
    )
    one = SimpleNamespace(axes={"down": down})
    found = ekf2_fusion._find_large_height_error_m(one, (20.0, 30.0))  # type: ignore[arg-type]
    assert found == (None if expected_m is None else pytest.approx(expected_m))
    assert ekf2_fusion._find_large_height_error_m(SimpleNamespace(axes={}), (0.0, 1.0)) is None  # type: ignore[arg-type]


def test_shift_of_mean_innovation_is_reported_with_its_time() -> None:
    log = aid_log()
    # windows of 10 s: from the window with the change, or the next one
    for from_s, expected_s in ((22.0, 20.0), (39.5, 40.0)):
        changed = log.samples.copy()
        changed.loc[from_s:, "innovation_east"] -= 0.7  # 1.4 √S
        found = evaluate(replace(log, samples=changed))
        assert found.axes["north"].change is None
        when_s, moved = found.axes["east"].change  # type: ignore[misc]
        assert when_s == pytest.approx(expected_s, abs=0.5)
        assert moved == pytest.approx(-1.4, abs=0.4)
    (finding,) = find_aid_findings({"mag": found}, aids_only())
    assert (finding.id, finding.severity, finding.evidence["axis"]) == (
        "aid_innovation_shift",
        "warning",
        "east",
    )
    # a change of KF's own source is another finding
    assert not [*detect_aid_faults({"gnss_vel": found}, "gnss_pos")]
    # an aiding source that EKF2 rejects after the change has the same finding
    rejected = replace(found, verdict="not_fused")
    (starved,) = detect_aid_faults({"gnss_vel": rejected}, "gnss_pos")
    assert starved.evidence[CAUSE_KEY] == SOURCE_SENSOR_CAUSE
    assert (
        next(detect_aid_faults({"mag": rejected}, "gnss_pos")).evidence[CAUSE_KEY]
        == INNOVATION_CHANGE_CAUSE
    )
    little = log.samples.copy()
    little.loc[35.0:, "innovation_east"] -= 0.2
    assert evaluate(replace(log, samples=little)).axes["east"].change is None


# ------------------------------------------------------------------------------ reading


@pytest.mark.parametrize("generation", ["v1.9", "v1.12", "v1.14", "v1.16"])
def test_innovation_sign_is_the_same_for_each_px4_release(generation, tmp_path):
    flight = read_log(gnss_log(generation).write(tmp_path / "a.ulg"))
    aids = flight.ekf2.aids  # type: ignore[union-attr]
    assert [name for name in aids if name in ("gnss_pos", "gnss_hgt", "baro_hgt")] == ["gnss_pos"]
    log, at = aids["gnss_pos"], seconds_of(stamps(20.0, 5.0))
    expected = -0.3 * np.random.default_rng(3).normal(size=(len(at), 2))
    np.testing.assert_allclose(log.samples.index, at, atol=1e-6)
    found = log.samples[["innovation_north", "innovation_east"]].to_numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert (log.samples["variance_north"] == 0.25).all()
    aid = evaluate_aids(flight)["gnss_pos"]  # type: ignore[index]
    assert aid.enabled_fraction == 1.0
    assert aid.fused_logged is (generation in ("v1.14", "v1.16"))
    assert aid.verdict == "underconfident"


# ---------------------------------------------------------------------------- reporting


def test_compare_with_option_checks_exits_with_1_on_sensor_fault(
    tmp_path, monkeypatch, capsys
) -> None:
    log, report = gnss_log("v1.16").write(tmp_path / "a.ulg"), tmp_path / "a.pdf"
    code, _, err = run_main(monkeypatch, capsys, "compare", log, "--checks", "-o", report)
    bad = [each.label for each in evaluate_aids(read_log(log)).values() if each.is_faulty]
    assert code == (1 if bad else 0)
    assert [line.partition(": ")[0] for line in err.splitlines()] == bad


@pytest.mark.parametrize(("sigma", "bad"), [(0.5, False), (0.25, False), (1.5, True)])
def test_underconfident_aiding_source_is_not_a_failed_check(sigma: float, bad: bool) -> None:
    made = with_aids(gnss_pos=aid_log(sigma=sigma))
    alone = AidingSourceAnalysis(
        made, evaluate_aids(made), Unavailable("it", "not there", "Log it.")
    )
    assert find_failed_checks(alone) == ({"GNSS position": "overconfident"} if bad else {})


def test_compare_of_log_without_position_evaluates_other_sensors(tmp_path: Path) -> None:
    log, report = gnss_log("v1.16").write(tmp_path / "a.ulg"), tmp_path / "a.pdf"
    done = run("compare", log, "-o", report)
    assert "no external position" in done.output
    found = read_results(report.with_suffix(".json").read_bytes())
    assert found.log.sha256 in PdfReader(report).pages[-1].extract_text().replace("\n", "")
    refused = run("verify", report, log).exception
    assert "has no results of KF or of a loop" in str(refused)


def test_compare_of_log_without_take_off_raises_an_error(tmp_path: Path) -> None:
    made = gnss_log("v1.16")
    made["vehicle_land_detected"]["landed"][:] = 1
    done = run("compare", made.write(tmp_path / "a.ulg"), "-o", tmp_path / "a.pdf")
    assert isinstance(done.exception, MissingDataError)
    assert "the vehicle never took off" in str(done.exception)
    assert "px4fuse info a.ulg" in str(done.exception)
    assert not (tmp_path / "a.pdf").exists()


def aids_only(**ekf2: Any) -> Any:
    """Make a flight without positions."""
    usual = {"primary_instances": ((0.5, 0),), "status_flags": {}, "fusion_flags": NONE}
    return SimpleNamespace(
        ekf2=made(Ekf2, **{**usual, **ekf2}), airborne=((5.0, 50.0),), log=log(), missing=()
    )


def test_aiding_source_report_lists_ekf2_instance_changes() -> None:
    (finding,) = find_aid_findings(
        {}, aids_only(primary_instances=((0.5, 0), (12.0, 1), (13.5, 0)))
    )
    assert (finding.id, finding.evidence["count"]) == ("ekf2_instance_switch", 2)
    assert not find_aid_findings({}, aids_only())


def test_log_without_positions_reports_unaligned_ekf2_heading() -> None:
    states = {"tilt_align": pd.Series([1.0], [0.0]), "yaw_align": pd.Series([0.0], [0.0])}
    (finding,) = find_aid_findings({}, aids_only(status_flags=states))
    assert finding.id == "ekf2_not_aligned"
    assert "heading" in finding.title
    assert finding.remedy.startswith("Calibrate the magnetometer")


def test_gnss_without_fix_is_reported() -> None:
    flight = aids_only()
    reason = "the log has 9 vehicle_gps_position, none with a 3D fix"
    flight.missing = (Unavailable("", reason, NO_FIX_ACTION, "vehicle_gps_position"),)
    (finding,) = find_aid_findings({}, flight)
    assert finding.id == "source_without_position"
    assert "none with a 3D fix" in finding.message


def test_ekf2_heading_advice_without_magnetometer_is_vision_yaw() -> None:
    flight = aids_only(status_flags={"yaw_align": pd.Series([0.0], [0.0])})
    flight.log = log(parameters={"EKF2_EV_CTRL": 9, "EKF2_MAG_TYPE": 5})
    (finding,) = ekf2_state.detect_missing_alignment(flight, SEGMENT, source())
    assert "the orientation, which is missing or constant, and let EKF2 fuse" in finding.remedy
    assert "Calibrate the magnetometer" not in finding.remedy
