"""EKF2's model on every further log: agreement, walk and what-if, or why there is none."""

import sys
from pathlib import Path

import pytest

from px4fuse.ekf2.model import open_model
from px4fuse.flight import Unavailable
from px4fuse.readers import read_log

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import bench_ekf2

pytestmark = pytest.mark.reallogs

NOT_CARRIED = {
    "v1.16.1_aisle_2hz_stock": "never fused external vision",
    "v1.16.1_aisle_hwlog": "estimator_aid_src_ev_pos holds one sample in",
}
# Why is in test_gnss.py
GNSS_NOT_CARRIED = ("v1.13.3_gps_profile1", "v1.14.4_gps_magdist")


def test_the_figures_of_the_benchmark_hold_on_every_simulated_flight(
    shared_logs, model_of, monkeypatch
):
    monkeypatch.setattr(bench_ekf2, "opened", model_of)
    paths = bench_ekf2.flights([shared_logs / "simulated", shared_logs / "gps"])
    models = bench_ekf2.agreement_table(paths)
    assert {path.stem for path in paths} - models.keys() == {*NOT_CARRIED, *GNSS_NOT_CARRIED}
    left = bench_ekf2.waterfalls(models)
    bench_ekf2.counterfactuals(models)
    assert bench_ekf2.agreement_page(models, left) == bench_ekf2.in_page()


@pytest.mark.parametrize("name", NOT_CARRIED)
def test_a_simulated_flight_that_cannot_carry_the_model_says_why(shared_logs, name):
    found = open_model(read_log(shared_logs / "simulated" / f"{name}.ulg"))
    assert isinstance(found, Unavailable)
    assert NOT_CARRIED[name] in found.reason


def test_a_real_flight_whose_imu_was_logged_with_holes_says_so(shared_logs):
    name = "mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3.ulg"
    found = open_model(read_log(shared_logs / "real" / name))
    assert isinstance(found, Unavailable)
    assert "30% of the IMU's samples are missing" in found.reason
