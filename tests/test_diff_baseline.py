"""A fleet against an earlier one: what is worse, and the same as JUnit XML."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest
from batch_tools import tiny_logs
from class_tools import in_turn
from cli_tools import done, refused
from scipy.stats import t as student

from px4fuse.errors import SettingsError
from px4fuse.fleet import run
from px4fuse.fleet.junit import junit
from px4fuse.fleet.regressions import MIN_FLIGHTS, marked, read_baseline
from px4fuse.fleet.rows import csv_bytes, table_of
from px4fuse.plain import number_words

AXES = ("north", "east")


def flight(number: int, *, vehicle: str = "quad", settings: str = "usual", **values) -> list[dict]:
    """Rows of one flight that is as all others are, but for some values."""
    rng = np.random.default_rng(number)
    return [
        {
            "log": f"{number}.ulg", "name": f"{number}.ulg", "log_sha256": f"{number:064x}",
            "settings": settings, "status": "done", "vehicle": vehicle, "axis": axis,
            "ekf2_nis_mean": np.exp(rng.normal(0.0, 0.1)),
            "kf_nis_mean": np.exp(rng.normal(-0.1, 0.1)),
            "sigma_z_m": 0.1 * np.exp(rng.normal(0.0, 0.05)),
            "sigma_a_m_s2": 0.3 * np.exp(rng.normal(0.0, 0.2)),
            "clock_offset_s": rng.normal(0.0, 0.02),
            "rejected_share": 0.0,
            "position_rmse_m": 0.07 * np.exp(rng.normal(0.0, 0.1)),
            **values,
        }
        for axis in AXES
    ]  # fmt: skip


def fleet(*flights: list[dict]) -> pd.DataFrame:
    return table_of(row for one in flights for row in one)


BEFORE = fleet(*(flight(number) for number in range(12)))


def changes_of(table: pd.DataFrame, baseline: pd.DataFrame = BEFORE) -> dict[tuple[str, str], str]:
    found, _ = marked(table, baseline)
    return {(row.log, row.axis): row.change for row in found.itertuples() if row.change}


# -- the same log ----------------------------------------------------------------------------------


def test_a_log_is_held_against_itself_whatever_its_settings():
    again = fleet(flight(3, settings="other", ekf2_nis_mean=4.0, sigma_z_m=0.05))
    found, against = marked(again, BEFORE)
    assert "1 by the same log, 0 by 5 or more flights of the vehicle; 0 with neither" in against
    change = found["change"].iloc[0]
    was = BEFORE.loc[BEFORE["log"] == "3.ulg", "ekf2_nis_mean"].iloc[0]
    assert change == f"NIS of EKF2 4, was {was:.3g}"  # a smaller noise is better


def test_a_log_that_fails_now_is_worse():
    assert changes_of(BEFORE) == {}
    lost, new = (
        table_of([{"log": name, "name": name, "status": "failed", "reason": "ended after 5 s"}])
        for name in ("3.ulg", "99.ulg")
    )
    assert changes_of(lost) == {("3.ulg", ""): "fails, and was compared before"}
    assert changes_of(new) == {}


# -- the vehicle's flights -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"ekf2_nis_mean": 0.2}, "NIS of EKF2 0.2, "),
        ({"clock_offset_s": -0.25}, r"clock offset -0\.25 s, -0\.0\d+ s to 0\.0\d+ s expected"),
        ({"rejected_share": 0.1}, "share that EKF2 rejected 0.1, "),
        ({"position_rmse_m": 0.3}, "ours - EKF2 0.3 m"),
    ],
)
def test_what_lies_outside_the_range_of_the_vehicle_is_worse(values, said):
    found = changes_of(fleet(flight(50, **values), flight(51)))
    assert set(found) == {("50.ulg", axis) for axis in AXES}
    assert re.search(said, found["50.ulg", "north"])
    assert ";" not in found["50.ulg", "north"]


def test_the_range_is_that_in_which_the_next_flight_is_expected():
    logs = np.log(BEFORE.loc[BEFORE["axis"] == "north", "sigma_z_m"])
    half = student.ppf(0.975, 11) * logs.std(ddof=1) * np.sqrt(1.0 + 1.0 / 12.0)
    low, high = (number_words(float(np.exp(logs.mean() + end))) for end in (-half, half))
    said = changes_of(fleet(flight(50, sigma_z_m=0.2)))["50.ulg", "north"]
    expected = f"{low} m to {high} m expected from 12 flights of the vehicle"
    assert said == f"SIGMA_Z found 0.2 m, {expected}"


def test_some_differences_say_nothing():
    better = fleet(flight(50, sigma_z_m=0.04), flight(51, ekf2_nis_mean=1.0))
    assert changes_of(better) == {}
    # with a truth the distance of the two filters
    known = {"ekf2_position_rmse_to_truth_m": 0.05}
    before = fleet(*(flight(number, **known) for number in range(12)))
    assert changes_of(fleet(flight(50, position_rmse_m=0.3, **known)), before) == {}
    worse = fleet(flight(50, ekf2_position_rmse_to_truth_m=0.06))
    assert "error of EKF2" in changes_of(worse, before)["50.ulg", "north"]
    # other vehicles, other settings and few flights
    bad = {"sigma_z_m": 0.5}
    table = fleet(flight(50, vehicle="hexa", **bad), flight(51, settings="other", **bad))
    found, against = marked(table, BEFORE)
    assert "2 with neither there" in against
    assert set(found["change"]) == {""}
    few = fleet(*(flight(number) for number in range(MIN_FLIGHTS - 1)))
    assert changes_of(fleet(flight(52, **bad)), few) == {}
    assert changes_of(fleet(flight(52, vehicle="", **bad))) == {}


def test_flights_of_the_same_vehicle_are_rarely_called_worse():
    """Of runs of twenty flights that are as the baseline's, one in twenty may have one."""
    hits = []
    for first in range(1000, 5000, 100):
        before = fleet(*(flight(number) for number in range(first, first + 15)))
        after = fleet(*(flight(number) for number in range(first + 50, first + 70)))
        hits.append(bool(changes_of(after, before)))
    assert np.mean(hits) <= 0.1


# -- files -----------------------------------------------------------------------------------------


def test_the_baseline_is_a_table_of_batch(tmp_path):
    BEFORE.to_parquet(tmp_path / "fleet.parquet")
    (tmp_path / "fleet.csv").write_bytes(csv_bytes(BEFORE))
    worse = fleet(flight(3, ekf2_nis_mean=4.0), flight(50, sigma_z_m=0.2))
    said = [changes_of(worse, read_baseline(tmp_path / f"fleet.{e}")) for e in ("parquet", "csv")]
    assert said[0] == said[1] == changes_of(worse)
    assert len(said[0]) == 4


def test_what_is_no_table_of_batch_is_refused(tmp_path):
    pd.DataFrame({"log": ["a"]}).to_parquet(tmp_path / "other.parquet")
    (tmp_path / "text.parquet").write_text("hello", encoding="utf-8")
    for name, said in (
        ("other", "has no column axis"), ("text", "cannot be read as a table"),
        ("missing", "cannot be read"),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=said):
            read_baseline(tmp_path / f"{name}.parquet")
    said = refused("batch", "x.ulg", "-o", tmp_path, "--fail-on", "worse")
    assert "requires --baseline" in said


# -- JUnit -----------------------------------------------------------------------------------------


def made(table: pd.DataFrame) -> ET.Element:
    """The suite, whose counts must be those of its cases."""
    suite = ET.fromstring(junit(table)).find("testsuite")
    for name, path in (("tests", "testcase"), ("failures", "testcase/failure"),
                       ("skipped", "testcase/skipped")):  # fmt: skip
        assert int(suite.attrib[name]) == len(suite.findall(path))
    return suite


def test_a_log_is_a_test_case_which_fails_where_it_is_worse_or_failed():
    table = table_of(
        [
            *flight(50),
            *flight(51, sigma_z_m=0.3),
            {"log": "52.ulg", "status": "failed", "reason": "ended after 5 s", "remedy": "Cut it."},
            {"log": "53.ulg", "status": "not judged", "reason": "no position", "remedy": "Log it."},
        ]
    )
    suite = made(marked(table, BEFORE)[0])
    cases = {case.attrib["name"]: case for case in suite}
    assert list(cases) == ["50.ulg", "51.ulg", "52.ulg", "53.ulg"]
    told = [child.tag for case in cases.values() for child in case]
    assert told == ["failure", "failure", "skipped"]
    worse, failed = (cases[name].find("failure") for name in ("51.ulg", "52.ulg"))
    assert worse.attrib["type"] == "worse"
    assert worse.text.splitlines()[1].startswith("east: SIGMA_Z found 0.3 m")
    assert failed.attrib == {"type": "failed", "message": "ended after 5 s. Cut it."}
    assert cases["50.ulg"].attrib["classname"] == "quad"
    # names that XML cannot hold are written without what it cannot
    table = table_of([{"log": "a\x00<&\x1b.ulg", "status": "failed", "reason": "\x07no"}])
    (case,) = made(table)
    assert (case.attrib["name"], case[0].attrib["message"]) == ("a<&.ulg", "no")


def test_the_command_marks_writes_and_fails(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "run_bounded", in_turn)
    tiny_logs(tmp_path / "logs", 1)
    common = "batch", "logs", "--axis", "north"
    options = "--baseline", "before/fleet.parquet", "--junit", "j.xml", "--fail-on", "worse"
    done(*common, "-o", "before")
    same = done(*common, "-o", "after", *options).output
    unchanged = Path("j.xml").read_bytes()
    done(*common, "-o", "worse", "--sigma-z", "0.3", *options, code=1)
    assert "Held against the baseline: 1 by the same log" in same
    assert b'failures="0"' in unchanged
    table = pd.read_parquet("worse/fleet.parquet")
    assert table["change"].iloc[0].startswith("NIS of ours")
    assert Path("j.xml").read_bytes() == junit(table)
