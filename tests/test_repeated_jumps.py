"""Sources that jump repeatedly, with and without a change of reset_counter."""

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from flights import Uwb, aisle_flight, unexplained

from px4fuse.analysis import Analysis
from px4fuse.findings import source_positions
from px4fuse.flight.model import Columns

PRECISE = Uwb(rate_hz=30.0, sigma_m=0.005)


def shifted(shift_m: np.ndarray) -> Analysis:
    """Return a flight of a precise source whose north position is shifted."""
    flight = aisle_flight(uwb=PRECISE)
    samples = flight.positions[0].samples.copy()
    samples[Columns.POSITION[0]] += shift_m
    origin = replace(flight.positions[0].origin, kind="unknown")
    track = replace(flight.positions[0], samples=samples, origin=origin)
    return unexplained(compare(replace(flight, positions=(track,))))


def time_s() -> np.ndarray:
    return aisle_flight(uwb=PRECISE).positions[0].samples.index.to_numpy()


@pytest.mark.parametrize(("shift_m", "count", "words"), [
    (1.2 * (time_s() / 12.0 % 1.0), 9, "Possible causes: a relocalisation"),
    (0.18 * (time_s() // 3.0 % 2.0), 39, "of two points of the vehicle, 0.18 m apart"),
])  # fmt: skip
def test_position_jumps_without_reset_counter_are_reported(shift_m, count, words) -> None:
    (found,) = source_positions.detect_repeated_jumps(shifted(shift_m))
    assert found.evidence["count"] == pytest.approx(count, abs=2)
    assert words in found.message
    assert "does not change reset_counter" in found.message


def test_single_outliers_are_not_reported_as_jumps() -> None:
    time = time_s()
    outliers = 2.0 * (np.arange(len(time)) % 200 == 7) + 1.5 * (np.arange(len(time)) % 300 < 3)
    assert not [*source_positions.detect_repeated_jumps(shifted(outliers))]


def test_precise_positions_without_jumps_report_no_jumps() -> None:
    assert not [*source_positions.detect_repeated_jumps(shifted(0.0 * time_s()))]


def test_randomly_repeated_positions_are_not_reported_as_jumps() -> None:
    analysis = shifted(0.0 * time_s())
    track = analysis.source
    rows, is_repeated = (
        np.arange(len(track.samples)),
        np.random.default_rng(1).random(len(track.samples)) < 0.7,
    )
    last_new_rows = np.maximum.accumulate(np.where(is_repeated, 0, rows))
    samples = track.samples.iloc[last_new_rows].set_axis(track.samples.index)
    repeated = replace(analysis, source=replace(track, samples=samples))
    assert not [*source_positions.detect_repeated_jumps(repeated)]
