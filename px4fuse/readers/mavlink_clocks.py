"""Conversion of sender clocks and receive times to the autopilot's boot clock (MAVLink).

The delay from timestamp to receive time is never negative and often large. A line is therefore
fitted to the messages with the smallest delay. Source for TIMESYNC messages: MAVLink "Time
Synchronization Protocol v2".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import theilslopes

from px4fuse.core.arrays import Array
from px4fuse.flight.model import ClockMap

# Maximum median difference (s) between timestamps and receive times on the same clock
MAX_BOOT_TIME_DIFFERENCE_S = 10.0
# Minimum improvement (s) by TIMESYNC of the agreement with receive times
MIN_REDUCTION_BY_TIMESYNC_S = 0.1
# Minimum UNIX time (s), in 2001; smaller times are times since boot
MIN_UNIX_TIME_S = 1e9
# The clock fit uses the message with the least delay in each interval of this length (s)
CLOCK_FIT_INTERVAL_S = 2.0
MAX_CLOCK_FIT_INTERVALS = 200
# Minimum time span (s) to estimate a clock drift
MIN_DRIFT_SPAN_S = 30.0
# Maximum relative difference of two clock rates; more shows a replay at another speed
MAX_RELATIVE_CLOCK_RATE_DIFFERENCE = 0.01
# Maximum ratio of two clock rates; above 1e9, for timestamps in ns that were read as s
MAX_RATIO_OF_CLOCK_RATES = 1e12
MIN_TIMESYNC_REPLIES = 3
# Minimum fraction of distinct timestamps of a running clock
MIN_DISTINCT_TIME_FRACTION = 0.1
# Maximum interval (s) between positions; a longer interval is a gap
MAX_REGULAR_SAMPLE_INTERVAL_S = 1.0


@dataclass(frozen=True)
class ClockLine:
    """Linear relation between readings x of a source clock and y of a target clock.

    y = y0 + slope · (x - x0)

    ``jitter_s`` is the robust standard deviation of the clock readings from the line.
    """

    x0: float
    y0: float
    slope: float
    jitter_s: float
    reading_pair_count: int

    def at(self, x: Array | float) -> Array:
        """Convert readings x of the source clock to readings y of the target clock."""
        return np.asarray(self.y0 + self.slope * (x - self.x0), dtype=np.float64)

    def inverse(self) -> ClockLine:
        """Return the line that converts readings of the target clock to the source clock."""
        return ClockLine(
            self.y0, self.x0, 1.0 / self.slope, self.jitter_s / self.slope, self.reading_pair_count
        )


def fit_clock_line(x: Array, y: Array) -> ClockLine:
    """Fit a line to clock readings x and y (s); y is read after x, with an unknown delay.

    The fit uses the readings with the least delay.
    """
    time_order = np.argsort(x, kind="stable")
    x, y = x[time_order], y[time_order]
    x0, span_s = float(x[len(x) // 2]), float(x[-1] - x[0])
    interval_count = int(np.clip(span_s / CLOCK_FIT_INTERVAL_S, 1, MAX_CLOCK_FIT_INTERVALS))
    interval_starts = np.searchsorted(x, np.linspace(x[0], x[-1], interval_count + 1)[1:-1])
    rows_by_interval = [rows for rows in np.split(np.arange(len(x)), interval_starts) if len(rows)]
    middle_rows = [rows[len(rows) // 2] for rows in rows_by_interval]
    slope = _fit_clock_rate(x[middle_rows], y[middle_rows])
    if abs(slope - 1.0) <= MAX_RELATIVE_CLOCK_RATE_DIFFERENCE:
        slope = 1.0
    # Fit the slope twice, because it affects the selection of messages with the least delay
    for is_slope_final in (False, False, True):
        relative_delay_s = y - slope * (x - x0)
        least_delay_rows = [rows[np.argmin(relative_delay_s[rows])] for rows in rows_by_interval]
        if not is_slope_final and span_s >= MIN_DRIFT_SPAN_S:
            slope = _fit_clock_rate(x[least_delay_rows], relative_delay_s[least_delay_rows], slope)
    y0 = float(np.median(relative_delay_s[least_delay_rows]))
    return ClockLine(x0, y0, slope, robust_std(relative_delay_s), len(x))


def _fit_clock_rate(x: Array, y: Array, added_rate: float = 0.0) -> float:
    """Return the Theil-Sen slope of y over x plus ``added_rate``; 1 if it is not plausible."""
    if len(x) < 2 or x[0] == x[-1]:
        return 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        rate = float(theilslopes(y, x)[0]) + added_rate
    return rate if 1.0 / MAX_RATIO_OF_CLOCK_RATES < rate < MAX_RATIO_OF_CLOCK_RATES else 1.0


def is_running_clock(timestamps_s: Array) -> bool:
    """Return True if the timestamps are of a running clock: enough of them are distinct."""
    return len(np.unique(timestamps_s)) >= max(MIN_DISTINCT_TIME_FRACTION * len(timestamps_s), 2)


def robust_std(values: Array) -> float:
    """Estimate the standard deviation as 1.4826 · median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class ClockMapping:
    """Conversion of a sender's timestamps to the autopilot's boot clock, with a description.

    ``sender_to_boot_fit`` is None if receive times replace the timestamps.
    """

    sender_to_boot_fit: ClockLine | None
    description: ClockMap


def map_clock_to_boot(
    name: str,
    timestamps_s: Array,
    receive_times_s: Array,
    receipt_to_boot_fit: ClockLine,
    sender_replies: tuple[Array, Array],
    autopilot_replies: tuple[Array, Array],
    boot_to_unix_fit: ClockLine | None,
    *,
    has_receive_times: bool,
) -> ClockMapping:
    """Find the conversion of a sender's clock to the autopilot's boot clock.

    The first conversion that applies is used:

    1. None if too few timestamps are distinct: the receive times are the sample times.
    2. The timestamps are already boot times: they agree with the receive times, and TIMESYNC does
       not improve the agreement.
    3. TIMESYNC, then SYSTEM_TIME, if the converted timestamps agree with the receive times.
    4. Line through the timestamps and receive times.

    Parameters
    ----------
    name : str
        Name of the sender.
    timestamps_s, receive_times_s : ndarray, shape (n,)
        Timestamp (sender's clock) and receive time of each message.
    receipt_to_boot_fit : ClockLine
        Conversion of receive times to the boot clock.
    sender_replies : tuple of ndarray
        TIMESYNC request times (s, boot clock) and reply times (s, sender's clock).
    autopilot_replies : tuple of ndarray
        TIMESYNC request times (s, sender's clock) and reply times (s, boot clock).
    boot_to_unix_fit : ClockLine or None
        Conversion of the boot clock to UNIX time.
    has_receive_times : bool
        True if the recording contains receive times.
    """
    time_source = "receive time" if has_receive_times else "message order"
    boot_time_at_receipt_s = receipt_to_boot_fit.at(receive_times_s)
    if not is_running_clock(timestamps_s):
        distinct_count = len(np.unique(timestamps_s))
        note = (
            f"the {len(timestamps_s)} timestamps have only {distinct_count} distinct values, so "
            f"px4fuse uses the {time_source}"
        )
        # Jitter of the receive time, if the sender sends at regular intervals
        intervals_s = np.diff(receive_times_s)
        intervals_s = intervals_s[intervals_s < MAX_REGULAR_SAMPLE_INTERVAL_S]
        jitter_s = float(np.std(intervals_s) / np.sqrt(2.0)) if len(intervals_s) else 0.0
        description = ClockMap(
            name, time_source, len(timestamps_s), 0.0, 0.0, jitter_s, note, distinct_count
        )
        return ClockMapping(None, description)

    def compute_difference_from_receipt_s(boot_time_s: Array) -> float:
        return abs(float(np.median(boot_time_at_receipt_s - boot_time_s)))

    timesync_fit = _fit_timesync(sender_replies, autopilot_replies)
    difference_from_receipt_s = compute_difference_from_receipt_s(timestamps_s)
    # Without TIMESYNC, a clock that started seconds later looks like the boot clock
    reduction_by_timesync_s = (
        0.0
        if timesync_fit is None
        else difference_from_receipt_s
        - compute_difference_from_receipt_s(timesync_fit.at(timestamps_s))
    )
    if (
        difference_from_receipt_s <= MAX_BOOT_TIME_DIFFERENCE_S
        and reduction_by_timesync_s < MIN_REDUCTION_BY_TIMESYNC_S
    ):
        same_clock = ClockLine(0.0, 0.0, 1.0, 0.0, len(timestamps_s))
        note = "the timestamps of the sender are boot times of the autopilot"
        return _make_clock_mapping(name, "boot clock", same_clock, timestamps_s, note)
    clock_kind = "UNIX time" if float(np.median(timestamps_s)) > MIN_UNIX_TIME_S else "clock"
    clock_name = f"{clock_kind} of {name}"
    candidate_fits = [] if timesync_fit is None else [("TIMESYNC", timesync_fit, "")]
    if clock_kind == "UNIX time" and boot_to_unix_fit is not None:
        unix_note = "assumption: the UNIX clocks of sender and autopilot are synchronised"
        candidate_fits.append(("SYSTEM_TIME", boot_to_unix_fit.inverse(), unix_note))
    for method, sender_to_boot_fit, note in candidate_fits:
        # Converted timestamps that disagree with the receive times are from another clock
        if (
            compute_difference_from_receipt_s(sender_to_boot_fit.at(timestamps_s))
            <= MAX_BOOT_TIME_DIFFERENCE_S
        ):
            return _make_clock_mapping(clock_name, method, sender_to_boot_fit, timestamps_s, note)
    sender_to_boot_fit = fit_clock_line(timestamps_s, receive_times_s)
    sender_to_boot_fit = replace(
        sender_to_boot_fit,
        y0=float(receipt_to_boot_fit.at(sender_to_boot_fit.y0)),
        slope=sender_to_boot_fit.slope * receipt_to_boot_fit.slope,
    )
    note = (
        "the recording has no usable TIMESYNC or SYSTEM_TIME. All sample times are late by the "
        "minimum delay of the link, which is unknown"
    )
    return _make_clock_mapping(clock_name, time_source, sender_to_boot_fit, timestamps_s, note)


def _fit_timesync(
    sender_replies: tuple[Array, Array], autopilot_replies: tuple[Array, Array]
) -> ClockLine | None:
    """Fit the conversion of sender clock to boot clock by TIMESYNC, as mean of both directions."""
    clock_fits = []
    if len(sender_replies[0]) >= MIN_TIMESYNC_REPLIES:
        # Inverse, because the request (boot time) is before the reply (sender time)
        clock_fits.append(fit_clock_line(*sender_replies).inverse())
    if len(autopilot_replies[0]) >= MIN_TIMESYNC_REPLIES:
        clock_fits.append(fit_clock_line(*autopilot_replies))
    if not clock_fits:
        return None
    x0 = clock_fits[0].x0
    line_parameters = [(float(line.at(x0)), line.slope, line.jitter_s) for line in clock_fits]
    y0, slope, jitter_s = np.mean(line_parameters, axis=0).tolist()
    return ClockLine(x0, y0, slope, jitter_s, sum(line.reading_pair_count for line in clock_fits))


def _make_clock_mapping(
    clock: str, method: str, line: ClockLine, timestamps_s: Array, note: str
) -> ClockMapping:
    middle_timestamp_s = float(0.5 * (timestamps_s.min() + timestamps_s.max()))
    offset_s = float(line.at(middle_timestamp_s)) - middle_timestamp_s
    drift_ppm = (line.slope - 1.0) * 1e6
    description = ClockMap(
        clock, method, line.reading_pair_count, offset_s, drift_ppm, line.jitter_s, note
    )
    return ClockMapping(line, description)
