"""What readers of all formats make alike: usable rows, stretches of time, what is missing."""

from typing import Any

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray
from px4fuse.flight import Columns, Ekf2, FlightMode, Unavailable

# No position, velocity, acceleration or angle of a flight in SI units comes near it
DAMAGED = 1e9
# m/s² and rad/s: more than any accelerometer (400 g) or gyro (4000 °/s) measures
BEYOND_IMU = 1e4
MIN_NORM = 0.5  # a zero quaternion is no attitude


def collect_unavailable(*flight_parts: object) -> tuple[Unavailable, ...]:
    """Those of some parts of a flight that its log lacks, with what it lacks of EKF2."""
    for flight_part in flight_parts:
        if isinstance(flight_part, Ekf2):
            flight_parts += (
                flight_part.variance,
                *flight_part.innovations.values(),
                flight_part.fusing,
            )
    return tuple(
        flight_part for flight_part in flight_parts if isinstance(flight_part, Unavailable)
    )


def constant_spans(steps: pd.Series, end_s: float) -> list[tuple[float, float, Any]]:
    """Stretches in which a step function of time keeps its value: start and end (s), value.

    None where it has no value.
    """
    changes = steps[steps.ne(steps.shift())]
    starts = np.maximum.accumulate(np.maximum(changes.index.to_numpy(), 0.0)).tolist()
    spans = zip(starts, [*starts[1:], end_s], changes, strict=False)
    return [(start, end, value) for start, end, value in spans if end > start]


def flight_spans(landed: pd.Series, duration_s: float) -> tuple[tuple[float, float], ...]:
    """Stretches (s) in which a step function of time says "not landed" (0 or False)."""
    return tuple((start, end) for start, end, on in constant_spans(landed, duration_s) if not on)


def ends_in_flight(
    airborne: tuple[tuple[float, float], ...] | Unavailable, duration_s: float
) -> bool:
    """Whether the last stretch of flight has no end but that of the data."""
    last_span = () if isinstance(airborne, Unavailable) else airborne[-1:]
    return any(end >= duration_s for _, end in last_span)


def format_truncation(part: str, duration_s: float, in_flight: bool) -> str:
    """What is said of a file that ends in the middle of a part of it."""
    flying = ", in flight" if in_flight else ""
    end = f"the file ends in mid-{part} after {duration_s:.1f} s{flying}"
    return f"{end}: what came after is not in it"


def mode_spans(names: pd.Series, end_s: float) -> tuple[FlightMode, ...]:
    """Stretches (s) of a step function of time whose values are names of flight modes."""
    return tuple(FlightMode(*span) for span in constant_spans(names, end_s))


def finite_rows(samples: pd.DataFrame, columns: list[str], limit: float = DAMAGED) -> pd.DataFrame:
    """Rows of a frame in which all of some float columns are finite, and none is beyond physics.

    A value of 1e30 is damage as much as NaN is, and its square would soon be infinite.
    """
    possible: BoolArray = (np.abs(samples[columns].to_numpy()) < limit).all(axis=1)
    return samples[possible]


def join_nearest(samples: pd.DataFrame, others: pd.DataFrame, within_s: float) -> pd.DataFrame:
    """Rows of a frame, each with the row of another that is nearest in time; NaN beyond."""
    return pd.merge_asof(
        samples,
        others,
        left_index=True,
        right_index=True,
        direction="nearest",
        tolerance=within_s,  # type: ignore[arg-type]
    )


def with_attitude(samples: pd.DataFrame) -> pd.DataFrame:
    """Rows of a frame with a quaternion ``w, x, y, z``; one of norm 0 means "not given"."""
    norm: Array = np.linalg.norm(samples[Columns.QUATERNION].to_numpy(), axis=1)
    return samples[(norm > MIN_NORM) & (norm < DAMAGED)]


def read_orientation(samples: pd.DataFrame) -> pd.DataFrame | None:
    """Orientations in a frame of samples; None where there are none, or all are the same.

    Parameters
    ----------
    samples : DataFrame
        With the columns ``w, x, y, z`` where the sender gave quaternions, and perhaps
        ``forward_rad2, right_rad2, down_rad2``, of which 0 means "not given" (``EKF2.cpp``).
    """
    found = with_attitude(samples.reindex(columns=Columns.QUATERNION + Columns.ROTATION_VARIANCE))
    quaternions = found[Columns.QUATERNION]
    if len(found) < 2 or (quaternions == quaternions.iloc[0]).to_numpy().all():
        return None
    variances = found[Columns.ROTATION_VARIANCE]
    return found.assign(**variances.where(variances > 0))


def read_attitude(samples: pd.DataFrame | None) -> pd.DataFrame | None:
    """Quaternions of :func:`read_orientation` alone."""
    found = None if samples is None else read_orientation(samples)
    return None if found is None else found[Columns.QUATERNION]
