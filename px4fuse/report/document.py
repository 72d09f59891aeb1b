"""What a report is made of: the comparison or the loop, its findings, and who it is for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from px4fuse.analysis import AidsAlone, Analysis, Counterfactual
from px4fuse.comparison.events import Events, happened
from px4fuse.comparison.model import AxisComparison
from px4fuse.findings import Finding
from px4fuse.findings.story import story
from px4fuse.flight import Unavailable
from px4fuse.loop.model import Loop
from px4fuse.results.model import Provenance, Student


def who(student: Student, between: str) -> str:
    """Name and id, as far as they are given."""
    return between.join(filter(None, (student.name, student.id)))


@dataclass(frozen=True)
class Document:
    """One report.

    Attributes
    ----------
    analysis : Analysis
    findings : tuple of Finding
        Most severe first.
    student : Student
    command : str
        The command line that makes it again, without folders.
    made : Provenance or None
        Versions to print; None for those that run.
    """

    analysis: Analysis
    findings: tuple[Finding, ...]
    student: Student
    command: str
    made: Provenance | None = None

    @property
    def other_axes(self) -> list[AxisComparison]:
        """The axes beside the main one."""
        return [axis for axis in self.analysis.axes.values() if axis is not self.analysis.main]

    @cached_property
    def story(self) -> tuple[str, ...]:
        """What happened, in up to three sentences."""
        return story(self.analysis, self.findings)

    @property
    def truth_known(self) -> bool:
        """Whether the log has a truth to compare with."""
        return not isinstance(self.analysis.flight.truth, Unavailable)

    @cached_property
    def events(self) -> Events:
        """What is marked on every time axis."""
        return happened(self.analysis)


@dataclass(frozen=True)
class AidsDocument:
    """A report on the aids of EKF2 alone.

    Attributes
    ----------
    alone : AidsAlone
    findings : tuple of Finding
        Most severe first.
    student : Student
    command : str
    """

    alone: AidsAlone
    findings: tuple[Finding, ...]
    student: Student
    command: str


@dataclass(frozen=True)
class WhatIfDocument:
    """A page on EKF2 with other parameters.

    Attributes
    ----------
    made_of : Counterfactual
    command : str
        The command line that makes it again, without folders.
    """

    made_of: Counterfactual
    command: str


@dataclass(frozen=True)
class LoopDocument:
    """A report on a loop alone.

    Attributes
    ----------
    loop : Loop
    findings : tuple of Finding
        Most severe first.
    student : Student
    command : str
    made : Provenance or None
        As in :class:`Document`.
    """

    loop: Loop
    findings: tuple[Finding, ...]
    student: Student
    command: str
    made: Provenance | None = None
