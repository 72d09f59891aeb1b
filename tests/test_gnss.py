"""GNSS as a position source: position, time and noise of fixes as EKF2 uses them."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import findings_tools
import numpy as np
import pandas as pd
import pytest
from comparisons import compare, prepare
from exchange import replace
from findings_tools import analysis as stand_in
from findings_tools import late, made
from scipy.spatial.transform import Rotation, Slerp
from ulog_tools import Log, gnss_log, position, seconds_of, stamps, take, topic

import px4fuse
from px4fuse.comparison.preparation import choose_source
from px4fuse.core.arrays import rms
from px4fuse.diagnose import prepare_comparison
from px4fuse.ekf2.aids import AidResult
from px4fuse.ekf2.inputs import _make_fusion_rules, read_gnss
from px4fuse.ekf2.inputs import prepare_inputs as prepare_replay
from px4fuse.ekf2.model import Ekf2Model
from px4fuse.ekf2.replay import is_inside_spans
from px4fuse.ekf2.whatif import Ekf2Statistics, what_if
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.findings import find, noises
from px4fuse.flight.model import (
    GNSS_ORIGIN,
    Columns,
    Flight,
    FusionRecord,
    PositionTrack,
    Unavailable,
)
from px4fuse.readers import px4_fixes, read_log
from px4fuse.readers.px4_fixes import reconstruct_fixes
from px4fuse.report.clock import make_time_offset_advice
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

EARTH_M = 6_371_000.0
ORIGIN = (47.4, 8.5, 488.0)
SECONDS = 20.0


def geographic(local: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Convert local positions (m) to degrees, degrees and metres on a locally flat earth."""
    north, east, down = local.T
    latitude = origin[0] + np.degrees(north / EARTH_M)
    longitude = origin[1] + np.degrees(east / (EARTH_M * np.cos(np.radians(origin[0]))))
    return np.stack([latitude, longitude, origin[2] - down], axis=1)


def outdoors(
    generation: str = "v1.16", rate_hz: float = 5.0, late_s: float = 0.11,
    own_s: float | None = None, eph_m: float = 0.4, fused: bool = True, **parameters: float,
) -> Log:  # fmt: skip
    """Return a log of a GNSS flight whose fixes have timestamps ``late_s`` after the measurement.

    ``own_s``: age of the fix at its timestamp according to the receiver driver.
    """
    log = gnss_log(generation)
    measured = stamps(SECONDS, rate_hz, 0.2)
    places = geographic(position(seconds_of(measured)))
    old = int(generation.removeprefix("v1.")) < 14
    fields: dict[str, Any] = {
        "eph": np.full(len(measured), eph_m), "epv": np.full(len(measured), 0.7),
        "fix_type": np.full(len(measured), 3, np.uint8),
    }  # fmt: skip
    if old:
        names, scales = ("lat", "lon", "alt"), (1e7, 1e7, 1e3)
        fields |= {n: np.round(v * s).astype(np.int32)
                   for n, v, s in zip(names, places.T, scales, strict=True)}  # fmt: skip
    made = topic("vehicle_gps_position", measured + np.uint64(round(late_s * 1e6)), fields)
    if not old:  # float32 is too coarse for degrees
        for name, values in zip(("latitude_deg", "longitude_deg", "altitude_msl_m"), places.T,
                                strict=True):  # fmt: skip
            made.fields[name] = values.copy()
    if own_s is not None:
        made.fields["timestamp_sample"] = made.fields["timestamp"] - np.uint64(round(own_s * 1e6))
    log.add(made)
    local = log["vehicle_local_position"]
    for name, value in zip(("ref_lat", "ref_lon", "ref_alt"), ORIGIN, strict=True):
        local[name] = np.full(len(local["timestamp"]), value)
    if not fused:
        log.drop(*(name for name in log.names() if "gnss" in name))
    log.parameters |= {"EKF2_GPS_P_NOISE": 0.5, "EKF2_GPS_DELAY": 110.0, **parameters}
    return log


def flight_of(log: Log, folder: Path) -> Flight:
    return read_log(log.write(folder / "a.ulg"))


def test_gnss_positions_without_fix_are_invalid(tmp_path: Path) -> None:
    log = outdoors("v1.16")
    log["vehicle_gps_position"]["fix_type"][10:20] = 1
    (track,) = (one for one in flight_of(log, tmp_path).positions if one.origin.is_gnss)
    assert track.invalid_reasons.tolist() == ["no fix"] * 10
    assert not track.invalid_reasons.index.isin(track.samples.index).any()


def track_of(flight: Flight) -> PositionTrack:
    return next(track for track in flight.positions if track.name == "vehicle_gps_position")


@pytest.mark.parametrize("generation", ["v1.9", "v1.12", "v1.14", "v1.16"])
def test_gnss_fixes_have_position_and_time_that_ekf2_uses(generation, tmp_path):
    """Relative to EKF2's origin, and EKF2_GPS_DELAY before their timestamps."""
    track = track_of(flight_of(outdoors(generation), tmp_path))
    times = track.samples.index.to_numpy()
    np.testing.assert_allclose(times, seconds_of(stamps(SECONDS, 5.0, 0.2)), atol=1e-6)
    exact_m = 0.012 if generation in ("v1.9", "v1.12") else 1e-4  # m, resolution of 1e-7 degrees
    measured = track.samples[Columns.POSITION].to_numpy()
    np.testing.assert_allclose(measured, position(times), atol=exact_m)
    assert track.clock == "autopilot boot clock: timestamp minus EKF2_GPS_DELAY (110 ms)"
    # EKF2 uses eph for each axis
    np.testing.assert_allclose(track.samples["east_m2"], 0.16, rtol=1e-6)
    np.testing.assert_allclose(track.samples["down_m2"], 0.49, rtol=1e-6)


@pytest.mark.parametrize(("parameters", "own_s", "expected_s"), [
    ({"EKF2_GPS_DELAY": 0.0}, 0.03, 0.11),  # the timestamp
    ({}, 0.03, 0.0),  # the timestamp minus 110 ms, independent of the driver
    ({"EKF2_GPS_MODE": 0}, 0.03, 0.11 - 0.03),  # main of 2026: measurement time of the driver
    ({"EKF2_GPS_MODE": 0}, 0.0, 0.0),  # without one: the delay
])  # fmt: skip
def test_gnss_fix_time_is_driver_time_if_px4_has_ekf2_gps_mode(
    parameters, own_s, expected_s, tmp_path
):
    track = track_of(flight_of(outdoors(own_s=own_s, **parameters), tmp_path))
    first = seconds_of(stamps(SECONDS, 5.0, 0.2))[0]
    assert track.samples.index[0] - first == pytest.approx(expected_s, abs=1e-6)


def test_gnss_track_from_topic_vehicle_gnss_equals_older_topic(tmp_path):
    """vehicle_gnss contains the receiver's message; its timestamp_sample includes the delay."""
    log = with_velocity(outdoors(own_s=0.03, EKF2_GPS_MODE=0))
    before = track_of(flight_of(log, tmp_path))
    old = log["vehicle_gps_position"]
    renamed = {
        "latitude_deg": "latitude", "longitude_deg": "longitude", "altitude_msl_m": "altitude_msl",
        "vel_n_m_s": "vel_north", "vel_e_m_s": "vel_east", "vel_d_m_s": "vel_down",
        "s_variance_m_s": "speed_accuracy",
    }  # fmt: skip
    made = topic("vehicle_gnss", old["timestamp"].astype(np.uint64), {})
    made.fields.update({  # type: ignore[attr-defined]
        f"receiver.{renamed.get(name, name)}": values.copy() for name, values in old.items()
    })  # fmt: skip
    made.fields["timestamp_sample"] = old["timestamp_sample"].copy()
    made.fields["antenna_offset"] = np.tile(
        np.array([0.1, 0.0, -0.2], np.float32), (len(old["timestamp"]), 1)
    )
    log.drop("vehicle_gps_position")
    log.add(made)
    track = track_of(flight_of(log, tmp_path))
    assert track.topics == ("vehicle_gnss",)
    pd.testing.assert_frame_equal(track.samples, before.samples)
    pd.testing.assert_frame_equal(track.velocity, before.velocity)
    assert track.lever_arm_m == pytest.approx((0.1, 0.0, -0.2))


def test_compare_subtracts_gnss_antenna_lever_arm(tmp_path):
    moved = flight_of(outdoors(EKF2_GPS_POS_X=0.3, EKF2_GPS_POS_Z=-0.2), tmp_path)
    antenna, vehicle = track_of(moved), compare(moved).source
    assert antenna.lever_arm_m == pytest.approx((0.3, 0.0, -0.2))
    assert "0.3 m forward" in vehicle.notes[-1]
    at = antenna.samples.index.to_numpy()
    known = moved.attitude.index.to_numpy()
    turned = Slerp(known, Rotation.from_quat(
        moved.attitude.to_numpy(copy=True), scalar_first=True
    ))(np.clip(at, known[0], known[-1]))  # fmt: skip
    expected = antenna.samples[Columns.POSITION].to_numpy() - turned.apply([0.3, 0.0, -0.2])
    np.testing.assert_allclose(vehicle.samples[Columns.POSITION], expected, atol=1e-4)
    assert compare(flight_of(outdoors(), tmp_path)).source.notes == ()


def test_default_position_source_is_gnss_only_if_ekf2_fused_it(tmp_path):
    flight = flight_of(outdoors(), tmp_path)
    track, reason = choose_source(flight)
    assert track.name == "vehicle_gps_position"
    assert reason == "the only position source in the log, fused by EKF2"
    prepared = prepare(flight)
    assert [line.name for line in prepared.input_axes] == ["aisle", "north", "east"]
    # external vision is not reported as missing
    assert not [part for part in prepared.missing if "vision" in f"{part.reason} {part.remedy}"]
    never = flight_of(outdoors(fused=False), tmp_path)
    assert not track_of(never).origin.is_selectable_by_default


@pytest.mark.parametrize(("eph_m", "least_m", "axes", "expected_m"), [
    (0.4, 0.5, (), 0.5),
    (0.8, 0.5, (), 0.8),
    (0.4, 0.2, ("down",), 0.7),  # epv
    (0.4, 0.5, ("down",), 0.75),  # 1.5 times EKF2_GPS_P_NOISE
])  # fmt: skip
def test_default_kf_measurement_noise_equals_ekf2_gnss_noise(
    eph_m, least_m, axes, expected_m, tmp_path
):
    flight = flight_of(outdoors(eph_m=eph_m, EKF2_GPS_P_NOISE=least_m), tmp_path)
    request = ComparisonRequest(log="a.ulg", axes=axes)
    prepared = prepare_comparison(flight, request)
    assert prepared.settings.sigma_z_m == pytest.approx(expected_m, rel=1e-3)
    requested = ComparisonRequest(log="a.ulg", axes=axes, sigma_z_m=0.3)
    assert prepare_comparison(flight, requested).settings.sigma_z_m == 0.3


def test_compare_of_gnss_flight_uses_gnss_innovations(tmp_path):
    flight = flight_of(outdoors(), tmp_path)
    ekf2 = prepare(flight).flight.ekf2
    north, down = ekf2.innovations["north"], ekf2.innovations["down"]
    logged = 0.3 * np.random.default_rng(3).normal(size=(len(north), 2))
    np.testing.assert_allclose(north["innovation_m"], -logged[:, 0], rtol=1e-6)
    np.testing.assert_allclose(north["observation_variance_m2"], 0.16, rtol=1e-6)
    assert isinstance(down, Unavailable)
    assert down.reason == "EKF2 never fused the height from GNSS in this log"
    assert ekf2.innovation_topics == ("estimator_aid_src_gnss_pos",)
    assert ekf2.gate == 5.0
    # the flight itself is unchanged
    assert isinstance(flight.ekf2.innovations["north"], Unavailable)  # type: ignore[union-attr]


ALTITUDE_OFF_M = 37.0


def with_barometer(log: Log, *, fused: bool = True) -> Log:
    """Return the log with a barometer altitude, offset by a constant, and its fusion."""
    at = stamps(SECONDS, 5.0, 0.1)
    altitude_m = ORIGIN[2] + ALTITUDE_OFF_M - position(seconds_of(at))[:, 2]
    log.add(topic("vehicle_air_data", at, {"baro_alt_meter": altitude_m}, sampled=True))
    if fused:
        flags = log["estimator_status_flags"]
        flags["cs_baro_hgt"] = np.ones(len(flags["timestamp"]), np.bool_)
        logged, ones = np.full(len(at), 0.2), np.ones(len(at))
        log.add(topic("estimator_aid_src_baro_hgt", at, {
            "innovation": logged, "innovation_variance": 0.25 * ones,
            "observation_variance": 0.16 * ones, "test_ratio": logged, "fused": ones > 0.0,
            "innovation_rejected": ones < 0.0,
        }, sampled=True))  # fmt: skip
    log.parameters["EKF2_BARO_NOISE"] = 0.4
    return log


def test_height_measurement_of_gnss_flight_is_fused_barometer(tmp_path):
    flight = flight_of(with_barometer(outdoors()), tmp_path)
    request = ComparisonRequest(log="a.ulg", axes=("down", "north"))
    prepared = prepare_comparison(flight, request)
    down, north = prepared.input_axes
    at = down.measurement_time_s
    np.testing.assert_allclose(at % 0.2, 0.1, atol=1e-6)  # barometer times, not fix times
    np.testing.assert_allclose(down.measurement_m, position(at)[:, 2], atol=1e-4)
    np.testing.assert_allclose(north.measurement_m, position(north.measurement_time_s)[:, 0],
                               atol=1e-4)  # fmt: skip
    assert prepared.settings.sigma_z_m == pytest.approx(0.4)  # EKF2_BARO_NOISE
    innovations = prepared.flight.ekf2.innovations["down"]  # type: ignore[union-attr]
    np.testing.assert_allclose(innovations["innovation_m"], -0.2, rtol=1e-6)
    is_fused_as_gnss = prepare_comparison(flight, replace(request, height="gnss"))
    assert not np.isin(is_fused_as_gnss.input_axes[0].measurement_time_s, at).any()
    assert isinstance(is_fused_as_gnss.flight.ekf2.innovations["down"], Unavailable)  # type: ignore[union-attr]


def test_unfused_barometer_height_is_used_only_if_requested(tmp_path):
    flight = flight_of(with_barometer(outdoors(), fused=False), tmp_path)
    assert prepare(flight, axes=("down",)).source.barometer is None
    requested = prepare(flight, axes=("down",), height="barometer")
    assert requested.source.barometer is not None
    bare = flight_of(outdoors(), tmp_path)
    with pytest.raises(MissingDataError, match="the log contains no barometer height"):
        prepare(bare, height="barometer")
    vision = simulate_flight(make_scenario("aisle", seed=1))
    with pytest.raises(SettingsError, match="`height` needs GNSS as position source"):
        prepare(vision, height="gnss")


@pytest.mark.reallogs
def test_height_measurement_of_px4_v1_13_log_is_barometer(shared_logs):
    """EKF2 of v1.13 uses the barometer height by default."""
    log = shared_logs / "gps" / "v1.13.3_gps_profile1.ulg"
    analysis = px4fuse.compare(log, axes="down")
    ekf2, kf = (analysis.axes["down"].filters[name] for name in ("ekf2", "kf"))
    aid = analysis.aids["baro_hgt"].axes["down"]  # type: ignore[index]
    assert ekf2.nis_mean == pytest.approx(aid.nis_mean, rel=0.02)  # type: ignore[union-attr]
    assert kf.truth.position_rmse_m < 0.35  # type: ignore[union-attr]
    assert kf.verdict == "consistent"  # type: ignore[union-attr]
    texts = " ".join(f"{item.message} {item.remedy}" for item in find(analysis))
    assert "EKF2_GPS" not in texts


@pytest.mark.parametrize("fused", [True, False])
def test_ground_truth_of_gnss_flight_is_relative_to_ekf2_origin(fused, tmp_path):
    log = outdoors(fused=fused)
    home = (ORIGIN[0] + 1e-5, ORIGIN[1] - 2e-5, ORIGIN[2] + 0.5)
    times = stamps(SECONDS, 20.0)
    here = position(seconds_of(times))
    east_m = -np.radians(2e-5) * EARTH_M * np.cos(np.radians(ORIGIN[0]))
    shift = np.array([np.radians(1e-5) * EARTH_M, east_m, -0.5])
    about_home = dict(zip(("x", "y", "z"), (here - shift).T, strict=True))
    velocity = {name: np.zeros(len(times)) for name in ("vx", "vy", "vz")}
    everywhere = topic("vehicle_global_position_groundtruth", times, {})
    for name, values in zip(("lat", "lon", "alt"), geographic(here - shift, home).T, strict=True):
        everywhere.fields[name] = values.copy()
    log.add(topic("vehicle_local_position_groundtruth", times, about_home | velocity), everywhere)
    truth = flight_of(log, tmp_path).truth
    expected = here if fused else here - shift
    np.testing.assert_allclose(truth.samples[Columns.POSITION], expected, atol=1e-3)


@pytest.mark.parametrize(("least_m", "eph_m", "expected"), [
    (2.0, 0.3, True), (0.5, 0.45, False), (0.5, 0.9, False), (None, 0.3, False),
])  # fmt: skip
def test_ekf2_gps_p_noise_above_receiver_sigma_is_reported(
    least_m, eph_m, expected, tmp_path, monkeypatch
):
    log = outdoors(eph_m=eph_m)
    log.parameters.pop("EKF2_GPS_P_NOISE")
    if least_m is not None:
        log.parameters["EKF2_GPS_P_NOISE"] = least_m
    prepared = prepare(flight_of(log, tmp_path))
    monkeypatch.setattr(findings_tools, "SEGMENT", prepared.segment)
    words = noises._format_action_for_excessive_noise(
        stand_in(source=prepared.source, log=prepared.flight.log)
    )
    assert bool(words) is expected
    if expected:
        assert words.startswith(
            "EKF2_GPS_P_NOISE is 2 m, but the noise that the receiver reports is 0.3 m."
        )


# -------------------------------------------------------------------- flights of PX4's EKF2

# By flight: first finding above a note; verdicts of aiding sources; reason without EKF2 replay
FLIGHTS: dict[str, tuple[str | None, dict[str, str], str]] = {
    "main202603_gps_outage_flow":
        ("source_without_position", {"gnss_pos": "not_fused", "gnss_vel": "not_fused"}, ""),
    "v1.13.3_gps_profile1":
        (None, {"gnss_pos": "consistent", "gnss_vel": "consistent"},
         "GNSS is logged at 3.0 Hz"),
    "v1.14.4_gps_magdist":
        ("aid_innovation_shift", {"gnss_pos": "consistent", "mag": "biased"},
         "GNSS is logged at 3.4 Hz"),
    "v1.16.1_gps_delay0":
        ("source_time_offset", {"gnss_pos": "consistent", "gnss_vel": "consistent"}, ""),
    "v1.16.1_gps_fullrate": (None, {"gnss_pos": "consistent", "gnss_hgt": "consistent"}, ""),
    "v1.16.1_gps_nominal": (None, {"gnss_pos": "consistent", "gravity": "disabled"}, ""),
    "v1.16.1_gps_overconfident":
        ("ekf2_noise_too_small",
         {"gnss_pos": "overconfident", "gnss_vel": "consistent"}, ""),
    "v1.16.1_gps_stock_flow":
        (None, {"gnss_pos": "underconfident", "rng_hgt": "underconfident"}, ""),
}  # fmt: skip
# Minimum number of fixes reconstructed from innovations in flights logged at 2 Hz
REBUILT_FROM_INNOVATIONS_ORIGIN = {"v1.13.3_gps_profile1": 100, "v1.14.4_gps_magdist": 200}
STAMP_S = 0.016  # s, simulation steps of 8 ms from a fix to its timestamp and to the filter
OF_OTHERS = ("EKF2_EV", "vision", "anchor", "UWB", "line of sight", " tag ")


@pytest.mark.reallogs
@pytest.mark.parametrize("name", FLIGHTS)
def test_compare_of_real_gnss_flights_equals_reference_numbers(name, shared_logs):
    folder = shared_logs / "gps"
    analysis = px4fuse.compare(folder / f"{name}.ulg")
    injected = json.loads((folder / f"{name}.json").read_text())
    truth = injected["truth"]
    assert analysis.source.name == "vehicle_gps_position"
    # position RMSE of EKF2, from take-off to landing
    for axis, stated in zip(("north", "east"), truth["ekf2_rmse_m_ned"], strict=False):
        found = analysis.axes[axis].filters["ekf2"].truth
        assert found.position_rmse_m == pytest.approx(stated, rel=0.1, abs=0.01)  # type: ignore[union-attr]
    # age of a fix beyond the delay parameter
    parameters = analysis.flight.log.parameters
    age_ms = injected["simulated_sensors"].get("GPS_LAT_MS", 0.0)
    low_s, high_s = analysis.time_offset.interval_s  # type: ignore[union-attr]
    left_s = 1e-3 * (parameters["EKF2_GPS_DELAY"] - age_ms)
    assert low_s - STAMP_S <= left_s <= high_s + STAMP_S
    findings = find(analysis)
    first, verdicts, reason = FLIGHTS[name]
    loud = [one.id for one in findings if one.severity != "note"]
    assert loud[:1] == [first] if first else not loud
    texts = " ".join(f"{item.message} {item.remedy}" for item in findings)
    assert not [word for word in OF_OTHERS if word in texts]
    assert isinstance(analysis.ekf2_model, Unavailable) == bool(reason)
    assert not reason or re.search(reason, analysis.ekf2_model.reason)
    assert verdicts == {aid: analysis.aids[aid].verdict for aid in verdicts}
    assert compare_mean_nis(analysis.aids, truth) >= 2
    if name in REBUILT_FROM_INNOVATIONS_ORIGIN:
        track = track_of(analysis.flight)
        assert "2.0" in track.notes[0]
        pattern = r"^(\d+) GNSS fixes are not logged.*RMS error of ([\d.]+) m"
        count, exact_m = re.findall(pattern, track.notes[1])[0]
        assert int(count) > REBUILT_FROM_INNOVATIONS_ORIGIN[name]
        assert float(exact_m) < 0.1
        assert track.compute_rate_hz() > 2.9


@pytest.mark.reallogs
def test_smaller_gnss_noise_is_advised_if_nees_is_consistent(shared_logs):
    analysis = px4fuse.compare(shared_logs / "simulated" / "v1.16.1_no_uwb.ulg")
    remedies = {one.id: one.remedy for one in find(analysis)}
    assert remedies["kf_underconfident"].startswith("Set SIGMA_Z to 0.1")
    assert "noise that the receiver reports (0.9 m)" in remedies["ekf2_underconfident"]


def compare_mean_nis(found: dict[str, AidResult], truth: dict[str, Any]) -> int:
    """Compare the mean NIS of aiding sources with independent values; return their number."""
    stated = {
        # the stated number excludes rejected samples otherwise
        aid: one["mean_nis" if one["rejected_share"] > 0.0 else "mean_nis_fused"]
        for aid, one in truth["aid_sources"].items()
        if aid in found and found[aid].axes
    }
    if not truth["aid_sources"]:
        for aid, fields in (("gnss_pos", ("gps_hpos[0]", "gps_hpos[1]")),
                            ("gnss_vel", ("gps_hvel[0]", "gps_hvel[1]", "gps_vvel"))):  # fmt: skip
            logged = truth["estimator_innovations"]
            stated[aid] = [logged[field]["mean_nis"] for field in fields]
    for aid, expected in stated.items():
        # the flight begins above the ground by the barometer here, at take-off in the reference
        nis = [axis.nis_mean for axis in found[aid].axes.values()]
        assert nis == pytest.approx(expected, rel=0.03, abs=0.002), aid
    return len(stated)


REPLAYED = ("delay0", "fullrate", "nominal", "overconfident")


@pytest.fixture(scope="module")
def models(shared_logs: Path, model_of: Any) -> dict[str, Ekf2Model]:
    found = {}
    for name in REPLAYED:
        model = model_of(shared_logs / "gps" / f"v1.16.1_gps_{name}.ulg")
        assert model.inputs.mean_step_s == pytest.approx(0.008, abs=1e-6)
        found[name] = model
    return found


@pytest.mark.reallogs
def test_ekf2_replay_of_real_gnss_flights_agrees_with_log(models):
    """EKF2 rejects no fix on most of the flights, and almost half of the fixes on one."""
    for name in ("delay0", "fullrate", "nominal"):
        agreement = models[name].agreement
        assert agreement.good
        assert agreement.ev_pos == {}
        assert list(agreement.gnss_vel) == ["north", "east", "down"]
        for aid, least in ((agreement.gnss_pos, 0.998), (agreement.gnss_vel, 0.999)):
            for axis in aid.values():
                assert axis.innovation_correlation > least
                # the logger omits 1 of 24 fixes
                assert axis.s_ratio_median == pytest.approx(1.0, abs=0.002)
        assert all(axis.position_rms_difference_m < 0.03 for axis in agreement.gnss_pos.values())
        assert agreement.rejected_fraction_replayed == agreement.rejected_fraction_logged == 0.0
    for axis in models["fullrate"].agreement.gnss_pos.values():
        assert axis.innovation_correlation > 0.9999
        assert axis.innovation_rms_difference < 0.004
        assert axis.position_rms_difference_m < 0.004
    rejecting = models["overconfident"].agreement
    assert rejecting.good
    assert rejecting.rejected_fraction_replayed == pytest.approx(
        rejecting.rejected_fraction_logged, abs=0.01
    )
    for axis in (*rejecting.gnss_pos.values(), *rejecting.gnss_vel.values()):
        assert axis.innovation_correlation > 0.997
        assert axis.s_ratio_p5 > 0.998
        assert axis.s_ratio_p95 < 1.004
        assert axis.position_rms_difference_m < 0.04


@pytest.mark.reallogs
def test_ekf2_replay_rmse_of_gnss_settings_equals_reference(models):
    """The simulated delay and noise; expected numbers are from an independent replay."""

    def error_m(name: str, **settings: float) -> tuple[float, float, float]:
        found = what_if(models[name], [settings])
        (after,) = found.whatif
        error = after.position_rmse_to_truth_m
        return error, after.nis_mean, after.rejected_fraction

    assert error_m("delay0")[0] == pytest.approx(0.688, rel=0.03)
    assert error_m("delay0", EKF2_GPS_DELAY=200.0)[0] == pytest.approx(0.233, rel=0.06)
    assert error_m("nominal", EKF2_GPS_P_NOISE=0.8)[:2] == pytest.approx((0.193, 0.26), rel=0.05)
    less = error_m("overconfident", EKF2_GPS_P_NOISE=0.72)
    assert less == pytest.approx((0.737, 0.41, 0.0), rel=0.05)


@pytest.mark.reallogs
def test_ekf2_replay_with_true_gnss_delay_reduces_heading_error(models):
    """An independent replay with a magnetometer gives 4.7° before and 1.5° after."""

    def heading_deg(name: str, **settings: float) -> tuple[float, float]:
        found = what_if(models[name], [settings])
        after, logged = found.whatif[0].heading_error_mean_deg, found.logged.heading_error_mean_deg
        assert found.replayed.heading_error_mean_deg == pytest.approx(logged, abs=0.4)
        return logged, after

    for model in models.values():
        assert {segment.magnetic_field is None for segment in model.inputs.segments} == {False}
        assert model.agreement.heading_rms_difference_deg < 0.5
        # height follows the logged EKF2 height
        state, replayed = (
            model.flight.ekf2.state["down_m"],
            model.baseline_replay.published_state["down_m"],
        )
        state = state[is_inside_spans(state.index, model.baseline_replay.find_evaluated_spans())]
        assert rms(np.interp(state.index, replayed.index, replayed) - state.to_numpy()) < 0.05
    assert heading_deg("delay0", EKF2_GPS_DELAY=200.0) == pytest.approx((4.7, 1.5), abs=0.3)
    # 110 ms of delay error rotate the heading in proportion to 4.7° for 200 ms
    logged, after = heading_deg("nominal", EKF2_GPS_DELAY=0.0)
    assert after - logged == pytest.approx(4.7 * 110.0 / 200.0, abs=0.6)
    # with a less weighted magnetometer the wrong delay rotates the heading further
    found = what_if(models["delay0"], [{"EKF2_MAG_NOISE": 0.5}])
    assert found.whatif[0].heading_error_mean_deg > found.replayed.heading_error_mean_deg + 0.2


@pytest.mark.reallogs
def test_ekf2_replay_without_aiding_source_predicts_state_error(models):
    """The error after 93 s agrees with the noise of the remaining aiding sources."""

    def without(*names: str) -> tuple[Ekf2Statistics, float]:
        found = what_if(models["nominal"], [{}], dict.fromkeys(names, 60.0))
        assert found.evaluated_s[0][0] == 60.0
        (after,) = found.whatif
        error = after.position_rmse_to_truth_m
        return after, error

    # 0.3 m/s of velocity noise at 10 Hz integrate to 0.9 m
    velocity_alone, error = without("gnss_pos")
    assert 0.4 < error < 1.5
    assert 0.2 < velocity_alone.nis_mean < 2.0
    assert without("gnss_vel")[1] == pytest.approx(0.2, abs=0.05)
    inertial, error = without("gnss_pos", "gnss_vel")
    assert error > 10.0
    assert inertial.nis_mean < 2.0
    no_field, error = without("mag")
    assert error == pytest.approx(0.155, abs=0.02)
    assert no_field.heading_error_mean_deg == pytest.approx(0.0, abs=1.0)


@pytest.mark.reallogs
def test_ekf2_replay_rejects_parameter_that_has_no_effect(models):
    with pytest.raises(SettingsError, match="the replay of this log fuses only gnss_pos"):
        what_if(models["nominal"], [{"EKF2_EVP_NOISE": 0.2}])
    own = replace(models["nominal"].inputs.received_positions, uses_sender_timestamps=True)
    model = replace(
        models["nominal"], inputs=replace(models["nominal"].inputs, received_positions=own)
    )
    with pytest.raises(SettingsError, match="EKF2_GPS_DELAY has no effect in a replay of this log"):
        what_if(model, [{"EKF2_GPS_DELAY": 50.0}])


def test_read_gnss_recovers_unlogged_fixes_from_innovations(tmp_path):
    log = outdoors(rate_hz=10.0)
    every = log["vehicle_gps_position"]
    count, fused_at = len(every["timestamp"]), every["timestamp"] - np.uint64(115_000)
    both = np.ones((count, 2))
    rows = topic("estimator_aid_src_gnss_pos", fused_at, {
        "innovation": 0.0 * both, "innovation_variance": both, "observation_variance": both,
        "test_ratio": 0.0 * both, "fused": np.ones(count, np.bool_),
        "innovation_rejected": np.zeros(count, np.bool_),
    }, sampled=True)  # fmt: skip
    rows.fields["observation"] = np.stack([every["latitude_deg"], every["longitude_deg"]], axis=1)
    rows.fields["fused"][60] = False  # no fix: neither fused nor rejected
    rows.fields["fused"][50], rows.fields["innovation_rejected"][50] = False, True
    speed = topic("estimator_aid_src_gnss_vel", fused_at, {
        "observation": np.tile([1.0, 2.0, 3.0], (count, 1)),
    }, sampled=True)  # fmt: skip
    log.drop("estimator_aid_src_gnss_pos")
    log.add(rows, speed)
    # heights that cannot be interpolated from neighbours
    zigzag_m = 0.02 * (-1.0) ** np.arange(count)
    every["altitude_msl_m"] = every["altitude_msl_m"] + zigzag_m
    heights_m = every["altitude_msl_m"].copy()
    whole = track_of(flight_of(log, tmp_path)).samples
    left = np.ones(count, bool)
    left[[20, 50, 51, 60]] = False
    for name, values in every.items():
        every[name] = values[left]
    found = track_of(flight_of(log, tmp_path))
    assert "3 GNSS fixes missing in the GNSS topic are read from" in " ".join(found.notes)
    whole = whole.drop(index=whole.index[60])
    np.testing.assert_allclose(found.samples.index, whole.index, atol=1e-6)
    np.testing.assert_allclose(found.samples[Columns.POSITION], whole[Columns.POSITION], atol=0.05)
    np.testing.assert_allclose(found.velocity.loc[found.samples.index[50], "east_m_s"], 2.0)
    assert "(3 with interpolated height" in " ".join(found.notes)
    # EKF2's observation contains heights, plus a bias if GNSS is not the reference
    for reference, bias_m, interpolated in ((1.0, 0.0, 0), (0.0, 0.3, 3)):
        log.parameters["EKF2_HGT_REF"] = reference
        log.drop(*({"estimator_aid_src_gnss_hgt"} & log.names()))
        log.add(topic("estimator_aid_src_gnss_hgt", rows.fields["timestamp_sample"], {
            "observation": bias_m - heights_m, "innovation": np.zeros(len(heights_m)),
        }, sampled=True))  # fmt: skip
        found = track_of(flight_of(log, tmp_path))
        assert f"{interpolated} with interpolated height" in " ".join(found.notes)
        off_m = np.abs(found.samples["down_m"].to_numpy() - whole["down_m"].to_numpy())
        assert (off_m[[20, 50, 51]] > 1e-3).sum() == interpolated


def with_velocity(log: Log) -> Log:
    fixes = log["vehicle_gps_position"]
    for name, value in (("vel_n_m_s", 1.0), ("vel_e_m_s", 2.0), ("vel_d_m_s", 3.0),
                        ("s_variance_m_s", 0.2)):  # fmt: skip
        fixes[name] = np.full(len(fixes["timestamp"]), value, np.float32)
    return log


@pytest.mark.parametrize(("parameters", "fused"), [
    ({}, True), ({"EKF2_GPS_CTRL": 7.0}, True), ({"EKF2_GPS_CTRL": 3.0}, False),
    ({"EKF2_AID_MASK": 1.0}, True),
])  # fmt: skip
def test_gnss_noise_is_limited_by_the_same_bounds_as_in_ekf2(parameters, fused, tmp_path):
    """Timestamps and accuracies as in EKF2; the noise is limited by EKF2_NOAID_NOISE."""
    flight = flight_of(with_velocity(outdoors(eph_m=12.0)), tmp_path)
    record = made(FusionRecord, parameters=parameters)
    found = read_gnss(flight, flight.ekf2, record)
    samples = track_of(flight).samples
    np.testing.assert_allclose(found.timestamp_s, samples.index + 0.11)
    np.testing.assert_allclose(found.arrival_s, found.timestamp_s)
    np.testing.assert_allclose(found.variance_m2[:, :2], 100.0)
    assert not found.uses_sender_timestamps
    assert (found.velocity_m_s is not None) is fused
    if found.velocity_m_s is not None and found.velocity_variance_m2_s2 is not None:
        np.testing.assert_allclose(found.velocity_m_s[0], [1.0, 2.0, 3.0])
        np.testing.assert_allclose(found.velocity_variance_m2_s2, 0.04, rtol=1e-6)


def test_ekf2_model_without_fused_gnss_samples_is_unavailable(tmp_path):
    log = with_velocity(outdoors())
    log["estimator_states"]["states"][:, 0] = 1.0
    log["estimator_status_flags"]["cs_gnss_pos"][1:] = False  # disabled from 1 s on
    log.topics = [
        take(one, range(20, 99)) if one.name == "vehicle_gps_position" else one
        for one in log.topics
    ]
    found = prepare_replay(flight_of(log, tmp_path))
    assert isinstance(found, Unavailable)
    assert "the log contains no sample of this source" in found.reason


def test_gnss_driver_timestamp_replaces_delay_parameter(tmp_path):
    record = made(FusionRecord, parameters={"EKF2_GPS_DELAY": 110.0, "EKF2_GPS_MODE": 0.0})
    flight = flight_of(outdoors(own_s=0.09, EKF2_GPS_MODE=0.0), tmp_path)
    found = read_gnss(flight, flight.ekf2, record)
    assert found.uses_sender_timestamps
    assert found.velocity_m_s is None
    # the timestamp is chosen so that the delay leads to the driver's time
    np.testing.assert_allclose(found.timestamp_s - 0.11, track_of(flight).samples.index)


@pytest.mark.parametrize(("north_m", "parameters", "scale", "with_velocity"), [
    (0.0, {}, 1.0, True), (np.nan, {}, 2.0, True), (np.nan, {"EKF2_GPS_MODE": 0.0}, 2.0, False),
])  # fmt: skip
def test_gnss_reset_keeps_velocity_if_px4_has_ekf2_gps_mode(
    north_m, parameters, scale, with_velocity
):
    delayed_state = pd.DataFrame({"north_m": [north_m]})
    record = made(
        FusionRecord,
        parameters=parameters,
        has_delta_angle_biases=False,
        delayed_state=delayed_state,
    )
    rules = _make_fusion_rules(record, 0.01, is_gnss=True)
    assert (rules.reset_variance_factor, rules.resets_velocity) == (scale, with_velocity)
    assert (rules.reset_timeout_s, rules.stop_timeout_s) == (7.0, np.inf)


@pytest.mark.parametrize(("delay_ms", "age_s", "remaining_s", "expected"), [
    (110.0, 0.11, 0.0, ("EKF2_GPS_DELAY", "110 ms")),
    (0.0, 0.0, -0.15, ("EKF2_GPS_DELAY", "150 ms")),
    (200.0, 0.2, 0.15, ("EKF2_GPS_DELAY", "50 ms")),
    (110.0, 0.0, -0.15, None),  # EKF2 uses the driver's times
])  # fmt: skip
def test_gnss_time_offset_advice_names_delay_parameter(delay_ms, age_s, remaining_s, expected):
    source = SimpleNamespace(
        origin=GNSS_ORIGIN,
        assumed_delay_s=age_s,
        alignment=None,
        aid=lambda _: GNSS_ORIGIN.aid,
        frame="NED",
    )
    log = SimpleNamespace(name="x.ulg", parameters={"EKF2_GPS_DELAY": delay_ms})
    flight = SimpleNamespace(log=log, ekf2=SimpleNamespace(parameters={}))
    comparison = SimpleNamespace(source=source, flight=flight, convention=None)
    clock = late(remaining_s, drift_ppm=None, drift_sigma_ppm=None)
    advice = make_time_offset_advice(comparison, clock).get("PX4")  # type: ignore[arg-type]
    assert all(text in (advice or "") for text in expected or ())
    assert (advice is None) is (expected is None)


def test_read_gnss_drops_damaged_fix_and_its_velocity(tmp_path):
    """The velocity is dropped too if another fix has the same publication time."""
    log = with_velocity(outdoors(own_s=0.0))
    fixes = log["vehicle_gps_position"]
    fixes["timestamp"][20] = fixes["timestamp"][21]
    fixes["altitude_msl_m"][20] = 1e30
    track = track_of(flight_of(log, tmp_path))
    assert track.velocity.index.equals(track.samples.index)


@pytest.mark.parametrize(
    "recorded", [False, pytest.param(True, marks=pytest.mark.reallogs)], ids=["model", "real EKF2"]
)
def test_gnss_fix_reconstruction_recovers_missing_fixes(recorded, request):
    """Keep every fourth to sixth fix of a complete flight, and two innovations per second."""
    if recorded:
        folder = request.getfixturevalue("shared_logs")
        flight = read_log(folder / "gps" / "v1.16.1_gps_fullrate.ulg")
    else:
        flight = simulate_flight(make_scenario("outdoor", seed=2, gnss_rate_hz=10.0))
    track = track_of(flight)
    every = track.samples[track.samples.index > 5.0]
    log = flight.ekf2.aids["gnss_pos"]
    taken = every.index.to_numpy()
    shown = log.samples.set_axis(log.samples.index + 0.5 * flight.ekf2.step_s)
    at = np.searchsorted(shown.index, taken[2::7])
    at = at[np.abs(shown.index.to_numpy()[at] - taken[2::7]) < 0.002]
    # rows show the last fix before them
    rows = shown.iloc[at].set_axis(shown.index[at] + 0.03)
    ekf2 = replace(
        flight.ekf2, aids=dict(flight.ekf2.aids) | {"gnss_pos": replace(log, samples=rows)}
    )
    remaining = every.iloc[np.cumsum(np.random.default_rng(1).choice([4, 5, 5, 6], 200))]
    made, note = reconstruct_fixes(remaining, ekf2, 0.11)

    def note_of(samples: pd.DataFrame) -> str:
        aids = dict(ekf2.aids) | {"gnss_pos": replace(log, samples=samples)}
        return reconstruct_fixes(remaining, replace(ekf2, aids=aids), 0.11)[1]

    assert len(made) > 60
    assert "0.0" in note
    true = every.iloc[np.abs(taken[:, None] - made.index.to_numpy()).argmin(axis=0)]
    assert np.abs(true.index - made.index).max() < 0.01
    error = (made[Columns.POSITION[:2]] - true[Columns.POSITION[:2]].to_numpy()).to_numpy()
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.isfinite(made[Columns.POSITION]).all(axis=None)
    # no reconstruction from wrong innovations
    assert note_of(rows.assign(innovation_north=rows["innovation_north"] + 0.5)) == ""
    # nor from a row in the fusion step, whose fix is ambiguous
    assert note_of(rows.set_axis(rows.index - 0.03)) == ""
    unknown = Unavailable("horizon", "not logged", "Log it.")
    assert reconstruct_fixes(remaining, replace(ekf2, horizon_s=unknown), 0.11)[1] == ""
    # a fix older than the horizon is fused at the horizon
    assert reconstruct_fixes(remaining, replace(ekf2, horizon_s=0.05), 0.11)[1] != note


def test_gnss_receiver_interval_is_found_from_logged_fixes():
    rng = np.random.default_rng(3)
    for interval_s in (0.1, 0.096, 0.2, 0.125):
        remaining = np.cumsum(rng.choice([4, 5, 6], 100)) * interval_s
        found = px4_fixes._estimate_receiver_interval(remaining + rng.normal(0.0, 0.0005, 100))
        assert found == pytest.approx(interval_s, rel=0.01)
    assert px4_fixes._estimate_receiver_interval(np.cumsum(rng.uniform(0.3, 0.9, 100))) is None
    # ambiguous: every fifth of 0.1 s, or every fourth of 0.125 s
    assert px4_fixes._estimate_receiver_interval(np.arange(100) * 0.5) is None
