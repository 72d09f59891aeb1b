"""EKF2 model on all other logs: agreement with the log, differences to KF, and what-if."""

import sys
from pathlib import Path

import pytest

from px4fuse.diagnose import run_what_if
from px4fuse.ekf2.model import prepare_ekf2_model
from px4fuse.flight.model import Unavailable
from px4fuse.readers import read_log
from px4fuse.request import WhatIfRequest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import bench_ekf2

pytestmark = pytest.mark.reallogs

NOT_CARRIED = {
    "v1.16.1_aisle_2hz_stock": "never fused the horizontal position",
    "v1.16.1_aisle_hwlog": "estimator_aid_src_ev_pos is logged every",
}
# the reasons are in test_gnss.py
GNSS_NOT_CARRIED = ("v1.13.3_gps_profile1", "v1.14.4_gps_magdist")


def test_ekf2_replay_benchmark_matches_documented_numbers(shared_logs, model_of, monkeypatch):
    monkeypatch.setattr(bench_ekf2, "opened", model_of)
    paths = bench_ekf2.flights([shared_logs / "simulated", shared_logs / "gps"])
    models = bench_ekf2.agreement_table(paths)
    assert {path.stem for path in paths} - models.keys() == {*NOT_CARRIED, *GNSS_NOT_CARRIED}
    left = bench_ekf2.waterfalls(models)
    bench_ekf2.check_what_if(models)
    assert bench_ekf2.agreement_page(models, left) == bench_ekf2.in_page()


@pytest.mark.parametrize("name", NOT_CARRIED)
def test_ekf2_replay_of_insufficient_log_gives_reason(shared_logs, name):
    found = prepare_ekf2_model(read_log(shared_logs / "simulated" / f"{name}.ulg"))
    assert isinstance(found, Unavailable)
    assert NOT_CARRIED[name] in found.reason


def test_ekf2_model_reports_fraction_of_missing_imu_samples(shared_logs):
    name = "mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3.ulg"
    found = prepare_ekf2_model(read_log(shared_logs / "real" / name))
    assert isinstance(found, Unavailable)
    assert "23 % of the IMU samples are missing" in found.reason


# Minimum correlation of replayed and logged innovations, with EKF2's rejections and resets
REJECTING_FLIGHTS = {
    "conventions/yaw_90_off": 0.999,
    "conventions/quaternion_xyzw": 0.99,
    "conventions/enu_uwb": 0.999,
    "conventions/relocalised": 0.999,
    "flown/v1_evp003": 0.99,
    "flown/v2_gate15": 0.999,
    "flown/g1_p01": 0.999,
}


@pytest.mark.parametrize("name", REJECTING_FLIGHTS)
def test_ekf2_replay_of_flights_with_rejections_agrees_with_log(shared_logs, name):
    model = prepare_ekf2_model(read_log(shared_logs / f"{name}.ulg"))
    assert not isinstance(model, Unavailable)
    assert model.agreement.good
    correlations = [axis.innovation_correlation for axis in model.agreement.axes.values()]
    assert min(correlations) > REJECTING_FLIGHTS[name]


def test_ekf2_replay_differs_from_log_with_86_percent_rejections(shared_logs):
    """EKF2 rejects 86 % of the positions, and its variance is reduced by unlogged samples."""
    model = prepare_ekf2_model(read_log(shared_logs / "conventions" / "nwu_vio.ulg"))
    assert not isinstance(model, Unavailable)
    assert not model.agreement.good
    assert "rejected 86% of the positions and relied on the IMU" in model.agreement.reason


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("eg1_base", {}),
        ("eg1_evp20", {"EKF2_EVP_NOISE": 0.1}),
        ("eg1_d0", {"EKF2_GPS_DELAY": 110.0}),
        ("g1_d0", {"EKF2_GPS_DELAY": 110.0}),
        ("g1_base", {}),
    ],
)
def test_whatif_command_without_options_corrects_wrong_parameter(shared_logs, name, expected):
    log = str(shared_logs / "flown" / f"{name}.ulg")
    found = run_what_if(WhatIfRequest(log=log)).changes
    assert found == pytest.approx(expected, abs=20.0 if "d0" in name else 0.01)
