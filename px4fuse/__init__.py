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
    from px4fuse.analysis import Analysis as Analysis
    from px4fuse.analysis import explain as explain
    from px4fuse.analysis import run as run
    from px4fuse.comparison.comparison import Comparison as Comparison
    from px4fuse.comparison.comparison import compare as compare
    from px4fuse.ekf2.model import Model as Model
    from px4fuse.ekf2.model import open_model as open_model
    from px4fuse.ekf2.model import replay_ekf2 as replay_ekf2
    from px4fuse.ekf2.whatif import what_if as what_if
    from px4fuse.errors import Px4FuseError as Px4FuseError
    from px4fuse.filter.consistency import Consistency as Consistency
    from px4fuse.filter.consistency import assess as assess
    from px4fuse.filter.kalman import Settings as Settings
    from px4fuse.filter.kalman import replay as replay
    from px4fuse.filter.tuning import tune as tune
    from px4fuse.findings import Finding as Finding
    from px4fuse.findings import find as find
    from px4fuse.flight import Flight as Flight
    from px4fuse.flight import Unavailable as Unavailable
    from px4fuse.loop.loop import close_loop as close_loop
    from px4fuse.readers import read_log as read_log
    from px4fuse.readers.trajectory import read_trajectory as read_trajectory
    from px4fuse.request import ComparisonRequest as ComparisonRequest
    from px4fuse.request import LoopRequest as LoopRequest
    from px4fuse.trajectory.evaluation import evaluate as evaluate

# Where each public name lives
_HOMES = {
    "Analysis": "analysis",
    "Comparison": "comparison.comparison",
    "ComparisonRequest": "request",
    "Consistency": "filter.consistency",
    "Finding": "findings",
    "Flight": "flight",
    "LoopRequest": "request",
    "Model": "ekf2.model",
    "Px4FuseError": "errors",
    "Settings": "filter.kalman",
    "Unavailable": "flight",
    "assess": "filter.consistency",
    "close_loop": "loop.loop",
    "compare": "comparison.comparison",
    "evaluate": "trajectory.evaluation",
    "explain": "analysis",
    "find": "findings",
    "open_model": "ekf2.model",
    "read_log": "readers",
    "read_trajectory": "readers.trajectory",
    "replay": "filter.kalman",
    "replay_ekf2": "ekf2.model",
    "run": "analysis",
    "tune": "filter.tuning",
    "what_if": "ekf2.whatif",
}
__all__ = list(_HOMES)


def __dir__() -> list[str]:
    """Complete the public names, which are imported when they are first used."""
    return sorted({*globals(), *_HOMES})


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``px4fuse --help`` is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
