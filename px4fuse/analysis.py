"""Records with the results of an analysis, computed by :mod:`px4fuse.diagnose`."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from px4fuse.comparison.estimates import Estimates
from px4fuse.comparison.flight_events import Events
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.comparison.reruns import Reruns
from px4fuse.comparison.trials import Trial
from px4fuse.core.record import display_html, one_line_repr
from px4fuse.ekf2.aids import AidResult
from px4fuse.ekf2.replay import Ekf2Replay
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2.whatif import WhatIf
from px4fuse.finding import Finding
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.request import ComparisonRequest


@dataclass(frozen=True, repr=False, kw_only=True)
class Analysis(Comparison, Estimates, Reruns):
    """Comparison of KF and EKF2, with parameter estimates, re-runs of both filters and faults.

    Attributes
    ----------
    aids : mapping from PX4's name to AidResult, or Unavailable
        Innovation statistics of each aiding source of EKF2.
    loop : Loop or Unavailable
        Loop closure error of the flight's odometry, and corrected paths.
    findings : tuple of Finding
        Faults of the flight, most severe first, each cause followed by its effects.
    request : ComparisonRequest or None
    """

    events: Events
    aids: Mapping[str, AidResult] | Unavailable
    loop: Loop | Unavailable
    findings: tuple[Finding, ...] = ()
    request: ComparisonRequest | None = None

    def _repr_html_(self) -> str | None:
        return display_html(self)

    @property
    def ekf2_replay(self) -> Ekf2Replay | Unavailable:
        """Replay of EKF2 with the parameters as flown, and its agreement with the log."""
        model = self.ekf2_model
        return model if isinstance(model, Unavailable) else model.baseline_replay

    def select_main_trials(self) -> list[Trial]:
        """Return re-runs along the main axis, without those of EKF2 that start from a replay."""
        main_axis = self.main.axis.name
        return [trial for trial in self.trials if trial.axis == main_axis and trial.is_logged]

    def select_secondary_axes(self) -> list[AxisComparison]:
        """Return comparisons along all axes except ``main``, the axis with the largest motion."""
        return [axis for axis in self.axes.values() if axis is not self.main]


@dataclass(frozen=True)
class AidsOnlyAnalysis:
    """Evaluation of EKF2's aiding sources in a flight without positions for the filter KF.

    Attributes
    ----------
    flight : Flight
    aids : mapping from PX4's name to AidResult
    missing_data : Unavailable
        Reason why KF cannot be run, and advice for logging positions.
    findings : tuple of Finding
        Faults of the aiding sources.
    """

    flight: Flight
    aids: Mapping[str, AidResult]
    missing_data: Unavailable
    findings: tuple[Finding, ...] = ()

    __repr__ = one_line_repr


@dataclass(frozen=True)
class WhatIfAnalysis:
    """Replays of EKF2 with changed parameters, or with aiding sources switched off.

    Attributes
    ----------
    changes : mapping from PX4 name to value
        Changed parameters of EKF2; empty if the user requested only a sweep of one parameter.
    uses_estimates : bool
        True if the changes are the maximum-likelihood estimates.
    difference_steps : mapping from axis name to DifferenceExplanation or Unavailable
        Causes of the difference between KF (default settings) and EKF2 as flown.
    without : mapping from PX4's name of an aiding source to float
        Aiding sources switched off in the replays, each with the time (s) of switching off.
    """

    flight: Flight
    whatif: WhatIf
    changes: Mapping[str, float]
    uses_estimates: bool
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable]
    without: Mapping[str, float] = field(default_factory=dict)

    __repr__ = one_line_repr

    @property
    def sweep_start_index(self) -> int:
        """Number of replays before the sweep: 1 with ``changes`` or ``without``, else 0."""
        return int(bool(self.changes or self.without))


def failed_checks(analysis: Analysis | AidsOnlyAnalysis) -> dict[str, str]:
    """Return the consistency verdicts of failed EKF2 checks, by axis or aiding source.

    A check fails if EKF2 is overconfident along an axis, or if an aiding source is overconfident,
    biased or not fused for too long.
    """
    failed_verdicts = {}
    if isinstance(analysis, Analysis):
        for name, axis in analysis.axes.items():
            ekf2 = axis.filters["ekf2"]
            if not isinstance(ekf2, Unavailable) and ekf2.verdict == "overconfident":
                failed_verdicts[f"EKF2, {name}"] = ekf2.verdict
    aids = {} if isinstance(analysis.aids, Unavailable) else analysis.aids
    return failed_verdicts | {aid.label: aid.verdict for aid in aids.values() if aid.is_faulty}
