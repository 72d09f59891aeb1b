"""px4fuse: replay a PX4 flight through a two-state Kalman filter and compare it with EKF2.

>>> import px4fuse
>>> flight = px4fuse.read_log("sample_logs/aisle_uwb.ulg")
>>> comparison = px4fuse.compare(flight, px4fuse.Settings(sigma_z_m=0.1))
>>> [axis.axis.name for axis in comparison.axes]
['north', 'east', 'down', 'aisle']
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from px4fuse.analysis import explain
    from px4fuse.comparison.comparison import Comparison, compare
    from px4fuse.errors import Px4FuseError
    from px4fuse.filter.consistency import Consistency, assess
    from px4fuse.filter.kalman import Settings, replay
    from px4fuse.filter.tuning import tune
    from px4fuse.findings import Finding, find
    from px4fuse.flight import Flight, Unavailable
    from px4fuse.loop.loop import close_loop
    from px4fuse.readers import read_log
    from px4fuse.readers.trajectory import read_trajectory
    from px4fuse.trajectory.evaluation import evaluate

__all__ = [
    "Comparison",
    "Consistency",
    "Finding",
    "Flight",
    "Px4FuseError",
    "Settings",
    "Unavailable",
    "assess",
    "close_loop",
    "compare",
    "evaluate",
    "explain",
    "find",
    "read_log",
    "read_trajectory",
    "replay",
    "tune",
]

_HOMES = {
    "Comparison": "comparison.comparison",
    "Consistency": "filter.consistency",
    "Finding": "findings",
    "Flight": "flight",
    "Px4FuseError": "errors",
    "Settings": "filter.kalman",
    "Unavailable": "flight",
    "assess": "filter.consistency",
    "close_loop": "loop.loop",
    "compare": "comparison.comparison",
    "evaluate": "trajectory.evaluation",
    "explain": "analysis",
    "find": "findings",
    "read_log": "readers",
    "read_trajectory": "readers.trajectory",
    "replay": "filter.kalman",
    "tune": "filter.tuning",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``px4fuse --help`` is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
