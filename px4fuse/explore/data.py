"""Data of one flight for the interactive web page of ``px4fuse explore``.

The arrays are encoded compactly: numbers are rounded to integers, and their differences are
compressed (deflate).
"""

import base64
import json
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import msgspec
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.preparation import shift_timestamps
from px4fuse.comparison.remedy import find_aid
from px4fuse.core.arrays import Array
from px4fuse.filter.consistency import CONFIDENCE_LEVEL
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import SETTING_RANGES
from px4fuse.filter.signals import AISLE_AXIS, Acceleration, Axis, find_imu_gaps, weighted_sum
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Columns, PositionTrack, Unavailable
from px4fuse.request import DT_S, SIGMA_A_M_S2, ComparisonRequest, command_line

# Data for the web page, in JSON types
PageData = dict[str, Any]
# Half the range (s) of the slider for the time offset
OFFSET_SLIDER_HALF_RANGE_S = 0.6
# Rounding steps per unit (m, m/s or s) for the inputs of KF; integers compress well
KF_INPUT_ROUNDING_STEPS_PER_UNIT = 2.0**36
# Values that are only drawn or averaged are rounded to 1 ÷ this number
DRAWN_VALUE_ROUNDING_STEPS_PER_UNIT = 1e6
# Limit of the rounded values: JavaScript represents integers exactly up to twice this limit
MAX_EXACT_INTEGER = 2.0**52


@dataclass
class ArrayEncoder:
    """Encoder of the arrays for the web page.

    Each array is stored as scale, and differences of successive values that are rounded to
    integers.
    """

    _encoded_arrays: list[tuple[float, list[int]]] = field(default_factory=list)

    def add(self, values: Array, scale: float = KF_INPUT_ROUNDING_STEPS_PER_UNIT) -> dict[str, int]:
        """Add an array, rounded to ``scale`` steps per unit.

        Return ``{"array": index}``, which replaces the array in the JSON data.
        """
        values = np.asarray(values, dtype=np.float64)
        largest_value = float(np.max(np.abs(values), initial=1.0))
        while largest_value * scale > MAX_EXACT_INTEGER:
            scale /= 2.0
        integers = np.rint(values * scale).astype(np.int64)
        self._encoded_arrays.append((scale, np.diff(integers, prepend=0).tolist()))
        return {"array": len(self._encoded_arrays) - 1}

    def add_times(self, time_s: Array) -> dict[str, int]:
        """Add times (s); whole microseconds, as in PX4 logs, are stored without rounding."""
        has_whole_microseconds = bool(np.all(np.abs(np.rint(time_s * 1e6) / 1e6 - time_s) < 1e-10))
        return self.add(time_s, 1e6 if has_whole_microseconds else KF_INPUT_ROUNDING_STEPS_PER_UNIT)

    def text(self) -> str:
        """Return all arrays as one base64 text of compressed JSON."""
        text = json.dumps(self._encoded_arrays, separators=(",", ":"))
        return base64.b64encode(zlib.compress(text.encode(), 9)).decode()


def make_flight_data(analysis: Analysis, encoder: ArrayEncoder) -> PageData:
    """Return the data of one flight for JSON; ``encoder`` encodes the arrays."""
    inputs = make_kf_inputs(analysis, encoder)
    request = analysis.request
    assert request is not None
    offset_s = analysis.settings.clock_offset_s
    # a position file is aligned with the log, so its offset is fixed
    half_range_s = OFFSET_SLIDER_HALF_RANGE_S if request.position is None else 0.0
    limits = {name: (low, high) for name, (low, high, *_) in SETTING_RANGES.items()}
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
        # SIGMA_A and SIGMA_Z by axis
        "likely": {
            name: [axis_tuning.sigma_a_two_state.value, axis_tuning.sigma_z.value]
            for name, axis_tuning in analysis.tuning.items()
            if isinstance(axis_tuning, AxisTuning)
        },
        "likely_offset": _find_estimated_offset(analysis),
        "gaps": analysis.events.gaps,
        "command": _make_command(request, analysis),
        "limits": limits | {"clock_offset_s": (offset_s - half_range_s, offset_s + half_range_s)},
        "flown": _format_ekf2_settings(analysis),
    }


def make_kf_inputs(comparison: Comparison, encoder: ArrayEncoder) -> PageData:
    """Return the inputs of KF: positions, accelerations and initial covariance."""
    # positions with their original timestamps
    source = shift_timestamps(comparison.source, -comparison.settings.clock_offset_s)
    return {
        "segment": [comparison.segment.start_s, comparison.segment.end_s],
        "start": list(INITIAL_COVARIANCE),
        "imu": _make_imu_data(comparison, encoder),
        "axes": [_make_axis_inputs(axis, source, encoder) for axis in comparison.input_axes],
    }


def _find_estimated_offset(analysis: Analysis) -> float | None:
    """Return the estimated time offset (s) of the position source, if it is determinable."""
    estimate = analysis.time_offset
    if isinstance(estimate, SourceTimeOffset) and estimate.is_determinable:
        return analysis.settings.clock_offset_s + estimate.remaining_s
    return None


def _make_imu_data(comparison: Comparison, encoder: ArrayEncoder) -> PageData | str:
    """Return sample times and gaps (s) of the acceleration, or why it is missing."""
    acceleration = comparison.input_axes[0].acceleration
    if isinstance(acceleration, Unavailable):
        return acceleration.reason
    time_s = acceleration.time_s
    gap_start_indices = np.flatnonzero(find_imu_gaps(time_s))
    gap_bounds_s = np.stack([time_s[gap_start_indices], time_s[gap_start_indices + 1]], 1)
    # Total duration (s) before the first gap, and after each gap
    total_gap_duration_s = np.append(0.0, np.cumsum(np.diff(gap_bounds_s)))
    return {
        "time": encoder.add_times(time_s),
        "gapEdges": gap_bounds_s.ravel().tolist(),
        # Total gap length (s) at each gap edge. It is constant between gaps, and linear in a gap
        "gapSum": np.repeat(total_gap_duration_s, 2)[1:-1].tolist(),
    }


def _make_axis_inputs(axis: Axis, source_track: PositionTrack, encoder: ArrayEncoder) -> PageData:
    """Return position measurements (m) and the time integral of acceleration (m/s) along an axis.

    Data outside the analysed time span are included: if the user of the page changes the time
    offset, they may move into the time span.
    """
    position_m = weighted_sum(source_track.samples, Columns.POSITION, axis.direction)
    is_finite = np.isfinite(position_m)
    axis_data: PageData = {
        "name": axis.name,
        "time": encoder.add_times(source_track.samples.index.to_numpy()[is_finite]),
        "z": encoder.add(position_m[is_finite]),
    }
    if isinstance(axis.acceleration, Acceleration):
        axis_data |= {
            "integral": encoder.add(axis.acceleration.compute_velocity_change_m_s(axis.direction)),
            "rms": axis.acceleration.compute_rms_m_s2(axis.direction),
        }
    return axis_data


def _make_axis_data(analysis: Analysis, result: AxisComparison, encoder: ArrayEncoder) -> PageData:
    """Return the results along one axis for the page: NIS bands, EKF2 and ground truth."""
    name, whole_flight = result.axis.name, result.with_whole_flight_tracks()
    return {
        "note": result.axis.note,
        "bands": _pack_nis_bands(len(result.axis.measurement_time_s), encoder),
        # key of the noise estimate: north and east may have a common estimate
        "noises": HORIZONTAL if name != "down" and HORIZONTAL in analysis.tuning else name,
        "ekf2": _make_ekf2_data(whole_flight, encoder),
        "truth": _make_truth_data(whole_flight, encoder),
    }


def _pack_nis_bands(innovation_count: int, encoder: ArrayEncoder) -> list[dict[str, int]]:
    """Return lower and upper limits of the 95 % band of the mean NIS, encoded for the page.

    Row n - 1 contains the limits for n innovations.
    """
    innovation_counts = np.arange(1, 2 * innovation_count + 1)
    bounds = stats.chi2.interval(CONFIDENCE_LEVEL, innovation_counts)
    return [
        encoder.add(bound / innovation_counts, DRAWN_VALUE_ROUNDING_STEPS_PER_UNIT)
        for bound in bounds
    ]


def _make_ekf2_data(result: AxisComparison, encoder: ArrayEncoder) -> PageData | None:
    """Return state, σ and innovations of EKF2 along one axis; None if EKF2 is not logged."""
    ekf2, summary = result.ekf2_tracks, result.filters["ekf2"]
    if isinstance(ekf2.state, Unavailable):
        return None
    state = ekf2.state.dropna()
    state_columns = [state["position_m"], state["velocity_m_s"]]
    if isinstance(ekf2.variance, pd.DataFrame):
        sigma = ekf2.variance.dropna().pow(0.5)
        state_columns += [
            np.interp(state.index, sigma.index, sigma[name])
            for name in ("position_variance_m2", "velocity_variance_m2_s2")
            if len(sigma)
        ]
    ekf2_data: PageData = {
        "state": _pack_series(state.index, state_columns, encoder),
        "innovations": [],
        "summary": {
            "outside": getattr(summary, "fraction_outside_two_sigma", None),
            "rmse": getattr(summary.truth, "position_rmse_m", None),
        },
        "r": None,
    }
    if isinstance(innovations := ekf2.innovations, pd.DataFrame):
        rows = innovations[
            np.isfinite(innovations["innovation_m"]) & (innovations["innovation_variance_m2"] > 0)
        ]
        columns = [
            rows["innovation_m"],
            np.sqrt(rows["innovation_variance_m2"]),
            rows["rejected"] > 0,
        ]
        ekf2_data["innovations"] = _pack_series(rows.index, columns, encoder)
        variance_m2 = innovations["observation_variance_m2"].dropna()
        ekf2_data["r"] = float(np.sqrt(variance_m2.median())) if len(variance_m2) else None
    return ekf2_data


def _make_truth_data(result: AxisComparison, encoder: ArrayEncoder) -> PageData | None:
    """Return position and velocity of the ground truth; None if the log contains none."""
    if isinstance(result.truth, Unavailable):
        return None
    position_m, velocity_m_s = (
        result.truth[name].dropna() for name in ("position_m", "velocity_m_s")
    )
    return {
        "p": _pack_series(position_m.index, [position_m], encoder),
        "v": _pack_series(velocity_m_s.index, [velocity_m_s], encoder),
    }


def _pack_series(
    time_s: ArrayLike, columns: Iterable[ArrayLike], encoder: ArrayEncoder
) -> list[dict[str, int]]:
    """Encode a time series that the web page only draws or averages.

    The values are rounded to 6 decimals. The inputs of KF, which runs in the page, need more
    digits.
    """
    values = [
        encoder.add(np.asarray(column), DRAWN_VALUE_ROUNDING_STEPS_PER_UNIT) for column in columns
    ]
    return [encoder.add_times(np.asarray(time_s)), *values]


def _format_ekf2_settings(analysis: Analysis) -> dict[str, str]:
    """Return the EKF2 parameters for noise, delay and gate of the position source, with units."""
    aid, logged_parameters = find_aid(analysis), analysis.flight.log.parameters
    return {
        name: f"{logged_parameters[name]:.4g} {MODEL_PARAMETERS[name].unit}".rstrip()
        for name in (aid.noise, aid.delay, aid.gate)
        if name in logged_parameters and name in MODEL_PARAMETERS
    }


def _make_command(request: ComparisonRequest, analysis: Analysis) -> str:
    """Return the ``px4fuse compare`` command with time span and heading of this analysis.

    The settings of KF are omitted; the web page appends them.
    """
    heading_deg = request.heading_deg
    if heading_deg is None and AISLE_AXIS in analysis.axes:
        heading_deg = analysis[AISLE_AXIS].heading_deg
    request_without_kf_settings = msgspec.structs.replace(
        request,
        sigma_a_m_s2=SIGMA_A_M_S2,
        sigma_z_m=None,
        dt_s=DT_S,
        input=None,
        clock_offset_s=None if request.position is None else request.clock_offset_s,
        start_s=analysis.segment.start_s,
        end_s=analysis.segment.end_s,
        heading_deg=heading_deg,
    )
    return command_line(request_without_kf_settings, for_shell=True)
