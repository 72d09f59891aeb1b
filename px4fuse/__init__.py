"""px4fuse: run a two-state Kalman filter on a PX4 flight and compare it with EKF2.

>>> import px4fuse
>>> analysis = px4fuse.compare("sample_logs/aisle_uwb.ulg", sigma_z_m=0.1)
>>> [axis.axis.name for axis in analysis.axes.values()]
['north', 'east', 'down', 'aisle']
"""

import importlib as _importlib
import typing as _typing

# Module of each public name. A module is imported at the first use of a name, which saves time
_MODULE_BY_NAME = {
    "Analysis": "analysis",
    "Px4FuseError": "errors",
    "Settings": "filter.settings",
    "Unavailable": "core.record",
    "run_batch": "batch.run",
    "diff": "batch.changes",
    "find": "findings",
    "read_log": "readers",
    "read_trajectory": "readers.trajectory",
    "run_kf": "filter.kalman",
    **dict.fromkeys(
        (
            "close_loop",
            "compare",
            "evaluate",
            "table",
            "what_if",
            "write_page",
            "write_report",
        ),
        "api",
    ),
}
__all__ = list(_MODULE_BY_NAME)

if _typing.TYPE_CHECKING:
    from .analysis import Analysis as Analysis
    from .api import close_loop as close_loop
    from .api import compare as compare
    from .api import evaluate as evaluate
    from .api import table as table
    from .api import what_if as what_if
    from .api import write_page as write_page
    from .api import write_report as write_report
    from .batch.changes import diff as diff
    from .batch.run import run_batch as run_batch
    from .core.record import Unavailable as Unavailable
    from .errors import Px4FuseError as Px4FuseError
    from .filter.kalman import run_kf as run_kf
    from .filter.settings import Settings as Settings
    from .findings import find as find
    from .readers import read_log as read_log
    from .readers.trajectory import read_trajectory as read_trajectory
else:

    def __dir__():
        return sorted(__all__)

    def __getattr__(name):
        """Import a public name at its first use."""
        if name not in _MODULE_BY_NAME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(_importlib.import_module(f"px4fuse.{_MODULE_BY_NAME[name]}"), name)
        globals()[name] = value
        return value
