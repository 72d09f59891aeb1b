"""Data classes for the results of :mod:`px4fuse.diagnose`."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from .comparison.estimates import Estimates
from .comparison.flight_events import Events
from .comparison.model import AxisComparison, Comparison
from .comparison.rerun_effects import Rerun
from .comparison.reruns import Reruns
from .core.record import display_html, one_line_repr
from .ekf2.aids import AidResult
from .ekf2.replay import Ekf2Replay
from .ekf2.whatif import WhatIf
from .errors import SettingsError
from .finding import Finding
from .flight.model import Flight, Unavailable
from .loop.model import Loop
from .request import ComparisonRequest


@dataclass(frozen=True, repr=False, kw_only=True)
class Analysis(Comparison, Estimates, Reruns):
    """Comparison of KF and EKF2 on one flight, with parameter estimates, filter re-runs and faults.

    The fields of :class:`Comparison`, :class:`Estimates` and :class:`Reruns` are also fields of
    this class.

    Attributes
    ----------
    events : Events
        Gaps, dropouts, resets and times on the ground.
    aids : mapping from PX4's name to AidResult, or Unavailable
        Innovation statistics of each aiding source of EKF2.
    loop : Loop or Unavailable
        Loop closure error of the odometry in the log, and corrected paths.
    findings : tuple of Finding
        Faults of the flight, most severe first, each cause followed by its effects.
    request : ComparisonRequest or None
        Files and settings of the analysis.
    """

    events: Events
    aids: Mapping[str, AidResult] | Unavailable
    loop: Loop | Unavailable
    findings: tuple[Finding, ...] = ()
    request: ComparisonRequest | None = None

    def _repr_html_(self) -> str | None:
        return display_html(self)

    def require_request(self) -> ComparisonRequest:
        """Return the request, or raise SettingsError for an analysis without a request."""
        if self.request is None:
            raise SettingsError(
                "The analysis contains no options of px4fuse.compare. Reports, web pages and "
                "summaries need these options.",
                "Pass an analysis from px4fuse.compare.",
            )
        return self.request

    @property
    def ekf2_replay(self) -> Ekf2Replay | Unavailable:
        """Replay of EKF2 with the parameters as flown, and its agreement with the log."""
        model = self.ekf2_model
        return model if isinstance(model, Unavailable) else model.baseline_replay

    def select_main_reruns(self) -> list[Rerun]:
        """Return the re-runs along the axis of largest motion, compared with the original run.

        The original run is the logged EKF2 or the first run of KF. Re-runs that are compared with a
        replay of EKF2 are omitted.
        """
        main_axis = self.main.axis.name
        return [rerun for rerun in self.reruns if rerun.axis == main_axis and rerun.is_logged]

    def select_secondary_axes(self) -> list[AxisComparison]:
        """Return the comparisons along all axes except that of ``main``."""
        return [axis for axis in self.axes.values() if axis is not self.main]


@dataclass(frozen=True)
class AidingSourceAnalysis:
    """Evaluation of EKF2's aiding sources, for a flight without positions for KF.

    Attributes
    ----------
    flight : Flight
    aids : mapping from PX4's name to AidResult
    missing_data : Unavailable
        Reason why KF cannot run, and advice to log positions.
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
        Changed parameters of EKF2.
    uses_estimates : bool
        True if ``changes`` are maximum-likelihood estimates.
    without : mapping from PX4's name of an aiding source to float
        Time (s) from which EKF2 does not fuse the aiding source in the replays.
    """

    flight: Flight
    statistics: WhatIf
    changes: Mapping[str, float]
    uses_estimates: bool
    without: Mapping[str, float] = field(default_factory=dict)

    __repr__ = one_line_repr

    @property
    def sweep_start_index(self) -> int:
        """Index of the first replay of the parameter sweep."""
        return int(bool(self.changes or self.without))


def find_failed_checks(analysis: Analysis | AidingSourceAnalysis) -> dict[str, str]:
    """Return the axes along which EKF2 is overconfident, and its faulty aiding sources.

    The result maps "EKF2, " and axis, or the name of the aiding source, to the verdict.
    """
    failed_verdicts = {}
    if isinstance(analysis, Analysis):
        for name, axis in analysis.axes.items():
            ekf2 = axis.filters["ekf2"]
            if not isinstance(ekf2, Unavailable) and ekf2.verdict == "overconfident":
                failed_verdicts[f"EKF2, {name}"] = ekf2.verdict
    results_by_aid = {} if isinstance(analysis.aids, Unavailable) else analysis.aids
    return failed_verdicts | {
        aid.label: aid.verdict for aid in results_by_aid.values() if aid.is_faulty
    }
