"""Catalogue of all findings, and functions to make, group and sort them."""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pandas as pd
from msgspec.structs import replace

from px4fuse.comparison.model import PreparedComparison
from px4fuse.core.record import Record, Span, read_toml
from px4fuse.core.text import capitalise_first_letter
from px4fuse.filter.signals import Segment
from px4fuse.finding import SEVERITIES, Finding, Severity
from px4fuse.flight.ekf2_parameters import MAG, MAG_TYPE_NONE
from px4fuse.flight.model import Flight, PositionKind


class CatalogueEntry(Record):
    """Title and meaning of a finding, and its relation to other findings (``catalogue.toml``)."""

    title: str
    meaning: str
    group: str = "position source"
    report_class: Literal["", "unusable", "misleading", "first", "noise", "recording"] = ""
    verdict: Literal["", "meaningless", "repeated"] = ""
    rerun_kinds: frozenset[str] = frozenset()
    status_if_convention_wrong: Literal["", "effect", "withdrawn"] = ""


# All findings by id. The report lists findings of equal severity in this order
FINDING_CATALOGUE: Mapping[str, CatalogueEntry] = read_toml(
    __file__, dict[str, CatalogueEntry], "catalogue.toml"
)
# Key in Finding.evidence: cause of the finding, one of the values below
CAUSE_KEY = "cause"
# Values of CAUSE_KEY for causes that a re-run of KF or EKF2 confirms
MEASUREMENT_NOISE_CAUSE = "measurement noise"
PROCESS_NOISE_CAUSE = "process noise"
OUTLIER_CAUSE = "outliers"
CLOCK_CAUSE = "clock"
MISALIGNED_FRAME_CAUSE = "frame"
WRONG_GATE_CAUSE = "gate"
ACCELEROMETER_CAUSE = "accelerometer"
# Cause unknown: no re-run with a changed setting makes the filter consistent
UNKNOWN_CAUSE = "elsewhere"
# Key in Finding.evidence: σ of the white position noise ÷ assumed measurement noise
WHITE_TO_ASSUMED_NOISE_RATIO_KEY = "white_over_assumed"
# Cause of a finding on an EKF2 aiding source: its measurements are from the sensor that also
# measures KF's positions
SOURCE_SENSOR_CAUSE = "the source's sensor"
# Cause: the position source reports a wrong variance, and EKF2 uses this variance
REPORTED_VARIANCE_USED_BY_EKF2_CAUSE = "EKF2's noise"
# Cause: the mean innovation of the aiding source changes in flight
INNOVATION_CHANGE_CAUSE = "change"
# Cause of position resets of EKF2: gaps in the position source
SOURCE_GAP_CAUSE = "gap"
# Cause of too little motion: the vehicle stayed on the ground
VEHICLE_ON_GROUND_CAUSE = "never took off"
# Key in Finding.evidence: property with a wrong convention ("axes", "unit", "time offset", ...)
WRONG_CONVENTION_KEY = "convention"
# Key in Finding.evidence: time (s) at which the source changed reset_counter at a position jump
RESET_TIME_KEY = "reset_at_s"
# A finding with one of these ids is the cause of other findings only if its severity is warning or
# error, not note
CAUSES_ONLY_ABOVE_SEVERITY_NOTE = ("ekf2_not_aligned", "parameter_changed")
# Findings that keep their own action even if another finding is their cause, because their action
# also corrects the cause
EFFECTS_WITH_OWN_ACTION = ("ekf2_ev_delay_wrong",)

_KF_FINDINGS = ("kf_underconfident", "kf_overconfident")
# For the id of each finding that can cause others: ids of the findings that it causes, one per line
EFFECTS_BY_CAUSE: Mapping[str, str] = read_toml(__file__, dict[str, str], "consequences.toml")
NO_ESTIMATES_SENTENCE = (
    "px4fuse does not estimate noise, time offset or frame from these positions."
)
FINDING_GROUPS = ("position source", "time", "IMU", "tuning", "EKF2", "loops", "logging")
FINDING_TITLES: Mapping[str, str] = {name: entry.title for name, entry in FINDING_CATALOGUE.items()}


def finding_title(finding_id: str) -> str:
    """Return the title of a finding. If its id is unknown, return the id with blanks.

    >>> finding_title("source_gap"), finding_title("of_a_later_version")
    ('Gap in the position source', 'of a later version')
    """
    return FINDING_TITLES.get(finding_id, finding_id.replace("_", " "))


class FindingExample(Record):
    """Example of a finding, and its rates on simulated flights (tests/studies/rates.csv).

    Attributes
    ----------
    fault_free_flight_count : int
        Number of simulated flights without an injected fault.
    false_alarm_count : int
        Number of these flights in which px4fuse reports the finding.
    detection_rate_by_fault : dict
        Fraction of the flights with an injected fault in which px4fuse reports the finding.
    """

    message: str
    remedy: str
    fault_free_flight_count: int
    false_alarm_count: int
    detection_rate_by_fault: Mapping[str, float]


def load_finding_examples() -> Mapping[str, FindingExample]:
    return msgspec.json.decode(
        Path(__file__).with_name("examples.json").read_bytes(), type=dict[str, FindingExample]
    )


class SourceTexts(Record):
    """Sentences on causes and actions for one kind of position source (source_words.toml).

    The defaults are the texts for an unknown kind.
    """

    low_pass_action: str = "Switch off smoothing in the positioning system and send raw positions."
    jump_causes: str = "Possible causes: a relocalisation of the source, or a change of its origin."
    jump_action: str = "Do not change the origin of the source in flight."
    outlier_causes: str = "Possible causes: lost or ambiguous tracking."
    outlier_action: str = "Remove the outliers before sending."
    data_link_check: str = "Check the positioning system and its data link"
    scale_check: str = "Check unit and calibration of the positioning system"
    slow_error_check: str = "Check calibration, drift and smoothing of the positioning system"


SOURCE_TEXTS = read_toml(__file__, dict[PositionKind, SourceTexts], "source_words.toml")


def find_source_texts(comparison: PreparedComparison) -> SourceTexts:
    """Return the texts about causes and actions for the kind of position source, such as UWB."""
    return SOURCE_TEXTS[comparison.source.origin.kind]


def magnetometer_advice(flight: Flight) -> str:
    """Return the action for a wrong magnetic heading; empty if EKF2 uses no magnetometer."""
    if flight.log.parameters.get(MAG.switch) == MAG_TYPE_NONE:
        return ""
    return "Calibrate the magnetometer away from metal and motors."


Findings = Iterator[Finding]


def finding(
    severity: Severity,
    name: str,
    message: str,
    remedy: str,
    evidence: Mapping[str, int | float | str] = {},
    spans_s: tuple[Span, ...] = (),
) -> Finding:
    """Make a finding with the id ``name``; its title is the first sentence of the message."""
    message = capitalise_first_letter(message)
    title = message.partition(". ")[0].removesuffix(".")
    return Finding(name, severity, message, remedy, evidence, title, spans_s=spans_s)


def error_if(is_severe: bool) -> Severity:
    return "error" if is_severe else "warning"


make_error, make_warning, make_note = (partial(finding, severity) for severity in SEVERITIES)


def split_cause_groups(findings: Iterable[Finding]) -> list[list[Finding]]:
    """Split findings into groups: a cause, followed by the findings that it causes."""
    groups: list[list[Finding]] = []
    for entry in findings:
        if entry.caused_by is None:
            groups.append([])
        groups[-1].append(entry)
    return groups


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity; each cause is followed by its effects."""
    # A group is a finding, followed by its effects. At first, most groups are single findings
    ids = list(FINDING_CATALOGUE)
    groups = sorted(split_cause_groups(findings), key=lambda group: ids.index(group[0].id))
    for cause, effects_text in EFFECTS_BY_CAUSE.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if (
            cause_group is None
            or (cause_group[0].severity == "note" and cause in CAUSES_ONLY_ABOVE_SEVERITY_NOTE)
            # White position noise above the assumed measurement noise may also cause the effects
            # of time-correlated noise, so time-correlated noise is not stated as their cause
            or WHITE_TO_ASSUMED_NOISE_RATIO_KEY in cause_group[0].evidence
        ):
            continue
        # Each line of effects_text is the id of a finding that ``cause`` can cause. A line
        # "id: word" applies only if the evidence of the finding has this word as "cause"
        effect_lines, severity = effects_text.splitlines(), cause_group[0].severity
        for group in groups.copy():
            effect, *effects_of_effect = group
            possible_lines = {effect.id, f"{effect.id}: {effect.evidence.get(CAUSE_KEY)}"}
            if group is cause_group or possible_lines.isdisjoint(effect_lines):
                continue
            # The finding and its effects move to the group of the cause
            groups.remove(group)
            cause_group += [replace(effect, caused_by=cause), *effects_of_effect]
            # A cause is as severe as its effects, except the effects on KF
            if effect.id not in _KF_FINDINGS:
                severity = min(severity, effect.severity, key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    findings = list[Finding]()
    for cause_finding, *effect_findings in sorted(groups, key=_compute_report_rank):
        findings.append(cause_finding)
        for effect in effect_findings:
            # A finding with a cause shows the action for the cause. Its own action may be wrong:
            # for example, a larger noise setting only hides outliers
            keeps_action = cause_finding.severity == "note" or effect.id in EFFECTS_WITH_OWN_ACTION
            remedy = effect.remedy if keeps_action else cause_finding.remedy
            findings.append(replace(effect, remedy=remedy))
    return tuple(findings)


def find_effect_ids(cause: str) -> tuple[str, ...]:
    """Return the ids of the findings that a finding can cause."""
    effects = EFFECTS_BY_CAUSE.get(cause, "").splitlines()
    return tuple(dict.fromkeys(effect.partition(":")[0] for effect in effects))


def _compute_report_rank(group: list[Finding]) -> int:
    """Return the place of a group in the report.

    0 faults that make other findings wrong, 1 errors, 2 warnings about the recording, 3 errors of
    noise settings (a bad recording makes noise estimates wrong), 4 other warnings, 5 notes.
    """
    cause = group[0]
    report_class = FINDING_CATALOGUE[cause.id].report_class
    if cause.severity == "note":
        return 5
    if WRONG_CONVENTION_KEY in cause.evidence or report_class in (
        "unusable",
        "misleading",
        "first",
    ):
        return 0
    if cause.severity == "error":
        return 3 if report_class == "noise" else 1
    return 2 if report_class == "recording" else 4


def make_zero_length_spans(times_s: Iterable[float]) -> tuple[Span, ...]:
    """Convert times (s) to time spans of length zero."""
    return tuple((float(time), float(time)) for time in times_s)


def lower_severity(severity: Severity) -> Severity:
    return "warning" if severity == "error" else "note"


def format_occurrences(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def format_percent(fraction: float, digits: int = 0) -> str:
    return f"{100.0 * fraction:.{digits}f} %"


def find_spans_with_value(
    value: float, step_function: pd.Series, segment: Segment
) -> tuple[Span, ...]:
    """Return the time spans (s) in a segment in which a step function equals ``value``."""
    changes = step_function[step_function.diff() != 0.0]
    # Each value applies until the next change, the first value also before its time
    edges_s = [-np.inf, *changes.index[1:], np.inf]
    spans_and_values = zip(pairwise(edges_s), changes, strict=False)
    return segment.clip_spans(span_s for span_s, each in spans_and_values if each == value)


def compute_flag_fraction(step_function: pd.Series, segment: Segment) -> float:
    """Return the fraction of a segment's duration in which a flag (0 or 1) is 1."""
    duration_of_ones_s = sum(
        end - start for start, end in find_spans_with_value(1.0, step_function, segment)
    )
    return duration_of_ones_s / (segment.end_s - segment.start_s)
