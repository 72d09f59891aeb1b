"""Points by a rubric, and what the student reads about them.

A report comes from a student; its results have been read strictly. A number that is not there gives
no points and a comment, never an exception.
"""

from __future__ import annotations

import math
import re
import textwrap
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from px4fuse.assignment.drawing import POSSIBLE_FINDINGS
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.findings import SEVERITIES
from px4fuse.grading.model import Graded, Item, Parameter, Rubric, RubricItem
from px4fuse.plain import factor_words
from px4fuse.results.comparison import ASKED, Clock, Filter, HorizontalNis, Tuned
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_plain
from px4fuse.results.model import Absent
from px4fuse.results.trajectories import Correction, Corrections, Loop, Score
from px4fuse.verification.model import Report, Verdict
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import NO_LOG

# What verification has refuted, rather than what it could not look at
REFUTED: Mapping[str, str] = {
    "numbers differ": "your report's numbers are not those that its log gives",
    "other log": "the log of your report is not one of those that your instructor has",
}
# As many as px4fuse compare takes
MAX_NOTES = 200_000
MAX_QUOTE = 160
# A text without full stops is cut into pieces of so many words, in which words belong together
LONGEST_SENTENCE = 40
NEGATIONS = frozenset(("no", "without", "not", "never", "nor", "zero"))
# In the words of the rubric: what says that a flight has no mistake
NOTHING = "none"
# Lists are cut where a comment would become longer than a sentence
NAMED = 4
SIGMAS = ("sigma_z_m", "sigma_a_m_s2")
# Half is lost where notes name so many kinds of mistakes that some must be guesses
GUESSING = 0.5
NO_SPACES = re.compile("[\u0e00-\u0eff\u1780-\u17ff]+|[\u3040-\u30ff\u3400-\u9fff]+")
WORD = re.compile(r"\w+")
SENTENCE_END = re.compile(r"(?<=[.!?;])\s+|\n\s*\n|\n\s*(?:[-*+#]|\d+[.)])\s*")
STEP = re.compile(r'"([^"]*)"|([^."]+)')
NEXT = (
    "Your instructor has these points as a proposal and decides; ask if you think that something "
    "was overlooked."
)

Scorer = Callable[["Evidence", Mapping[str, Any]], tuple[float, str]]


# ------------------------------------------------------------------ what is looked at


class Notes:
    """The student's own words, so that it can be told quickly what they mention."""

    def __init__(self, text: str) -> None:
        text = unicodedata.normalize("NFKC", text[:MAX_NOTES]).casefold()
        # scripts that do not part words: five letters of Thai, Lao or Khmer and two of Chinese or
        # Japanese stand for a word
        spaceless = sum(
            -(-len(run) // (2 if run[0] >= "\u3000" else 5)) for run in NO_SPACES.findall(text)
        )
        counted = WORD.findall(NO_SPACES.sub(" ", text))
        self.words = len(counted) + spaceless
        self.different = len(set(counted)) + spaceless
        self._sentences: dict[str, set[int]] = {}
        self._affirmed: dict[str, set[int]] = {}
        number = 0
        for sentence in SENTENCE_END.split(text):
            words = WORD.findall(sentence)
            for start in range(0, len(words), LONGEST_SENTENCE):
                piece = words[start : start + LONGEST_SENTENCE]
                for at, word in enumerate(piece):
                    self._sentences.setdefault(word, set()).add(number)
                    if NEGATIONS.isdisjoint(piece[max(at - 2, 0) : at]):
                        self._affirmed.setdefault(word, set()).add(number)
                number += 1

    def mention(self, phrases: Sequence[str], affirmed: bool = False) -> bool:
        """Whether one sentence has words that begin like all the words of one phrase.

        ``affirmed``: the first of them not after a "no", "not" or "without".
        """
        return any(self._mention(phrase, affirmed) for phrase in phrases)

    def _mention(self, phrase: str, affirmed: bool) -> bool:
        stems = WORD.findall(unicodedata.normalize("NFKC", phrase).casefold())
        if not stems:
            return False
        found = self._with(stems[0], self._affirmed if affirmed else self._sentences)
        for stem in stems[1:]:
            found &= self._with(stem, self._sentences)
        return bool(found)

    @staticmethod
    def _with(stem: str, index: Mapping[str, set[int]]) -> set[int]:
        return set().union(*(at for word, at in index.items() if word.startswith(stem)))


@dataclass(frozen=True)
class Evidence:
    """What a check may look at."""

    report: Report
    verdict: Verdict
    words: Mapping[str, tuple[str, ...]]
    key: AnswerKey | None

    @property
    def results(self) -> Reported:
        """The attached results."""
        return self.report.results

    @property
    def comparison(self) -> ComparisonResults | None:
        """The attached results where they compare filters."""
        return None if isinstance(self.results, LoopResults) else self.results

    @property
    def kind(self) -> Literal["compare", "loop"]:
        """Which command made the report."""
        return "loop" if isinstance(self.results, LoopResults) else "compare"

    @cached_property
    def plain(self) -> dict[str, Any]:
        """The attached results, for paths that a rubric names."""
        return to_plain(self.results)

    @cached_property
    def notes(self) -> Notes:
        """The student's own words."""
        return Notes(self.results.student.notes)

    def names(self, finding: str, affirmed: bool = False) -> bool:
        """Whether the notes name a finding: by its id, or by words that stand for it."""
        phrases = (finding, finding.replace("_", " "), *self.words.get(finding, ()))
        return self.notes.mention(phrases, affirmed)

    def has(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(finding in one.ids for one in self.results.findings)


def values_at(results: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """Paths and values where a path leads; ``*`` is every key, quotes hold names with dots.

    >>> list(values_at({"a": {"b.c": [1, 2]}}, 'a."b.c".1'))
    [('a.b.c.1', 2)]
    """
    found: list[tuple[str, Any]] = [("", results)]
    for match in STEP.finditer(path):
        step = match[1] if match[1] is not None else match[2]
        every = match[2] == "*"
        following = []
        for name, value in found:
            if isinstance(value, dict):
                keys = list(value) if every else [step] * (step in value)
                following += [(f"{name}.{key}", value[key]) for key in keys]
            elif isinstance(value, list | tuple):
                following += [
                    (f"{name}.{place}", value[place])
                    for place in range(len(value))
                    if every or step == str(place)
                ]
        found = following
    yield from ((name.removeprefix("."), value) for name, value in found)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(value: str) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    kept = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in value[: 4 * MAX_QUOTE])
    line = " ".join(kept.split())
    return line if len(line) <= MAX_QUOTE else line[: MAX_QUOTE - 1] + "…"


def _why(part: object) -> str:
    """Why a part is not there, in brackets; "" where it is, or nobody says."""
    if isinstance(part, Absent):
        return f" ({_text(part.unavailable.reason).rstrip('.')})"
    return ""


def _why_absent(evidence: Evidence, path: str) -> str:
    """Why there is nothing at a path of the rubric: what the results themselves say of it."""
    steps = [match[0] for match in STEP.finditer(path)]
    for end in range(len(steps), 0, -1):
        above = ".".join(steps[:end])
        for _, reason in values_at(evidence.plain, f"{above}.unavailable.reason"):
            return f" ({_text(reason).rstrip('.')})"
    return _why_not_horizontal(evidence) if HORIZONTAL in path else ""


def _why_not_horizontal(evidence: Evidence) -> str:
    """Why there is nothing about north and east together."""
    if evidence.comparison is None or {"north", "east"} <= set(evidence.comparison.axes):
        return ""
    return " (it needs the axes north and east, which were not both analysed: leave --axis out)"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:NAMED])
    return f"{shown} and {len(names) - NAMED} more" if len(names) > NAMED else shown


# ------------------------------------------------------------------ checks


def _verified(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    verdict = evidence.verdict
    if _without_log(verdict):
        return given["without_log"], (
            "The log of your report was not at hand, so that its numbers could not be computed "
            "again."
        )
    if verdict.status == "verified":
        return 1.0, "Your report's numbers were computed again from its log and agree."
    status = "" if verdict.status == "cannot verify" else f": {verdict.status}"
    return 0.0, f"Your report could not be verified{status}{_reason(verdict)}."


def _without_log(verdict: Verdict) -> bool:
    """Whether nothing is wrong with a report, but its log is missing."""
    if verdict.status == "verified":
        return not verdict.with_log
    return verdict.status == "cannot verify" and verdict.reasons == (NO_LOG,)


def _reason(verdict: Verdict) -> str:
    said = _joined(verdict.reasons[:1])
    return f" ({said})" if said else ""


def _joined(reasons: Sequence[str]) -> str:
    """Reasons as the end of a sentence."""
    return "; ".join(text for reason in reasons if (text := _text(reason).rstrip(".")))


def _student(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    student = evidence.results.student
    asked = [
        (what, option, value)
        for what, option, value, wanted in (
            ("name", "--student", _text(student.name), given["name"]),
            ("student id", "--id", _text(student.id), given["id"]),
        )
        if wanted
    ]
    missing = [(what, option) for what, option, value in asked if not value]
    if not missing:
        return 1.0, f"Your report names {', '.join(value for *_, value in asked) or 'nobody'}."
    return 1.0 - len(missing) / len(asked), (
        f"Your report does not give your {' and '.join(what for what, _ in missing)}; make it with "
        f"{' and '.join(option for _, option in missing)}."
    )


def _sections(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    pages = [" ".join(page.split()).casefold() for page in evidence.report.pages]
    missing = [
        f"the page {_text(wanted)!r}"
        for wanted in given["pages"]
        if not any(" ".join(wanted.split()).casefold() in page for page in pages)
    ]
    for path in given["results"]:
        there = [value for _, value in values_at(evidence.plain, path)]
        if not any(v for v in there if not (isinstance(v, dict) and set(v) == {"unavailable"})):
            missing.append(f"{path}{_why_absent(evidence, path)}")
    asked = len(given["pages"]) + len(given["results"])
    if not missing:
        return 1.0, f"Your report has all {asked} parts that were asked for."
    return 1.0 - len(missing) / asked, (
        f"Your report has {asked - len(missing)} of {asked} parts; missing: {_listed(missing)}."
    )


def _notes(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    words, different = evidence.notes.words, evidence.notes.different
    if not words:
        return 0.0, "Your report has no notes of your own; write them and add them with --notes."
    share = min(words / given["min_words"], different / given["min_different"], 1.0)
    if share == 1.0:
        return 1.0, f"Your notes have {words} words."
    if words < given["min_words"]:
        return share, f"Your notes have {words} words; {given['min_words']} were asked for."
    return share, (
        f"Your notes have {words} words, but only {different} different ones; "
        f"{given['min_different']} were asked for."
    )


def _findings(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    asked = {
        one.id: one.ids
        for one in evidence.results.findings
        if one.severity in given["severities"] and one.id not in given["ignore"]
    }
    if not asked:
        return 1.0, f"Your report has no {' or '.join(given['severities'])} left to explain."
    # whoever names what a cause brings with it has seen it too
    missing = [name for name, ids in asked.items() if not any(map(evidence.names, ids))]
    if not missing:
        return 1.0, f"Your notes take up all {len(asked)} findings of your report."
    return 1.0 - len(missing) / len(asked), (
        f"Your notes take up {len(asked) - len(missing)} of {len(asked)} findings; say what causes "
        f"{_listed(missing)} and what you did about it."
    )


def _drifts(evidence: Evidence) -> bool:
    """Whether the report says that its innovations are no measure of the error."""
    return evidence.has("source_may_drift") or evidence.has("errors_larger_than_claimed")


def _tuning(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    axis = given["axis"]
    shares, said = [], []
    for name in given["settings"]:
        share, comment = _tuned(evidence, axis, name, given["factor"])
        shares.append(share)
        said.append(comment)
    if not shares:
        return 0.0, "The rubric asks for no setting."
    return sum(shares) / len(shares), f"{'; '.join(said)}."


def _tuned(evidence: Evidence, axis: str, name: str, factor: float) -> tuple[float, str]:
    label, unit = {"sigma_z_m": ("SIGMA_Z", "m")}.get(name, ("SIGMA_A", "m/s²"))
    comparison = evidence.comparison
    if comparison is None:
        return 0.0, f"Your report does not say which {label} you chose"
    chosen: float = getattr(comparison.settings, name)
    tuned = comparison.tuning.get(axis)
    interval = bound = None
    if isinstance(tuned, Tuned):
        asked = ASKED[name]
        interval = getattr(tuned, f"{asked}_interval")
        bound = getattr(tuned, f"{asked}_upper_bound")
    if interval is None and bound is not None:
        interval = (0.0, bound)
    if interval is None:
        why = _why(tuned) or (_why_not_horizontal(evidence) if axis == HORIZONTAL else "")
        return 0.0, f"Your report has no interval for {label}{why}"
    low, high = interval
    above = chosen / high if high > 0.0 else math.inf
    # small innovations are no reason to trust a source that drifts
    off = max(1.0 if chosen > high and _drifts(evidence) else above, low / chosen, 1.0)
    said = f"your {label} {chosen:.3g} {unit} is"
    wanted = f"what the data ask for ({low:.3g} to {high:.3g} {unit})"
    if off == 1.0 and chosen > high:
        return 1.0, f"{said} above {wanted}, as it should be for a source that may drift"
    if off == 1.0:
        return 1.0, f"{said} within {wanted}"
    share = 1.0 - math.log(off) / math.log(factor) if factor > max(off, 1.0) else 0.0
    side = "above" if chosen > high else "below"
    return share, f"{said} {side} {wanted}, by a factor of {factor_words(off)}"


def _number_between(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    found: list[tuple[str, float]] = []
    for path in given["path"]:
        found = [
            (name, float(value))
            for name, value in values_at(evidence.plain, path)
            if _is_number(value)
        ]
        if found:
            break
    label = given["name"]
    if not found:
        why = next((why for path in given["path"] if (why := _why_absent(evidence, path))), "")
        return 0.0, f"Your report has no number for {label or given['path'][0]}{why}."
    # of several the one that is worst counts
    name, number = min(found, key=lambda pair: _within(pair[1], given))
    share = _within(number, given)
    low, high = given["at_least"], given["at_most"]
    bounds = (("at least", low), ("at most", high))
    limits = " and ".join(f"{word} {bound:.4g}" for word, bound in bounds if bound is not None)
    shown = f"{number:.4g} {given['unit']}".strip()
    what = label or f"the number {_text(name)}"
    what += f" ({_text(name)})" * (bool(label) and len(found) > 1)
    return share, f"{what[:1].upper() + what[1:]} is {shown}; {limits} was asked for."


def _within(number: float, given: Mapping[str, Any]) -> float:
    """1 within the bounds, falling to 0 at ``zero_at``, without that 0 outside."""
    low, high, zero = given["at_least"], given["at_most"], given["zero_at"]
    if (low is None or number >= low) and (high is None or number <= high):
        return 1.0
    if zero is None:
        return 0.0
    bound: float = low if low is not None else high
    return min(max((number - float(zero)) / (bound - float(zero)), 0.0), 1.0)


def _consistent(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    shares, said = [], []
    owner = "your filter" if given["filter"] == "kf" else "EKF2"
    for axis in given["axes"]:
        judged, why = _judged(evidence, axis, given["filter"])
        if judged is None:
            shares.append(0.0)
            said.append(f"there is no verdict on {owner} ({axis}){why}")
            continue
        verdict, factor = judged.verdict, judged.variance_factor
        off = max(factor, 1.0 / factor)
        good = verdict == "consistent"
        # small innovations are no reason to trust a source that drifts
        excused = "overstated" in verdict and _drifts(evidence)
        gone = given["factor"] <= off or given["factor"] <= 1.0
        # no noise explains outliers, and none should be made to
        outliers = "understated" in verdict and evidence.has("source_outliers")
        explained = outliers and evidence.names("source_outliers")
        shares.append(
            1.0
            if good or explained or excused
            else 0.0
            if gone
            else 1.0 - math.log(off) / math.log(given["factor"])
        )
        because = (
            ", because of outliers that no setting fixes, as your notes say"
            if explained
            else ", because of outliers that no setting fixes; your notes should say so"
            if outliers
            else ", as it may be against a source that may drift"
            if excused
            else ""
        )
        said.append(
            f"{owner} is consistent ({axis})"
            if good
            else f"{verdict} by a factor of {factor_words(off)} ({owner}, {axis}){because}"
        )
    comment = "; ".join(said) or "the rubric names no axis"
    return sum(shares) / max(len(shares), 1), f"{comment[:1].upper() + comment[1:]}."


def _judged(evidence: Evidence, axis: str, which: str) -> tuple[Filter | HorizontalNis | None, str]:
    """The consistency of a filter along an axis, or why there is none."""
    comparison = evidence.comparison
    if comparison is None:
        return None, ""
    if axis == HORIZONTAL:
        return getattr(comparison.horizontal, which), _why_not_horizontal(evidence)
    analysed = comparison.axes.get(axis)  # type: ignore[call-overload]
    found = None if analysed is None else getattr(analysed, which)
    return (found, "") if isinstance(found, Filter) else (None, _why(found))


def _clock(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    comparison = evidence.comparison
    clock = None if comparison is None else comparison.clock
    if not isinstance(clock, Clock):
        return 0.0, f"Your report says nothing about the clock offset{_why(clock)}."
    interval, applied = clock.interval_s, clock.applied_s
    if not clock.determinable:
        said = "Your flight does not determine the clock offset"
        said += f" ({_text(clock.reason).rstrip('.')})" if clock.reason else ""
        key = evidence.key
        if key is not None and key.of_log(log_sha256(evidence.results)) is not None:
            return 1.0, f"{said}, which is not your choice."
        return given["undeterminable"], f"{said}; fly clear starts and stops."
    low, high = interval
    said = f"You applied a clock offset of {applied:.3f} s"
    if low - given["margin_s"] <= applied <= high + given["margin_s"]:
        return 1.0, f"{said}, which is what the data ask for ({low:.3f} to {high:.3f} s)."
    return 0.0, (
        f"{said} where the data ask for {low:.3f} to {high:.3f} s; set it with --clock-offset, or "
        "use --clock-offset auto."
    )


def _loop(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    loop = evidence.results.loop
    if not isinstance(loop, Loop) or loop.closure_error_m is None:
        why = _why(loop.known_end if isinstance(loop, Loop) else loop)
        return 0.0, f"Your report measures no loop{why}."
    if loop.absolute:
        return 0.0, (
            "Your loop is on a track that follows a positioning system and does not drift; measure "
            "it on odometry."
        )
    measured = f"You measured a closure error of {loop.closure_error_m:.3g} m"
    if loop.closures and not any(one.accepted for one in loop.closures):
        said = f"{measured} and rejected the closure as false, which leaves the path as it is"
        if evidence.names("false_loop_closure"):
            return 1.0, f"{said}."
        return 2 / 3, f"{said}; your notes should say why it cannot be true."
    share, comment = _corrected(loop.corrections, given["without_reference"])
    return (1.0 + share) / 3.0, f"{measured}{comment}"


def _corrected(corrections: Corrections, without_reference: float) -> tuple[float, str]:
    """One for a corrected path and one for an ATE below the uncorrected one."""
    tried = (
        corrections.by_distance_plain, corrections.by_distance, corrections.pose_graph_gated,
    )  # fmt: skip
    done = [one for one in tried if isinstance(one, Correction)]
    if not done:
        return 0.0, ", but the path is not corrected."
    before = _ates(corrections.uncorrected)
    pairs = [
        (before[name], ate) for one in done for name, ate in _ates(one).items() if before.get(name)
    ]
    if not pairs:
        return 1.0 + without_reference, (
            " and corrected the path, but not against a reference: with --reference its error "
            "would show."
        )
    was, now = min(pairs, key=lambda pair: pair[1] / pair[0])
    if now < was:
        return 2.0, f", and correcting the path brought its ATE from {was:.3g} m to {now:.3g} m."
    return 1.0, (
        f" and corrected the path, but its ATE is {now:.3g} m against {was:.3g} m uncorrected: "
        "explain why the correction makes it worse."
    )


def _ates(correction: Correction | Absent) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }


def _flight(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    results = evidence.results
    part = results.loop if isinstance(results, LoopResults) else results.settings
    if evidence.has("no_motion"):
        return 0.0, "Your vehicle hardly moved; fly several passes of 5 m or more."
    value: float
    if isinstance(results, LoopResults):
        value, least, unit = results.loop.path_length_m, given["min_path_m"], "m of path"
    else:
        value = max(axis.updates.count for axis in results.axes.values())
        least, unit = given["min_measurements"], "measurements"
    shares = [_up_to(part.end_s - part.start_s, given["min_duration_s"]), _up_to(value, least)]
    said = f"You analysed {part.end_s - part.start_s:.3g} s with {value:.4g} {unit}"
    if min(shares) == 1.0:
        return 1.0, f"{said}, which is enough."
    return min(shares), (
        f"{said}; {given['min_duration_s']:g} s and {least:g} {unit} were asked for."
    )


def _up_to(value: float, least: float) -> float:
    return 1.0 if value >= least else max(value, 0.0) / least


def _mistakes(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    student_id, sha256 = _text(evidence.results.student.id), log_sha256(evidence.results)
    answer = answer_for(evidence.key, student_id, sha256)
    if answer is None:
        return 0.0, (
            f"Neither your id ({student_id or 'none is given'}) nor your log is in the "
            "answer key; make the report of the log that you were given, with your --id."
        )
    if answer.sha256 != sha256:
        return 0.0, f"This report is not about the log that you were given, {_text(answer.file)}."
    named = [name for name in sorted(POSSIBLE_FINDINGS) if evidence.names(name, affirmed=True)]
    if not answer.findings:
        return _nothing_wrong(evidence, named, given)
    shown = {name for one in evidence.results.findings for name in one.ids}
    if _applied(evidence, answer):
        shown.add("source_clock_offset")
    shares = {
        name: 1.0 if evidence.names(name, affirmed=True) else given["in_report"] * (name in shown)
        for name in answer.findings
    }
    share = sum(shares.values()) / len(shares)
    found = [name for name, part in shares.items() if part == 1.0]
    left = [name for name in shares if name not in found]
    was = f"Your flight was made with {_listed([_text(one) for one in answer.mistakes])}"
    if len(named) > given["most_named"]:
        return share * GUESSING, (
            f"{was}, but your notes name {len(named)} kinds of mistakes as if all were there; say "
            "which of them your log has."
        )
    if not left:
        return share, f"{was}, and your notes name {'it' if len(found) == 1 else 'all of it'}."
    listed = any(name in shown for name in left)
    return share, (
        f"{was}; your notes name {len(found)} of {len(shares)}, missing: {_listed(left)}"
        + (", which your report shows but your notes do not explain." if listed else ".")
    )


def _nothing_wrong(
    evidence: Evidence, named: Sequence[str], given: Mapping[str, Any]
) -> tuple[float, str]:
    was = "Your flight was made without a mistake"
    if evidence.notes.mention(evidence.words.get(NOTHING, ())):
        if not named:
            return 1.0, f"{was}, and your notes say so."
        return given["in_report"], f"{was}; your notes say so but also name {_listed(named)}."
    if named:
        return 0.0, f"{was}, but your notes name {_listed(named)}."
    return given["in_report"], f"{was}; your notes should say that you looked and found none."


def answer_for(key: AnswerKey | None, student_id: str, log_sha256: str) -> Answer | None:
    """The answer that counts: the student's own, or for an id that is not in the key the log's."""
    if key is None:
        return None
    return key.of_student(student_id) or key.of_log(log_sha256)


def _applied(evidence: Evidence, answer: Answer) -> bool:
    """Whether the clock offset was mended, so that it is no longer a finding."""
    comparison = evidence.comparison
    applied = 0.0 if comparison is None else comparison.settings.clock_offset_s
    asked = answer.truth.get("clock_offset_to_add_s", 0.0)
    return bool(applied) and abs(applied - asked) < abs(asked) / 2.0


@dataclass(frozen=True)
class Check:
    """What a rubric may ask for: how it is scored, and what it can be told."""

    score: Scorer
    parameters: Mapping[str, Parameter]


def _check(score: Scorer, **parameters: Parameter) -> Check:
    return Check(score, parameters)


def _share(default: float) -> Parameter:
    return Parameter("number", default, 0.0, 1.0)


# A check is a function above, its line here, and an item of rubric.toml that explains it
CHECKS: Mapping[str, Check] = {
    "verified": _check(_verified, without_log=_share(0.5)),
    "student": _check(_student, name=Parameter("flag", True), id=Parameter("flag", True)),
    "sections": _check(_sections, results=Parameter("texts", ()), pages=Parameter("texts", ())),
    "notes": _check(
        _notes,
        min_words=Parameter("whole", 150, 1, 100_000),
        min_different=Parameter("whole", 60, 1, 100_000),
    ),
    "findings": _check(
        _findings,
        severities=Parameter("texts", ("error", "warning"), choices=SEVERITIES),
        ignore=Parameter("texts", ("ekf2_unavailable",)),
    ),
    "tuning": _check(
        _tuning,
        axis=Parameter("text", "horizontal"),
        settings=Parameter("texts", SIGMAS, choices=SIGMAS),
        factor=Parameter("number", 2.0, 1.0, 1000.0),
    ),
    "number": _check(
        _number_between,
        path=Parameter("texts", required=True),
        name=Parameter("text", ""),
        unit=Parameter("text", ""),
        at_least=Parameter("number"),
        at_most=Parameter("number"),
        zero_at=Parameter("number"),
    ),
    "consistent": _check(
        _consistent,
        filter=Parameter("text", "kf", choices=("kf", "ekf2")),
        axes=Parameter("texts", ("horizontal",)),
        factor=Parameter("number", 1.5, 1.0, 1000.0),
    ),
    "clock": _check(
        _clock, margin_s=Parameter("number", 0.03, 0.0, 10.0), undeterminable=_share(0.5)
    ),
    "loop": _check(_loop, without_reference=_share(0.5)),
    "flight": _check(
        _flight,
        min_duration_s=Parameter("number", 60.0, 0.0, 1e5),
        min_measurements=Parameter("whole", 100, 0, 10_000_000),
        min_path_m=Parameter("number", 20.0, 0.0, 1e6),
    ),
    "mistakes": _check(_mistakes, in_report=_share(0.25), most_named=Parameter("whole", 4, 1, 100)),
}


# ------------------------------------------------------------------ points


def score(
    report: Report, verdict: Verdict, rubric: Rubric, key: AnswerKey | None
) -> tuple[Item, ...]:
    """Points for one report.

    Items for another kind of report are left out, and without an answer key those on mistakes.
    """
    evidence = Evidence(report, verdict, rubric.words, key)
    refuted = verdict.status in REFUTED and rubric.unverified == "zero"
    made = []
    for item in rubric.items:
        if not _applies(item, key, evidence.kind):
            continue
        if refuted:
            comment = f"No points, since {REFUTED[verdict.status]}{_reason(verdict)}."
            made.append(Item(item.title, 0.0, item.points, comment))
            continue
        share, comment = CHECKS[item.check].score(evidence, item.parameters)
        made.append(
            Item(
                item.title,
                round(item.points * min(max(share, 0.0), 1.0), 2),
                item.points,
                comment[:1].upper() + comment[1:],
            )
        )
    return tuple(made)


def score_refused(rubric: Rubric, key: AnswerKey | None, reason: str) -> tuple[Item, ...]:
    """No points for what is no report, so that it stands in the table with the others."""
    comment = f"No points, since the file could not be read as a report: {_text(reason)}"
    return tuple(
        Item(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if _applies(item, key, "compare")
    )


def _applies(item: RubricItem, key: AnswerKey | None, kind: str) -> bool:
    return item.report in ("any", kind) and (item.check != "mistakes" or key is not None)


# ------------------------------------------------------------------ what the student reads


def feedback(graded: Graded, class_name: str = "") -> str:
    """Plain text for the student: the points, why, and where most can still be gained.

    Flags are for the instructor and are not in it.
    """
    who = ", ".join(part for part in (_text(graded.student), _text(graded.student_id)) if part)
    lines = [*([class_name] if class_name else []), f"Report   {_text(graded.submission)}"]
    lines += [f"Student  {who}"] if who else []
    lines += [f"Points   {_points(graded.points)} of {_points(graded.of)}"] if graded.items else []
    lines += ["", *_wrapped(_verdict_text(graded.verdict))]
    lines += [""] if graded.items else []
    for item in graded.items:
        lines.append(f"{_points(item.points)} of {_points(item.of)}  {_text(item.title)}")
        lines += [f"    {line}" for line in _wrapped(item.comment, 84)]
    lost = sorted(
        (item for item in graded.items if item.of > item.points),
        key=lambda item: item.points - item.of,
    )
    if lost and graded.points > 0.0:
        lines += ["", "You can still gain most points here:"]
        lines += [f"  - {_text(i.title)} ({_points(i.of - i.points)})" for i in lost[:3]]
    elif graded.items and not lost:
        lines += ["", "Nothing is missing. Well done."]
    lines += ["", *_wrapped(NEXT)] if graded.items else []
    return "\n".join(lines) + "\n"


def _verdict_text(verdict: Verdict) -> str:
    said = {
        "verified": "Your report was verified: its numbers are what px4fuse computes"
        + (" from your log." if verdict.with_log else "; its log was not at hand."),
        "numbers differ": "Numbers in your report are not those that px4fuse computes from the "
        "log with your settings.",
        "other log": "The log of your report is not one of those that your instructor has.",
        "cannot verify": "Your report could not be verified.",
    }[verdict.status]
    if verdict.status == "verified":
        return said
    if _without_log(verdict):
        return (
            "The log of your report was not at hand, so that its numbers could not be computed "
            "again."
        )
    reasons = _joined(verdict.reasons[:NAMED])
    said = f"{said.rstrip('.')}: {reasons}." if reasons else said
    if verdict.status == "other log":
        return f"{said} Make the report of the log that you were given, or hand in your log too."
    return f"{said} Make it again with px4fuse and hand in the PDF as it was written."


def _wrapped(text: str, width: int = 88) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _points(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")


def gradescope(graded: Graded) -> dict[str, Any]:
    """``results.json`` for Gradescope's autograder, to be shown once grades are published.

    Valid for refused files too, whose score is 0. Flags go into a test that students never see.
    """
    tests: list[dict[str, Any]] = [
        {
            "name": _text(item.title),
            "name_format": "text",
            "score": item.points,
            "max_score": item.of,
            "output": item.comment,
            "output_format": "text",
            "visibility": "after_published",
        }
        for item in graded.items
    ]
    if graded.flags:
        tests.append(
            {
                "name": "For the instructor",
                "name_format": "text",
                "score": 0.0,
                "max_score": 0.0,
                "output": "\n".join(_plain_lines(graded.flags)),
                "output_format": "text",
                "visibility": "hidden",
            }
        )
    return {
        "score": round(graded.points, 2),
        "output": _verdict_text(graded.verdict),
        "output_format": "text",
        "visibility": "after_published",
        "stdout_visibility": "hidden",
        "tests": tests,
    }


def _plain_lines(texts: Sequence[str]) -> Iterator[str]:
    for text in texts:
        yield "".join(c if unicodedata.category(c)[0] != "C" else " " for c in text)
