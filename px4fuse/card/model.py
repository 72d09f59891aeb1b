"""Records of the diagnosis card (headline, verdicts, causes, actions), part of the JSON results."""

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.comparison.trials import Improvement
from px4fuse.core.record import Count, NotNegative, Positive, Record, Share, Span
from px4fuse.filter.consistency import CONSISTENT_RATIOS, Reference

FilterName = Literal["kf", "ekf2"]
CardSeverity = Literal["clean", "note", "warning", "error", "refused"]
VerdictWord = Literal["consistent", "overconfident", "underconfident", "not evaluated"]
Target = Literal["sender", "receiver", "source", "logging", "flight", "KF", "EKF2", "KF, EKF2"]
FILTER_NAMES: Mapping[FilterName, Target] = {"kf": "KF", "ekf2": "EKF2"}

# Limits of the σ ratio of a consistent filter: against the source, and against ground truth
SIGMA_RATIO_BANDS = CONSISTENT_RATIOS
# Ends of the logarithmic axis of σ ratios; triangles at the ends show ratios beyond them
AXIS_ENDS = (0.1, 10.0)
# Ticks of the logarithmic axis of σ ratios, with their labels
AXIS_TICKS = {0.1: "1/10", 0.2: "1/5", 0.5: "1/2", 1.0: "1", 2.0: "2", 5.0: "5", 10.0: "10"}
# Maximum number of causes on a card, which states the number of further causes
MAX_CAUSES = 3
# Maximum number of notes on the cover and the terminal, which state the number of further notes
MAX_NOTES = 3
MAX_HEADLINE_LENGTH = 84


def axis_fraction(ratio: float) -> float:
    """Return the place of a σ ratio on the logarithmic axis of the card (ends at 0 and 1).

    >>> axis_fraction(0.1), axis_fraction(1.0), axis_fraction(10.0)
    (0.0, 0.5, 1.0)
    """
    low, high = (math.log10(end) for end in AXIS_ENDS)
    return (math.log10(ratio) - low) / (high - low)


class Verdict(Record, frozen=True, kw_only=True):
    """Ratio of actual to reported σ of one filter, with its verdict.

    Attributes
    ----------
    filter : {"kf", "ekf2"}
    against : {"source", "truth"}
        "source": RMS of innovation / √S; "truth": RMS of error / reported σ.
    ratio : float or None
        √(mean NIS) or √(mean NEES); above 1 the reported σ is too small.
    interval : (float, float) or None
        95 % interval of the ratio: chi-square for the source, block bootstrap for ground truth.
    word : str
        Verdict on the reported σ.
    samples : int
        Number of innovations or errors.
    reason : str
        Missing data, if the ratio is not evaluated.
    is_explained : bool
        True if the card explains the ratio and this filter needs no change.
    """

    filter: FilterName
    against: Reference
    ratio: Positive | None = None
    interval: tuple[NotNegative, NotNegative] | None = None
    word: VerdictWord
    samples: Count = 0
    reason: str = ""
    is_explained: bool = False

    @property
    def is_loud(self) -> bool:
        """True if the filter is inconsistent and the card does not explain this."""
        return self.word in ("overconfident", "underconfident") and not self.is_explained


class Effect(Record, frozen=True, kw_only=True):
    """Position errors of KF and EKF2, their difference, and EKF2's rejections and resets.

    Attributes
    ----------
    axis : str
        Main axis by name, with its reference ("along the main axis, 30° from north").
    position_rmse_m, horizontal_rmse_m : mapping from "kf" and "ekf2" to float
        Position RMSE against ground truth, along the axis and horizontally; empty without it.
    difference_rms_m : float or None
        RMS position difference KF - EKF2 along the axis.
    rejected_fraction : float or None
        Fraction of the positions that EKF2 rejected.
    horizontal_resets : int or None
        Number of horizontal resets of EKF2.
    """

    axis: str
    position_rmse_m: Mapping[FilterName, NotNegative] = {}
    horizontal_rmse_m: Mapping[FilterName, NotNegative] = {}
    difference_rms_m: NotNegative | None = None
    rejected_fraction: Share | None = None
    horizontal_resets: Count | None = None


class Action(Record, frozen=True):
    """Action against a fault: commands to paste, or a sentence.

    Attributes
    ----------
    target : str
        Device, person or filters that have to change.
    sentence : str
        Action as an imperative, or "no change: <reason>"; may be empty with commands.
    commands : tuple of str
        Complete lines; a shell command contains the name of the log.
    where : {"shell", "console", ""}
        Place where the commands are typed: the shell of the computer, or the MAVLink console;
        empty without commands.
    """

    target: Target
    sentence: str = ""
    commands: tuple[str, ...] = ()
    where: Literal["shell", "console", ""] = ""


class Rerun(Record, frozen=True, kw_only=True):
    """Statistics of KF or EKF2 as flown, and run again with one change.

    Attributes
    ----------
    label : str
        Filter and change: "KF without the 26 outliers", "EKF2 (replay)".
    is_prediction : bool
        True for a replay of EKF2, which starts at ``from_s``; False for KF.
    position_rmse_m, source_ratio, truth_ratio, rejected_fraction : (float, float) or None
        Value as flown, and value with the change; None if unknown.
    improves : str
        Quantities that the change improves.
    """

    label: str
    is_prediction: bool = False
    from_s: float | None = None
    position_rmse_m: tuple[NotNegative, NotNegative] | None = None
    source_ratio: tuple[NotNegative, NotNegative] | None = None
    truth_ratio: tuple[NotNegative, NotNegative] | None = None
    rejected_fraction: tuple[Share, Share] | None = None
    improves: Improvement


class Cause(Record, frozen=True, kw_only=True):
    """Cause on the card: fault with its magnitude, effect, actions and re-runs.

    Attributes
    ----------
    id : str
        Id of the finding.
    severity : {"error", "warning"}
    title : str
        Fault and its size.
    why : str
        Effect of the fault on KF and EKF2.
    spans_s : tuple of (float, float)
        Times of the fault (s); empty for the whole flight.
    alternatives : tuple of tuple of Action
        Groups of actions that exclude each other; one group is sufficient.
    actions : tuple of Action
        Actions that are necessary with each alternative.
    reruns : tuple of Rerun
    after : str
        Sentence below the table of re-runs, for example on an equally good value.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Literal["error", "warning"]
    title: str
    why: str
    spans_s: tuple[Span, ...] = ()
    alternatives: tuple[tuple[Action, ...], ...] = ()
    actions: tuple[Action, ...] = ()
    reruns: tuple[Rerun, ...] = ()
    after: str = ""


class Note(Record, frozen=True):
    """Finding of severity "note" as a sentence, with its action if it has one."""

    id: str
    text: str
    action: str = ""


class Identity(Record, frozen=True, kw_only=True):
    """Flight, settings of KF and EKF2, and author of a card.

    Attributes
    ----------
    file, firmware, hardware : str
    duration_s : float
    source : str
        Sensor and rate of the position source: "UWB 5.0 Hz".
    settings : str
        SIGMA_A, SIGMA_Z and DT of KF with their origin.
    changed : tuple of str
        Options of KF that differ from their default: "--sigma-a 0.001 (default 0.5)".
    parameters : tuple of str
        Noise, delay and gate of EKF2 for the source that differ from PX4's default.
    segment : str
    command : str
    student, student_id, version : str
    """

    file: str
    firmware: str = ""
    hardware: str = ""
    duration_s: NotNegative = 0.0
    source: str = ""
    settings: str = ""
    changed: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    segment: str = ""
    command: str = ""
    student: str = ""
    student_id: str = ""
    version: str = ""


class AidRow(Record, frozen=True, kw_only=True):
    """RMS ratio of innovation to √S along one axis (``component``) of an aiding source.

    ``is_usual`` is True if a ratio below its band is usual with PX4's default noises.
    """

    label: str
    component: str
    ratio: Positive | None = None
    is_usual: bool = False


class Card(Record, frozen=True, kw_only=True):
    """Diagnosis of a flight: fault, effect, actions, verdicts and causes.

    Attributes
    ----------
    severity : str
        Severity of the first cause. Without a cause: "note" with an unexplained inconsistent
        verdict, else "clean"; "refused" for a log that cannot be analysed.
    id : str
        Id of the first cause, or of the error that prevents an analysis; else empty.
    headline : str
        First cause with its magnitude, or the result without a cause.
    effect : Effect or None
    effect_text : str
        Effect in sentences, made from ``effect`` and ``verdicts``.
    do_this : tuple of str
        The one to three most important actions; without a fault "Change nothing.".
    verdicts : tuple of Verdict
        KF and EKF2, each against source and ground truth; empty without a position source.
    reconcile : str
        Explanation if two verdicts of one filter differ.
    difference : str
        Position difference KF - EKF2 before and after the first fix.
    causes : tuple of Cause
    more_causes : int
        Number of further causes, which the card does not list.
    notes : tuple of Note
    aids : tuple of AidRow
        Ratios of the aiding sources, on a flight without a position source.
    facts : mapping from label to str
        Texts on data that cannot be analysed, for example bytes read, and fix.
    identity : Identity
    """

    severity: CardSeverity
    id: str = ""
    headline: str
    effect: Effect | None = None
    effect_text: str = ""
    do_this: tuple[str, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    reconcile: str = ""
    difference: str = ""
    causes: tuple[Cause, ...] = ()
    more_causes: Count = 0
    notes: tuple[Note, ...] = ()
    aids: tuple[AidRow, ...] = ()
    facts: Mapping[str, str] = {}
    identity: Identity
