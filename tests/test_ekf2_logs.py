"""EKF2 model on all other logs: agreement with the log, differences to KF, and what-if."""

import sys
from pathlib import Path

import pytest

from px4fuse.ekf2.model import open_model
from px4fuse.flight.model import Unavailable
from px4fuse.readers import read_log

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import bench_ekf2

pytestmark = pytest.mark.reallogs

NOT_CARRIED = {
    "v1.16.1_aisle_2hz_stock": "never fused external vision",
    "v1.16.1_aisle_hwlog": "estimator_aid_src_ev_pos has a sample interval",
}
# the reasons are in test_gnss.py
GNSS_NOT_CARRIED = ("v1.13.3_gps_profile1", "v1.14.4_gps_magdist")


def test_ekf2_replay_benchmark_matches_documented_numbers(shared_logs, model_of, monkeypatch):
    monkeypatch.setattr(bench_ekf2, "opened", model_of)
    paths = bench_ekf2.flights([shared_logs / "simulated", shared_logs / "gps"])
    models = bench_ekf2.agreement_table(paths)
    assert {path.stem for path in paths} - models.keys() == {*NOT_CARRIED, *GNSS_NOT_CARRIED}
    left = bench_ekf2.waterfalls(models)
    bench_ekf2.counterfactuals(models)
    assert bench_ekf2.agreement_page(models, left) == bench_ekf2.in_page()


@pytest.mark.parametrize("name", NOT_CARRIED)
def test_ekf2_model_of_insufficient_log_states_reason(shared_logs, name):
    found = open_model(read_log(shared_logs / "simulated" / f"{name}.ulg"))
    assert isinstance(found, Unavailable)
    assert NOT_CARRIED[name] in found.reason


def test_ekf2_model_states_fraction_of_missing_imu_samples(shared_logs):
    name = "mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3.ulg"
    found = open_model(read_log(shared_logs / "real" / name))
    assert isinstance(found, Unavailable)
    assert "23 % of the IMU samples are missing" in found.reason
