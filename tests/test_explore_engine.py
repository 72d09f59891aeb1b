"""KF of the explore page in a browser, compared with px4fuse.run_kf."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from comparisons import compare
from exchange import replace
from explore_tools import ask
from flights import Imu, Uwb, aisle_flight

from px4fuse.comparison.model import Comparison
from px4fuse.comparison.preparation import shift_timestamps
from px4fuse.explore.data import (
    KF_INPUT_ROUNDING_STEPS_PER_UNIT,
    OFFSET_SLIDER_HALF_RANGE_S,
    ArrayEncoder,
    make_kf_inputs,
)
from px4fuse.filter.kalman import KfRun, predict_track, run_kf
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import make_axes
from px4fuse.readers import read_log

TRIES = 50
TOLERANCE = 1e-9
# Runs the engine on one flight with all settings
SCRIPT = """(async () => {
  const arrays = await Engine.unpack(%(text)s);
  const withArrays = (_, value) => value?.array === undefined ? value : arrays[value.array];
  const flight = JSON.parse(%(flight)s, withArrays);
  return %(tries)s.map(([at, settings]) => {
    const run = Engine.replay(flight, flight.axes[at], settings);
    const lists = (part) => Object.fromEntries(
      Object.entries(part).map(([name, values]) => [name, Array.from(values)]));
    const early = flight.segment[0] - 1;
    const between = Float64Array.from({ length: 400 }, (_, i) => early + 0.0813 * i);
    return { steps: lists(run.steps), updates: lists(run.updates),
      between: lists({ time: between, ...Engine.stateAt(run, between) }) };
  });
})()"""


# Columns of a replay: name in the page, name in Python
COLUMNS = {
    "steps": {
        "time": "time", "p": "position_m", "v": "velocity_m_s", "p00": "position_variance_m2",
        "p01": "covariance_m2_s", "p11": "velocity_variance_m2_s2",
    },
    "updates": {
        "time": "time", "z": "measurement_m", "nu": "innovation_m", "s": "innovation_variance_m2",
        "k0": "gain_position", "k1": "gain_velocity", "p": "prior_position_m",
        "p00": "prior_position_variance_m2", "p11": "prior_velocity_variance_m2_s2",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def engine(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Browser:
    file = tmp_path_factory.mktemp("engine") / "engine.html"
    code = files("px4fuse.explore").joinpath("engine.js").read_text(encoding="utf-8")
    file.write_text(f"<meta charset=utf-8><script>{code}</script>", encoding="utf-8")
    browser.open(file)
    return browser


def in_browser(
    engine: Browser, comparison: Comparison, tries: list[tuple[int, Settings]]
) -> list[dict[str, dict[str, list[float]]]]:
    encoder = ArrayEncoder()
    flight = make_kf_inputs(comparison, encoder)
    tries_for_page = [(at, asdict(settings)) for at, settings in tries]
    values = {
        "text": encoder.text(), "flight": json.dumps(flight),
        "tries": tries_for_page,
    }  # fmt: skip
    return list(ask(engine, SCRIPT % {name: json.dumps(one) for name, one in values.items()}))


def in_python(comparison: Comparison, at: int, settings: Settings) -> KfRun:
    """Run KF in Python with the segment and the aisle of the comparison."""
    change_s = settings.clock_offset_s - comparison.settings.clock_offset_s
    track = shift_timestamps(comparison.source, change_s)
    original = list(comparison.axes.values())[at].axis
    axis = make_axes(
        comparison.flight, track, comparison.segment, names=(original.name,),
        heading_deg=original.heading_deg if original.name == "aisle" else None,
    )[0]  # fmt: skip
    return run_kf(axis, settings)


def some_settings(rng: np.random.Generator, imu: bool) -> Settings:
    a, z, dt = np.exp(rng.uniform(np.log([1e-3, 1e-3, 0.02]), np.log([50.0, 5.0, 1.0]))).tolist()
    offset = (
        0.0 if rng.random() < 0.2 else float(rng.uniform(-1.0, 1.0)) * OFFSET_SLIDER_HALF_RANGE_S
    )
    if rng.random() < 0.3:  # a grid that contains the measurement times
        dt, offset = float(rng.choice([0.1, 0.2, 0.05])), round(offset, 1)
    return Settings(a, z, dt, "imu" if imu and rng.random() < 0.8 else "zero", offset)


def flights(name: str, sample_log: Path) -> Comparison:
    if name == "sample":
        return compare(read_log(sample_log), start_s=20.0, end_s=45.0)
    if name == "odometry":
        log = read_log(sample_log.with_name("loop_vio.ulg"))
        return compare(log, start_s=30.0, end_s=45.0)
    if name == "IMU with a gap":
        flight = aisle_flight(duration_s=30.0, imu=Imu(gap_s=(9.0, 11.5)))
        # the IMU also ends before the position source
        return compare(replace(flight, imu=flight.imu.loc[:27.0]))
    return compare(aisle_flight(duration_s=30.0, imu=None, uwb=Uwb(gap_s=(12.0, 16.0))))


@pytest.mark.parametrize("name", ["sample", "odometry", "IMU with a gap", "no IMU, gap in source"])
def test_javascript_kf_matches_python_replay(engine: Browser, sample_log: Path, name: str) -> None:
    comparison = flights(name, sample_log)
    rng = np.random.default_rng(len(name))
    imu = comparison.settings.input == "imu"
    axes = len(comparison.axes)
    tries = [(int(rng.integers(axes)), some_settings(rng, imu)) for _ in range(TRIES)]
    gaps = 0
    for (at, settings), page in zip(tries, in_browser(engine, comparison, tries), strict=True):
        run = in_python(comparison, at, settings)
        gaps += run.input_gap_s > 0.0
        for part, columns in COLUMNS.items():
            frame = getattr(run, part).rename_axis("time").reset_index()
            for column, python_column in columns.items():
                close(page[part][column], frame[python_column], column, settings)
        times = np.array(page["between"]["time"])
        # null in JSON means no state
        found = np.array(page["between"]["p"], dtype=float)
        close(list(found), predict_track(run, times)["position_m"].to_numpy(), "p", settings)
    assert (gaps > 0) == (name == "IMU with a gap")


def close(page: list[float], expected: Any, column: str, settings: Settings) -> None:
    """Check a column of the page; variances, up to 1e4 after a gap, relative to their size."""
    assert len(page) == len(expected), (column, asdict(settings))
    relative = 0.0 if column in ("nu", "p", "v", "z", "time") else TOLERANCE
    np.testing.assert_allclose(
        page, np.asarray(expected), rtol=relative, atol=TOLERANCE, err_msg=f"{column} {settings}"
    )


def test_javascript_unpack_restores_packed_arrays(engine: Browser) -> None:
    rng = np.random.default_rng(2)
    encoder = ArrayEncoder()
    arrays = [
        rng.normal(0.0, 100.0, 500), np.empty(0), np.array([-1e9, 1e9, 0.0]),
        np.arange(1000) / 250.0, np.zeros(5),
    ]  # fmt: skip
    for values in arrays:
        encoder.add(values)
    encoder.add_times(np.array([0.1, 0.2, 123.456789]))
    unpacked = ask(
        engine,
        f"Engine.unpack({json.dumps(encoder.text())})"
        ".then((all) => all.map((one) => Array.from(one)))",
    )
    for back, values in zip(unpacked, arrays, strict=False):
        # very large numbers have larger steps
        step = (
            1.0 / KF_INPUT_ROUNDING_STEPS_PER_UNIT
            if np.max(np.abs(values), initial=0.0) < 1e5
            else 1e-6
        )
        np.testing.assert_allclose(back, values, rtol=0.0, atol=step)
    assert unpacked[-1] == [0.1, 0.2, 123.456789]


def test_javascript_kf_with_too_few_measurements_returns_null(engine: Browser) -> None:
    comparison = compare(aisle_flight(duration_s=30.0))
    encoder = ArrayEncoder()
    flight = make_kf_inputs(comparison, encoder)
    flight["segment"] = [flight["segment"][0], flight["segment"][0] + 0.05]
    flight["axes"] = [{"time": [0.0, 1.0, 2.0], "z": [0.0, 0.0, 0.0]}]
    settings = asdict(Settings(input="zero"))
    script = f"Engine.replay({json.dumps(flight)}, {json.dumps(flight['axes'][0])}, "
    assert ask(engine, f"{script}{json.dumps(settings)})") is None
