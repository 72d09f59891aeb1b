"""The shipped table of false-alarm rates and power, and that this code still makes it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from px4fuse.simulation.detector_rates import CLEAN, CONDITIONS, RIGHT, Condition, found, rates

TABLE = rates()


def test_the_table_covers_every_condition() -> None:
    faulty = TABLE[TABLE["condition"] != CLEAN]
    pairs = list(zip(faulty["finding"], faulty["condition"], strict=True))
    assert pairs == [(condition.finding, condition.typed) for condition in CONDITIONS]


def test_no_detector_cries_wolf_on_more_than_two_clean_flights_in_a_hundred() -> None:
    clean = TABLE[TABLE["condition"] == CLEAN]
    assert clean["flights"].min() >= 200
    assert clean["rate"].max() <= 0.02


@pytest.mark.parametrize("finding", sorted({condition.finding for condition in CONDITIONS}))
def test_every_detector_finds_its_mistake_at_the_size_stated(finding) -> None:
    rows = TABLE[(TABLE["finding"] == finding) & (TABLE["condition"] != CLEAN)]
    assert rows["rate"].max() >= 0.95


def test_the_code_still_does_what_the_table_says() -> None:
    certain = {(row.finding, row.condition) for row in TABLE.itertuples() if row.rate == 1.0}
    assert found(5) == ()
    for condition in (
        Condition("source_clock_offset", "--mistake clock-offset=250ms"),
        Condition("source_frame_turned", "--mistake yaw=30"),
        Condition("sigma_z_large", "sigma_z_m=0.3"),
        Condition("source_gap", "--mistake dropout=2s"),
    ):
        assert (condition.finding, condition.typed) in certain
        assert condition.finding in found(20_000, condition)


def test_a_condition_is_read_as_it_is_typed() -> None:
    both = Condition("", "--kind loop --mistake nlos=1% --mistake open-end=3m sigma_z_m=0.3")
    assert both.kind == "loop"
    assert both.mistakes == ("nlos=1%", "open-end=3m")
    assert both.settings == replace(RIGHT, sigma_z_m=0.3)
    clean = Condition("", "")
    assert (clean.kind, clean.mistakes, clean.settings) == ("aisle", (), RIGHT)
