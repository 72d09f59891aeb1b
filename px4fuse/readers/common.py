"""Functions for all log readers: message fields, valid samples, time intervals, missing data.

The message fields are defined in ``px4_topics.toml`` and ``mavlink_messages.toml``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.flight.model import Columns, Ekf2, Spans, Unavailable

# Maximum absolute value of valid fields, above UNIX times in µs (1.8e15)
MAX_FIELD_VALUE = 1e17
# Maximum absolute value (SI units) of valid data; larger values are from damaged bytes
MAX_VALID_SI_VALUE = 1e9
# Maximum absolute value (m/s², rad/s) of valid IMU data, above the range of sensors
MAX_IMU_READING = 1e4
# A position 0, 0, 0 is invalid if its distance (m) from the previous and the next position exceeds
# this limit (3 σ of UWB)
MIN_DISTANCE_OF_INVALID_ZERO_POSITION_M = 0.3
# A position is damaged if its distance (m) from the median position exceeds this limit and the
# following multiple of the median distance
MIN_DAMAGED_POSITION_DISTANCE_M = 1e4
# A damaged position is farther from the median position than this multiple of the median distance
MIN_DAMAGED_TO_MEDIAN_DISTANCE_RATIO = 100.0
# Minimum duration (s) of equal positions that are rejected as frozen
MIN_FROZEN_S = 1.0
# Minimum number of successive equal positions that are rejected as frozen
MIN_FROZEN_POSITION_COUNT = 5
# Maximum fraction of frozen positions; with more, the vehicle may be at rest
MAX_FROZEN_FRACTION = 0.5
# Maximum probability that randomly repeated positions are rejected as frozen
MAX_FALSE_ALARM_PROBABILITY_OF_FROZEN_RUN = 0.01
# Tolerance (fraction of the quantisation step) for the detection of rounded values
MAX_DIFFERENCE_FROM_INTEGER = 0.01
# Minimum norm of a valid quaternion; senders without attitude send zeros
MIN_QUATERNION_NORM = 0.5


@dataclass(frozen=True)
class MessageLayout:
    """Fields of a PX4 topic or MAVLink message, and the DataFrame columns that they become."""

    # PX4 topic or MAVLink message
    topic: str = ""
    # Message field for each required column, for example ``q[0]``
    columns: Mapping[str, str] = field(default_factory=dict)
    # Message field for each column that only some PX4 releases log
    optional_columns: Mapping[str, str] = field(default_factory=dict)
    # Factor from the message field to the unit of each column; 1 if absent
    scale: Mapping[str, float] = field(default_factory=dict)
    # True if a value is valid until the next sample
    is_step_function: bool = False


# Fields of MessageLayout that are tables in the TOML files
_FIELD_TABLES = ("columns", "optional_columns", "scale")


def expand_layouts(toml_tables: Mapping[str, Any]) -> dict[str, MessageLayout]:
    """Convert TOML tables to message layouts, with one message field for each column.

    By default, the key of a table is the name of the topic or message.
    """
    rows = {
        name: {"topic": name, **row}
        | {key: assign_fields_to_columns(row[key]) for key in _FIELD_TABLES if key in row}
        for name, row in toml_tables.items()
    }
    return msgspec.convert(rows, dict[str, MessageLayout])


def assign_fields_to_columns(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message field of each DataFrame column.

    A key of ``fields`` contains column names, or the name of a list in :class:`Columns` such as
    POSITION. Its value is one of

    - field names, one for each column, for example ``x,y,z``
    - an empty text: the fields have the names of the columns
    - an array: ``q[]`` for its first elements, ``covariance[0,6]`` for the elements 0 and 6
    - a number: the value of all columns

    Examples
    --------
    >>> assign_fields_to_columns({"POSITION": "x,y,z"})
    {'north_m': 'x', 'east_m': 'y', 'down_m': 'z'}
    >>> assign_fields_to_columns({"north_m,east_m": "position[]"})
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    >>> assign_fields_to_columns({"north_m2,east_m2": "covariance[0,6]", "w,x": 1.0})
    {'north_m2': 'covariance[0]', 'east_m2': 'covariance[6]', 'w': 1.0, 'x': 1.0}
    >>> assign_fields_to_columns({"a,b": "hpos[0],vpos"})
    {'a': 'hpos[0]', 'b': 'vpos'}
    """
    columns: dict[str, Any] = {}
    for column_names, field_names in fields.items():
        column_list: list[str] = (
            getattr(Columns, column_names) if column_names.isupper() else column_names.split(",")
        )
        if isinstance(field_names, float):
            columns |= dict.fromkeys(column_list, field_names)
            continue
        if not field_names:
            column_fields = column_list
        elif array_match := re.fullmatch(r"([^\[]+)\[([\d,]*)\]", field_names):
            array, elements = array_match.groups()
            element_indices = elements.split(",") if elements else range(len(column_list))
            column_fields = [f"{array}[{element}]" for element in element_indices]
        else:
            column_fields = field_names.split(",")
        columns |= zip(column_list, column_fields, strict=True)
    return columns


def collect_unavailable(*flight_data: object) -> tuple[Unavailable, ...]:
    """Return the missing data of a flight, each with its reason."""
    for data in flight_data:
        if isinstance(data, Ekf2):
            flight_data += (data.variance, *data.innovations.values(), data.fusion_flags)
    return tuple(data for data in flight_data if isinstance(data, Unavailable))


def find_spans(flags: pd.Series, duration_s: float) -> Spans:
    """Return start and end (s) of each span in which a flag is set, up to the end of the data.

    Each value of the flag is valid until the next value. Times before 0 are replaced by 0.
    """
    changes = flags[flags.ne(flags.shift())]
    # Receive times may jump backward. The running maximum keeps the spans in order
    start_times_s = np.maximum.accumulate(np.maximum(changes.index.to_numpy(), 0.0)).tolist()
    end_times_s = [*start_times_s[1:], duration_s]
    # strict=False: if no flag was logged, there are no start times, but one end time
    spans = zip(start_times_s, end_times_s, changes, strict=False)
    return tuple((start, end) for start, end, is_set in spans if is_set and end > start)


def ends_in_flight(airborne: Spans | Unavailable, duration_s: float) -> bool:
    """Return True if the vehicle is still in flight at the end of the data."""
    return not isinstance(airborne, Unavailable) and any(
        end_s >= duration_s for _, end_s in airborne
    )


def format_truncation(item: str, duration_s: float, in_flight: bool) -> str:
    """Return a note that the file ends within a frame or message."""
    return (
        f"the file ends within a {item} after {duration_s:.1f} s{', in flight' * in_flight}; later "
        "data are missing"
    )


def select_valid_rows(
    samples: pd.DataFrame, columns: list[str], limit: float = MAX_VALID_SI_VALUE
) -> pd.DataFrame:
    """Return the rows in which the absolute values of all ``columns`` are below ``limit``."""
    is_valid: BoolArray = (np.abs(samples[columns].to_numpy()) < limit).all(axis=1)
    return samples[is_valid]


def classify_invalid_positions(samples: pd.DataFrame, columns: list[str]) -> "pd.Series[str]":
    """Return the reason why each position is invalid; "" for a valid position.

    - "NaN": a coordinate is not finite.
    - "zero": the source sent 0, 0, 0 instead of a position.
    - "far": the position is more than 10 km from the median position, so it must be damaged.
    - "held": the source sent its last position again and again.
    """
    values, time_s = samples[columns].to_numpy(), samples.index.to_numpy()
    reason_by_row = pd.Series("", index=samples.index)
    is_number: BoolArray = (np.abs(values) < MAX_VALID_SI_VALUE).all(axis=1)
    reason_by_row[~is_number] = "NaN"
    is_zero: BoolArray = (values == 0.0).all(axis=1)
    # If the valid positions before and after a position of 0, 0, 0 are both far from the origin,
    # the zeros are no measurement
    positions = pd.DataFrame(np.where((is_number & ~is_zero)[:, None], values, np.nan))
    previous_distance_m = np.linalg.norm(positions.ffill(), axis=1)
    next_distance_m = np.linalg.norm(positions.bfill(), axis=1)
    distance_m = np.fmin(previous_distance_m, next_distance_m)
    reason_by_row[is_zero & (distance_m > MIN_DISTANCE_OF_INVALID_ZERO_POSITION_M)] = "zero"
    valid_rows = np.flatnonzero(reason_by_row == "")
    if not len(valid_rows):
        return reason_by_row
    offset_from_median_m = values[valid_rows] - np.median(values[valid_rows], axis=0)
    distance_m = np.linalg.norm(offset_from_median_m, axis=1)
    is_far_from_median = distance_m > max(
        MIN_DAMAGED_POSITION_DISTANCE_M,
        MIN_DAMAGED_TO_MEDIAN_DISTANCE_RATIO * np.median(distance_m),
    )
    reason_by_row.iloc[valid_rows[is_far_from_median]] = "far"
    near_rows = valid_rows[~is_far_from_median]
    if len(near_rows) > 1:
        is_frozen = _find_frozen_positions(values[near_rows], time_s[near_rows])
        if np.mean(is_frozen) < MAX_FROZEN_FRACTION:
            reason_by_row.iloc[near_rows[is_frozen]] = "held"
    return reason_by_row


def _find_frozen_positions(positions: Array, time_s: Array) -> BoolArray:
    """Return True for each repetition in a long run of equal positions; False for the first.

    ``positions`` has one row per sample.
    """
    is_repeated = np.append(False, np.all(np.diff(positions, axis=0) == 0.0, axis=1))
    times_in_run_s = pd.Series(time_s).groupby(np.cumsum(~is_repeated))
    run_length = times_in_run_s.transform("size")
    run_duration_s = times_in_run_s.transform("max") - times_in_run_s.transform("min")
    # A source may repeat positions at random, with probability p. A random run of n repetitions
    # then has the probability p^n. A run is frozen only if a random run of its length is improbable
    # in the whole track: count · p^n < MAX_FALSE_ALARM_PROBABILITY_OF_FROZEN_RUN
    repetition_probability = np.clip(np.mean(is_repeated[1:]), 1e-6, 1.0 - 1e-6)
    max_random_run_length = np.log(
        len(time_s) / MAX_FALSE_ALARM_PROBABILITY_OF_FROZEN_RUN
    ) / -np.log(repetition_probability)
    min_length = max(MIN_FROZEN_POSITION_COUNT, max_random_run_length)
    is_frozen_run = (run_length >= min_length) & (run_duration_s >= MIN_FROZEN_S)
    return np.asarray(is_repeated & is_frozen_run)


def estimate_quantisation_step(values: Array) -> float:
    """Return the quantisation step of rounded values; 0 if the values are not rounded."""
    differences = np.diff(np.unique(values[np.isfinite(values)]))
    if not len(differences):
        return 0.0
    # The quotients may overflow to infinity or NaN. The comparison below is then False, so the
    # values count as not rounded
    with np.errstate(over="ignore", invalid="ignore"):
        step_counts = differences / differences.min()
        rounding_errors = np.abs(step_counts - np.rint(step_counts))
    return (
        float(differences.min()) if (rounding_errors < MAX_DIFFERENCE_FROM_INTEGER).all() else 0.0
    )


def interpolate_inside_time_span(time_s: pd.Index | Array, values: "pd.Series[float]") -> Array:
    """Interpolate a time series at the given times; NaN outside its time span."""
    return np.asarray(np.interp(time_s, values.index, values, np.nan, np.nan))


def join_nearest_samples(
    samples: pd.DataFrame, other_samples: pd.DataFrame, tolerance_s: float
) -> pd.DataFrame:
    """Join each sample with the sample of ``other_samples`` that is nearest in time.

    The joined columns are NaN if the time difference exceeds the tolerance.
    """
    return pd.merge_asof(
        samples,
        other_samples,
        left_index=True,
        right_index=True,
        direction="nearest",
        tolerance=tolerance_s,  # type: ignore[arg-type]
    )


def select_rows_with_attitude(samples: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with a valid quaternion."""
    norm: Array = np.linalg.norm(samples[Columns.QUATERNION].to_numpy(), axis=1)
    return samples[(norm > MIN_QUATERNION_NORM) & (norm < MAX_VALID_SI_VALUE)]


def read_orientation(samples: pd.DataFrame) -> pd.DataFrame | None:
    """Return the orientation of each sample with its variances; None if it is constant.

    A variance of 0 means "not sent" (``EKF2.cpp``) and becomes NaN.
    """
    orientation = select_rows_with_attitude(
        samples.reindex(columns=Columns.QUATERNION + Columns.ROTATION_VARIANCE)
    )
    quaternions = orientation[Columns.QUATERNION]
    if len(orientation) < 2 or (quaternions == quaternions.iloc[0]).to_numpy().all():
        return None
    variances = orientation[Columns.ROTATION_VARIANCE]
    return orientation.assign(**variances.where(variances > 0))


def read_attitude(samples: pd.DataFrame | None) -> pd.DataFrame | None:
    """Return the attitude quaternions; None if they are missing or constant."""
    orientation = None if samples is None else read_orientation(samples)
    return None if orientation is None else orientation[Columns.QUATERNION]
