"""What explains a comparison: noises asked for, clock offset, difference budget, loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from px4fuse.comparison.budget import budget
from px4fuse.comparison.comparison import Comparison
from px4fuse.errors import MissingDataError
from px4fuse.filter.clock import ClockOffset, estimate_clock_offset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, tune
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import loop_in

# What the report shows; each axis by itself is for `px4fuse tune`
REPORTED = (HORIZONTAL, "down", "aisle")


def explain(comparison: Comparison, progress: Callable[[str], None] = lambda _: None) -> Comparison:
    """Add tuning, clock offset, difference budget and loop closure to a comparison.

    Parameters
    ----------
    comparison : Comparison
    progress : callable
        Told what is being done.
    """
    axes = tuple(result.axis for result in comparison.axes)
    names = REPORTED if {"north", "east"} <= {axis.name for axis in axes} else None
    tuning = tune(axes, comparison.settings, names, lambda name: progress(f"tuning {name}"))
    tuned = replace(comparison, tuning=tuning)
    timed = replace(tuned, clock=clock_offset(tuned, progress))
    budgeted = replace(timed, budget=budget(timed, progress))
    progress("looking for a loop")
    return replace(budgeted, loop=loop_in(comparison.flight, progress))


def tuned_horizontally(comparison: Comparison) -> Comparison:
    """Add the horizontal noises, which is what the clock estimate needs."""
    axes = tuple(result.axis for result in comparison.axes)
    return replace(comparison, tuning=tune(axes, comparison.settings, (HORIZONTAL,)))


def clock_offset_found(
    comparison: Comparison, progress: Callable[[str], None] = lambda _: None
) -> float:
    """Clock offset (s) to set, for ``--clock-offset auto``.

    Raises
    ------
    MissingDataError
        The flight does not determine it; the text says why.
    """
    found = clock_offset(tuned_horizontally(comparison), progress)
    if isinstance(found, Unavailable) or not found.determinable:
        raise MissingDataError(
            f"{comparison.flight.log.name}: --clock-offset auto: not determinable: {found.reason}. "
            "Give the seconds to add, or leave the option out."
        )
    return comparison.settings.clock_offset_s + found.offset_s


def clock_offset(
    comparison: Comparison, progress: Callable[[str], None] = lambda _: None
) -> ClockOffset | Unavailable:
    """What must still be added to the stamps of the source, beyond the offset that was set.

    Takes measurement noise and outliers from the comparison's tuning where it has that.
    """
    tuned = next(
        (
            found
            for found in (comparison.tuning.get(HORIZONTAL), *comparison.tuning.values())
            if isinstance(found, AxisTuning)
        ),
        None,
    )
    sigma_z_m, outliers = comparison.settings.sigma_z_m, None
    if tuned is not None:
        sigma_z_m = tuned.sigma_z.value or tuned.sigma_z.high or sigma_z_m
        outliers = tuned.outlier_time_s
    return estimate_clock_offset(
        comparison.flight,
        comparison.source,
        comparison.segment,
        comparison.settings,
        sigma_z_m,
        outliers,
        progress,
    )
