"""Data of one flight for the interactive web page of ``px4fuse explore``."""

from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np
import pandas as pd
from scipy import stats

from px4fuse.analysis import Analysis
from px4fuse.card.build import describe_axis
from px4fuse.card.model import RATIO_AXIS_ENDS
from px4fuse.card.verdicts import make_sigma_verdicts
from px4fuse.comparison.model import AxisComparison, Comparison, ErrorsAgainstTruth
from px4fuse.comparison.preparation import shift_clock
from px4fuse.comparison.remedy import find_aid
from px4fuse.explore.packing import DRAWN_VALUE_STEPS_PER_UNIT, ArrayEncoder
from px4fuse.filter.consistency import CONFIDENCE_LEVEL, CONSISTENT_SIGMA_RATIOS
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import KF_NUMERIC_SETTINGS, SETTING_RANGES, Settings
from px4fuse.filter.signals import AISLE, Acceleration, Axis, find_imu_gaps, weighted_sum
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight.ekf2_parameters import PARAMETERS
from px4fuse.flight.model import Columns, PositionTrack, Unavailable
from px4fuse.report.card_html import MARKER_SVG_PATHS
from px4fuse.request import ComparisonRequest, command_line

# Data for the web page, in JSON types
PageData = dict[str, Any]
# Half the range (s) of the slider for the time offset
OFFSET_SLIDER_HALF_RANGE_S = 0.6


def make_flight_data(analysis: Analysis, encoder: ArrayEncoder) -> PageData:
    """Return the data of one flight for JSON; ``encoder`` encodes the arrays."""
    inputs = make_kf_inputs(analysis, encoder)
    events, request = analysis.events, analysis.request
    assert request is not None
    return {
        "log": analysis.flight.log.name,
        "settings": asdict(analysis.settings),
        "main": analysis.main.axis.name,
        "shown": [analysis.segment.whole_flight.start_s, analysis.segment.whole_flight.end_s],
        **inputs,
        "axes": [
            axis_inputs | _make_axis_data(analysis, result, encoder)
            for axis_inputs, result in zip(inputs["axes"], analysis.axes.values(), strict=True)
        ],
        "likely": _collect_estimated_noises(analysis),
        "events": {
            "gap": events.gaps,
            "dropout": events.dropouts,
            "ground": events.ground_spans_s,
            "reset": list(events.reset_times_s),
        },
        "command": _make_commands(request, analysis),
        "offset": _make_offset_slider(request, analysis),
        "flown": _format_ekf2_settings(analysis),
    }


def make_kf_inputs(comparison: Comparison, encoder: ArrayEncoder) -> PageData:
    """Return the inputs of KF: positions, accelerations and initial covariance."""
    source = undo_time_offset(comparison)
    return {
        "segment": [comparison.segment.start_s, comparison.segment.end_s],
        "start": list(INITIAL_COVARIANCE),
        "imu": _make_imu_data(comparison, encoder),
        "axes": [
            _make_axis_inputs(comparison, axis, source, encoder) for axis in comparison.input_axes
        ],
    }


def make_page_constants() -> PageData:
    """Return ranges and defaults of the KF settings, and the constants of σ ratio plots."""
    return {
        "settings": {name: (low, high) for name, (low, high, *_) in SETTING_RANGES.items()},
        "lesson": asdict(Settings()),
        "bands": CONSISTENT_SIGMA_RATIOS,
        "ends": RATIO_AXIS_ENDS,
        "marks": MARKER_SVG_PATHS,
    }


def undo_time_offset(comparison: Comparison) -> PositionTrack:
    """Return the positions with their original timestamps."""
    return shift_clock(comparison.source, -comparison.settings.clock_offset_s)


def _make_offset_slider(request: ComparisonRequest, analysis: Analysis) -> PageData:
    """Return range and estimate of the time offset, or the reason why it cannot be changed."""
    if request.position is not None:
        return {"why": "You cannot change this offset: it aligns the position file with the log."}
    applied_offset_s, clock_offset = analysis.settings.clock_offset_s, analysis.clock
    estimated_offset_s = None
    if isinstance(clock_offset, ClockOffset) and clock_offset.is_determinable:
        estimated_offset_s = applied_offset_s + clock_offset.remaining_s
    return {
        "from": applied_offset_s - OFFSET_SLIDER_HALF_RANGE_S,
        "to": applied_offset_s + OFFSET_SLIDER_HALF_RANGE_S,
        "likely": estimated_offset_s,
    }


def _make_imu_data(comparison: Comparison, encoder: ArrayEncoder) -> PageData | str:
    """Return sample times, gaps and time span (s) of the acceleration, or why it is missing."""
    acceleration = comparison.input_axes[0].acceleration
    if isinstance(acceleration, Unavailable):
        return acceleration.reason
    time_s = acceleration.time_s
    gap_start_indices = np.flatnonzero(find_imu_gaps(time_s))
    gap_bounds_s = np.stack([time_s[gap_start_indices], time_s[gap_start_indices + 1]], 1)
    cumulative_gap_duration_s = np.cumsum(np.diff(gap_bounds_s, prepend=gap_bounds_s[:, :1]))
    return {
        "time": encoder.add_times(time_s[_find_segment_slice(comparison, acceleration)]),
        "span": [time_s[0], time_s[-1]],
        "gapEdges": gap_bounds_s.ravel().tolist(),
        # total duration (s) of all gaps up to each start and each end of a gap
        "gapSum": cumulative_gap_duration_s.tolist(),
    }


def _find_segment_slice(comparison: Comparison, acceleration: Acceleration) -> slice:
    """Return the slice of IMU samples in the analysed time span, plus one sample at each end."""
    segment, time_s = comparison.segment, acceleration.time_s
    first_row = int(np.searchsorted(time_s, segment.start_s, side="right")) - 1
    end_row = int(np.searchsorted(time_s, segment.end_s)) + 1
    return slice(max(first_row, 0), end_row)


def _make_axis_inputs(
    comparison: Comparison, axis: Axis, source_track: PositionTrack, encoder: ArrayEncoder
) -> PageData:
    """Return position measurements (m) and the time integral of acceleration (m/s) along an axis.

    Measurements shortly outside the analysed time span are included, for other time offsets.
    """
    segment = comparison.segment
    time_s = source_track.samples.index.to_numpy()
    position_m = weighted_sum(source_track.samples, Columns.POSITION, axis.direction)
    margin_s = OFFSET_SLIDER_HALF_RANGE_S + abs(comparison.settings.clock_offset_s)
    is_near_segment = (time_s >= segment.start_s - margin_s) & (time_s <= segment.end_s + margin_s)
    is_near_segment &= np.isfinite(position_m)
    axis_data: PageData = {
        "name": axis.name,
        "time": encoder.add_times(time_s[is_near_segment]),
        "z": encoder.add(position_m[is_near_segment]),
    }
    if isinstance(axis.acceleration, Acceleration):
        acceleration_integral_m_s = axis.acceleration.compute_velocity_change_m_s(axis.direction)[
            _find_segment_slice(comparison, axis.acceleration)
        ]
        axis_data |= {
            "integral": encoder.add(acceleration_integral_m_s - acceleration_integral_m_s[0]),
            "rms": axis.acceleration.compute_rms_m_s2(axis.direction),
        }
    return axis_data


def _make_axis_data(analysis: Analysis, result: AxisComparison, encoder: ArrayEncoder) -> PageData:
    name = result.axis.name
    return {
        "called": result.axis.label,
        "along": describe_axis(analysis, result),
        "ratios": [verdict.ratio for verdict in make_sigma_verdicts(result)],
        "note": result.axis.note,
        "bands": _pack_nis_bands(len(result.axis.measurement_time_s), encoder),
        # key of the noise estimate: north and east may have a common estimate
        "noises": HORIZONTAL if name != "down" and HORIZONTAL in analysis.tuning else name,
        "ekf2": _make_ekf2_data(analysis, result.with_whole_flight_tracks(), encoder),
        "truth": _make_truth_data(result.with_whole_flight_tracks(), encoder),
    }


def _pack_nis_bands(innovation_count: int, encoder: ArrayEncoder) -> list[dict[str, int]]:
    """Return lower and upper limits of the 95 % band of the mean NIS, encoded for the page.

    Row n - 1 contains the limits for n innovations.
    """
    innovation_counts = np.arange(1, 2 * innovation_count + 1)
    bounds = stats.chi2.interval(CONFIDENCE_LEVEL, innovation_counts)
    return [encoder.add(bound / innovation_counts, DRAWN_VALUE_STEPS_PER_UNIT) for bound in bounds]


def _make_ekf2_data(
    analysis: Analysis, result: AxisComparison, encoder: ArrayEncoder
) -> PageData | str:
    if isinstance(result.ekf2_state, Unavailable):
        return result.ekf2_state.reason
    state = result.ekf2_state.dropna()
    summary = result.filters["ekf2"]
    ekf2_data: PageData = {
        "state": _pack_table(state, ["position_m", "velocity_m_s"], encoder),
        "variance": [],
        "innovations": [],
        "summary": {"why": summary.reason}
        if isinstance(summary, Unavailable)
        else {
            "why": "",
            "count": summary.count,
            "outside": summary.fraction_outside_two_sigma,
            "lag1": summary.lag1_autocorrelation,
        },
        "r": None,
    }
    if isinstance(summary.truth, ErrorsAgainstTruth):
        ekf2_data["summary"] |= {
            "truthP": summary.truth.position_rmse_m,
            "truthV": summary.truth.velocity_rmse_m_s,
        }
    if isinstance(result.ekf2_variance, pd.DataFrame):
        sigma = result.ekf2_variance.dropna().pow(0.5)
        ekf2_data["variance"] = _pack_table(
            sigma, ["position_variance_m2", "velocity_variance_m2_s2"], encoder
        )
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        innovations = result.ekf2_innovations
        valid_rows = innovations[
            np.isfinite(innovations["innovation_m"]) & (innovations["innovation_variance_m2"] > 0)
        ]
        drawn_innovations = valid_rows.assign(
            rejected=(valid_rows["rejected"] > 0).astype(float),
            sigma=np.sqrt(valid_rows["innovation_variance_m2"]),
        )
        ekf2_data["innovations"] = _pack_table(
            drawn_innovations, ["innovation_m", "sigma", "rejected"], encoder
        )
        variance_m2 = innovations["observation_variance_m2"].dropna()
        ekf2_data["r"] = float(np.sqrt(variance_m2.median())) if len(variance_m2) else None
    return ekf2_data


def _make_truth_data(result: AxisComparison, encoder: ArrayEncoder) -> PageData | str:
    if isinstance(result.truth, Unavailable):
        return result.truth.reason
    position = result.truth[["position_m"]].dropna()
    velocity = result.truth[["velocity_m_s"]].dropna()
    return {
        "p": _pack_table(position, ["position_m"], encoder),
        "v": _pack_table(velocity, ["velocity_m_s"], encoder) if len(velocity) else None,
    }


def _pack_table(
    table: pd.DataFrame, columns: list[str], encoder: ArrayEncoder
) -> list[dict[str, int]]:
    values = [
        encoder.add(table[column].to_numpy(), DRAWN_VALUE_STEPS_PER_UNIT) for column in columns
    ]
    return [encoder.add_times(table.index.to_numpy()), *values]


def _collect_estimated_noises(analysis: Analysis) -> PageData:
    return {
        name: [axis_tuning.sigma_a_two_state.value, axis_tuning.sigma_z.value]
        for name, axis_tuning in analysis.tuning.items()
        if isinstance(axis_tuning, AxisTuning)
    }


def _format_ekf2_settings(analysis: Analysis) -> dict[str, str]:
    """Return the EKF2 parameters for noise, delay and gate of the position source, with units."""
    aid, logged_parameters = find_aid(analysis), analysis.flight.log.parameters
    return {
        name: f"{logged_parameters[name]:.4g} {PARAMETERS[name].unit}".rstrip()
        for name in (aid.noise, aid.delay, aid.gate)
        if name in logged_parameters and name in PARAMETERS
    }


def _make_commands(request: ComparisonRequest, analysis: Analysis) -> PageData:
    """Return the ``px4fuse compare`` command of this analysis in two forms.

    In "fixed", time span and main axis are those of this analysis. In "base", px4fuse chooses both.
    """
    offset_s = None if request.position is None else request.clock_offset_s
    defaults = ComparisonRequest(log=request.log)
    kf_defaults = {name: getattr(defaults, name) for name in (*KF_NUMERIC_SETTINGS, "input")}
    base_request = msgspec.structs.replace(request, clock_offset_s=offset_s, **kf_defaults)
    heading_deg = request.heading_deg
    if heading_deg is None and AISLE in analysis.axes:
        heading_deg = analysis[AISLE].heading_deg
    fixed_request = msgspec.structs.replace(
        base_request,
        start_s=analysis.segment.start_s,
        end_s=analysis.segment.end_s,
        heading_deg=heading_deg,
    )
    return {
        "base": command_line(base_request, for_shell=True),
        "fixed": command_line(fixed_request, for_shell=True),
        "input": request.input,
        "default_input": "zero"
        if isinstance(analysis.main.axis.acceleration, Unavailable)
        else "imu",
    }
