"""The engine of the page in a real browser, against px4fuse.replay."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from exchange import replace
from explore_tools import ask
from flights import Imu, Uwb, aisle_flight

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.preparation import shift_clock
from px4fuse.explore.data import OFFSET_REACH_S, raw_source, replay_signals
from px4fuse.explore.packing import FINE_SCALE, Packer
from px4fuse.filter.kalman import Replay, replay, state_at
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import make_axes
from px4fuse.readers import read_log

TRIES = 50
TOLERANCE = 1e-9
# What the engine makes of one flight, all settings in one go
SCRIPT = """(async () => {
  const arrays = await Engine.unpack(%(text)s, %(specs)s);
  const flight = %(flight)s;
  if (flight.imu.time !== undefined) flight.imu.time = arrays[flight.imu.time];
  for (const axis of flight.axes) {
    for (const name of ["time", "z", "integral"]) {
      if (axis[name] !== undefined) axis[name] = arrays[axis[name]];
    }
  }
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


# What the page calls the columns of a replay
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
    packer = Packer()
    flight = replay_signals(comparison, packer)
    asked = [
        (at, {"sigmaA": one.sigma_a_m_s2, "sigmaZ": one.sigma_z_m, "dt": one.dt_s,
              "input": one.input, "offset": one.clock_offset_s})
        for at, one in tries
    ]  # fmt: skip
    words = {"text": packer.text(), "specs": packer.specs, "flight": flight, "tries": asked}
    made = ask(engine, SCRIPT % {name: json.dumps(value) for name, value in words.items()})
    return list(made)


def in_python(comparison: Comparison, at: int, settings: Settings) -> Replay:
    """As ``compare`` would with the segment and the aisle held."""
    track = shift_clock(raw_source(comparison), settings.clock_offset_s)
    held = list(comparison.axes.values())[at].axis
    axis = make_axes(
        comparison.flight, track, comparison.segment, names=(held.name,),
        heading_deg=held.heading_deg if held.name == "aisle" else None,
    )[0]  # fmt: skip
    return replay(axis, settings)


def some_settings(rng: np.random.Generator, imu: bool) -> Settings:
    a, z, dt = np.exp(rng.uniform(np.log([1e-3, 1e-3, 0.02]), np.log([50.0, 5.0, 1.0]))).tolist()
    offset = 0.0 if rng.random() < 0.2 else float(rng.uniform(-1.0, 1.0)) * OFFSET_REACH_S
    if rng.random() < 0.3:  # a grid that measurements fall on
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
        # and ends before the source does
        return compare(replace(flight, imu=flight.imu.loc[:27.0]))
    return compare(aisle_flight(duration_s=30.0, imu=None, uwb=Uwb(gap_s=(12.0, 16.0))))


@pytest.mark.parametrize("name", ["sample", "odometry", "IMU with a gap", "no IMU, silent source"])
def test_the_page_replays_as_python_does(engine: Browser, sample_log: Path, name: str) -> None:
    comparison = flights(name, sample_log)
    rng = np.random.default_rng(len(name))
    imu = comparison.settings.input == "imu"
    axes = len(comparison.axes)
    tries = [(int(rng.integers(axes)), some_settings(rng, imu)) for _ in range(TRIES)]
    gaps = 0
    for (at, settings), made in zip(tries, in_browser(engine, comparison, tries), strict=True):
        run = in_python(comparison, at, settings)
        gaps += run.input_gap_s > 0.0
        for part, columns in COLUMNS.items():
            frame = getattr(run, part).rename_axis("time").reset_index()
            for column, ours in columns.items():
                close(made[part][column], frame[ours], column, settings)
        times = np.array(made["between"]["time"])
        for column, values in zip(("p", "v"), state_at(run, times), strict=True):
            # JSON has null where there is no state
            found = np.array(made["between"][column], dtype=float)
            close(list(found), values, column, settings)
    assert (gaps > 0) == (name == "IMU with a gap")


def close(made: list[float], expected: Any, column: str, settings: Settings) -> None:
    assert len(made) == len(expected), (column, asdict(settings))
    # variances after a gap are of the order of 1e4: of those its share
    share = 0.0 if column in ("nu", "p", "v", "z", "time") else TOLERANCE
    np.testing.assert_allclose(
        made, np.asarray(expected), rtol=share, atol=TOLERANCE, err_msg=f"{column} {settings}"
    )


def test_arrays_come_back_as_they_went(engine: Browser) -> None:
    rng = np.random.default_rng(2)
    packer = Packer()
    given = [
        rng.normal(0.0, 100.0, 500), np.empty(0), np.array([-1e9, 1e9, 0.0]),
        np.arange(1000) / 250.0, np.zeros(5),
    ]  # fmt: skip
    for values in given:
        packer.add(values)
    packer.add_times(np.array([0.1, 0.2, 123.456789]))
    made = ask(
        engine,
        f"Engine.unpack({json.dumps(packer.text())}, {json.dumps(packer.specs)})"
        ".then((all) => all.map((one) => Array.from(one)))",
    )
    for back, values in zip(made, given, strict=False):
        # half a step, of which very large numbers have fewer
        step = 1.0 / FINE_SCALE if np.max(np.abs(values), initial=0.0) < 1e5 else 1e-6
        np.testing.assert_allclose(back, values, rtol=0.0, atol=step)
    assert made[-1] == [0.1, 0.2, 123.456789]


def test_too_few_measurements_give_no_replay(engine: Browser) -> None:
    comparison = compare(aisle_flight(duration_s=30.0))
    packer = Packer()
    flight = replay_signals(comparison, packer)
    flight["segment"] = [flight["segment"][0], flight["segment"][0] + 0.05]
    flight["axes"] = [{"time": [0.0, 1.0, 2.0], "z": [0.0, 0.0, 0.0]}]
    settings = {"sigmaA": 0.5, "sigmaZ": 0.1, "dt": 0.1, "input": "zero", "offset": 0.0}
    script = f"Engine.replay({json.dumps(flight)}, {json.dumps(flight['axes'][0])}, "
    assert ask(engine, f"{script}{json.dumps(settings)})") is None
