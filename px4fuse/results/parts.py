"""What every builder of results uses: fields of the same names, absent parts, provenance."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any, TypeVar

import msgspec

from px4fuse.findings import Finding
from px4fuse.flight import Flight, Unavailable
from px4fuse.results.comparison import ClockMap, Dropout, JoinedFile, Log
from px4fuse.results.contract import VERSION
from px4fuse.results.model import Absent, FoundMistake, Missing, Provenance, Schema

S = TypeVar("S", bound=msgspec.Struct)
# The libraries on whose arithmetic the numbers rest
LIBRARIES = ("numpy", "scipy", "pandas", "pyulog", "pymavlink", "filterpy", "matplotlib", "pypdf")


def copied(kind: type[S], source: object, /, **more: Any) -> S:
    """A struct whose fields are those of the same names of ``source``, and ``more``.

    What is unavailable is absent.
    """
    same = {n: getattr(source, n) for n in kind.__struct_fields__ if hasattr(source, n)} | more
    return kind(**{n: absent(v) if isinstance(v, Unavailable) else v for n, v in same.items()})


def absent(part: Unavailable) -> Absent:
    """What stands where a number could not be computed."""
    return Absent(copied(Missing, part))


def copied_or_absent(kind: type[S], part: object) -> S | Absent:
    """As :func:`copied`, or why there is nothing to copy."""
    return absent(part) if isinstance(part, Unavailable) else copied(kind, part)


def found_mistakes(findings: tuple[Finding, ...]) -> tuple[FoundMistake, ...]:
    """Findings as results hold them."""
    return tuple(
        copied(FoundMistake, finding, consequences=found_mistakes(finding.consequences))
        for finding in findings
    )


def log_part(flight: Flight) -> Log:
    """The log of a flight and what was joined with it."""
    log = flight.log
    return copied(
        Log,
        log,
        dropouts=tuple(copied(Dropout, dropout) for dropout in log.dropouts),
        parameters=dict(log.parameters),
        joined=tuple(copied(JoinedFile, file) for file in flight.inputs),
        clocks=tuple(copied(ClockMap, clock) for clock in flight.clocks),
    )


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
