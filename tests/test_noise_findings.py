"""Detectors on what the likelihood says: clean, faulty, unexplained, short and real flights."""

from __future__ import annotations

from functools import cache

import pytest
from exchange import replace
from flights import unexplained

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.comparison import compare
from px4fuse.filter.settings import Settings
from px4fuse.findings import Finding, noises, source_clock, source_frame, source_positions
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

DETECTORS = (
    source_clock.detect,
    source_frame.detect,
    source_positions.detect,
    noises.settings_off,
)
RIGHT = Settings(sigma_a_m_s2=0.27, sigma_z_m=0.10)
SEED = 3


@cache
def flown(settings: Settings = RIGHT, *mistakes: str) -> Analysis:
    flight = simulate_flight(Scenario(seed=SEED), parse(mistakes))
    return explain(compare(flight, settings, axes=("north", "east")))


def found(analysis: Analysis) -> dict[str, Finding]:
    return {finding.id: finding for detect in DETECTORS for finding in detect(analysis)}


def test_a_clean_flight_has_none() -> None:
    assert found(flown()) == {}


@pytest.mark.parametrize(
    ("name", "mistakes", "settings", "severity", "remedy"),
    [
        ("source_clock_offset", ("clock-offset=120ms",), {}, "error", "--clock-offset -0."),
        ("source_clock_changes", ("clock-jump=400ms",), {}, "error", "--start"),
        ("source_frame_turned", ("yaw=30",), {}, "error", "Turn the positions by -2|by -3"),
        ("source_outliers", ("nlos=5%",), {}, "error", "line of sight"),
        ("sigma_z_small", (), {"sigma_z_m": 0.02}, "error", "--sigma-z 0.09|--sigma-z 0.1"),
        ("sigma_z_large", (), {"sigma_z_m": 0.3}, "warning", "--sigma-z 0.09|--sigma-z 0.1"),
        ("sigma_a_small", (), {"sigma_a_m_s2": 0.02}, "error", "--sigma-a 0.2|--sigma-a 0.3"),
        ("sigma_a_large", (), {"sigma_a_m_s2": 2.0}, "error", "--sigma-a 0.2|--sigma-a 0.3"),
    ],
)
def test_a_mistake_is_named_with_what_to_type(name, mistakes, settings, severity, remedy) -> None:
    named = found(flown(replace(RIGHT, **settings), *mistakes))
    assert named[name].severity == severity
    # both noises make S too large; only the likelihood knows which
    if name.endswith("_large"):
        assert [other for other in named if other.startswith("sigma")] == [name]
    assert any(part in named[name].remedy for part in remedy.split("|"))


@pytest.mark.parametrize("mistake", ["clock-offset=120ms", "nlos=5%"])
def test_what_was_not_explained_is_not_guessed(mistake) -> None:
    assert found(unexplained(flown(RIGHT, mistake))) == {}


def test_a_flight_of_a_moment_says_nothing() -> None:
    flight = simulate_flight(Scenario(seed=SEED), parse(["clock-offset=120ms"]))
    short = compare(flight, RIGHT, axes=("north", "east"), start_s=20.0, end_s=22.0)
    assert found(explain(short)) == {}
