"""``px4fuse whatif``: results, table, refused input, and flights from SITL."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from cli_tools import run_checked
from exchange import replace

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.diagnose import run_what_if
from px4fuse.ekf2.model import prepare_ekf2_model
from px4fuse.ekf2.whatif import Ekf2Statistics, what_if
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.report.whatif import (
    NOT_PREDICTABLE_TEXT,
    describe_sweep,
    list_statistics,
    list_sweep_results,
    make_whatif_page,
)
from px4fuse.request import Sweep, WhatIfRequest, command_line
from px4fuse.results.contract import WhatIfResults, schema
from px4fuse.results.reading import read_results

pytestmark = pytest.mark.usefixtures("cached_analyses")


@pytest.fixture(scope="module")
def estimated(sample_log: Path) -> WhatIfAnalysis:
    """Replay the sample flight with the maximum-likelihood noise and delay."""
    return run_what_if(WhatIfRequest(log=str(sample_log)))


@pytest.fixture(scope="module")
def swept(sample_log: Path) -> WhatIfAnalysis:
    """Replay with a changed gate and three values of the noise."""
    sweep = Sweep("EKF2_EVP_NOISE", 0.05, 0.2, 3)
    request = WhatIfRequest(log=str(sample_log), changes={"EKF2_EVP_GATE": 3.0}, sweep=sweep)
    return run_what_if(request)


def test_whatif_command_writes_logged_and_replayed_ekf2_results(sample_log: Path) -> None:
    options = "--set", "EKF2_EVP_NOISE=0.3", "--json", "-"
    text = run_checked("whatif", sample_log, *options).stdout
    said = json.loads(text)
    jsonschema.validate(said, schema())
    assert isinstance(read_results(text.encode()), WhatIfResults)
    for key in ("logged", "replayed", "whatif"):
        for axis in ("north", "east"):
            assert 0.04 < said[key][axis]["position_rmse_to_truth_m"] < 0.09
    assert said["whatif"]["north"]["nis_mean"] < 0.3 * said["replayed"]["north"]["nis_mean"]


def test_whatif_command_without_vision_predicts_position_drift(sample_log: Path) -> None:
    options = "--without", "ev_pos", "--from", "100", "--json", "-"
    said = json.loads(run_checked("whatif", sample_log, *options).stdout)
    jsonschema.validate(said, schema())
    assert said["whatif"]["without"] == {"ev_pos": 100.0}
    assert said["evaluated_s"][0][0] == 100.0
    assert said["provenance"]["command"].endswith("aisle_uwb.ulg --without ev_pos --from 100")
    assert said["replayed"]["without"] == {}
    # consistent after 30 s of dead reckoning with a noise of 0.35 m/s²
    for axis in ("north", "east"):
        assert said["replayed"][axis]["position_rmse_to_truth_m"] < 0.1
        assert 0.02 < said["whatif"][axis]["nis_mean"] < 4.0
    parts = [said["whatif"][axis]["position_rmse_to_truth_m"] for axis in ("north", "east")]
    assert np.hypot(*parts) > 1.0
    (note,) = [one for one in said["notes"] if one.startswith("Without ev_pos from 100 s on")]
    assert "EKF2 stops publishing a position after EKF2_NOAID_TOUT (5 s)" in note


def test_ekf2_replay_rejects_removal_of_unknown_aiding_source(estimated: WhatIfAnalysis) -> None:
    model = prepare_ekf2_model(estimated.flight)
    for without, said in (
        (
            {"baro_hgt": 60.0},
            "baro_hgt cannot be omitted: the replay of this log fuses only ev_pos.",
        ),
        ({"ev_pos": 500.0}, "500 s leaves less than 5 s of the replayed flight"),
    ):
        with pytest.raises(SettingsError, match=said):
            what_if(model, [], without)


def test_whatif_without_option_set_proposes_no_needless_change(estimated: WhatIfAnalysis) -> None:
    """The UWB noise is 0.10 m, as EKF2 assumes, and its timestamps are right."""
    assert estimated.uses_estimates
    assert not estimated.changes
    assert not estimated.statistics.whatif
    texts = [str(block) for block in make_whatif_page(estimated).blocks]
    assert any("fit this log best" in text for text in texts)
    title, *lines = list_statistics(estimated)
    assert title.endswith("EKF2 (replay) as flown:")
    nis = f"{estimated.statistics.replayed.north.nis_mean:.3g}"
    assert any(f"north: mean NIS {nis} (expected" in line for line in lines)
    assert not any("→" in line for line in lines)


def test_whatif_sweep_also_applies_parameters_of_option_set(swept: WhatIfAnalysis) -> None:
    first, *values = swept.statistics.whatif
    assert dict(first.changed) == {"EKF2_EVP_GATE": 3.0}
    assert [v.changed["EKF2_EVP_NOISE"] for v in values] == pytest.approx([0.05, 0.1, 0.2])
    assert all(value.changed["EKF2_EVP_GATE"] == 3.0 for value in values)
    nis = [value.nis_mean for value in values]
    assert nis == sorted(nis, reverse=True)
    for text, line in zip(("0.05", "0.1", "0.2"), list_sweep_results(swept), strict=True):
        assert line.startswith(f"EKF2_EVP_NOISE {text} m: horizontal position RMSE")
    best, error, *_ = describe_sweep(swept)
    assert "closest to 1 at EKF2_EVP_NOISE 0.1" in best
    least = min(values, key=lambda value: value.position_rmse_to_truth_m)
    assert f"smallest at EKF2_EVP_NOISE {least.changed['EKF2_EVP_NOISE']:.3g}" in error


def test_whatif_command_on_log_without_ekf2_states_raises_error(sample_log: Path) -> None:
    with pytest.raises(MissingDataError, match="EKF2 replay: estimator_states is not logged"):
        run_what_if(WhatIfRequest(log=str(sample_log.with_suffix(".tlog"))))


@pytest.mark.reallogs
class TestFlownFlights:
    @staticmethod
    @cache
    def of(shared_logs: Path, name: str) -> WhatIfAnalysis:
        log = shared_logs / "simulated" / f"{name}.ulg"
        return run_what_if(WhatIfRequest(log=str(log)))

    def test_ekf2_replay_with_estimated_noise_has_no_rejections(self, shared_logs: Path) -> None:
        found = self.of(shared_logs, "v1.16.1_aisle_overconfident")
        assert set(found.changes) == {"EKF2_EVP_NOISE"}
        (cured,) = found.statistics.whatif
        assert all(0.9 <= axis.nis_mean <= 1.1 for axis in cured.axes.values())
        assert cured.rejected_fraction == 0.0
        assert found.statistics.logged.rejected_fraction > 0.5
        assert cured.position_rmse_to_truth_m < 0.4 * error(found.statistics.logged)

    @pytest.mark.parametrize("name", ["v1.16.1_aisle_clock_late", "v1.16.1_aisle_clock_nosync"])
    def test_ekf2_replay_with_estimated_delay_restores_position_rmse(
        self, shared_logs: Path, name: str
    ) -> None:
        found = self.of(shared_logs, name)
        assert found.changes["EKF2_EV_DELAY"] == pytest.approx(250.0, abs=25.0)
        clean = self.of(shared_logs, "v1.16.1_aisle_nominal").statistics.logged
        (cured,) = found.statistics.whatif
        assert error(cured) < 1.2 * error(clean) < 0.5 * error(found.statistics.logged)
        assert not any("would reach EKF2 after" in note for note in found.statistics.notes)

    def test_whatif_command_finds_true_delay_from_wrong_ekf2_delay(self, shared_logs: Path) -> None:
        found = self.of(shared_logs, "v1.13.3_aisle_evdelay175")
        assert found.changes["EKF2_EV_DELAY"] == 0.0
        (cured,) = found.statistics.whatif
        assert error(cured) < 0.7 * error(found.statistics.logged)
        with pytest.raises(
            SettingsError, match="the largest sensor delay parameter sets the delay of"
        ):
            what_if(prepare_ekf2_model(found.flight), [{"EKF2_DELAY_MAX": 300.0}])

    @pytest.mark.parametrize(
        ("log", "said"),
        [
            ("simulated/v1.16.1_aisle_2hz_stock", "never fused the horizontal position"),
            ("gps/v1.13.3_gps_profile1", "but EKF2 fused more samples"),
            ("real/mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3",
             "23 % of the IMU samples are missing"),
            ("real/vladimireganov_ROS_PX4_MOCAP_square2", "EKF2 may have fused more samples"),
        ],
    )  # fmt: skip
    def test_whatif_command_on_log_unsuited_to_replay_raises_error(
        self, shared_logs: Path, log: str, said: str
    ) -> None:
        with pytest.raises(MissingDataError, match=said):
            run_what_if(WhatIfRequest(log=str(shared_logs / f"{log}.ulg")))


def error(summary: Ekf2Statistics) -> float:
    """Return the horizontal position RMSE against ground truth (m)."""
    parts = [axis.position_rmse_to_truth_m for axis in summary.axes.values()]
    assert all(isinstance(part, float) for part in parts)
    assert summary.position_rmse_to_truth_m == pytest.approx(np.hypot(*parts))
    return float(np.hypot(*parts))


def test_whatif_omits_numbers_that_the_replay_cannot_predict(sample_flight: Flight) -> None:
    name, sweep = sample_flight.log.name, Sweep("EKF2_EVP_GATE", 1.0, 5.0, 2)
    request = WhatIfRequest(log=name, changes={"EKF2_EVP_NOISE": 0.02}, sweep=sweep)
    assert command_line(request).endswith("--set EKF2_EVP_NOISE=0.02 --sweep EKF2_EVP_GATE=1:5:2")
    told = run_what_if(request, flight=sample_flight)
    changed, *lines = list_statistics(told)
    assert changed == f"EKF2 (replay), EKF2_EVP_NOISE 0.02 m: {NOT_PREDICTABLE_TEXT}"
    assert not any(NOT_PREDICTABLE_TEXT in line for line in lines)
    assert all(line.endswith(NOT_PREDICTABLE_TEXT) for line in list_sweep_results(told))
    said = " ".join(describe_sweep(told))
    assert "'not predictable': the replay rejects more than 35% of the samples" in said
    assert "2 mm of added position noise changes the results strongly" in said
    assert "closest to 1" not in said


def test_whatif_command_prints_expected_nis_range_if_it_differs(swept: WhatIfAnalysis) -> None:
    changed, *others = swept.statistics.whatif
    north = replace(
        changed.axes["north"],
        nis_band=(0.5, 1.5),
        position_rmse_to_truth_m=Unavailable("", "", ""),
    )
    changed = replace(changed, north=north)
    statistics = replace(swept.statistics, whatif=(changed, *others))
    lines = "\n".join(list_statistics(replace(swept, statistics=statistics)))
    assert "north: mean NIS 0.819 (expected 0.89 to 1.12) → " in lines
    assert "(expected 0.50 to 1.50)" in lines
    assert "north: position RMSE 0.068 m → n/a\n" in lines
    assert "east: median reported position σ 0.059 → " in lines
