"""What somebody who works in a notebook meets: names, errors, results that show themselves."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from class_tools import in_this_process
from cli_tools import done, refused
from conftest import LOG
from exchange import replace
from matplotlib.axes import Axes

import px4fuse
from px4fuse.comparison.model import Comparison, UnjudgedFilter
from px4fuse.display import Shown
from px4fuse.filter.consistency import Consistency
from px4fuse.results.reading import read_results

pytestmark = pytest.mark.usefixtures("analysed_once")

# A terminal's width and a half; results that hold several others have a line for each
LINE = 200


@pytest.fixture(autouse=True)
def unseen():
    """Figures that nobody looks at are drawn without a window, and closed."""
    mpl.use("Agg")
    yield
    from matplotlib import pyplot as plt

    plt.close("all")


@pytest.fixture(scope="module")
def analysis(sample_log) -> px4fuse.Analysis:
    return px4fuse.compare(sample_log, sigma_z_m=0.2)


@pytest.fixture(scope="module")
def results(sample_log, analysis) -> dict[str, Shown]:
    """Everything that shows itself."""
    vio, slam = sample_log.with_name("loop_vio.ulg"), sample_log.with_name("loop_slam.tum")
    loop = px4fuse.close_loop(vio, reference=slam)
    evaluation = px4fuse.evaluate(f"{vio}:vio", slam)
    names = [each.name for each in dataclasses.fields(Comparison)]
    comparison = Comparison(**{name: getattr(analysis, name) for name in names})
    ours = analysis["aisle"].filters["kf"]
    consistency = {name: getattr(ours, name) for name in Consistency.__struct_fields__}
    shown = (
        analysis.flight, comparison, analysis, analysis["aisle"], Consistency(**consistency),
        analysis.why["aisle"], analysis.tuning["horizontal"], analysis.clock, loop,
        loop.odometry.trajectory, evaluation, evaluation.rpe[0],
        px4fuse.what_if(analysis.ekf2_model, {"EKF2_EVP_NOISE": 0.3}), analysis.heading,
    )  # fmt: skip
    return {type(one).__name__: one for one in shown}


NAMES = ["Analysis", *(part.__name__ for part in Shown.__subclasses__())]


# -- names -----------------------------------------------------------------------------------------


def test_dir_shows_the_public_names_alone():
    source = Path(px4fuse.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    assert dir(px4fuse) == sorted(px4fuse.__all__)
    assert {"compare", "find", "read_log", "Settings"} <= set(dir(px4fuse))
    for name in dir(px4fuse):
        assert getattr(px4fuse, name).__name__ == name
        assert f"import {name} as {name}\n" in source  # what a type checker reads
    # what completes by reading the source sees no other name either
    names = {name for name in vars(px4fuse) if not name.startswith("_")}
    modules = {name for name in names if f"px4fuse.{name}" in sys.modules}
    assert names - modules <= set(px4fuse.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'comapre'"):
        px4fuse.comapre  # noqa: B018


# -- compare and find ------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_drawing")
def test_findings_are_those_of_the_command_line(sample_log, analysis, tmp_path):
    command = "compare", sample_log, "--sigma-z", "0.2", "--json", "-", "-o", tmp_path / "r.pdf"
    told = json.loads(done(*command).stdout)["findings"]
    typed = [(f["id"], f["message"], f["remedy"]) for f in told]
    found = px4fuse.find(analysis)
    assert [(f.id, f.message, f.remedy) for f in found] == typed
    assert "sigma_z" in " ".join(finding.id for finding in found)
    assert px4fuse.find(analysis) == found


def test_a_flight_that_was_read_gives_the_same(sample_log, analysis):
    again = px4fuse.compare(px4fuse.read_log(str(sample_log)), sigma_z_m=0.2)
    pd.testing.assert_frame_equal(again.to_frame(), analysis.to_frame())
    assert px4fuse.find(again) == px4fuse.find(analysis)


def test_arguments_do_what_the_options_do(sample_log, analysis):
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
        ({"axes": "ailse"}, "`axes` 'ailse': choose from north, east, down, aisle."),
        ({"clock_offset_s": "find"}, "`clock_offset_s` 'find': give seconds, or 'auto'."),
        ({"mavlink": "a.tlog"}, "`position`, `mavlink` and `system` say what is read"),
        ({"sigma_a_m_s2": -1}, "`sigma_a_m_s2` -1 is out of range"),
        ({"start_s": float("nan")}, "`start_s` nan is not a finite number."),
        ({"position_source": "gps"}, "position source gps: no such source."),
    ],
)
def test_arguments_that_make_no_sense_are_refused(analysis, arguments, said):
    with pytest.raises(px4fuse.Px4FuseError) as raised:
        px4fuse.compare(analysis.flight, **arguments)
    assert said in str(raised.value)
    with pytest.raises(px4fuse.Px4FuseError, match="no axis 'up' here"):
        analysis["up"]


# -- errors ----------------------------------------------------------------------------------------


def test_errors_name_arguments_in_python_and_options_on_the_command_line(sample_log):
    with pytest.raises(px4fuse.Px4FuseError, match=r"^`clock_offset_s` 99 is out of range"):
        px4fuse.Settings(clock_offset_s=99.0)
    said = refused("tune", sample_log, "--clock-offset", 99.0)
    assert said.startswith("--clock-offset 99 is out of range")


# -- results that show themselves ------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_text_is_short_and_a_table_tidy_with_units(results, name):
    text, html, table = repr(results[name]), results[name]._repr_html_(), results[name].to_frame()
    assert len(text.splitlines()) <= 10
    assert all(len(line) <= LINE for line in text.splitlines()), text
    assert any(character.isdigit() for character in text)
    parser = Tags()
    parser.feed(html)
    assert parser.open == []
    assert {"pre", "table", "td"} <= parser.seen
    assert len(html) < 20_000
    assert len(table) >= 1
    assert table.columns.is_unique
    without_unit = (
        "nis_mean|nis_band|nees_|outside_|autocorrelation|gain_nats|_share|sigma_factor|_p$|bias_t|_lags|count|"
        "^([wxyzq]|(a|b|change)(_low|_high)?|delta)$|_block"  # a column has the unit
    )
    unit = r"_(m|s|m_s|m_s2|m2|m2_s2|deg)(_(interval|low|high|rmse|mean|median|std|min|max)|$)"
    for column in table.select_dtypes("floating"):
        assert re.search(f"{unit}|{without_unit}", column), column


def test_nothing_prints_a_whole_table(results):
    """What is reached from a result by its fields is short too."""
    seen: set[int] = set()

    def walk(value: object, path: str) -> None:
        names = getattr(value, "__struct_fields__", ())
        if dataclasses.is_dataclass(value):
            names = [field.name for field in dataclasses.fields(value)]
        if names and not isinstance(value, type) and id(value) not in seen:
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


def test_tables_hold_the_results(results, analysis):
    table = results["Comparison"].to_frame().set_index(["axis", "filter"])["nis_mean"]
    for owner, name in (("kf", "our filter"), ("ekf2", "EKF2")):
        assert table["aisle", name] == analysis["aisle"].filters[owner].nis_mean
    assert np.isnan(table["down", "EKF2"])  # not fused, so not judged
    series = results["AxisComparison"].to_frame()
    error = (series["kf_position_m"] - series["truth_position_m"]).to_numpy()
    assert np.sqrt(np.nanmean(error[50:] ** 2)) == pytest.approx(
        analysis["aisle"].filters["kf"].truth.position_rmse_m, rel=0.1
    )
    updates = analysis["aisle"].replay.updates
    assert list(series["kf_innovation_m"].dropna()) == list(updates["innovation_m"])
    positions = results["Flight"].to_frame().groupby("track")
    assert positions.size()["EKF2"] == len(analysis.flight.ekf2.state)
    evaluation = results["Evaluation"]
    scores = evaluation.to_frame().set_index("score")["translation_m_rmse"]
    assert scores["ATE"] == evaluation.ate.translation_m.rmse
    assert scores["RPE 5 m"] == evaluation.rpe[1].translation_m.rmse
    changed = results["WhatIf"].to_frame().set_index("ekf2")["north_nis_mean"]
    assert changed["EKF2_EVP_NOISE=0.3"] < 0.3 * changed["logged"]


class Tags(HTMLParser):
    """Opened and not yet closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.seen.add(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_truth_is_a_line_and_positions_are_dots(results):
    style = {
        re.split("[ :,]", line.get_label())[0]: (line.get_linestyle(), line.get_color())
        for line in results["Flight"].plot().lines
    }
    assert style.pop("truth") == ("-", "black")
    assert style.pop("EKF2")[0] == "--"
    assert style
    assert {dots for dots, _ in style.values()} == {"None"}


@pytest.mark.parametrize(
    "name", [name for name in NAMES if name not in ("Consistency", "HeadingError")]
)
def test_pictures_are_axes(results, name):
    drawn = np.atleast_1d(results[name].plot()).ravel()
    assert all(isinstance(ax, Axes) for ax in drawn)
    for ax in drawn:
        assert ax.has_data()
        assert ax.get_xlabel() or ax.get_ylabel()
    drawn[0].figure.canvas.draw()
    # onto axes that somebody else made
    again = results[name].plot(ax=drawn if len(drawn) > 1 else drawn[0])
    assert np.atleast_1d(again).ravel()[0] is drawn[0]


def test_another_axis_can_be_drawn_as_the_report_draws_it(results):
    """Our error lies about zero, with the band ±2σ about zero, so that it may leave the band."""
    drawn = results["Analysis"].plot(axis="down")[0]
    table = results["Analysis"]["down"].to_frame()
    error = (table["kf_position_m"] - table["truth_position_m"]).dropna()
    ours = drawn.lines[-1]
    np.testing.assert_allclose(ours.get_ydata(), np.interp(ours.get_xdata(), error.index, error))
    assert np.abs(ours.get_ydata()).max() == error.abs().max()
    (band,) = drawn.collections
    assert band.get_paths()[0].vertices[:, 1].min() < -0.05
    assert drawn.get_title() == "down"


def test_what_has_no_picture_says_so(results):
    with pytest.raises(TypeError, match="Consistency has no picture"):
        results["Consistency"].plot()


def test_a_flight_without_anything_shows_itself(analysis):
    nothing = px4fuse.Unavailable("it", "not logged", "Log it.")
    empty = replace(
        analysis.flight, positions=(), ekf2=nothing, truth=nothing, airborne=nothing,
        log=replace(analysis.flight.log, name="<b>&.ulg"),
    )  # fmt: skip
    assert "no position" in repr(empty)
    assert "&lt;b&gt;&amp;.ulg" in empty._repr_html_()  # the name of a file is no markup
    assert len(empty.to_frame()) == 0
    without = replace(
        analysis["aisle"], ekf2_state=nothing, ekf2_variance=nothing, ekf2_innovations=nothing,
        truth=nothing, filters={
            "kf": replace(analysis["aisle"].filters["kf"], truth=nothing),
            "ekf2": UnjudgedFilter("it", "not logged", "Log it.", truth=nothing),
        },
    )  # fmt: skip
    assert "no EKF2" in repr(without)
    assert not any(column.startswith(("ekf2", "truth")) for column in without.to_frame())
    assert without.plot()[0].get_ylabel() == "Position (m)"


def test_a_noise_that_is_not_known_says_so(analysis) -> None:
    for value, ends, said in (
        (None, (None, None), "not determinable"), (None, (None, 0.25), "at most 0.25 m"),
        (0.1, (None, 0.2), "0.1 (0-0.2) m"), (0.1, (0.05, None), "0.1 (0.05-?) m"),
    ):  # fmt: skip
        tuned = analysis.tuning["horizontal"]
        assert f"SIGMA_Z {said}" in repr(replace(tuned, sigma_z_m=value, sigma_z_m_interval=ends))


@pytest.mark.usefixtures("drawn_once")
def test_report_and_page_are_written_as_by_the_commands(
    analysis: px4fuse.Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import px4fuse.report.pdf  # a room of the same name as the function

    in_this_process(monkeypatch)

    report = px4fuse.report(analysis, tmp_path / "x.pdf")
    page = px4fuse.explore(analysis, str(tmp_path / "x.html"))
    assert report == tmp_path / "x.pdf"
    assert report.read_bytes().startswith(b"%PDF")
    assert page.read_bytes().startswith(b"<!DOCTYPE html>")
    results = read_results((tmp_path / "x.json").read_bytes())
    assert results.request.sigma_z_m == 0.2
    assert results.provenance.command == "px4fuse compare aisle_uwb.ulg --sigma-z 0.2"
    done("verify", report, LOG)


def test_what_cannot_be_written_is_said(analysis: px4fuse.Analysis, tmp_path: Path) -> None:
    for function, name in ((px4fuse.report, "x.html"), (px4fuse.explore, "x.pdf")):
        with pytest.raises(px4fuse.Px4FuseError, match="give a name that ends in"):
            function(analysis, tmp_path / name)
    bare = dataclasses.replace(analysis, request=None)
    with pytest.raises(px4fuse.Px4FuseError, match="does not say what was asked for"):
        px4fuse.report(bare, tmp_path / "x.pdf")
    assert list(tmp_path.iterdir()) == []


def test_counts_are_whole_and_the_parts_of_a_clock_numbered_from_one(analysis) -> None:
    assert str(analysis.to_frame()["count"].dtype) == "Int64"
    _, *parts = analysis.clock.to_frame()["part"]
    assert parts == [f"part {n}" for n in range(1, len(parts) + 1)]
    assert len(parts) >= 2
