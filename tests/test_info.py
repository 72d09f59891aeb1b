"""``px4fuse info`` on complete, incomplete and damaged logs, and on files that are no flights."""

import json
from pathlib import Path

import numpy as np
import pytest
from cli_tools import run_main
from click.testing import CliRunner
from comparisons import compare
from exchange import replace
from flights import Estimator, Uwb, aisle_flight
from mavlink_tools import Aisle
from ulog_tools import Log, load, make_log, odometry, stamps, take, topic

from px4fuse.cli import cli
from px4fuse.comparison.preparation import choose_source
from px4fuse.diagnose import diagnose_comparison
from px4fuse.errors import Px4FuseError
from px4fuse.flight.model import GNSS_ORIGIN, Dropout, Flight, Sender, Unavailable
from px4fuse.info.inventory import (
    AnalysisOption,
    Inventory,
    LoggedData,
    list_log_contents,
    to_json_dict,
)
from px4fuse.readers import read_log

WIDTH = 80


@pytest.fixture(autouse=True)
def screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the width of a terminal; in a pipe lines do not wrap."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def info(*arguments: str | Path) -> str:
    runner = CliRunner(env={"COLUMNS": str(WIDTH)})
    result = runner.invoke(cli, ["info", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.stdout


def widest(text: str) -> int:
    """Return the length of the longest line, except for the command to paste."""
    return max(len(line) for line in text.splitlines() if not line.startswith("Run"))


def inventory_of(log: Log, tmp_path: Path) -> Inventory:
    return list_log_contents(read_log(log.write(tmp_path / "made.ulg")))


def source(inventory: Inventory, part: str) -> LoggedData:
    return next(source for source in inventory.sources if source.part == part)


def ability(inventory: Inventory, name: str) -> AnalysisOption:
    return next(ability for ability in inventory.abilities if ability.name == name)


def remedies(inventory: Inventory) -> list[str]:
    return [advice.remedy for advice in inventory.advice]


# ---- the sample log ---------------------------------------------------------------------------


def test_info_output_matches_contents_of_log(sample_flight):
    inventory, ekf2 = list_log_contents(sample_flight), sample_flight.ekf2
    frames = {
        "IMU": sample_flight.imu, "attitude": sample_flight.attitude, "EKF2 state": ekf2.state,
        "EKF2 variance": ekf2.variance, "innovations": ekf2.innovations["north"],
        "fusion flags": ekf2.fusion_flags, "ground truth": sample_flight.truth.samples,
    }  # fmt: skip
    for part, frame in frames.items():
        row = source(inventory, part)
        assert (row.samples, row.start_s) == (len(frame), frame.index[0])
        assert row.end_s == frame.index[-1]
        assert row.log == "aisle_uwb.ulg"
        assert row.topics[0] == row.name
        assert row.clock.startswith("autopilot boot clock")
    positions = [row for row in inventory.sources if row.part == "position"]
    assert [row.name for row in positions] == [track.name for track in sample_flight.positions]
    assert [row.chosen for row in positions] == [True, False, False]
    assert positions[0].rate_hz == pytest.approx(5.0, abs=0.01)
    assert source(inventory, "land detector").start_s == sample_flight.airborne[0][0]


def test_info_sample_counts_match_those_of_compare(sample_flight):
    inventory = list_log_contents(sample_flight)
    comparison = compare(sample_flight)
    assert all(ability.possible for ability in inventory.abilities)
    assert inventory.segment == comparison.segment
    assert all(remedies(inventory))
    assert (
        "external vision, position: 2 Hz; " in ability(inventory, "aiding sources of EKF2").reason
    )
    north = comparison.axes["north"]
    for name, samples in (
        ("EKF2 states", north.ekf2_tracks.state),
        ("EKF2 variances", north.ekf2_tracks.variance),
        ("EKF2 consistency", north.ekf2_tracks.innovations),
        ("error against ground truth", north.truth),
    ):
        assert ability(inventory, name).reason.startswith(f"from {len(samples)} ")


# ---- JSON -------------------------------------------------------------------------------------


def strict(text: str) -> dict:
    """Parse JSON; NaN and infinity fail the test."""
    return json.loads(text, parse_constant=pytest.fail)


def test_info_json_is_written_to_named_file_or_stdout(
    sample_log, sample_flight, tmp_path, monkeypatch, capsys
):
    text, target = info(sample_log, "--json", "-"), tmp_path / "new" / "info.json"
    found = strict(text)
    assert found["log"]["sha256"] == sample_flight.log.sha256
    (chosen,) = [row["name"] for row in found["sources"] if row.get("chosen")]
    assert chosen == choose_source(sample_flight)[0].name
    assert "start_utc" not in found, "an unknown value is absent"
    printed = info(sample_log, "--json", target)
    assert widest(printed.partition("Wrote")[0]) <= WIDTH
    assert len(printed.splitlines()) <= 50
    assert target.read_text(encoding="utf-8") == text
    code, out, err = run_main(monkeypatch, capsys, "info", sample_log, "--json", tmp_path)
    assert (code, out, len(err.splitlines())) == (2, "", 1)


# ---- logs that lack something -----------------------------------------------------------------


@pytest.mark.parametrize(("topic_", "part", "lost"), [
    ("sensor_combined", "IMU", {"acceleration", "what-if"}),
    ("vehicle_local_position", "EKF2 state",
     {"EKF2 states", "EKF2 variances", "EKF2 consistency", "aiding sources of EKF2", "what-if"}),
])  # fmt: skip
def test_info_lists_analyses_disabled_by_missing_topic(tmp_path, topic_, part, lost):
    inventory = inventory_of(make_log().drop(topic_), tmp_path)
    assert topic_ in source(inventory, part).unavailable
    assert {can.name for can in inventory.abilities if not can.possible} - {
        "error against ground truth"
    } == lost
    assert all(f"{topic_} is not logged" in ability(inventory, name).reason for name in lost)
    assert remedies(inventory).count("Record with SDLOG_PROFILE bit 0 (default).") == 1


@pytest.mark.parametrize(("profile", "wanted"), [(1, 129), (3, 131)])
def test_info_on_unlogged_source_advises_sdlog_profile(tmp_path, profile, wanted):
    log = make_log().drop("vehicle_visual_odometry")
    log.parameters["SDLOG_PROFILE"] = profile
    inventory = inventory_of(log, tmp_path)
    assert (
        remedies(inventory)[0]
        == f"Set SDLOG_PROFILE to {wanted} (bit 7: vision topics) and fly again."
    )
    assert source(inventory, "position").name == "estimator_aid_src_ev_pos"


@pytest.mark.parametrize(
    ("imu_hz", "said"), [(4.0, "IMU was logged at 4.0 Hz"), (49.5, None), (100.0, None)]
)
def test_info_reports_imu_rate_too_low_for_analysis(tmp_path, imu_hz, said):
    inventory = inventory_of(make_log(imu_hz=imu_hz), tmp_path)
    found = ability(inventory, "acceleration")
    slow = [remedy for remedy in remedies(inventory) if "sensor_combined at full rate" in remedy]
    assert len(slow) == (said is not None)
    assert found.possible == (said is None)
    if said is not None:
        assert said in found.reason
        assert "50 Hz are needed" in found.reason
    both = (list_log_contents(aisle_flight(attitude_hz=rate_hz)) for rate_hz in (5.0, 9.97))
    slow, fast = (ability(one, "acceleration") for one in both)
    assert (slow.possible, fast.possible) == (False, True)
    assert "attitude was logged at 5.0 Hz, but 10 Hz are needed" in slow.reason


def test_info_on_damaged_log_reports_the_damage_first(tmp_path, sample_log):
    path = tmp_path / "damaged.tlog"
    content = Aisle(seconds=10.0).record().tlog()
    path.write_bytes(content[: len(content) // 2] + bytes(5000) + content[len(content) // 2 :])
    inventory = list_log_contents(read_log(path))
    assert any("damaged" in note for note in inventory.notes)
    assert "link" in remedies(inventory)[0]
    (named,) = [
        f for f in diagnose_comparison(compare(read_log(path))).findings if f.id == "log_damaged"
    ]
    assert not any("SD card" in remedy for remedy in (*remedies(inventory), named.remedy))
    ulog = bytearray(sample_log.read_bytes())
    ulog[1_500_000:1_504_096] = bytes(4096)
    path.with_suffix(".ulg").write_bytes(ulog)
    assert "Copy the log" in remedies(list_log_contents(read_log(path.with_suffix(".ulg"))))[0]


def test_info_on_log_without_take_off_reports_never_airborne(tmp_path):
    log = make_log()
    for name in ("x", "y", "z"):
        log["vehicle_local_position"][name][:] = 0
    log["vehicle_visual_odometry"]["position"][:] = 0
    log["vehicle_land_detected"]["landed"][:] = 1
    inventory = inventory_of(log, tmp_path)
    assert inventory.flight.airborne == ()
    assert ability(inventory, "compare").possible
    assert "the land detector never reported a flight" in info(tmp_path / "made.ulg")


def test_info_does_not_use_position_source_as_ground_truth(tmp_path):
    log = make_log().add(odometry("vehicle_mocap_odometry", 10.0, 16))
    assert ability(inventory_of(log, tmp_path), "error against ground truth").possible
    flight = read_log(log.drop("vehicle_visual_odometry").write(tmp_path / "made.ulg"))
    inventory = list_log_contents(flight)
    assert source(inventory, "position").name == "vehicle_mocap_odometry"
    assert not ability(inventory, "error against ground truth").possible


# ---- gaps -------------------------------------------------------------------------------------


def test_info_reports_count_and_duration_of_sample_gaps(tmp_path):
    log = make_log(seconds=40.0)
    for name, rate_hz, first_s in (("sensor_combined", 100, 0.0),
                                   ("vehicle_visual_odometry", 5, 0.1)):  # fmt: skip
        at = next(i for i, t in enumerate(log.topics) if t.name == name)
        seconds = first_s + np.arange(len(log.topics[at].fields["timestamp"])) / rate_hz
        lost = ((seconds > 10.0) & (seconds < 12.0)) | ((seconds > 20.0) & (seconds < 20.15))
        log.topics[at] = take(log.topics[at], np.flatnonzero(~lost))
    inventory = inventory_of(log, tmp_path)
    imu, position = source(inventory, "IMU").gaps, source(inventory, "position").gaps
    assert (imu.count, imu.limit_s) == (2, pytest.approx(0.1))
    assert imu.longest_s == pytest.approx(2.0)
    assert imu.total_s == pytest.approx(2.15)
    assert (position.count, position.limit_s) == (1, pytest.approx(1.0, abs=0.01))
    assert position.longest_s == pytest.approx(2.0, abs=0.21)
    assert source(inventory, "attitude").gaps.count == 0


# ---- flights of any reader --------------------------------------------------------------------


@pytest.mark.parametrize("flight", [
    aisle_flight(duration_s=20.0),
    aisle_flight(duration_s=0.3),  # too short for compare
    aisle_flight(duration_s=20.0, imu=None),
    aisle_flight(duration_s=20.0, attitude_hz=None),
    aisle_flight(duration_s=20.0, ekf2=None),
    aisle_flight(duration_s=20.0, ekf2=Estimator(variance_logged=False)),
    aisle_flight(duration_s=20.0, ekf2=Estimator(innovations_logged=False)),
    aisle_flight(duration_s=20.0, ekf2=Estimator(fusing=None)),
    aisle_flight(duration_s=20.0, truth=False),
    aisle_flight(duration_s=20.0, uwb=Uwb(name="vehicle_gps_position", origin=GNSS_ORIGIN)),
    replace(aisle_flight(duration_s=20.0), positions=()),
])  # fmt: skip
def test_info_lists_exactly_the_analyses_that_compare_performs(flight: Flight):
    """The flights have no streams; an analysis is possible exactly if compare performs it."""
    inventory = list_log_contents(flight)
    strict(json.dumps(to_json_dict(inventory)))
    try:
        comparison = compare(flight)
    except Px4FuseError:
        assert not ability(inventory, "compare").possible
        return
    north = next(iter(comparison.axes.values()))
    assert ability(inventory, "compare").possible
    for name, part in (
        ("acceleration", north.axis.acceleration),
        ("EKF2 states", north.ekf2_tracks.state),
        ("EKF2 variances", north.ekf2_tracks.variance),
        ("EKF2 consistency", north.filters["ekf2"]),
        ("error against ground truth", north.truth),
    ):
        assert ability(inventory, name).possible != isinstance(part, Unavailable), name


def test_info_prints_log_dropouts_and_advice(monkeypatch, tmp_path, sample_flight):
    """The golden files test other logs; the UNIX time of this one is out of range."""
    senders = (Sender(1, 197, "visual odometry", 99, None, False),)
    dropouts = (Dropout(3.0, 0.25), Dropout(7.0, 0.5))
    log = replace(sample_flight.log, format="MAVLink tlog", senders=senders, dropouts=dropouts,
                  start_unix_s=1e18)  # fmt: skip
    flight = replace(sample_flight, log=log)
    monkeypatch.setattr("px4fuse.diagnose.read_log", lambda _, **__: flight)
    assert list_log_contents(flight).start_utc is None
    text = info(tmp_path / "any.tlog")
    assert widest(text) <= WIDTH
    for words in ("unknown", "2 logger dropouts", "faster SD card"):
        assert words in text


# ---- every log --------------------------------------------------------------------------------


@pytest.mark.reallogs
def test_info_ends_without_traceback_on_each_test_log(shared_logs, monkeypatch, capsys):
    kinds = ("real/*.ulg", "simulated/*.ulg", "mavlink/*")
    paths = sorted(path for kind in kinds for path in shared_logs.glob(kind))
    assert len(paths) > 30
    taken = []

    def take(flight: Flight) -> Inventory:
        taken.append(list_log_contents(flight))
        return taken[-1]

    monkeypatch.setattr("px4fuse.info.inventory.list_log_contents", take)
    for path in paths:
        code, out, err = run_main(monkeypatch, capsys, "info", path)
        assert code in ((0,) if path.suffix == ".ulg" else (0, 2)), path.name
        assert len(err.splitlines()) == code // 2, path.name
        if code == 2:
            continue
        assert widest(out) <= WIDTH, path.name
        (inventory,) = taken
        taken.clear()
        strict(json.dumps(to_json_dict(inventory)))
        assert len(inventory.abilities) == 8, path.name
        assert all(a.reason for a in inventory.abilities), path.name
        try:
            choose_source(inventory.flight)
        except Px4FuseError:
            assert not ability(inventory, "compare").possible, path.name
            remedy = (
                "VISION_POSITION"
                if path.suffix == ".ulg"
                else "position file of the positioning system"
            )
            assert any(remedy in a.remedy for a in inventory.advice), path.name


@pytest.mark.slow
def test_info_on_log_with_any_one_topic_removed_succeeds(sample_log, tmp_path):
    whole = load(sample_log)
    short = Log([take(t, range(0, len(t.fields["timestamp"]), 40)) for t in whole.topics])
    for name in sorted(short.names()):
        less = Log([t for t in short.topics if t.name != name], whole.parameters, whole.info)
        text = json.dumps(to_json_dict(inventory_of(less, tmp_path)))
        strict(text)
    at = stamps(2.0, 10.0)
    other = Log([topic("battery_status", at, {"voltage_v": np.full(len(at), 16.0)})])
    inventory = inventory_of(other, tmp_path)
    assert all(row.unavailable for row in inventory.sources)
    assert not any(ability.possible for ability in inventory.abilities)
    assert "battery_status" in info(tmp_path / "made.ulg")
