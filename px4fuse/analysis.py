"""Run a comparison, a loop analysis or a what-if analysis from its request.

A comparison reads and aligns the recordings of a flight, runs KF, compares KF with EKF2, and
explains the differences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from px4fuse.comparison.causal_replays import (
    Intervention,
    planned_configurations,
    run_interventions,
)
from px4fuse.comparison.comparison import compare, compare_prepared
from px4fuse.comparison.difference_steps import (
    corrected_settings,
    explain_ekf2_difference,
    explanation_configurations,
)
from px4fuse.comparison.estimates import (
    Progress,
    Tuning,
    estimate_frame_rotation,
    estimate_noises_and_clock,
    ignore_progress,
    value_or_bound,
)
from px4fuse.comparison.flight_events import Events, collect_events
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.preparation import explain_missing_source, prepare
from px4fuse.comparison.remedy import ml_ekf2_parameters
from px4fuse.comparison.trials import Trial
from px4fuse.ekf2.aids import AidResult, evaluate_aids
from px4fuse.ekf2.filter_recursion import FilterConfiguration
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, open_model
from px4fuse.ekf2.replay import Ekf2Replay
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2.whatif import WhatIf, sweep_values, what_if
from px4fuse.ekf2_parameters import check_parameters
from px4fuse.errors import LogError, MissingDataError, SettingsError
from px4fuse.filter.correlated_noise import (
    SourceLowPass,
    TimeCorrelatedNoise,
    fit_time_correlation,
    fit_time_correlation_to_truth,
)
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.hypotheses import OUTLIERS_AFTER_STEP_S, BiasScaleJumpFit, fit_bias_scale_jumps
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE, Axis
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight import Flight, Unavailable
from px4fuse.notebook_display import display_html, one_line_repr
from px4fuse.readers import read_log
from px4fuse.reading import display_name
from px4fuse.request import AUTO, ComparisonRequest, LoopRequest, WhatIfRequest

if TYPE_CHECKING:
    from px4fuse.loop.model import Loop

# Axes of the noise estimates in a report; north and east have one estimate
REPORTED_AXES = (HORIZONTAL, "down")


@dataclass(frozen=True, repr=False, kw_only=True)
class Analysis(Comparison):
    """Comparison of KF and EKF2, with estimates and re-runs that explain the differences.

    Attributes
    ----------
    flight, source, source_reason, segment, settings, lines, notes, missing, axes, horizontal
        See :class:`~px4fuse.comparison.model.Comparison`.
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
        Maximum-likelihood estimates of the noises.
    clock : ClockOffset or Unavailable
        Time offset between position source and IMU.
    ekf2_model : Model or Unavailable
        Model of EKF2 for replays; ``agreement`` compares a replay with the log.
    difference_steps : mapping from axis name to DifferenceExplanation or Unavailable
        Differences KF - EKF2 after each replacement of one EKF2 property by that of KF.
    loop : Loop or Unavailable
        Loop closure error of the flight's odometry, and corrected paths.
    heading : HeadingError or Unavailable
        Yaw misalignment of the position frame.
    request : ComparisonRequest or None
        None if :func:`explain` was called without :func:`run`.
    """

    tuning: Tuning
    clock: ClockOffset | Unavailable
    ekf2_model: Model | Unavailable
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable]
    loop: Loop | Unavailable
    heading: HeadingError | Unavailable
    request: ComparisonRequest | None = None

    def _repr_html_(self) -> str | None:
        return display_html(self)

    @property
    def ekf2_replay(self) -> Ekf2Replay | Unavailable:
        """Replay of EKF2 with the parameters as flown, and its agreement with the log."""
        model = self.ekf2_model
        return model if isinstance(model, Unavailable) else model.flown

    @cached_property
    def events(self) -> Events:
        """Events that time plots show: gaps, rejections, resets, flight modes."""
        return collect_events(self)

    @property
    def secondary_axes(self) -> list[AxisComparison]:
        """Comparisons along all axes except the main axis."""
        return [axis for axis in self.axes.values() if axis is not self.main]

    @property
    def causes(self) -> tuple[Intervention, ...]:
        """Re-runs with one change each, and the fraction of an inconsistency that it explains."""
        return self._reruns[0]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Re-runs along the main axis, with all statistics before and after the change."""
        return self._reruns[1]

    @cached_property
    def _reruns(self) -> tuple[tuple[Intervention, ...], tuple[Trial, ...]]:
        model = self.ekf2_model
        reruns = run_interventions(
            self, self.tuning, self.clock, self.heading, self.bias_scale_jump_fit, model
        )
        if isinstance(model, Model):  # frees most of the memory; a later replay is computed again
            model.runs.clear()
            model.intervals.clear()
        return reruns

    @cached_property
    def bias_scale_jump_fit(self) -> BiasScaleJumpFit | Unavailable:
        """Accelerometer biases, scale factor error and position jumps, fitted to innovations."""
        horizontal = self._horizontal_estimate()
        if isinstance(horizontal, Unavailable):
            return horizontal
        axes, axis_tuning, offset_s = horizontal
        return fit_bias_scale_jumps(
            self.flight,
            axes,
            self.settings,
            sigma_a_m_s2=value_or_bound(axis_tuning.sigma_a_two_state, self.settings.sigma_a_m_s2),
            sigma_z_m=value_or_bound(axis_tuning.sigma_z, self.settings.sigma_z_m),
            outlier_time_s=axis_tuning.outlier_time_s,
            clock_offset_s=offset_s,
        )

    @cached_property
    def time_correlation_fit(
        self,
    ) -> tuple[SourceLowPass | Unavailable, TimeCorrelatedNoise | Unavailable]:
        """Low-pass filter and time-correlated noise of the position source, without jumps."""
        horizontal = self._horizontal_estimate()
        if isinstance(horizontal, Unavailable):
            return horizontal, horizontal
        axes, axis_tuning, offset_s = horizontal
        jumps = (
            self.bias_scale_jump_fit.jumps
            if isinstance(self.bias_scale_jump_fit, BiasScaleJumpFit)
            else ()
        )
        # the exact time of a jump is unknown, so measurements just after the jump are excluded
        time_s, excluded_s = axes[0].measurement_time_s, axis_tuning.outlier_time_s
        for jump in jumps:
            is_after_jump = (time_s >= jump.time_s) & (time_s < jump.time_s + OUTLIERS_AFTER_STEP_S)
            excluded_s = np.union1d(excluded_s, time_s[is_after_jump])
        correlation_fit = fit_time_correlation(
            self.flight,
            axes,
            self.settings,
            axis_tuning.noises,
            outlier_time_s=excluded_s,
            clock_offset_s=offset_s,
            jumps=jumps,
        )
        if isinstance(correlation_fit, Unavailable):
            return correlation_fit, correlation_fit
        low_pass, correlated_noise = correlation_fit
        truths = [self.axes[axis.name].truth for axis in axes]
        available_truths = [truth for truth in truths if not isinstance(truth, Unavailable)]
        if len(available_truths) == len(axes):
            correlated_noise = fit_time_correlation_to_truth(
                axes, available_truths, excluded_s, offset_s, jumps, correlated_noise
            )
        return low_pass, correlated_noise

    @property
    def source_low_pass(self) -> SourceLowPass | Unavailable:
        return self.time_correlation_fit[0]

    @property
    def time_correlated_noise(self) -> TimeCorrelatedNoise | Unavailable:
        return self.time_correlation_fit[1]

    @cached_property
    def aids(self) -> Mapping[str, AidResult] | Unavailable:
        """Innovation statistics of each aiding source of EKF2, by PX4's name."""
        return evaluate_aids(self.flight)

    def _horizontal_estimate(self) -> tuple[tuple[Axis, ...], AxisTuning, float] | Unavailable:
        """Return horizontal axes, their noise estimates, and the time offset (s) if significant."""
        clock, offset_s = self.clock, 0.0
        if isinstance(clock, ClockOffset) and clock.is_determinable:
            offset_s = clock.remaining_s if abs(clock.remaining_s) > clock.three_sigma_s else 0.0
        for name, axis_names in ((HORIZONTAL, ("north", "east")), (AISLE, (AISLE,))):
            axis_tuning = self.tuning.get(name)
            if isinstance(axis_tuning, AxisTuning) and self.axes.keys() >= set(axis_names):
                return (
                    tuple(self.axes[axis_name].axis for axis_name in axis_names),
                    axis_tuning,
                    offset_s,
                )
        return Unavailable(
            "causes other than noise",
            "the noises along the horizontal axes could not be estimated",
            "Analyse the axes north and east, or the axis aisle (--axis).",
        )


@dataclass(frozen=True)
class AidsOnlyAnalysis:
    """Evaluation of EKF2's aiding sources in a flight without positions for KF.

    Attributes
    ----------
    flight : Flight
    aids : mapping from PX4's name to AidResult
    missing_data : Unavailable
        Reason why KF cannot be run, and the action.
    """

    flight: Flight
    aids: Mapping[str, AidResult]
    missing_data: Unavailable

    __repr__ = one_line_repr


def failed_checks(analysis: Analysis | AidsOnlyAnalysis) -> dict[str, str]:
    """Return the failed EKF2 checks of ``--checks``: axis or aiding source, and its verdict.

    A check fails if EKF2 is overconfident along an axis, or if an aiding source is overconfident,
    biased or not fused for too long.
    """
    failed = {}
    if isinstance(analysis, Analysis):
        for name, axis in analysis.axes.items():
            ekf2 = axis.filters["ekf2"]
            if not isinstance(ekf2, Unavailable) and ekf2.verdict == "overconfident":
                failed[f"EKF2, {name}"] = ekf2.verdict
    aids = {} if isinstance(analysis.aids, Unavailable) else analysis.aids
    return failed | {aid.label: aid.verdict for aid in aids.values() if aid.is_faulty}


def run_or_evaluate_aids(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Analysis | AidsOnlyAnalysis:
    """Run a comparison as :func:`run`; without positions, evaluate only EKF2's aiding sources.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        See :func:`run`; also if the flight has no positions and no innovations of EKF2.
    """
    flight = flight or read_flight(request, progress)
    has_named_source = request.position_source is not None
    if has_named_source or any(track.origin.is_automatic for track in flight.positions):
        return run(request, progress, flight)
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
    return AidsOnlyAnalysis(flight, aids, no_position)


def run(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Analysis:
    """Read a flight, compare KF with EKF2 and explain the differences.

    Parameters
    ----------
    request : ComparisonRequest
    progress : callable
        Function that receives the name of each step of the computation.
    flight : Flight, optional
        Flight from the recordings of the request; without it, the recordings are read.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, the flight lacks required data, or a setting is out of range.
    """
    return replace(explain(run_comparison(request, progress, flight), progress), request=request)


def read_flight(request: ComparisonRequest, progress: Progress = ignore_progress) -> Flight:
    """Read the recordings of a request and join them into one flight.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, or does not belong to the flight.
    """
    log = Path(request.log)
    progress(f"reading {display_name(log)}")
    flight = read_log(log, system=request.system if request.mavlink is None else None)
    # imported on demand, as alignment imports scipy.signal and scipy.ndimage, which takes 0.2 s
    if request.mavlink is not None:
        from px4fuse.alignment.merge_recordings import join  # noqa: PLC0415

        mavlink_flight = read_log(Path(request.mavlink), system=request.system)
        if not mavlink_flight.log.format.startswith("MAVLink"):
            raise LogError(
                f"--mavlink {mavlink_flight.log.name} is a {mavlink_flight.log.format}, not a "
                "MAVLink recording.",
                "Give the ULog as LOG and the recording (.tlog) with --mavlink.",
            )
        flight = join(flight, mavlink_flight)
    position, offset = request.position, request.clock_offset_s
    if position is None:
        return flight
    from px4fuse.alignment.placement import align_position_file  # noqa: PLC0415
    from px4fuse.readers.position_csv import read_position_csv  # noqa: PLC0415

    units = {"time_unit": position.time_unit, "length_unit": position.length_unit}
    position_file = read_position_csv(Path(position.path), columns=position.columns, **units)
    clock_offset_s = None if isinstance(offset, str) else offset
    return align_position_file(
        flight,
        position_file,
        frame=position.frame,
        yaw_deg=position.yaw_deg,
        clock_offset_s=clock_offset_s,
    )


def run_comparison(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Comparison:
    """Read a flight and compare KF with EKF2, without explaining the differences.

    Arguments and errors are those of :func:`run`.
    """
    prepared = prepare_comparison(request, progress, flight)
    return compare_prepared(prepared, lambda name: progress(f"running KF along {name}"))


def prepare_comparison(
    request: ComparisonRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> Comparison:
    """Read a flight and select position source, time span and axes, without running KF.

    Arguments and errors are those of :func:`run`.
    """
    clock_offset = request.clock_offset_s
    _check_finite(start_s=request.start_s, end_s=request.end_s, clock_offset_s=clock_offset)
    flight = flight or read_flight(request, progress)
    settings = Settings(
        sigma_a_m_s2=request.sigma_a_m_s2,
        sigma_z_m=Settings().sigma_z_m if request.sigma_z_m is None else request.sigma_z_m,
        dt_s=request.dt_s,
        input=request.input or "imu",
        # for a position file, align_position_file has already applied the time offset
        clock_offset_s=clock_offset
        if isinstance(clock_offset, float) and request.position is None
        else 0.0,
    )
    field_names = ("heading_deg", "position_source", "source_kind", "height", "start_s", "end_s")
    choices: dict[str, Any] = {name: getattr(request, name) for name in field_names}
    choices |= {
        "input_required": request.input == "imu",
        "sigma_z_given": request.sigma_z_m is not None,
        "axes": request.axes or None,
    }
    prepared = prepare(flight, settings, **choices)
    if clock_offset != AUTO or request.position is not None:
        return prepared
    _, clock = estimate_noises_and_clock(prepared, progress)
    if isinstance(clock, Unavailable) or not clock.is_determinable:
        raise MissingDataError(
            f"{flight.log.name}: the time offset cannot be estimated from this flight "
            f"({clock.reason}).",
            "Give --clock-offset SECONDS, or omit --clock-offset.",
        )
    low, high = clock.interval_s
    if low <= 0.0 <= high:
        note = (
            f"--clock-offset auto: the time offset {clock.offset_s:+.3f} s (95 % {low:+.3f} to "
            f"{high:+.3f} s) is not significant and was not applied"
        )
        return replace(prepared, notes=(*prepared.notes, note))
    settings = replace(settings, clock_offset_s=clock.offset_s)
    return prepare(flight, settings, **choices)


def _check_finite(**values: float | str | None) -> None:
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise SettingsError(f"`{name}` {value:g} is not a finite number.")


def analyse_loop_closure(request: LoopRequest, progress: Progress = ignore_progress) -> Loop:
    """Read a flight or a trajectory, measure its loop closure error and correct the path.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read or lacks required data, or a setting is out of range.
    """
    from px4fuse.loop.analysis import analyse  # noqa: PLC0415 - not for tune and sync
    from px4fuse.loop.tracks import read_source  # noqa: PLC0415

    _check_finite(start_s=request.start_s, end_s=request.end_s)
    progress(f"reading {display_name(Path(request.source))}")
    system, reference = request.system, None
    source = read_source(request.source, frame=request.frame, system=system)
    if request.reference is not None:
        reference = read_source(request.reference, default="truth", system=system).trajectory
    return analyse(source, request, reference, progress)


@dataclass(frozen=True)
class WhatIfAnalysis:
    """Replays of EKF2 with changed parameters or without aiding sources.

    Attributes
    ----------
    flight : Flight
    whatif : WhatIf
        Results of the replays. Its field ``whatif`` has the replay with ``changes`` and ``without``
        (if any), and then one replay for each value of the sweep.
    changes : mapping from PX4 name to value
        Changed parameters; empty if only a sweep is requested.
    uses_estimates : bool
        True if the changes are the maximum-likelihood estimates.
    without : mapping from PX4's name of an aiding source to float
        Time (s) from which EKF2 does not fuse the aiding source.
    difference_steps : mapping from axis name to DifferenceExplanation or Unavailable
        Differences between KF with default settings and EKF2 as flown; empty if not comparable.
    """

    flight: Flight
    whatif: WhatIf
    changes: Mapping[str, float]
    uses_estimates: bool
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable]
    without: Mapping[str, float] = field(default_factory=dict)

    __repr__ = one_line_repr

    @property
    def sweep_start(self) -> int:
        """Index of the first replay of the sweep in ``whatif.whatif``."""
        return int(bool(self.changes or self.without))


def run_what_if(
    request: WhatIfRequest, progress: Progress = ignore_progress, flight: Flight | None = None
) -> WhatIfAnalysis:
    """Read a flight and replay EKF2 with other parameters; arguments as in :func:`run`.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, EKF2 cannot be replayed from it or the replay does not agree with
        the log, or a parameter is unknown or out of PX4's range.
    """
    changes, sweep = check_parameters(request.changes), request.sweep
    values: list[float] = []
    if sweep is not None:
        values = sweep_values(sweep.parameter, sweep.low, sweep.high, sweep.count)
        if sweep.parameter in changes:
            raise SettingsError(
                f"{sweep.parameter} is both set and swept.", f"Set or sweep {sweep.parameter}."
            )
    recordings = ComparisonRequest(log=request.log, mavlink=request.mavlink, system=request.system)
    flight = flight or read_flight(recordings, progress)
    progress("replaying EKF2")
    model = open_model(flight)
    if isinstance(model, Unavailable):
        raise MissingDataError(f"{flight.log.name}: {model.what}: {model.reason}", model.remedy)
    is_default_change = not changes and sweep is None and not request.without
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable] = {}
    comparison = None
    try:
        if model.agreement.good:
            comparison = compare(flight, axes=("north", "east", AISLE), sigma_z_given=False)
    except MissingDataError:  # a replay of EKF2 is possible without a comparison with KF
        if is_default_change:
            raise
    if comparison is not None:
        tuning, clock = estimate_noises_and_clock(comparison, progress)
        corrected = corrected_settings(comparison, tuning)
        difference_steps = explain_ekf2_difference(comparison, model, clock, corrected)
        if is_default_change:
            changes = ml_ekf2_parameters(comparison, model, tuning, clock)
            if not changes:
                raise MissingDataError(_explain_missing_change(comparison, model))
    settings = [changes] if changes or request.without else []
    settings += [{**changes, sweep.parameter: value} for value in values] if sweep else []
    progress("replaying EKF2 with other parameters")
    replays = what_if(model, settings, request.without)
    if isinstance(replays, Unavailable):
        raise MissingDataError(
            f"{flight.log.name}: {replays.what}: {replays.reason}", replays.remedy
        )
    return WhatIfAnalysis(
        flight, replays, changes, is_default_change, difference_steps, request.without
    )


def _explain_missing_change(comparison: Comparison, model: Model) -> str:
    """Format the error that a log does not determine maximum-likelihood parameters of EKF2."""
    source = comparison.source
    reason = f"noise and delay of {source.name} cannot be estimated from this log"
    if source.origin.is_gnss or source.origin.may_drift:
        reason = (
            f"innovations do not show the slow errors of {source.name}, and the delay of "
            f"{source.name} is correct or cannot be estimated"
        )
    name, noise = comparison.flight.log.name, model.inputs.aid.noise
    return f"{name}: {reason}. Give a changed parameter, for example `changes` {noise}=0.1."


def explain(comparison: Comparison, progress: Progress = ignore_progress) -> Analysis:
    """Add noise estimates, time offset, explanations and loop closure error to a comparison."""
    names = REPORTED_AXES if {"north", "east"} <= {line.name for line in comparison.lines} else None
    tuning, clock = estimate_noises_and_clock(comparison, progress, names)
    heading = estimate_frame_rotation(comparison, tuning, clock, progress)
    progress("replaying EKF2")
    corrected = corrected_settings(comparison, tuning)

    def requested_configurations(inputs: Inputs) -> list[FilterConfiguration]:
        cause_configurations = planned_configurations(comparison, tuning, clock, heading, inputs)
        return [*explanation_configurations(comparison, inputs, corrected), *cause_configurations]

    model = open_model(comparison.flight, requested_configurations)
    difference_steps = explain_ekf2_difference(comparison, model, clock, corrected)
    progress("searching for a loop closure")
    from px4fuse.loop.analysis import analyse_flight_loop  # noqa: PLC0415 - not for tune and sync

    loop = analyse_flight_loop(comparison.flight, progress)
    return Analysis(
        **vars(comparison),
        tuning=tuning,
        clock=clock,
        ekf2_model=model,
        difference_steps=difference_steps,
        loop=loop,
        heading=heading,
    )
