"""px4fuse: replay a PX4 flight through a two-state Kalman filter and compare it with EKF2.

>>> import px4fuse
>>> analysis = px4fuse.compare("sample_logs/aisle_uwb.ulg", sigma_z_m=0.1)
>>> [axis.axis.name for axis in analysis.axes.values()]
['north', 'east', 'down', 'aisle']
"""

import importlib as _importlib
import pathlib as _pathlib
import re as _re
import sys as _sys
import types as _types
import typing as _typing

# What type checkers read is where every public name is at home
_STUB = _pathlib.Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {name: home for home, name in _re.findall(r"^from (\S+) import (\w+)", _STUB, _re.M)}
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
    value = getattr(_importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


class _Package(_types.ModuleType):
    """The package, of which two functions have the names of rooms: attributes are the functions."""

    explore = property(lambda _: __getattr__("explore"), lambda *_: None)
    report = property(lambda _: __getattr__("report"), lambda *_: None)


_sys.modules[__name__].__class__ = _Package
