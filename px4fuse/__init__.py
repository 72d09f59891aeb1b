"""px4fuse: replay a PX4 flight through a two-state Kalman filter and compare it with EKF2.

>>> import px4fuse
>>> analysis = px4fuse.compare("sample_logs/aisle_uwb.ulg", sigma_z_m=0.1)
>>> [axis.axis.name for axis in analysis.axes.values()]
['north', 'east', 'down', 'aisle']
"""

import importlib as _importlib
import sys as _sys
import types as _types
import typing as _typing

if _typing.TYPE_CHECKING:
    from px4fuse.analysis import Analysis as Analysis
    from px4fuse.analysis import explain as explain
    from px4fuse.analysis import run as run
    from px4fuse.comparison.model import Comparison as Comparison
    from px4fuse.ekf2.model import Model as Model
    from px4fuse.ekf2.model import open_model as open_model
    from px4fuse.ekf2.whatif import WhatIf as WhatIf
    from px4fuse.errors import Px4FuseError as Px4FuseError
    from px4fuse.filter.clock import ClockOffset as ClockOffset
    from px4fuse.filter.consistency import Consistency as Consistency
    from px4fuse.filter.consistency import assess as assess
    from px4fuse.filter.kalman import replay as replay
    from px4fuse.filter.settings import Settings as Settings
    from px4fuse.filter.tuning import AxisTuning as AxisTuning
    from px4fuse.filter.tuning import tune as tune
    from px4fuse.findings import Finding as Finding
    from px4fuse.findings import find as find
    from px4fuse.fleet.changes import diff as diff
    from px4fuse.fleet.run import batch as batch
    from px4fuse.flight import Flight as Flight
    from px4fuse.flight import Unavailable as Unavailable
    from px4fuse.loop.model import Loop as Loop
    from px4fuse.notebook.commands import close_loop as close_loop
    from px4fuse.notebook.commands import compare as compare
    from px4fuse.notebook.commands import evaluate as evaluate
    from px4fuse.notebook.commands import explore as explore
    from px4fuse.notebook.commands import report as report
    from px4fuse.notebook.commands import what_if as what_if
    from px4fuse.readers import read_log as read_log
    from px4fuse.readers.trajectory import read_trajectory as read_trajectory
    from px4fuse.request import ComparisonRequest as ComparisonRequest
    from px4fuse.request import LoopRequest as LoopRequest
    from px4fuse.request import PositionFile as PositionFile
    from px4fuse.results.contract import ChangeResults as ChangeResults
    from px4fuse.trajectory.evaluation import Evaluation as Evaluation
    from px4fuse.trajectory.model import Trajectory as Trajectory

# The public names of each module
_PUBLIC = {
    "analysis": ("Analysis", "explain", "run"),
    "comparison.model": ("Comparison",),
    "ekf2.model": ("Model", "open_model"),
    "ekf2.whatif": ("WhatIf",),
    "errors": ("Px4FuseError",),
    "filter.clock": ("ClockOffset",),
    "filter.consistency": ("Consistency", "assess"),
    "filter.kalman": ("replay",),
    "filter.settings": ("Settings",),
    "filter.tuning": ("AxisTuning", "tune"),
    "findings": ("Finding", "find"),
    "fleet.changes": ("diff",),
    "fleet.run": ("batch",),
    "flight": ("Flight", "Unavailable"),
    "loop.model": ("Loop",),
    "notebook.commands": ("close_loop", "compare", "evaluate", "explore", "report", "what_if"),
    "readers": ("read_log",),
    "readers.trajectory": ("read_trajectory",),
    "request": ("ComparisonRequest", "LoopRequest", "PositionFile"),
    "results.contract": ("ChangeResults",),
    "trajectory.evaluation": ("Evaluation",),
    "trajectory.model": ("Trajectory",),
}
_HOMES = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = list(_HOMES)


def __dir__() -> list[str]:
    """The public names, which are imported when they are first used."""
    return sorted(_HOMES)


def __getattr__(name: str) -> _typing.Any:
    """Import a public name when it is first used, so that ``px4fuse --help`` is instant."""
    if name not in _HOMES:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}", name=name, obj=_sys.modules[__name__]
        )
    _importlib.import_module(f"{__name__}.notebook")  # by which results show themselves
    value = getattr(_importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


class _Package(_types.ModuleType):
    """The package, of which two functions have the names of rooms: attributes are the functions."""

    explore = property(lambda _: __getattr__("explore"), lambda *_: None)
    report = property(lambda _: __getattr__("report"), lambda *_: None)


_sys.modules[__name__].__class__ = _Package
