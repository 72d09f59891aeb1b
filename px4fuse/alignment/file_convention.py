"""Axes and unit of a position file that does not match the motion of the flight."""

import pandas as pd

from px4fuse.alignment.matching import AlignmentProblem
from px4fuse.convention.axes import UNITS
from px4fuse.convention.check import check_convention
from px4fuse.convention.correction import MIN_ROTATION_DEG
from px4fuse.convention.texts import FRAME_AXES, UNIT_NAMES, describe_axes, describe_unit
from px4fuse.flight.model import POSITION_FILE, Columns, Flight, PositionTrack, time_index

# Maximum time span (s) of file and log for explain_mismatch, which takes 1 s per hour
MAX_SPAN_S = 7200.0


def explain_mismatch(
    flight: Flight, problem: AlignmentProblem, metres_per_unit: float = 1.0
) -> tuple[str, str] | None:
    """Return fault and action if the IMU data show wrong axes or a wrong unit of the file."""
    samples = problem.samples
    span_s = max(float(samples.index[-1] - samples.index[0]), flight.log.duration_s)
    if span_s > MAX_SPAN_S:
        return None
    time_s = samples.index - samples.index[0] + (problem.lag_s or 0.0)
    positions = samples[["x_m", "y_m", "z_m"]] / metres_per_unit
    table = pd.DataFrame(positions.to_numpy(), time_index(time_s.to_numpy()), Columns.POSITION)
    track = PositionTrack("", POSITION_FILE, "", table, "unknown", "", ())
    search_limits = {} if problem.lag_s is not None else {"max_offset_s": span_s}
    convention = check_convention(flight, track, **search_limits)
    if convention is None or convention.verdict != "determined":
        return None
    axes, faults = convention.axes, []
    if UNITS[convention.unit] != metres_per_unit:
        stated_unit = next(
            name for unit, name in UNIT_NAMES.items() if UNITS[unit] == metres_per_unit
        )
        faults.append(describe_unit(convention.unit, "the positions", stated_unit, is_file=True))
    stated_frame = problem.frames[0].upper() if len(problem.frames) == 1 else ""
    is_rotated = abs(convention.rotation_deg) > MIN_ROTATION_DEG
    if stated_frame and axes != FRAME_AXES[stated_frame] and not is_rotated:
        faults.append(
            describe_axes(axes, stated_frame, is_mirrored=convention.is_mirrored, is_file=True)
        )
    if not faults:
        return None
    fault_texts, actions = zip(*faults, strict=True)
    return "; ".join(fault_texts), " ".join(actions)
