"""The Python interface: public names, arguments, errors, table, report and page."""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from class_tools import in_this_process
from cli_tools import error_line, run_checked
from conftest import LOG

import px4fuse
from px4fuse.api import SUMMARY_COLUMNS
from px4fuse.results.reading import read_results

pytestmark = pytest.mark.usefixtures("cached_analyses")


@pytest.fixture(scope="module")
def analysis(sample_log) -> px4fuse.Analysis:
    return px4fuse.compare(sample_log, sigma_z_m=0.2)


# -- names -----------------------------------------------------------------------------------------


def test_dir_of_package_lists_only_public_names() -> None:
    assert dir(px4fuse) == sorted(px4fuse.__all__)
    assert {"compare", "find", "read_log", "Settings"} <= set(dir(px4fuse))
    for name in dir(px4fuse):
        assert getattr(px4fuse, name).__name__ == name
    # completion that reads the module has no other name
    names = {name for name in vars(px4fuse) if not name.startswith("_")}
    modules = {name for name in names if f"px4fuse.{name}" in sys.modules}
    assert modules.isdisjoint(px4fuse.__all__)
    assert names - modules <= set(px4fuse.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'comapre'"):
        px4fuse.comapre  # noqa: B018


def test_names_imported_for_type_checking_are_imported_lazily() -> None:
    tree = ast.parse(Path(px4fuse.__file__).read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    read = {one.asname: node.module for node in imports for one in node.names}
    assert read == dict(px4fuse._MODULE_BY_NAME)


def test_import_px4fuse_loads_no_numeric_library() -> None:
    code = "import px4fuse, sys; print({'numpy', 'pandas', 'msgspec'} & sys.modules.keys())"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


# -- compare and find ------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_drawing")
def test_python_fault_list_equals_that_of_command_line(sample_log, analysis, tmp_path):
    command = "compare", sample_log, "--sigma-z", "0.2", "--json", "-", "-o", tmp_path / "r.pdf"
    told = json.loads(run_checked(*command).stdout)["findings"]
    typed = [(f["id"], f["message"], f["remedy"]) for f in told]
    found = px4fuse.find(analysis)
    assert [(f.id, f.message, f.remedy) for f in found] == typed
    assert "sigma_z" in " ".join(finding.id for finding in found)
    assert px4fuse.find(analysis) == found


def test_compare_of_flight_object_equals_compare_of_log_path(sample_log, analysis):
    again = px4fuse.compare(px4fuse.read_log(str(sample_log)), sigma_z_m=0.2)
    pd.testing.assert_frame_equal(px4fuse.table(again), px4fuse.table(analysis))
    assert px4fuse.find(again) == px4fuse.find(analysis)


def test_python_compare_arguments_act_like_command_options(sample_log, analysis):
    chosen = {"sigma_a_m_s2": 0.3, "sigma_z_m": 0.3, "dt_s": 0.05, "clock_offset_s": 1}
    found = px4fuse.compare(
        analysis.flight, axes="aisle", heading_deg=30, end_s=60, input="zero", **chosen
    )
    assert [axis.axis.name for axis in found.axes.values()] == ["aisle"]
    assert found["aisle"].axis.heading_deg == 30
    assert found.segment.end_s == 60
    assert found.settings == px4fuse.Settings(input="zero", **chosen)
    csv = sample_log.with_name("aisle_uwb_external.csv")
    assert px4fuse.compare(sample_log, position=csv, axes=["down"]).source.name == csv.name


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"axes": "ailse"}, "`axes` 'ailse' is unknown. Choose from north, east, down, aisle."),
        (
            {"clock_offset_s": "find"},
            "`clock_offset_s` 'find' is not a number of seconds or 'auto'",
        ),
        ({"position": "a.csv"}, "`position` and `system` cannot be given with a Flight"),
        ({"sigma_a_m_s2": -1}, "`sigma_a_m_s2` -1 is out of range"),
        ({"start_s": float("nan")}, "`start_s` nan is not a finite number."),
        ({"position_source": "gps"}, "position source gps: no such source."),
    ],
)
def test_python_compare_with_invalid_arguments_is_rejected(analysis, arguments, said):
    with pytest.raises(px4fuse.Px4FuseError) as raised:
        px4fuse.compare(analysis.flight, **arguments)
    assert said in str(raised.value)
    with pytest.raises(px4fuse.Px4FuseError, match="The axis 'up' was not analysed"):
        analysis["up"]


# -- errors ----------------------------------------------------------------------------------------


def test_out_of_range_error_names_argument_or_command_option(sample_log):
    with pytest.raises(px4fuse.Px4FuseError, match=r"^`clock_offset_s` 99 is out of range"):
        px4fuse.Settings(clock_offset_s=99.0)
    said = error_line("tune", sample_log, "--clock-offset", 99.0)
    assert said.startswith("--clock-offset 99 is out of range")


# -- table and text --------------------------------------------------------------------------------


def test_table_of_python_api_equals_numbers_of_json_results(analysis) -> None:
    table = px4fuse.table(analysis)
    assert list(table.columns) == list(SUMMARY_COLUMNS)
    assert list(table.index) == [(axis, name) for axis in analysis.axes for name in ("kf", "ekf2")]
    for (axis, name), row in table.drop(("down", "ekf2")).iterrows():
        summary = analysis[axis].filters[name]
        assert (row["nis_low"], row["nis_high"]) == summary.nis_band
        for column in set(SUMMARY_COLUMNS) - {"nis_low", "nis_high"}:
            truth = column in type(summary.truth).__struct_fields__ and column != "count"
            assert row[column] == getattr(summary.truth if truth else summary, column)


def test_python_results_table_has_nan_for_missing_innovations(analysis) -> None:
    row = px4fuse.table(analysis).loc[("down", "ekf2")]
    assert row[["count", "nis_mean", "nis_low", "nis_high", "sigma_ratio"]].isna().all()
    assert row["verdict"] == ""
    assert row["position_rmse_m"] == analysis["down"].filters["ekf2"].truth.position_rmse_m


def test_repr_of_results_shows_arrays_by_their_shape(sample_log, analysis):
    """Also of the records that are fields of a result, without the inputs of EKF2's replay."""
    vio, slam = sample_log.with_name("loop_vio.ulg"), sample_log.with_name("loop_slam.tum")
    results = {
        "analysis": analysis,
        "loop": px4fuse.close_loop(vio, reference=slam),
        "evaluation": px4fuse.evaluate(f"{vio}:vio", slam),
    }
    seen: set[int] = set()

    def walk(value: object, path: str) -> None:
        names = getattr(value, "__struct_fields__", ())
        if dataclasses.is_dataclass(value):
            names = [field.name for field in dataclasses.fields(value)]
        is_record = names and not isinstance(value, type) and "ekf2_model." not in path
        if is_record and id(value) not in seen:
            seen.add(id(value))
            whole = [getattr(value, name) for name in names]
            if any(isinstance(part, pd.DataFrame | np.ndarray) for part in whole):
                assert len(repr(value)) < 1000, path
                assert "\n0 " not in repr(value), path
            for name, part in zip(names, whole, strict=True):
                walk(part, f"{path}.{name}")
        elif isinstance(value, tuple):
            for part in value:
                walk(part, f"{path}[]")
        elif isinstance(value, dict):
            for key, part in value.items():
                walk(part, f"{path}[{key}]")

    for name, result in results.items():
        walk(result, name)
    assert len(seen) > 50


def test_python_ekf2_replay_with_larger_noise_reduces_mean_nis(analysis) -> None:
    found = px4fuse.what_if(analysis.flight, {"EKF2_EVP_NOISE": 0.3})
    assert found.whatif[0].north.nis_mean < 0.3 * found.logged.north.nis_mean


# -- files -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("cached_pages")
def test_python_write_report_equals_report_of_the_command(
    analysis: px4fuse.Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_this_process(monkeypatch)

    report = px4fuse.write_report(analysis, tmp_path / "x.pdf")
    page = px4fuse.write_page(analysis, str(tmp_path / "x.html"))
    assert report == tmp_path / "x.pdf"
    assert report.read_bytes().startswith(b"%PDF")
    assert page.read_bytes().startswith(b"<!DOCTYPE html>")
    results = read_results((tmp_path / "x.json").read_bytes())
    assert results.request.sigma_z_m == 0.2
    assert results.provenance.command == "px4fuse compare aisle_uwb.ulg --sigma-z 0.2"
    run_checked("verify", report, LOG)


def test_python_write_report_to_wrong_suffix_is_rejected(
    analysis: px4fuse.Analysis, tmp_path: Path
) -> None:
    for function, name in ((px4fuse.write_report, "x.html"), (px4fuse.write_page, "x.pdf")):
        with pytest.raises(px4fuse.Px4FuseError, match=r"must end in \.(pdf|html)"):
            function(analysis, tmp_path / name)
    bare = dataclasses.replace(analysis, request=None)
    with pytest.raises(px4fuse.Px4FuseError, match="contains no options of"):
        px4fuse.write_report(bare, tmp_path / "x.pdf")
    assert list(tmp_path.iterdir()) == []
