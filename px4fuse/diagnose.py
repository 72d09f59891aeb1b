"""Diagnosis of one flight, from a request (files and settings) to the faults.

:func:`diagnose` calls:

1. read_flight: log → Flight
2. prepare_comparison: position source, time span, axes and time offset
3. compare: run KF along each axis; compare KF, EKF2 and ground truth
4. diagnose_comparison, which calls:

   a. estimate: noise σ, time offset, frame misalignment, biases
   b. refine_delay: report the time offset of step 4a, with opposite sign, as position delay
   c. rerun: replay EKF2, explain KF - EKF2, re-run both filters with one change at a time
   d. collect_events, evaluate_aids, analyse_flight_loop: events, EKF2's other aiding sources,
      loop closure error
   e. find: faults of the flight, with their causes

Signs of time offsets and delays:

- A time offset is added to the timestamps, so it is negative for late timestamps.
- A delay (late_s) has the opposite sign.

Fields of SourceTimeOffset: offset_s is the estimated time offset, applied_s the part that step 2
added to the timestamps, and remaining_s the rest. Step 4b changes only the reported delay: the
timestamps are not shifted again.

For a position file, step 1 estimates the time offset by comparison with EKF2's position. If step 4
finds that EKF2's position is late, steps 2 to 4 are repeated with a time offset that is estimated
with the IMU (_align_file_to_imu).

Further functions: :func:`diagnose_or_check_aids` also analyses flights without positions,
:func:`run_what_if` is ``px4fuse whatif``, and :func:`analyse_loop_closure` is ``px4fuse loop``.
"""

from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from msgspec import structs

from .analysis import AidingSourceAnalysis, Analysis, WhatIfAnalysis
from .comparison.comparison import compare
from .comparison.difference_steps import (
    explain_ekf2_difference,
    find_corrected_noise_settings,
    list_explanation_configurations,
)
from .comparison.estimates import (
    Estimates,
    Progress,
    estimate,
    estimate_noises_and_time_offset,
    ignore_progress,
)
from .comparison.flight_events import collect_events
from .comparison.model import Comparison, PreparedComparison
from .comparison.preparation import (
    explain_missing_source,
    prepare_comparison_inputs,
    shift_timestamps,
)
from .comparison.remedy import estimate_ekf2_parameters
from .comparison.reruns import Reruns, list_rerun_configurations, rerun_filters
from .core.memory import release_free_memory
from .core.reading import display_name
from .ekf2.aids import evaluate_aids
from .ekf2.model import Ekf2Model, prepare_ekf2_model
from .ekf2.whatif import make_sweep_values, what_if
from .errors import MissingDataError, SettingsError
from .filter.signals import AISLE_AXIS
from .filter.time_offset import SourceTimeOffset
from .filter.tuning import HORIZONTAL
from .findings import find, find_aid_findings
from .findings.model import WRONG_CONVENTION_KEY
from .findings.source_convention import detect_wrong_orientation
from .flight.ekf2_parameters import check_parameters
from .flight.model import DIAGNOSIS_WITHHELD, Flight, PositionTrack, Unavailable
from .loop.model import Loop
from .readers import read_log
from .request import AUTO, ComparisonRequest, LoopRequest, WhatIfRequest

Result = TypeVar("Result")


def diagnose(
    request: ComparisonRequest,
    progress: Progress = ignore_progress,
    flight: Flight | None = None,
) -> Analysis:
    """Read a flight, compare KF with EKF2, and find faults.

    Parameters
    ----------
    request : ComparisonRequest
    progress : callable
        Called with the name of each step of the computation.
    flight : Flight, optional
        Flight that was already read from the files of the request.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, the flight lacks required data, or a setting is out of range.
    """
    flight = flight or read_flight(request, progress)
    analysis = _diagnose_flight(request, progress, flight)
    if aligned_flight := _align_file_to_imu(flight, analysis):
        analysis = _diagnose_flight(request, progress, aligned_flight)
    return analysis


def _diagnose_flight(request: ComparisonRequest, progress: Progress, flight: Flight) -> Analysis:
    """Compare KF with EKF2 on a flight, and find faults: steps 2 to 4 of :func:`diagnose`."""
    prepared_comparison = prepare_comparison(flight, request, progress)
    progress("running KF")
    comparison = compare(prepared_comparison)
    return replace(diagnose_comparison(comparison, progress), request=request)


def _align_file_to_imu(flight: Flight, analysis: Analysis) -> Flight | None:
    """Correct the clock offset of a position file by the time offset that the IMU gives.

    The clock offset was estimated by comparison with EKF2's position, which may be late. It is not
    changed if the user gave it (clock_offset_sigma_s is None), if it does not depend on EKF2's
    position, if the analysis found no error of it, or if the positions have wrong axes. Return None
    in these cases.
    """
    alignment, time_offset = analysis.source.alignment, analysis.time_offset
    if (
        alignment is None
        or alignment.clock_offset_sigma_s is None
        or alignment.reference != "EKF2 position"
        or not isinstance(time_offset, SourceTimeOffset)
        or all(finding.id != "source_time_offset" for finding in analysis.findings)
        or any(WRONG_CONVENTION_KEY in finding.evidence for finding in analysis.findings)
    ):
        return None
    offset_s = time_offset.offset_s
    alignment = structs.replace(
        alignment,
        clock_offset_s=alignment.clock_offset_s + offset_s,
        clock_offset_sigma_s=time_offset.sigma_s,
        clock_reason="the time offset was estimated with the IMU; EKF2's position is "
        f"{abs(offset_s):.3f} s {'late' if offset_s < 0 else 'early'} relative to the IMU",
    )
    # align_position_file adds the position file as first track
    file_track, *other_tracks = flight.positions
    shifted_track = replace(shift_timestamps(file_track, offset_s), alignment=alignment)
    return replace(flight, positions=(shifted_track, *other_tracks))


def diagnose_comparison(comparison: Comparison, progress: Progress = ignore_progress) -> Analysis:
    """Estimate errors, re-run KF and EKF2, and find faults and their causes.

    If students must find the faults, only the comparison is returned.
    """
    if comparison.flight.log.is_assessed:
        withheld = DIAGNOSIS_WITHHELD
        return Analysis(
            **vars(comparison),
            tuning={HORIZONTAL: withheld},
            time_offset=withheld,
            heading=withheld,
            systematic_errors=withheld,
            source_low_pass=withheld,
            time_correlated_noise=withheld,
            ekf2_model=withheld,
            difference_steps=dict.fromkeys(comparison.axes, withheld),
            reruns=(),
            events=collect_events(comparison),
            aids=withheld,
            loop=withheld,
        )
    estimates = estimate(comparison, progress)
    release_free_memory()
    # Refine the delay that the findings report. The timestamps are not shifted again, so the
    # re-runs do not change
    comparison = refine_delay(comparison, estimates.time_offset)
    reruns = rerun(comparison, estimates, progress)
    release_free_memory()
    progress("measuring the loop closure error")
    from .loop.analysis import analyse_flight_loop  # noqa: PLC0415 - not for tune and sync

    flight = comparison.flight
    analysis = Analysis(  # inherits the fields of Comparison, Estimates and Reruns
        **vars(comparison),
        **vars(estimates),
        **vars(reruns),
        events=collect_events(comparison),
        aids=evaluate_aids(flight),
        loop=analyse_flight_loop(flight, progress, comparison.segment.flight_span_s),
    )
    return replace(analysis, findings=find(analysis))


def refine_delay(comparison: Comparison, time_offset: SourceTimeOffset | Unavailable) -> Comparison:
    """Replace the detected delay of the positions by the more precise ``time_offset``.

    Only the reported delay changes: the timestamps are not shifted again.
    """
    if (
        comparison.convention is None
        or isinstance(time_offset, Unavailable)
        or not time_offset.is_determinable
    ):
        return comparison
    # A late source has a positive delay and a negative time offset
    refined_convention = structs.replace(comparison.convention, late_s=-time_offset.offset_s)
    refined_comparison = replace(comparison, convention=refined_convention)
    # convention_faults.late_s is 0 if a delay is too small for a correction. Replace the delay only
    # if both delays are large enough, so that the fault neither appears nor disappears
    is_late_before_and_after_refinement = (
        comparison.convention_faults.late_s and refined_comparison.convention_faults.late_s
    )
    return refined_comparison if is_late_before_and_after_refinement else comparison


def read_flight(request: ComparisonRequest, progress: Progress = ignore_progress) -> Flight:
    """Read a log, and add the positions in a separate position file, if any.

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
    # imported on demand: scipy.signal and scipy.ndimage need 0.2 s
    from .alignment.placement import align_position_file  # noqa: PLC0415
    from .readers.position_file import read_position_file  # noqa: PLC0415

    position_recording = read_position_file(
        requested_file.path,
        columns=requested_file.columns,
        body=requested_file.body,
        time_unit=requested_file.time_unit,
        length_unit=requested_file.length_unit,
    )
    return align_position_file(
        flight,
        position_recording,
        frame=requested_file.frame,
        yaw_deg=requested_file.yaw_deg,
        clock_offset_s=None if isinstance(offset_s, str) else offset_s,
    )


def prepare_comparison(
    flight: Flight,
    request: ComparisonRequest,
    progress: Progress = ignore_progress,
) -> PreparedComparison:
    """Choose position source, time span, axes and time offset of a comparison.

    For arguments and errors see :func:`diagnose`.
    """
    prepared_comparison = prepare_comparison_inputs(flight, request)
    # read_flight has already corrected the time offset of a position file
    if request.clock_offset_s != AUTO or request.position is not None:
        return prepared_comparison
    _, time_offset = estimate_noises_and_time_offset(prepared_comparison, progress)
    if isinstance(time_offset, Unavailable) or not time_offset.is_determinable:
        raise MissingDataError(
            f"{flight.log.name}: the time offset cannot be estimated ({time_offset.reason}).",
            "State the offset (--clock-offset SECONDS), or omit --clock-offset.",
        )
    if not time_offset.is_significant(time_offset.remaining_s):
        # Time offset (s) that prepare_comparison_inputs has already applied to the timestamps
        applied_offset_s = time_offset.applied_s
        low_s, high_s = (limit_s - applied_offset_s for limit_s in time_offset.interval_s)
        notes = [
            *prepared_comparison.notes,
            f"--clock-offset auto: the time offset {time_offset.remaining_s:+.3f} s (95 % "
            f"{low_s:+.3f} to {high_s:+.3f} s) is not significant and not applied",
        ]
        if applied_offset_s:
            notes.append(f"the timestamps were shifted by {applied_offset_s:+.3f} s")
        return replace(prepared_comparison, notes=tuple(notes))
    request = structs.replace(request, clock_offset_s=time_offset.offset_s)
    return prepare_comparison_inputs(flight, request)


def rerun(
    comparison: Comparison, estimates: Estimates, progress: Progress = ignore_progress
) -> Reruns:
    """Explain the difference KF - EKF2, and re-run both filters with one change at a time.

    All necessary EKF2 replays are computed at once, which is faster. Both analyses then take their
    replays from ``ekf2_model.runs``, by the set of EKF2 parameters.
    """
    progress("replaying EKF2")
    estimated_settings = find_corrected_noise_settings(comparison, estimates.tuning)
    ekf2_model = prepare_ekf2_model(
        comparison.flight,
        lambda inputs: [
            *list_explanation_configurations(comparison, inputs, estimated_settings),
            *list_rerun_configurations(comparison, estimates, inputs),
        ],
    )
    release_free_memory()
    difference_steps = explain_ekf2_difference(
        comparison, ekf2_model, estimates.time_offset, estimated_settings
    )
    reruns = rerun_filters(comparison, estimates, ekf2_model)
    if isinstance(ekf2_model, Ekf2Model):  # the runs need much memory
        ekf2_model = replace(ekf2_model, runs=())
    return Reruns(ekf2_model=ekf2_model, difference_steps=difference_steps, reruns=reruns)


def diagnose_or_check_aids(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Analysis | AidingSourceAnalysis:
    """Run :func:`diagnose`; for a flight without positions, check only EKF2's aiding sources.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        As in :func:`diagnose`, or the log contains neither positions nor EKF2's innovations.
    """
    flight = flight or read_flight(request, progress)
    if request.position_source or any(
        track.origin.is_selectable_by_default for track in flight.positions
    ):
        return diagnose(request, progress, flight)
    missing_data, aids = explain_missing_source(flight), evaluate_aids(flight)
    if isinstance(aids, Unavailable):
        if flight.airborne == ():
            raise MissingDataError(
                f"{flight.log.name}: the vehicle did not fly, so no analysis is possible "
                f"({aids.reason}). px4fuse info {flight.log.name} lists the logged data."
            )
        raise MissingDataError(
            f"{flight.log.name}: {missing_data.reason}, and EKF2's aiding sources cannot be "
            f"checked: {aids.reason}",
            missing_data.remedy,
        )
    return AidingSourceAnalysis(flight, aids, missing_data, find_aid_findings(aids, flight))


def run_what_if(
    request: WhatIfRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> WhatIfAnalysis:
    """Read a flight, and replay EKF2 with changed parameters.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        The log cannot be read, EKF2 cannot be replayed or the replay does not agree with the log,
        or a parameter is unknown or out of range.
    """
    changes, sweep = check_parameters(request.changes), request.sweep
    swept_settings: list[dict[str, float]] = []
    if sweep is not None:
        values = make_sweep_values(sweep.parameter, sweep.low, sweep.high, sweep.count)
        swept_settings = [{sweep.parameter: value} for value in values]
        if sweep.parameter in changes:
            raise SettingsError(
                f"{sweep.parameter} has both a new value and a sweep.",
                "Use --set or --sweep, not both.",
            )
    comparison_request = ComparisonRequest(log=request.log, system=request.system)
    flight = flight or read_flight(comparison_request, progress)
    has_no_user_change = not changes and sweep is None and not request.without
    if flight.log.is_assessed and has_no_user_change:
        raise MissingDataError(
            f"{flight.log.name}: {DIAGNOSIS_WITHHELD.reason}",
            "State the change to replay with --set or --sweep.",
        )
    progress("replaying EKF2")
    ekf2_model = require_available(prepare_ekf2_model(flight), flight)
    if has_no_user_change and ekf2_model.agreement.good:
        comparison_request = structs.replace(comparison_request, axes=("north", "east", AISLE_AXIS))
        prepared_comparison = prepare_comparison_inputs(flight, comparison_request)
        comparison = compare(prepared_comparison)
        tuning, time_offset = estimate_noises_and_time_offset(comparison, progress)
        changes = estimate_ekf2_parameters(comparison, ekf2_model, tuning, time_offset)
    parameter_sets = [changes] if changes or request.without else []
    parameter_sets += [changes | values for values in swept_settings]
    progress("replaying EKF2 with other parameters")
    what_if_result = require_available(what_if(ekf2_model, parameter_sets, request.without), flight)
    return WhatIfAnalysis(flight, what_if_result, changes, has_no_user_change, request.without)


def require_available(result: Result | Unavailable, flight: Flight) -> Result:
    """Return ``result``; raise MissingDataError with the reason if it is unavailable."""
    if isinstance(result, Unavailable):
        reason = f"{flight.log.name}: {result.what}: {result.reason}"
        raise MissingDataError(reason, result.remedy)
    return result


def analyse_loop_closure(request: LoopRequest, progress: Progress = ignore_progress) -> Loop:
    """Read a flight or a trajectory, measure the loop closure error, and correct the path.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read or lacks required data, or a setting is out of range.
    """
    from .loop.analysis import analyse  # noqa: PLC0415 - not for tune and sync
    from .loop.tracks import find_odometry, read_trajectory_source  # noqa: PLC0415

    progress(f"reading {display_name(Path(request.source))}")
    system, reference = request.system, None
    source = read_trajectory_source(request.source, frame=request.frame, system=system)
    if request.reference is not None:
        reference = read_trajectory_source(
            request.reference, default_track="truth", system=system
        ).trajectory
    loop = analyse(source, request, reference, progress)
    if source.flight is None or loop.kind != "vio" or loop.is_assessed:
        return loop
    odometry = find_odometry(source.flight)
    assert isinstance(odometry, PositionTrack)
    orientation_findings = tuple(detect_wrong_orientation(source.flight, odometry))
    return structs.replace(loop, orientation_findings=orientation_findings)
