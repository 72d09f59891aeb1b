"""Sources that may drift, and what their innovations can therefore not say.

Innovations judge a filter against its source. An odometry is smooth over seconds and metres wrong
after minutes: a filter that follows it closely has small innovations and a large error, so that no
measurement noise follows from them, and the errors of scale and heading look like a clock that
wanders. Which sources those are says ``Origin.may_drift``; this says what is left of their clock
estimate.
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace
from scipy.special import stdtr

from px4fuse.arrays import Array
from px4fuse.filter.clock import MAX_HALF_INTERVAL_S, ClockOffset

# A step of the clock that drift cannot imitate: at 1 m/s a good UWB's noise
CHANGE_S = 0.10
# On either side of a step, so that each shows its own scatter
MIN_PARTS = 2


def with_drift(clock: ClockOffset) -> ClockOffset:
    """The clock estimate of a source that may drift: no surer than its parts agree.

    Errors of scale and heading, and the walk of an odometry, move the offset of each part by more
    than the noise does. The scatter of the parts about their steps is what they amount to: it
    widens the interval, and only a step beyond it, of 0.1 s or more, is a change of the clock.
    """
    offset = np.array([part.offset_s for part in clock.parts])
    weight = np.array([part.sigma_s**-2.0 for part in clock.parts])
    if len(offset) <= MIN_PARTS:
        return replace(clock, change_p=None, drift_ppm=None, drift_sigma_ppm=None)
    scatter = np.sqrt(max(1.0, _square(offset, weight) / (len(offset) - 1)))
    low, high = (clock.offset_s + scatter * (end - clock.offset_s) for end in clock.interval_s)
    reason = clock.reason
    if not reason and (high - low) / 2.0 > MAX_HALF_INTERVAL_S:
        reason = (
            "the parts of the flight differ by more than noise explains, as they do for a source "
            f"that drifts: offsets from {low:+.2f} s to {high:+.2f} s are possible"
        )
    return replace(
        clock,
        interval_s=(float(low), float(high)),
        sigma_s=float(clock.sigma_s * scatter),
        determinable=not reason,
        reason=reason,
        drift_ppm=None,
        drift_sigma_ppm=None,
        change_p=_step_p(offset, weight),
    )


def _square(offset: Array, weight: Array) -> float:
    """Σ w (x - weighted mean)²."""
    return float(np.sum(weight * (offset - np.average(offset, weights=weight)) ** 2))


def _step_p(offset: Array, weight: Array) -> float | None:
    """p-value of the largest step between parts against their own scatter, both sides estimated.

    Student's t of two weighted means whose common scatter comes from within the sides, times the
    number of places looked at (Bonferroni); 1 where the step is below ``CHANGE_S``.
    """
    count = len(offset)
    places = range(MIN_PARTS, count - MIN_PARTS + 1)
    smallest = 1.0
    for at in places:
        sides = [(offset[rows], weight[rows]) for rows in (slice(None, at), slice(at, None))]
        step = float(np.diff([np.average(x, weights=w) for x, w in sides])[0])
        if abs(step) < CHANGE_S:
            continue
        scatter = max(1.0, sum(_square(x, w) for x, w in sides) / (count - 2))
        sigma = np.sqrt(scatter * sum(1.0 / np.sum(w) for _, w in sides))
        p = 2.0 * float(stdtr(count - 2, -abs(step) / sigma))
        smallest = min(smallest, p * len(places))
    return smallest if places else None
