"""Records of the diagnosis card; they are part of the results."""

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.comparison.trials import Improvement
from px4fuse.filter.consistency import CONSISTENT_RATIOS, Reference
from px4fuse.record import Count, NotNegative, Positive, Record, Share, Span

FilterName = Literal["kf", "ekf2"]
CardSeverity = Literal["clean", "note", "warning", "error", "refused"]
VerdictWord = Literal["consistent", "overconfident", "underconfident", "not evaluated"]
Target = Literal["sender", "receiver", "source", "logging", "flight", "KF", "EKF2", "KF, EKF2"]

# Bands of a consistent ratio: against the source, and against ground truth
BANDS = CONSISTENT_RATIOS
# Ends of the logarithmic axis of all ratios; a ratio beyond is drawn as a triangle at the end
AXIS_ENDS = (0.1, 10.0)
# Ticks of that axis with their labels
AXIS_TICKS = {0.1: "1/10", 0.2: "1/5", 0.5: "1/2", 1.0: "1", 2.0: "2", 5.0: "5", 10.0: "10"}
# Numbered causes of a card; further ones are counted
MAX_CAUSES = 3
# Notes that cover and terminal print; further ones are counted
MAX_NOTES = 3
MAX_HEADLINE_LENGTH = 84


class Verdict(Record, frozen=True, kw_only=True):
    """Ratio of actual to reported uncertainty of one filter.

    Attributes
    ----------
    filter : {"kf", "ekf2"}
    against : {"source", "truth"}
        source: innovation over √S; truth: error against ground truth over reported σ.
    ratio : float or None
        √(mean NIS) or √(mean NEES); above 1 the reported σ is too small.
    interval : (float, float) or None
        95 %: chi-square for the source, block bootstrap for ground truth.
    word : str
    samples : int
    reason : str
        Missing data of a ratio that is not evaluated.
    is_explained : bool
        True if the card names the cause and nothing has to be changed for this filter.
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
        """True if the ratio is outside its band and the card does not explain it."""
        return self.word in ("overconfident", "underconfident") and not self.is_explained


class Effect(Record, frozen=True, kw_only=True):
    """Numbers of the effect along the main axis, and horizontally.

    Attributes
    ----------
    axis : str
        Main axis by name, with its reference ("along the aisle, 30° from north").
    position_rmse_m, horizontal_rmse_m : mapping from "kf" and "ekf2" to float
        Against ground truth, along the axis and horizontally; empty without ground truth.
    difference_rms_m : float or None
        RMS of KF - EKF2 in position along the axis.
    rejected_fraction : float or None
        Fraction of the samples that EKF2 rejected.
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
    """One action against a cause: commands to paste, or a sentence.

    Attributes
    ----------
    target : str
        Device, person or filter that changes.
    sentence : str
        Action as an imperative, or "no change: <reason>"; may be empty with commands.
    commands : tuple of str
        Complete lines; a shell command contains the name of the log.
    where : {"shell", "console", ""}
        Place where the commands are typed: the shell of the computer, or the MAVLink console.
    """

    target: Target
    sentence: str = ""
    commands: tuple[str, ...] = ()
    where: Literal["shell", "console", ""] = ""


class Rerun(Record, frozen=True, kw_only=True):
    """Filter run again with one change: as flown, and after.

    Attributes
    ----------
    label : str
        Filter and change: "KF without the 26 outliers", "EKF2 (replay)".
    is_prediction : bool
        True for EKF2: by a replay that starts at ``from_s``.
    position_rmse_m, source_ratio, truth_ratio, rejected_fraction : (float, float) or None
        Before and after the change.
    improves : str
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
    """Numbered cause: fault with its size, how it acts, actions and re-runs.

    Attributes
    ----------
    id : str
        Id of the finding.
    severity : {"error", "warning"}
    title : str
        Fault and size.
    why : str
        How it acts on the filters, in at most three sentences.
    spans_s : tuple of (float, float)
        Times of the fault; empty for the whole flight.
    alternatives : tuple of tuple of Action
        Two or more that exclude each other; one of them is done.
    actions : tuple of Action
        Done in any case.
    reruns : tuple of Rerun
    after : str
        Sentence below the re-runs: signs and units, or another cure that is as good.
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
    """Finding that is not a cause: one sentence, and an action if there is one."""

    id: str
    text: str
    action: str = ""


class Identity(Record, frozen=True, kw_only=True):
    """Flight and settings of a card.

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
    """Ratio of one component of an aiding source on a flight without a position source."""

    label: str
    component: str
    ratio: Positive | None = None
    is_usual: bool = False


class Card(Record, frozen=True, kw_only=True):
    """Diagnosis of a flight at a glance.

    Attributes
    ----------
    severity : str
        Of the first cause; clean without one.
    id : str
        Id of the first cause or of the refusal; empty without one.
    headline : str
        Fault and size of the first cause.
    effect : Effect or None
    effect_text : str
        Effect in sentences, made from ``effect`` and ``verdicts``.
    do_this : tuple of str
        The one to three most important actions, also on a flight without a fault.
    verdicts : tuple of Verdict
        KF and EKF2, each against source and ground truth; empty without a position source.
    reconcile : str
        Explanation if two verdicts of one filter differ.
    difference : str
        Difference KF - EKF2 before and after the first fix.
    causes : tuple of Cause
    more_causes : int
        Further causes, which the card does not list.
    notes : tuple of Note
    aids : tuple of AidRow
        Ratios of the aiding sources, on a flight without a position source.
    facts : mapping from label to str
        Texts of a refusal: what was read, and what was not run.
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
