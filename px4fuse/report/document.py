"""What a report is made of: what was analysed, and its results as they are attached."""

from dataclasses import dataclass
from functools import cached_property

from px4fuse.analysis import AidsAlone, Analysis, Counterfactual
from px4fuse.comparison.events import Events, happened
from px4fuse.comparison.model import AxisComparison
from px4fuse.flight import Unavailable
from px4fuse.loop.model import Loop
from px4fuse.results.contract import AidsResults, ComparisonResults, LoopResults, WhatIfResults
from px4fuse.results.model import Student


def who(student: Student, between: str) -> str:
    """Name and id, as far as they are given."""
    return between.join(filter(None, (student.name, student.id)))


@dataclass(frozen=True)
class Document:
    """A report on a comparison."""

    analysis: Analysis
    results: ComparisonResults

    @property
    def other_axes(self) -> list[AxisComparison]:
        """The axes beside the main one."""
        return [axis for axis in self.analysis.axes.values() if axis is not self.analysis.main]

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
    """A report on the aids of EKF2 alone."""

    alone: AidsAlone
    results: AidsResults


@dataclass(frozen=True)
class WhatIfDocument:
    """A page on EKF2 with other parameters."""

    made_of: Counterfactual
    results: WhatIfResults


@dataclass(frozen=True)
class LoopDocument:
    """A report on a loop alone."""

    loop: Loop
    results: LoopResults
