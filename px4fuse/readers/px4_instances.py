"""Which instance of EKF2 was primary at each time, and what a topic says of it.

Source: PX4-Autopilot ``EKF2Selector.cpp``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from px4fuse.readers.px4_topics import SELECTOR, Layout
from px4fuse.readers.ulog_topics import Topics

# Primary EKF2 instance from each time on
Instances = tuple[tuple[float, int], ...]
# One EKF2 instance alone publishes no selector
NO_SELECTOR: Instances = ((-np.inf, 0),)


def primary_instances(topics: Topics) -> Instances:
    """Primary EKF2 instance from each time on; instance 0 where there is no selector."""
    status = topics.read(SELECTOR, step=True)
    if status is None:
        return NO_SELECTOR
    selected = status["instance"]
    selected = selected[selected < 255]  # 255: none selected yet
    if selected.empty:
        return NO_SELECTOR
    changes = selected[selected.ne(selected.shift())]
    times = [-np.inf, *changes.index[1:]]
    return tuple((float(time), int(number)) for time, number in zip(times, changes, strict=True))


def of_primary(
    topics: Topics,
    layout: Layout,
    instances: Instances,
    *,
    step: bool = False,
    select: Callable[[pd.DataFrame], pd.DataFrame] | None = None,
) -> pd.DataFrame:
    """Rows of each instance of a topic from the times in which that instance was primary.

    Parameters
    ----------
    layout : Layout
        One that :meth:`Topics.find` returned.
    instances : tuple of (float, int)
    step : bool
        Whether the topic is a step function.
    select : callable, optional
        Which rows of an instance count; all by default.
    """

    def read(number: int) -> pd.DataFrame:
        frame = topics.frame(layout, number, step=step)
        return frame if select is None else select(frame)

    available = topics.instances(layout.topic)
    if instances == NO_SELECTOR:
        return read(available[0])
    starts = np.array([start for start, _ in instances])
    numbers = np.array([number for _, number in instances])
    parts: list[pd.DataFrame] = []
    for number in available:
        frame = read(number)
        at = np.searchsorted(starts, frame.index.to_numpy(), side="right") - 1
        parts.append(frame[numbers[at] == number])
    joined = pd.concat(parts).sort_index()
    return joined[~joined.index.duplicated()]
