"""Data of the diagnosis card, the one-page summary of a flight, as in the JSON results."""

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.comparison.model import FilterName
from px4fuse.comparison.rerun_effects import Improvement
from px4fuse.core.record import Count, NonNegativeFloat, PositiveFloat, Record, Share, Span
from px4fuse.filter.consistency import Reference

CardSeverity = Literal["clean", "note", "warning", "error", "refused"]
VerdictWord = Literal["consistent", "overconfident", "underconfident", "not evaluated"]
ActionTarget = Literal[
    "sender", "receiver", "source", "logging", "flight", "KF", "EKF2", "KF, EKF2"
]

# Limits of the logarithmic axis in plots of the σ ratio (actual / reported σ)
RATIO_AXIS_ENDS = (0.1, 10.0)
RATIO_AXIS_TICKS = {0.1: "1/10", 0.2: "1/5", 0.5: "1/2", 1.0: "1", 2.0: "2", 5.0: "5", 10.0: "10"}
MAX_CAUSES_ON_CARD = 3
MAX_NOTES = 3
MAX_HEADLINE_LENGTH = 84


def map_ratio_to_axis(ratio: float) -> float:
    """Return the position (0 to 1) of a ratio on a logarithmic axis from 0.1 to 10.

    The ratio is actual σ ÷ reported σ.

    >>> map_ratio_to_axis(0.1), map_ratio_to_axis(1.0), map_ratio_to_axis(10.0)
    (0.0, 0.5, 1.0)
    """
    log_axis_start, log_axis_end = (math.log10(end) for end in RATIO_AXIS_ENDS)
    return (math.log10(ratio) - log_axis_start) / (log_axis_end - log_axis_start)


class Verdict(Record, kw_only=True):
    """Consistency of KF or EKF2: ratio of actual to reported σ.

    Attributes
    ----------
    against : {"source", "truth"}
        "source": from innovations; "truth": from errors against ground truth.
    ratio : float or None
        √(mean NIS) or √(mean NEES); above 1 the reported σ is too small.
    interval : (float, float) or None
        95 % interval of the ratio.
    word : str
        "consistent", "overconfident" (reported σ too small), "underconfident" (too large), or
        "not evaluated" with a ``reason``.
    is_explained : bool
        True if an inconsistent filter needs no change of its settings, for example because it is
        consistent against ground truth.
    """

    filter: FilterName
    against: Reference
    ratio: PositiveFloat | None = None
    interval: tuple[NonNegativeFloat, NonNegativeFloat] | None = None
    word: VerdictWord
    samples: Count = 0
    reason: str = ""
    is_explained: bool = False

    @property
    def is_fault(self) -> bool:
        return self.word in ("overconfident", "underconfident") and not self.is_explained


class FlightErrors(Record, kw_only=True):
    """Errors in a flight: position RMSE of KF and EKF2, rejections and resets of EKF2.

    Attributes
    ----------
    axis : str
        Evaluated axis, for example "along the axis of largest motion, 30° from north".
    position_rmse_m : mapping
        Position RMSE of each filter against ground truth along ``axis``.
    horizontal_rmse_m : mapping
        Horizontal position RMSE of each filter against ground truth.
    difference_rms_m : float or None
        RMS of the position difference KF - EKF2 along ``axis``.
    rejected_fraction : float or None
        Fraction of the positions that EKF2 rejected.
    horizontal_resets : int or None
        Number of resets of EKF2's horizontal position.
    """

    axis: str
    position_rmse_m: Mapping[FilterName, NonNegativeFloat] = {}
    horizontal_rmse_m: Mapping[FilterName, NonNegativeFloat] = {}
    difference_rms_m: NonNegativeFloat | None = None
    rejected_fraction: Share | None = None
    horizontal_resets: Count | None = None


class Action(Record):
    """Recommended action against a fault: commands to paste, or a sentence.

    Attributes
    ----------
    target : str
        Device or filter to be changed.
    sentence : str
        Action as an imperative. If no action is recommended: the reason, which begins with "keep
        the settings" or "no".
    where : {"shell", "console", ""}
        Program for the commands: shell of the computer, or MAVLink console of the vehicle.
    """

    target: ActionTarget
    sentence: str = ""
    commands: tuple[str, ...] = ()
    where: Literal["shell", "console", ""] = ""

    @property
    def target_name(self) -> str:
        return "position source" if self.target == "source" else self.target

    @property
    def keeps_settings(self) -> bool:
        return self.sentence.startswith("keep the settings")

    def changes_something(self) -> bool:
        return not (self.keeps_settings or self.sentence.startswith("no "))


class CardRerun(Record, kw_only=True):
    """Statistics of KF or EKF2 before and after one change of a setting or of the data.

    Attributes
    ----------
    label : str
        Filter and change, for example "KF without 26 outliers".
    is_prediction : bool
        True for EKF2, because a replay predicts the results of PX4.
    from_s : float or None
        Start of the replay (s).
    position_rmse_m, source_ratio, truth_ratio, rejected_fraction : (float, float) or None
        Position RMSE, ratios of actual to reported σ (against position source and ground truth) and
        rejected fraction, before and after the change.
    improves : str
        Quantities that the change improves.
    """

    label: str
    is_prediction: bool = False
    from_s: float | None = None
    position_rmse_m: tuple[NonNegativeFloat, NonNegativeFloat] | None = None
    source_ratio: tuple[NonNegativeFloat, NonNegativeFloat] | None = None
    truth_ratio: tuple[NonNegativeFloat, NonNegativeFloat] | None = None
    rejected_fraction: tuple[Share, Share] | None = None
    improves: Improvement


class DiagnosedCause(Record, kw_only=True):
    """Fault in a flight, with its effect, recommended actions and re-runs.

    Attributes
    ----------
    why : str
        Effect of the fault on KF and EKF2.
    spans_s : tuple of (float, float)
        Times of the fault (s); empty for the whole flight.
    alternatives : tuple of tuple of Action
        Groups of actions. The user chooses one group and takes all its actions.
    actions : tuple of Action
        Actions that are necessary in addition to the chosen group.
    reruns : tuple of CardRerun
        Runs of KF and replays of EKF2 without the fault.
    after : str
        Closing sentence, for example on an error that remains after the actions.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Literal["error", "warning"]
    title: str
    why: str
    spans_s: tuple[Span, ...] = ()
    alternatives: tuple[tuple[Action, ...], ...] = ()
    actions: tuple[Action, ...] = ()
    reruns: tuple[CardRerun, ...] = ()
    after: str = ""


class Note(Record):
    """Remark about the flight that is neither an error nor a warning."""

    id: str
    text: str
    action: str = ""


class AnalysisDescription(Record, kw_only=True):
    """Log, firmware, settings and student of an analysis, and the px4fuse version.

    Attributes
    ----------
    source : str
        Position source, for example "UWB 5.0 Hz".
    settings : str
        SIGMA_A, SIGMA_Z and DT of KF.
    changed : tuple of str
        Settings of KF that differ from the default: "--sigma-a 0.001 (default 0.5)".
    parameters : tuple of str
        EKF2 parameters of the source that differ from PX4's default.
    segment : str
        Analysed time span.
    """

    file: str
    firmware: str = ""
    hardware: str = ""
    duration_s: NonNegativeFloat = 0.0
    source: str = ""
    settings: str = ""
    changed: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    segment: str = ""
    command: str = ""
    student: str = ""
    student_id: str = ""
    version: str = ""


class AidConsistency(Record, kw_only=True):
    """Consistency of one component (for example "north") of an EKF2 aiding source.

    Attributes
    ----------
    ratio : float or None
        RMS of innovation ÷ √S.
    is_usual : bool
        True for sensors whose ratio is usually below 1, because PX4's default noise is too large. A
        small ratio is then not a fault.
    """

    label: str
    component: str
    ratio: PositiveFloat | None = None
    is_usual: bool = False


class DiagnosisCard(Record, kw_only=True):
    """Diagnosis of a flight: headline, errors, actions, filter consistency and causes.

    Attributes
    ----------
    do_this : tuple of str
        Most important actions.
    verdicts : tuple of Verdict
        Consistency of KF and EKF2.
    reconcile : str
        Explanation if the verdict from innovations differs from that from errors against ground
        truth.
    difference : str
        RMS position difference KF - EKF2 and, if a re-run without the first fault exists, the RMS
        difference after this re-run.
    more_causes : int
        Number of causes omitted from ``causes``.
    facts : mapping from label to str
        Further rows of the card, for example the reason why KF was not run.
    """

    severity: CardSeverity
    id: str = ""
    headline: str
    effect: FlightErrors | None = None
    effect_text: str = ""
    do_this: tuple[str, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    reconcile: str = ""
    difference: str = ""
    causes: tuple[DiagnosedCause, ...] = ()
    more_causes: Count = 0
    notes: tuple[Note, ...] = ()
    aids: tuple[AidConsistency, ...] = ()
    facts: Mapping[str, str] = {}
    identity: AnalysisDescription
