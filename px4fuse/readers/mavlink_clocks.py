"""Clocks of a MAVLink recording: boot time, the senders' own clocks, and the time of receipt.

A message is received later than it was stamped, by a delay that is never negative and often
large, so that two clocks are mapped by the lower envelope of their difference: the messages that
were hardly delayed. TIMESYNC pairs (MAVLink "Time Synchronization Protocol v2") are mapped the
same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import theilslopes

from px4fuse.arrays import Array
from px4fuse.recording import ClockMap

# Stamps within this of the boot clock at their receipt are taken to be on the boot clock
SAME_CLOCK_S = 10.0
# unless TIMESYNC brings them closer to their receipt by this much
MIN_GAIN_S = 0.1
# 2001-09-09: below this, microseconds count from boot, above from 1970
UNIX_FROM_S = 1e9
# The envelope takes the least delayed message of each stretch of this length
ENVELOPE_S = 2.0
MAX_STRETCHES = 200
# A drift is stated from this span on; below, both clocks are taken to run alike
MIN_DRIFT_SPAN_S = 30.0
# but a recording replayed at another speed shows at once
MAX_SPEED_DIFFERENCE = 0.01
# Beyond this factor neither a replay nor a wrong unit of time (s for ns: 1e9) explains a speed
MAX_SPEED = 1e12
MIN_PAIRS = 3
# A clock whose stamps take fewer values than this share of its messages does not tell the time
MIN_DISTINCT_SHARE = 0.1
# Positions further apart than this are a gap
MAX_INTERVAL_S = 1.0


@dataclass(frozen=True)
class Line:
    """A straight line between two clocks: y = y0 + slope · (x - x0).

    ``jitter`` is the standard deviation of the pairs about it, 1.4826 · median absolute
    deviation, in the unit of y; ``pairs`` their number.
    """

    x0: float
    y0: float
    slope: float
    jitter: float
    pairs: int

    def at(self, x: Array | float) -> Array:
        """The other clock's reading y at readings x."""
        return np.asarray(self.y0 + self.slope * (x - self.x0), dtype=np.float64)

    def inverse(self) -> Line:
        """The same line from y to x."""
        return Line(self.y0, self.x0, 1.0 / self.slope, self.jitter / self.slope, self.pairs)


def fit_least_delay(x: Array, y: Array) -> Line:
    """Line below which no pair lies by much: y is a reading taken a varying delay after x.

    Parameters
    ----------
    x, y : ndarray, shape (n,), s
        Readings of the earlier and of the later clock; n ≥ 1.

    Returns
    -------
    Line
        Slope 1 where the span is too short to tell a drift.
    """
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    x0 = float(x[len(x) // 2])
    span = float(x[-1] - x[0])
    stretches = int(np.clip(span / ENVELOPE_S, 1, MAX_STRETCHES))
    edges = np.searchsorted(x, np.linspace(x[0], x[-1], stretches + 1)[1:-1])
    stretch_rows = [rows for rows in np.split(np.arange(len(x)), edges) if len(rows)]
    slope = 1.0
    middles = [rows[len(rows) // 2] for rows in stretch_rows]
    if len(middles) > 1 and x[middles[-1]] > x[middles[0]]:
        rough_slope = _median_slope(x[middles], y[middles])
        slope = (
            rough_slope
            if abs(rough_slope - 1.0) > MAX_SPEED_DIFFERENCE and _is_speed(rough_slope)
            else 1.0
        )
    residual = y - slope * (x - x0)
    lowest = [rows[np.argmin(residual[rows])] for rows in stretch_rows]
    if span >= MIN_DRIFT_SPAN_S and len(lowest) > 1:
        # with the drift known, others are the least delayed
        for _ in range(2):
            corrected = slope + _median_slope(x[lowest], residual[lowest])
            slope = corrected if _is_speed(corrected) else 1.0
            residual = y - slope * (x - x0)
            lowest = [rows[np.argmin(residual[rows])] for rows in stretch_rows]
    y0 = float(np.median(residual[lowest]))
    return Line(x0, y0, slope, robust_std(residual), len(x))


def _median_slope(x: Array, y: Array) -> float:
    """Theil-Sen slope of y over x; not finite where x differ by next to nothing."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(theilslopes(y, x)[0])


def _is_speed(slope: float) -> bool:
    """Whether one clock can run at this rate of another; none runs backwards."""
    return 1.0 / MAX_SPEED < slope < MAX_SPEED


def is_running_clock(stamp_s: Array) -> bool:
    """Whether stamps take enough values to be a clock's."""
    return len(np.unique(stamp_s)) >= max(MIN_DISTINCT_SHARE * len(stamp_s), 2)


def robust_std(values: Array) -> float:
    """Standard deviation by 1.4826 · median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class ClockMapping:
    """A sender's stamps on the boot clock.

    ``to_boot`` is None where the stamps do not tell the time; the time of receipt stands in then.
    """

    to_boot: Line | None
    statement: ClockMap


def map_clock(
    name: str,
    stamp_s: Array,
    received_s: Array,
    boot_of_receipt: Line,
    replies: tuple[Array, Array],
    answers: tuple[Array, Array],
    unix_of_boot: Line | None,
    *,
    has_receipt: bool,
) -> ClockMapping:
    """Map a sender's own clock to the autopilot's boot clock by the best means there is.

    Parameters
    ----------
    name : str
        The sender, for a person.
    stamp_s, received_s : ndarray, shape (n,)
        All that the sender stamped with this clock, and when it was received.
    boot_of_receipt : Line
        From time of receipt to boot clock.
    replies : tuple of ndarray, shape (n,), s
        TIMESYNC: the autopilot's clock when it had asked, and the sender's when it replied.
    answers : tuple of ndarray, shape (m,), s
        The sender's clock when it asked, and the autopilot's when it answered.
    unix_of_boot : Line or None
        From boot clock to UNIX time by the autopilot's SYSTEM_TIME.
    has_receipt : bool
        Whether the recording has times of receipt, or only an order.
    """
    receipt = "receive time" if has_receipt else "position in the stream"
    boot_at_receipt = boot_of_receipt.at(received_s)
    if not is_running_clock(stamp_s):
        distinct = len(np.unique(stamp_s))
        few_values = f"its {len(stamp_s)} time stamps take only {distinct} values"
        note = f"{few_values}, so the {receipt} stands in for them"
        # what the receipt adds to evenly sent samples; gaps are no jitter
        intervals = np.diff(received_s)
        regular = intervals[intervals < MAX_INTERVAL_S]
        jitter = float(np.std(regular) / np.sqrt(2.0)) if len(regular) > 1 else 0.0
        return ClockMapping(
            None, ClockMap(name, receipt, len(stamp_s), 0.0, 0.0, jitter, note, distinct)
        )
    synchronised = _line_of_exchange(replies, answers)
    unmapped_distance_s = abs(float(np.median(boot_at_receipt - stamp_s)))
    # a clock of its own may have started seconds after the autopilot's
    improvement_s = 0.0
    if synchronised is not None:
        improvement_s = unmapped_distance_s - abs(
            float(np.median(boot_at_receipt - synchronised.at(stamp_s)))
        )
    if unmapped_distance_s <= SAME_CLOCK_S and improvement_s < MIN_GAIN_S:
        line = Line(float(stamp_s[0]), float(stamp_s[0]), 1.0, 0.0, len(stamp_s))
        note = "its stamps are on the boot clock already"
        return ClockMapping(line, ClockMap(name, "boot clock", len(stamp_s), 0.0, 0.0, 0.0, note))
    kind = "UNIX time" if float(np.median(stamp_s)) > UNIX_FROM_S else "own clock"
    clock = f"{kind} of {name}"
    known = [] if synchronised is None else [("TIMESYNC", synchronised, "")]
    if kind == "UNIX time" and unix_of_boot is not None:
        assumed = "assumes that sender and autopilot agree on UNIX time"
        known.append(("SYSTEM_TIME", unix_of_boot.inverse(), assumed))
    for method, line, note in known:
        # a map that puts messages long before or after their receipt is of another clock
        if abs(float(np.median(line.at(stamp_s) - boot_at_receipt))) <= SAME_CLOCK_S:
            return ClockMapping(line, _clock_map(clock, method, line, stamp_s, note))
    receipt_line = fit_least_delay(stamp_s, received_s)
    boot_y0, slope = (
        float(boot_of_receipt.at(receipt_line.y0)),
        receipt_line.slope * boot_of_receipt.slope,
    )
    boot_line = replace(receipt_line, y0=boot_y0, slope=slope)
    note = "no usable TIMESYNC or SYSTEM_TIME; late by the least delay of the link"
    return ClockMapping(boot_line, _clock_map(clock, receipt, boot_line, stamp_s, note))


def _line_of_exchange(replies: tuple[Array, Array], answers: tuple[Array, Array]) -> Line | None:
    """From the sender's clock to the boot clock, between the two envelopes where both exist."""
    lines = []
    if len(replies[0]) >= MIN_PAIRS:
        # asked before replied: the reply is the later reading
        lines.append(fit_least_delay(*replies).inverse())
    if len(answers[0]) >= MIN_PAIRS:
        lines.append(fit_least_delay(*answers))
    if not lines:
        return None
    x0 = lines[0].x0
    line_values = [(float(line.at(x0)), line.slope, line.jitter) for line in lines]
    y0, slope, jitter = np.mean(line_values, axis=0).tolist()
    return Line(x0, y0, slope, jitter, sum(line.pairs for line in lines))


def _clock_map(clock: str, method: str, line: Line, stamp_s: Array, note: str) -> ClockMap:
    middle = float(0.5 * (stamp_s.min() + stamp_s.max()))
    offset_s, drift_ppm = float(line.at(middle)) - middle, (line.slope - 1.0) * 1e6
    return ClockMap(clock, method, line.pairs, offset_s, drift_ppm, line.jitter, note)
