"""The mistakes that px4fuse names: a file for those that share a condition.

A file declares thresholds with unit and source and, in ``detect``, the condition and evidence of
its findings; their words stand in ``words.toml``. A detector never prints and never guesses: what
it cannot see it does not mention.

To add a finding: its file with a ``detect``, its words in ``words.toml``, and the flights on which
its rate is measured in ``tests/studies/rates.csv``.
"""

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.aids import AidResult
from px4fuse.findings.aids import find_in as find_in_aids
from px4fuse.findings.causes import by_cause
from px4fuse.findings.loops import find_in
from px4fuse.findings.model import NAMES, Finding, Found, Severity, by_root
from px4fuse.loop.model import Loop

__all__ = [
    "NAMES", "Finding", "Severity", "by_root", "find", "find_aids", "find_loop",
    "named",
]  # fmt: skip


@cache
def detectors() -> tuple[Callable[[Analysis], Found], ...]:
    """``detect`` of every file of this package that has one."""
    files = [import_module(f"{__name__}.{file.name}") for file in iter_modules(__path__)]
    return tuple(file.detect for file in files if hasattr(file, "detect"))


def find(subject: Analysis | Comparison) -> tuple[Finding, ...]:
    """Findings, most severe first and what the recording lacks before noises.

    What follows from another stands behind it, see :attr:`Finding.caused_by`.

    Parameters
    ----------
    subject : Analysis or Comparison
        A comparison is explained first, which takes some seconds.
    """
    analysis = subject if isinstance(subject, Analysis) else explain(subject)
    return by_cause(found for detect in detectors() for found in detect(analysis))


def find_loop(loop: Loop) -> tuple[Finding, ...]:
    """All findings about a loop, most severe first."""
    return by_cause(find_in(loop))


def find_aids(aids: Mapping[str, AidResult]) -> tuple[Finding, ...]:
    """All findings about EKF2's aids alone, most severe first."""
    return by_cause(find_in_aids(aids))


def named(finding: str) -> str:
    """A finding as part of a sentence; one that this version does not know by its id.

    >>> named("source_gap"), named("of_a_later_version")
    ('a time without positions', 'of a later version')
    """
    return NAMES.get(finding, finding.replace("_", " "))
