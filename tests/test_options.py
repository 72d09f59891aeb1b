"""Each option of px4fuse compare reaches the analysis."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from conftest import SAMPLES
from exchange import replace

from px4fuse.comparison.comparison import compare
from px4fuse.diagnose import prepare_comparison, read_flight
from px4fuse.errors import Px4FuseError
from px4fuse.flight.model import SOURCE_ORIGINS, Flight, find_source_origin
from px4fuse.request import ComparisonRequest, PositionFile
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

pytestmark = pytest.mark.usefixtures("cached_analyses")
ULOG, TLOG = (str(SAMPLES / f"aisle_uwb.{ending}") for ending in ("ulg", "tlog"))
# A value of each field that differs from its default
CHANGED: dict[str, Any] = {
    "log": TLOG,
    "system": 250,
    "position": PositionFile(path=str(SAMPLES / "aisle_uwb_external.csv")),
    "position_source": "estimator_aid_src_ev_pos",
    "source_kind": "vio",
    "height": "gnss",  # EKF2 fused the barometer
    "sigma_a_m_s2": 0.3,
    "sigma_z_m": 0.2,
    "dt_s": 0.05,
    "input": "zero",
    "axes": ("down",),
    "heading_deg": 10.0,
    "start_s": 30.0,
    "end_s": 50.0,
    "clock_offset_s": 0.1,
}


@cache
def gnss_flight() -> Flight:
    return simulate_flight(make_scenario("outdoor", passes=1, length_m=10.0))


@cache
def outcome(request: ComparisonRequest) -> str:
    """Return inputs and results of a comparison as text, or its error."""
    is_simulated = request.log == gnss_flight().log.name
    try:
        flight = gnss_flight() if is_simulated else read_flight(request)
        prepared = prepare_comparison(flight, request)
    except Px4FuseError as error:
        return str(error)
    compared, source = compare(prepared), prepared.source
    numbers = {
        name: (axis.direction, axis.filters["kf"].nis_mean) for name, axis in compared.axes.items()
    }
    inputs = (compared.flight.log.sha256, compared.flight.inputs, source.name, source.origin)
    return repr((*inputs, source.description, compared.segment, compared.settings, numbers))


def test_each_compare_option_is_tested_with_non_default_value() -> None:
    assert set(CHANGED) == set(ComparisonRequest.__struct_fields__)


@pytest.mark.parametrize("name", CHANGED)
def test_each_option_of_compare_changes_the_results(name: str) -> None:
    request = ComparisonRequest(log=ULOG)
    if name == "system":
        request = ComparisonRequest(log=TLOG)
    elif name == "height":
        request = ComparisonRequest(log=gnss_flight().log.name, axes=("down",))
    assert outcome(replace(request, **{name: CHANGED[name]})) != outcome(request)


def test_unknown_kind_of_position_source_raises_an_error() -> None:
    for origin in SOURCE_ORIGINS:
        assert find_source_origin(origin.kind, origin.route) is origin
    with pytest.raises(ValueError, match="unknown position source: kind 'lidar'"):
        find_source_origin("lidar", "as received")
