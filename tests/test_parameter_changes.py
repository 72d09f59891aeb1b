"""EKF2 parameters that change in flight."""

from comparisons import compare
from exchange import replace
from flights import Estimator, aisle_flight, unexplained

from px4fuse.diagnose import diagnose
from px4fuse.finding import Finding
from px4fuse.findings import ekf2_settings, find
from px4fuse.flight.model import Flight, ParameterChange
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario


def with_change(flight: Flight, name: str, before: float, after: float) -> Flight:
    change = ParameterChange(60.0, name, before, after)
    return replace(flight, ekf2=replace(flight.ekf2, parameter_changes=(change,)))


def found(flight: Flight) -> Finding:
    (finding,) = ekf2_settings.detect_parameter_changes(unexplained(compare(flight)))
    return finding


def test_parameter_change_is_reported_as_cause_of_lost_fusion() -> None:
    flight = aisle_flight(ekf2=Estimator(fusing=((0.0, 1.0), (60.0, 0.0))))
    first, *others = find(unexplained(compare(with_change(flight, "EKF2_EV_CTRL", 1.0, 0.0))))
    assert (first.id, first.severity) == ("parameter_changed", "warning")
    effect = next(one for one in others if one.id.startswith("ekf2_") and "fus" in one.id)
    assert (effect.caused_by, effect.remedy) == ("parameter_changed", first.remedy)


def test_parameter_change_without_effect_has_severity_note() -> None:
    assert found(with_change(aisle_flight(), "EKF2_EVP_NOISE", 0.1, 0.11)).severity == "note"


def test_parameter_change_followed_by_larger_rmse_is_a_warning() -> None:
    flight = aisle_flight()
    state = flight.ekf2.state.copy()
    state.loc[60.0:, ["north_m", "east_m"]] += 0.5
    flight = replace(flight, ekf2=replace(flight.ekf2, state=state))
    changed = found(with_change(flight, "EKF2_EV_DELAY", 0.0, 200.0))
    assert changed.severity == "warning"
    assert "EKF2's position RMSE along the axis of largest motion is 0.0" in changed.message


def test_replay_ignores_change_of_parameter_that_it_does_not_use() -> None:
    flight = simulate_flight(Scenario(seed=2, passes=3), parse_faults([]))
    changed = with_change(flight, "EKF2_GPS_P_NOISE", 0.5, 0.6)
    replays = [
        diagnose(ComparisonRequest(log=one.log.name), flight=one).ekf2_model.baseline_replay
        for one in (flight, changed)
    ]
    for replay in replays:
        assert replay.updates["innovation_north_m"].notna().sum() > 100
