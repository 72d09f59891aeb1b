"""Parts that the results of several commands have in common, from what was computed."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any, TypeVar

import msgspec

from px4fuse.flight import Flight
from px4fuse.results.comparison import Log
from px4fuse.results.contract import VERSION
from px4fuse.results.model import Provenance, Schema

S = TypeVar("S", bound=msgspec.Struct)
# The libraries on whose arithmetic the numbers rest
LIBRARIES = ("numpy", "scipy", "pandas", "pyulog", "pymavlink", "filterpy", "matplotlib", "pypdf")


def copied(kind: type[S], source: object, /, **more: Any) -> S:
    """A struct whose fields are those of the same names of ``source``, and ``more``."""
    same = {n: getattr(source, n) for n in kind.__struct_fields__ if hasattr(source, n)}
    return kind(**(same | more))


def log_part(flight: Flight) -> Log:
    """The log of a flight and what was joined with it."""
    return Log(**msgspec.structs.asdict(flight.log), joined=flight.inputs, clocks=flight.clocks)


def schema_of(name: str) -> Schema:
    """Name and version of what is written."""
    return Schema(name, VERSION)


def provenance(command: str) -> Provenance:
    """Versions and the command line; nothing else of the machine is recorded."""
    return Provenance(
        px4fuse=metadata.version("px4fuse"),
        python=platform.python_version(),
        libraries={name: metadata.version(name) for name in LIBRARIES},
        command=command,
    )
