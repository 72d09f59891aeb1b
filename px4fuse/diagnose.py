"""Diagnosis of one flight: from a request (files and settings) to the faults, in seven steps.

1. read: log → Flight
2. prepare: position source, time span and axes
3. filter: run KF along each axis
4. compare: KF, EKF2 and ground truth
5. estimate: noises, time offset, frame misalignment, biases
6. rerun: re-run both filters with one change at a time
7. find: faults of the flight, with their causes
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from msgspec import structs

from px4fuse.analysis import AidsOnlyAnalysis, Analysis, WhatIfAnalysis
from px4fuse.comparison.comparison import compare, run_kf
from px4fuse.comparison.difference_steps import (
    corrected_settings,
    explain_ekf2_difference,
    explanation_configurations,
)
from px4fuse.comparison.estimates import (
    Estimates,
    Progress,
    estimate,
    estimate_noises_and_clock,
    ignore_progress,
)
from px4fuse.comparison.flight_events import collect_events
from px4fuse.comparison.model import Comparison, PreparedComparison
from px4fuse.comparison.preparation import explain_missing_source, prepare
from px4fuse.comparison.remedy import ml_ekf2_parameters
from px4fuse.comparison.reruns import Reruns, planned_configurations, rerun_filters
from px4fuse.convention.correction import convention_faults
from px4fuse.core.memory import release_free_memory
from px4fuse.core.reading import display_name
from px4fuse.ekf2.aids import evaluate_aids
from px4fuse.ekf2.model import Model, open_model
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2.whatif import sweep_values, what_if
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.filter.signals import AISLE
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.findings import find, find_aids
from px4fuse.flight.ekf2_parameters import check_parameters
from px4fuse.flight.model import DIAGNOSIS_WITHHELD, Flight, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.readers import read_log
from px4fuse.request import AUTO, ComparisonRequest, LoopRequest, WhatIfRequest

Result = TypeVar("Result")


def diagnose(
    request: ComparisonRequest,
    progress: Progress = ignore_progress,
    flight: Flight | None = None,
    *,
    as_sent: bool = False,
) -> Analysis:
    """Read a flight, compare KF with EKF2, and find faults (steps 1 to 7).

    Parameters
    ----------
    request : ComparisonRequest
    progress : callable
        Function that receives the name of each step of the computation.
    flight : Flight, optional
        Flight from the files of the request; without it, the files are read.
    as_sent : bool
        True to use axes, unit and timestamps of the positions as sent to PX4, without a check.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, the flight lacks required data, or a setting is out of range.
    """
    flight = flight or read_flight(request, progress)
    prepared = prepare_comparison(request, progress, flight, as_sent=as_sent)
    kf_runs = run_kf(prepared, progress)
    comparison = compare(prepared, kf_runs)
    return replace(find_faults(comparison, progress), request=request)


def find_faults(comparison: Comparison, progress: Progress = ignore_progress) -> Analysis:
    """Find the faults of a flight (steps 5 to 7): estimate errors, re-run filters, find causes.

    For a flight that is an assignment, the result contains only the comparison.
    """
    if comparison.flight.log.is_assessed:
        withheld_fields: dict[str, Any] = {
            field.name: DIAGNOSIS_WITHHELD for field in fields(Analysis) if field.default is MISSING
        }
        known_fields = {
            **vars(comparison),
            "tuning": {HORIZONTAL: DIAGNOSIS_WITHHELD},
            "difference_steps": dict.fromkeys(comparison.axes, DIAGNOSIS_WITHHELD),
            "trials": (),
            "events": collect_events(comparison),
        }
        return Analysis(**withheld_fields | known_fields)
    estimates = estimate(comparison, progress)
    release_free_memory()
    comparison = refine_delay(comparison, estimates.clock)
    reruns = rerun(comparison, estimates, progress)
    release_free_memory()
    progress("measuring the loop closure error")
    from px4fuse.loop.analysis import analyse_flight_loop  # noqa: PLC0415 - not for tune and sync

    flight = comparison.flight
    analysis = Analysis(
        **vars(comparison),
        **vars(estimates),
        **vars(reruns),
        events=collect_events(comparison),
        aids=evaluate_aids(flight),
        loop=analyse_flight_loop(flight, progress),
    )
    return replace(analysis, findings=find(analysis))


def refine_delay(comparison: Comparison, clock: ClockOffset | Unavailable) -> Comparison:
    """Replace the delay of the timestamps in the finding by the more precise estimate ``clock``.

    KF is not run again: :func:`prepare` has already subtracted the first estimate of the delay, and
    the re-runs test the remaining offset, ``clock.remaining_s``.
    """
    if comparison.convention is None or isinstance(clock, Unavailable) or not clock.is_determinable:
        return comparison
    # a time offset is negative if the timestamps are late
    refined_convention = structs.replace(comparison.convention, late_s=-clock.offset_s)
    # If the refined delay is too small for a finding, the first estimate is kept: the report must
    # contain the delay that prepare subtracted
    is_fault = all(
        convention_faults(convention, comparison.flight, comparison.source.frame).late_s
        for convention in (comparison.convention, refined_convention)
    )
    return replace(comparison, convention=refined_convention) if is_fault else comparison


def read_flight(request: ComparisonRequest, progress: Progress = ignore_progress) -> Flight:
    """Read the log of a request, and add the positions of its position file.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, or does not belong to the flight.
    """
    log_path = Path(request.log)
    progress(f"reading {display_name(log_path)}")
    flight = read_log(log_path, system=request.system)
    release_free_memory()
    requested_file, offset_s = request.position, request.clock_offset_s
    if requested_file is None:
        return flight
    # imported on demand, as alignment imports scipy.signal and scipy.ndimage, which takes 0.2 s
    from px4fuse.alignment.placement import align_position_file  # noqa: PLC0415
    from px4fuse.readers.position_file import read_position_file  # noqa: PLC0415

    position_file = read_position_file(
        requested_file.path,
        columns=requested_file.columns,
        body=requested_file.body,
        time_unit=requested_file.time_unit,
        length_unit=requested_file.length_unit,
    )
    return align_position_file(
        flight,
        position_file,
        frame=requested_file.frame,
        yaw_deg=requested_file.yaw_deg,
        clock_offset_s=None if isinstance(offset_s, str) else offset_s,
    )


def prepare_comparison(
    request: ComparisonRequest,
    progress: Progress = ignore_progress,
    flight: Flight | None = None,
    *,
    as_sent: bool = False,
) -> PreparedComparison:
    """Choose position source, time span, axes and time offset of a flight, before KF runs.

    Arguments and errors are those of :func:`diagnose`.
    """
    flight = flight or read_flight(request, progress)
    prepared = prepare(flight, request, as_sent=as_sent)
    # read_flight has already estimated the time offset of a position file
    if request.clock_offset_s != AUTO or request.position is not None:
        return prepared
    _, clock = estimate_noises_and_clock(prepared, progress)
    if isinstance(clock, Unavailable) or not clock.is_determinable:
        raise MissingDataError(
            f"{flight.log.name}: the time offset cannot be estimated from this flight "
            f"({clock.reason}).",
            "State the offset (--clock-offset SECONDS), or omit --clock-offset.",
        )
    if not clock.is_significant(clock.remaining_s):
        low, high = clock.interval_s
        note = (
            f"--clock-offset auto: the time offset {clock.offset_s:+.3f} s (95 % {low:+.3f} to "
            f"{high:+.3f} s) is not significant and was not applied"
        )
        return replace(prepared, notes=(*prepared.notes, note))
    request = structs.replace(request, clock_offset_s=clock.offset_s)
    return prepare(flight, request, as_sent=as_sent)


def rerun(
    comparison: Comparison, estimates: Estimates, progress: Progress = ignore_progress
) -> Reruns:
    """Replay EKF2, explain the difference KF - EKF2, and re-run with single errors corrected."""
    progress("replaying EKF2")
    corrected = corrected_settings(comparison, estimates.tuning)
    # all parameter sets of this step are replayed together, which is faster than one by one
    model = open_model(
        comparison.flight,
        lambda inputs: [
            *explanation_configurations(comparison, inputs, corrected),
            *planned_configurations(comparison, estimates, inputs),
        ],
    )
    release_free_memory()
    difference_steps = explain_ekf2_difference(comparison, model, estimates.clock, corrected)
    trials = rerun_filters(comparison, estimates, model)
    if isinstance(model, Model):  # frees memory; later replays are computed again
        model = replace(model, runs=(), intervals={})
    return Reruns(ekf2_model=model, difference_steps=difference_steps, trials=trials)


def diagnose_or_check_aids(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Analysis | AidsOnlyAnalysis:
    """Run :func:`diagnose`, or check only EKF2's aiding sources if the flight has no positions.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        See :func:`diagnose`; also if the flight has no positions and no innovations of EKF2.
    """
    flight = flight or read_flight(request, progress)
    if request.position_source or any(track.origin.is_automatic for track in flight.positions):
        return diagnose(request, progress, flight)
    no_position, aids = explain_missing_source(flight), evaluate_aids(flight)
    if isinstance(aids, Unavailable):
        if flight.airborne == ():
            raise MissingDataError(
                f"{flight.log.name}: the vehicle did not fly, so no analysis is possible "
                f"({aids.reason}). px4fuse info {flight.log.name} lists the logged data."
            )
        raise MissingDataError(
            f"{flight.log.name}: {no_position.reason}, and EKF2's aiding sources cannot be "
            f"checked: {aids.reason}",
            no_position.remedy,
        )
    return AidsOnlyAnalysis(flight, aids, no_position, find_aids(aids, flight.ekf2))


def run_what_if(
    request: WhatIfRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> WhatIfAnalysis:
    """Read a flight and replay EKF2 with other parameters; arguments as in :func:`diagnose`.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, EKF2 cannot be replayed from it or the replay does not agree with
        the log, or a parameter is unknown or out of PX4's range.
    """
    changes, sweep = check_parameters(request.changes), request.sweep
    swept_settings: list[dict[str, float]] = []
    if sweep is not None:
        values = sweep_values(sweep.parameter, sweep.low, sweep.high, sweep.count)
        swept_settings = [{sweep.parameter: value} for value in values]
        if sweep.parameter in changes:
            raise SettingsError(
                f"{sweep.parameter} has both a new value and a sweep.",
                f"Give a value or a sweep of {sweep.parameter}.",
            )
    comparison_request = ComparisonRequest(log=request.log, system=request.system)
    flight = flight or read_flight(comparison_request, progress)
    is_default_change = not changes and sweep is None and not request.without
    if flight.log.is_assessed and is_default_change:
        raise MissingDataError(
            f"{flight.log.name}: {DIAGNOSIS_WITHHELD.reason}", "Give --set or --sweep."
        )
    progress("replaying EKF2")
    model = require_available(open_model(flight), flight)
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable] = {}
    comparison = None
    try:
        if model.agreement.good and not flight.log.is_assessed:
            comparison_request = structs.replace(comparison_request, axes=("north", "east", AISLE))
            prepared_comparison = prepare(flight, comparison_request)
            comparison = compare(prepared_comparison, run_kf(prepared_comparison))
    except MissingDataError:  # only the default changes are computed from the comparison
        if is_default_change:
            raise
    if comparison is not None:
        tuning, clock = estimate_noises_and_clock(comparison, progress)
        corrected = corrected_settings(comparison, tuning)
        difference_steps = explain_ekf2_difference(comparison, model, clock, corrected)
        if is_default_change:
            changes = ml_ekf2_parameters(comparison, model, tuning, clock)
    parameter_sets = [changes] if changes or request.without else []
    parameter_sets += [changes | values for values in swept_settings]
    progress("replaying EKF2 with other parameters")
    replays = require_available(what_if(model, parameter_sets, request.without), flight)
    return WhatIfAnalysis(
        flight, replays, changes, is_default_change, difference_steps, request.without
    )


def require_available(result: Result | Unavailable, flight: Flight) -> Result:
    """Return ``result``, or raise MissingDataError with the reason why it is unavailable."""
    if isinstance(result, Unavailable):
        reason = f"{flight.log.name}: {result.what}: {result.reason}"
        raise MissingDataError(reason, result.remedy)
    return result


def analyse_loop_closure(request: LoopRequest, progress: Progress = ignore_progress) -> Loop:
    """Read a flight or a trajectory, measure its loop closure error and correct the path.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read or lacks required data, or a setting is out of range.
    """
    from px4fuse.loop.analysis import analyse  # noqa: PLC0415 - not for tune and sync
    from px4fuse.loop.tracks import read_source  # noqa: PLC0415

    for name in ("start_s", "end_s"):
        if not math.isfinite(getattr(request, name) or 0.0):
            raise SettingsError(f"`{name}` {getattr(request, name):g} is not a finite number.")
    progress(f"reading {display_name(Path(request.source))}")
    system, reference = request.system, None
    source = read_source(request.source, frame=request.frame, system=system)
    if request.reference is not None:
        reference = read_source(request.reference, default="truth", system=system).trajectory
    return analyse(source, request, reference, progress)
