"""What a report is made of: the comparison or the loop, its findings, and who it is for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from px4fuse.analysis import Analysis, Counterfactual
from px4fuse.comparison.events import Events, happened
from px4fuse.comparison.model import AxisComparison
from px4fuse.findings import Finding
from px4fuse.findings.story import story
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.results.contract import ChangeResults
from px4fuse.results.model import Provenance, Student
from px4fuse.trajectory.evaluation import Evaluation


def who(student: Student, between: str) -> str:
    """Name and id, as far as they are given."""
    return between.join(filter(None, (student.name, student.id)))


# Whose the pages are that are not handed in
NOBODY = Student()


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

    @property
    def log(self) -> tuple[str, str]:
        """Name and SHA-256 of the log."""
        return self.analysis.flight.log.name, self.analysis.flight.log.sha256

    @property
    def title(self) -> str:
        """Of the PDF."""
        return f"px4fuse compare {self.log[0]}"


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
    student: ClassVar[Student] = NOBODY

    @property
    def log(self) -> tuple[str, str]:
        """Name and SHA-256 of the log."""
        return self.made_of.flight.log.name, self.made_of.flight.log.sha256

    @property
    def title(self) -> str:
        """Of the PDF."""
        return f"px4fuse whatif {self.log[0]}"


@dataclass(frozen=True)
class EvaluationDocument:
    """A page on the errors of a trajectory.

    Attributes
    ----------
    score : Evaluation
    """

    score: Evaluation
    command: ClassVar[str] = ""
    student: ClassVar[Student] = NOBODY

    @property
    def log(self) -> tuple[str, str]:
        """Name and SHA-256 of what the estimate was read from."""
        return self.score.estimate.name, self.score.estimate.sha256

    @property
    def title(self) -> str:
        """Of the PDF."""
        return f"px4fuse evaluate {self.log[0]} {self.score.reference.name}"


@dataclass(frozen=True)
class ChangesDocument:
    """Pages on what changed from A to B.

    Attributes
    ----------
    results : ChangeResults
    a, b : Analysis or None
        Where their logs are at hand.
    """

    results: ChangeResults
    a: Analysis | None
    b: Analysis | None
    student: ClassVar[Student] = NOBODY

    @property
    def command(self) -> str:
        """The command line that makes it again, without folders."""
        return self.results.provenance.command

    @property
    def log(self) -> tuple[str, str]:
        """Names of both logs with the SHA-256 of A, and the SHA-256 of B."""
        a, b = self.results.a, self.results.b
        return f"A {a.log}, SHA-256 {a.log_sha256[:12]} · B {b.log}", b.log_sha256

    @property
    def title(self) -> str:
        """Of the PDF."""
        return f"px4fuse diff {self.results.a.given} {self.results.b.given}"


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

    @property
    def log(self) -> tuple[str, str]:
        """Name and SHA-256 of what the trajectory was read from."""
        track = self.loop.odometry.trajectory
        return track.name, track.sha256

    @property
    def title(self) -> str:
        """Of the PDF."""
        return f"px4fuse loop {self.log[0]}"
