"""``px4fuse extract``: tables, flight.json, and the lesson's example on them."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cli_tools import run_checked, run_main
from comparisons import compare
from conftest import REPOSITORY
from exchange import replace
from flights import Estimator, aisle_flight
from msgspec import structs
from ulog_tools import make_log

from px4fuse.filter.kalman import predict_track
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import compute_ned_acceleration
from px4fuse.flight.model import ClockConversion, Dropout, Flight, InputFile, Reset
from px4fuse.info import tables as extraction
from px4fuse.readers import read_log
from px4fuse.simulation.flights import simulate, to_ulog
from px4fuse.simulation.scenario import make_scenario

# Example 1 of the lesson on the tables of a flight, as printed in the documentation
PAGE = (REPOSITORY / "docs" / "python.md").read_text(encoding="utf-8")
(LESSON,) = re.findall(r"```python\n(import numpy.*?)```", PAGE, re.DOTALL)


def extract(*arguments: object) -> str:
    return run_checked("extract", *arguments).output


@pytest.fixture(scope="module")
def written(tmp_path_factory, sample_log) -> Path:
    folder = tmp_path_factory.mktemp("extracted") / "new" / "tables"
    extract(sample_log, "-o", folder)
    return folder


def read(path: Path) -> pd.DataFrame:
    # the fast reader of pandas may differ in the last bit; this one uses float()
    return pd.read_csv(path, engine="python")


def rich_flight() -> Flight:
    """Make a flight with all parts for which a table exists."""
    resets = Reset(5.0, "position", (0.5, 0.0, -1.0)), Reset(6.0, "velocity", (0, 1, 0))
    ekf2 = Estimator(resets=resets, primary_instances=((-np.inf, 0), (9.0, 1)))
    flight = aisle_flight(duration_s=20.0, ekf2=ekf2, dropouts=(Dropout(3.0, 0.2),))
    clock = ClockConversion(
        'UNIX time, "quoted"', "TIMESYNC", 512, -1.7e9 / 3, 2.5, 0.001, "a, note"
    )
    file = InputFile("uwb.csv", "00" * 32, 10, "position")
    return replace(flight, clocks=(clock,), inputs=(file,))


# ---- tables -----------------------------------------------------------------------------------


def test_extracted_csv_read_again_gives_identical_floats(written, sample_flight):
    ekf2 = sample_flight.ekf2
    expected = {
        "imu": sample_flight.imu.astype(float), "attitude": sample_flight.attitude,
        "acceleration_ned": compute_ned_acceleration(sample_flight), "ekf2_state": ekf2.state,
        "ekf2_variance": ekf2.variance, "ekf2_fusing": ekf2.fusion_flags,
        "truth": sample_flight.truth.samples,
    } | {f"position_{track.name}": track.samples for track in sample_flight.positions}  # fmt: skip
    for name, frame in expected.items():
        table, content = read(written / f"{name}.csv"), (written / f"{name}.csv").read_bytes()
        assert content.isascii()  # readable by spreadsheets with any encoding
        assert not re.search(rb"\r|nan|inf", content)
        assert table.columns[0] == "time_s"
        np.testing.assert_array_equal(table["time_s"], frame.index, strict=False)
        np.testing.assert_array_equal(table.iloc[:, 1:], frame, err_msg=name)


def test_extract_writes_innovations_of_all_axes_in_one_table(written, sample_flight):
    table = read(written / "ekf2_innovations.csv")
    assert table["time_s"].is_monotonic_increasing
    assert set(table["axis"]) == {"north", "east"}
    for axis, rows in table.groupby("axis"):
        frame = sample_flight.ekf2.innovations[axis]
        np.testing.assert_array_equal(rows["time_s"], frame.index)
        np.testing.assert_array_equal(rows[frame.columns], frame)


def test_extracted_imu_table_without_clipping_has_empty_column(sample_flight):
    for imu in (sample_flight.imu, sample_flight.imu.drop(columns="clipped")):
        table = extraction.tables(replace(sample_flight, imu=imu))["imu"]
        assert table.columns.tolist() == ["time_s", *sample_flight.imu.columns]
    assert table["clipped"].isna().all()


def test_extract_from_gnss_flight_writes_gnss_innovations(tmp_path):
    log = tmp_path / "o.ulg"
    log.write_bytes(to_ulog(simulate(make_scenario("outdoor", passes=1, length_m=10.0))))
    assert "external vision" not in extract(log, "-o", tmp_path / "o")
    flight = json.loads((tmp_path / "o" / "flight.json").read_text())
    assert flight["streams"]["ekf2_innovations"]["topics"] == ["estimator_aid_src_gnss_pos"]
    assert {*read(tmp_path / "o" / "ekf2_innovations.csv")["axis"]} == {"north", "east"}


def test_extract_writes_tables_of_resets_and_parameters():
    flight = rich_flight()
    tables = extraction.tables(flight)
    resets = tables["resets"]
    first, second = resets.to_numpy().tolist()
    assert first == [5.0, "position", 0.5, 0.0, -1.0]
    assert second == [6.0, "velocity", 0.0, 1.0, 0.0]
    instances = tables["instances"]
    assert instances["instance"].tolist() == [0, 1]
    assert np.isfinite(instances["time_s"]).all()
    assert instances["time_s"].iloc[1] == 9.0
    assert tables["airborne"].to_numpy().tolist() == [list(span) for span in flight.airborne]
    assert tables["dropouts"].to_numpy().tolist() == [[3.0, 0.2]]
    assert dict(tables["parameters"].to_numpy().tolist()) == dict(flight.log.parameters)
    clock = tables["clocks"].dropna(axis=1).iloc[0].to_dict()
    expected = structs.asdict(flight.clocks[0])
    assert clock == {name: value for name, value in expected.items() if value is not None}


def test_extracted_tables_contain_orientation_from_odometry(sample_flight):
    """Parameters of EKF2, and the orientation from odometry."""
    flight = read_log(REPOSITORY / "sample_logs" / "loop_vio.ulg")
    tables = extraction.tables(flight)
    values = dict(tables["parameters"].to_numpy().tolist())
    assert values.items() >= flight.ekf2.record.parameters.items()
    assert values["EKF2_GYR_NOISE"] == pytest.approx(0.015)
    orientation = tables["orientation_vehicle_visual_odometry"]
    (track,) = [track for track in flight.positions if track.orientation is not None]
    np.testing.assert_array_equal(orientation[list("wxyz")], track.orientation[list("wxyz")])
    assert len(orientation) == len(tables["position_vehicle_visual_odometry"])
    assert not any(name.startswith("orientation") for name in extraction.tables(sample_flight))


# ---- flight.json -----------------------------------------------------------------------------


def test_extracted_flight_json_lists_streams_and_missing_data(written, sample_flight):
    text = (written / "flight.json").read_text(encoding="utf-8")
    about = json.loads(text, parse_constant=pytest.fail)
    assert about["schema"] == {"name": "px4fuse-flight", "version": "1.0"}
    assert about["log"]["sha256"] == sample_flight.log.sha256
    assert about["streams"]["imu"]["topics"] == ["sensor_combined"]
    expected = {part["what"] for part in about["missing"]}
    assert expected >= {part.what for part in sample_flight.missing}
    for position in about["positions"]:
        assert (written / f"{position['table']}.csv").exists()


# ---- missing data -----------------------------------------------------------------------------


@pytest.mark.parametrize(("dropped", "lost"), [
    ("sensor_combined", {"imu", "acceleration_ned"}),
    ("estimator_states", {"ekf2_variance"}),
    ("vehicle_visual_odometry", {"position_vehicle_visual_odometry"}),
])  # fmt: skip
def test_extract_without_logged_topic_writes_no_table(tmp_path, dropped, lost):
    whole = set(extraction.tables(read_log(make_log().write(tmp_path / "whole.ulg"))))
    path = make_log().drop(dropped).write(tmp_path / "less.ulg")
    said = extract(path, "-o", tmp_path / "out")
    written = {file.stem for file in (tmp_path / "out").glob("*.csv")}
    assert written == whole - lost
    if dropped != "vehicle_visual_odometry":  # another track replaces this one
        assert "Not exported: " in said


# ---- names and folders ------------------------------------------------------------------------


def test_extracted_table_names_are_valid_file_names(sample_flight):
    track = sample_flight.positions[0]
    names = ["uwb log.csv", "UWB_LOG.csv", 'a/b\\c:d*?"<>|', "CON", "ünï", "x" * 300, "end. "]
    flight = replace(sample_flight, positions=tuple(replace(track, name=name) for name in names))
    tables = [name for name in extraction.tables(flight) if name.startswith("position_")]
    assert len(tables) == len(names)
    assert len({name.lower() for name in tables}) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,90}", name) for name in tables)


@pytest.mark.parametrize(("options", "said"), [
    ([], "is a file"), (["--format", "parquet"], 'pip install "px4fuse[parquet]"'),
])  # fmt: skip
def test_extract_to_unwritable_folder_prints_one_error_line(
    tmp_path, monkeypatch, capsys, sample_log, options, said
):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    folder = tmp_path / "tables"
    if not options:
        folder.write_text("mine")
    code, out, err = run_main(monkeypatch, capsys, "extract", sample_log, "-o", folder, *options)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert said in err
    assert folder.exists() == (not options)


# ---- Parquet ----------------------------------------------------------------------------------


def test_extract_to_parquet_writes_the_same_tables(tmp_path, sample_log, sample_flight):
    pytest.importorskip("pyarrow", reason="Parquet needs the extra px4fuse[parquet]")
    extract(sample_log, "-o", tmp_path, "--format", "parquet")
    for name, table in extraction.tables(sample_flight).items():
        back = pd.read_parquet(tmp_path / f"{name}.parquet")
        pd.testing.assert_frame_equal(back, table, check_exact=True)


# ---- the lesson by hand -----------------------------------------------------------------------


def test_kf_example_in_python_guide_equals_kf_of_compare(
    tmp_path, monkeypatch, capsys, sample_log, sample_flight
):
    """The example is KF, except that it rounds the time of each measurement to the DT grid."""
    monkeypatch.chdir(tmp_path)
    extract(sample_log, "-o", "reports/tables")
    exec(compile(LESSON, "python.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    printed = [[float(number) for number in re.findall(r"-?\d+\.\d+", line)] for line in lines]
    time, position, velocity, gain = np.array(printed).T
    north = compare(sample_flight, Settings(), axes=("north",), start_s=0.0)["north"]
    # both filters have settled, and the vehicle is airborne
    inside = (time > 5.0) & (time < 125.0)
    kf_state = predict_track(north.kf_run, time[inside]).to_numpy().T
    step_m = np.abs(kf_state[1]).max() * 0.1  # m; motion within the 0.1 s of rounding
    assert np.abs(position[inside] - kf_state[0]).max() < 2.0 * step_m
    assert np.sqrt(np.mean((velocity[inside] - kf_state[1]) ** 2)) < 0.1
    settled = north.kf_run.updates["gain_position"].loc[20.0:120.0].median()
    assert np.median(gain[inside]) == pytest.approx(settled, rel=0.1)
