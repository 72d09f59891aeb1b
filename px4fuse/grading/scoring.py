"""Points by a rubric, and what the student reads about them.

A report comes from a student: whatever stands in its results, a number that is not there or is no
number gives no points and a comment, never an exception.
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

from px4fuse.assignment.assignment import POSSIBLE_FINDINGS
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.model import Graded, Item
from px4fuse.grading.rubric import Rubric, RubricItem
from px4fuse.verification.model import Report, Verdict
from px4fuse.verification.verification import NO_LOG

# What verification has refuted, rather than what it could not look at
REFUTED: Mapping[str, str] = {
    "numbers differ": "your report's numbers are not those that its log gives",
    "other log": "the log of your report is none of those that your instructor has",
}
# As many as px4fuse compare takes
MAX_NOTES = 200_000
MAX_QUOTE = 160
# A text without full stops is cut into pieces of so many words, in which words belong together
LONGEST_SENTENCE = 40
NEGATIONS = frozenset(("no", "without", "not", "never", "nor", "zero"))
# In the words of the rubric: what says that a flight has no mistake
NOTHING = "none"
NOTES_PAGE = "Notes by the student"
# Lists are cut where a comment would become longer than a sentence
NAMED = 4
# Half is lost where notes name so many kinds of mistakes that some must be guesses
GUESSING = 0.5
CORRECTED = ("by_distance", "pose_graph_gated")
NO_SPACES = re.compile("[\u0e00-\u0eff\u1780-\u17ff]+|[\u3040-\u30ff\u3400-\u9fff]+")
WORD = re.compile(r"\w+")
SENTENCE_END = re.compile(r"(?<=[.!?;])\s+|\n\s*\n|\n\s*(?:[-*+#]|\d+[.)])\s*")
STEP = re.compile(r'"([^"]*)"|([^."]+)')
NEXT = (
    "Your instructor has these points as a proposal and decides; ask if you think that something "
    "was overlooked."
)

Check = Callable[["Evidence", Mapping[str, Any]], tuple[float, str]]


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
    def results(self) -> Mapping[str, Any]:
        """The attached results."""
        return self.report.results

    @property
    def kind(self) -> Literal["compare", "loop"]:
        """Which command made the report."""
        return "loop" if _at(self.results, "schema.name") == "px4fuse-loop" else "compare"

    @cached_property
    def student(self) -> tuple[str, str]:
        """Name and id, as far as they are known."""
        name, number = (_text(_at(self.results, f"student.{part}")) for part in ("name", "id"))
        if name or number or self.kind == "compare":
            return name, number
        # results of px4fuse loop do not say whose they are; its first page does
        match = re.search(r"^Student (.+)$", "\n".join(self.report.pages[:1]), re.MULTILINE)
        name, _, number = (match[1] if match else "").rpartition(", ")
        return _text(name or number), _text(number if name else "")

    @cached_property
    def notes(self) -> Notes:
        """The student's own words, from the pages where the results do not have them."""
        text = _at(self.results, "student.notes")
        if not isinstance(text, str) and self.kind == "loop":
            pages = [page for page in self.report.pages if page.lstrip().startswith(NOTES_PAGE)]
            # the page's title and its two lines at the foot are not the student's
            text = "\n".join("\n".join(page.strip().splitlines()[1:-2]) for page in pages)
        return Notes(text if isinstance(text, str) else "")

    @cached_property
    def findings(self) -> tuple[tuple[str, str, str], ...]:
        """Id, severity and message of each finding that is one."""
        given = self.results.get("findings")
        listed = [one for one in given if isinstance(one, dict)] if isinstance(given, list) else []
        return tuple(
            (_text(one.get("id")), _text(one.get("severity")), _text(one.get("message")))
            for one in listed
            if _text(one.get("id"))
        )

    @property
    def log_sha256(self) -> str:
        """Of the log that the report is about."""
        part = "track" if self.kind == "loop" else "log"
        return _text(_at(self.results, f"{part}.sha256"))

    def names(self, finding: str, affirmed: bool = False) -> bool:
        """Whether the notes name a finding: by its id, or by words that stand for it."""
        phrases = (finding, finding.replace("_", " "), *self.words.get(finding, ()))
        return self.notes.mention(phrases, affirmed)

    def number(self, path: str) -> float | None:
        """A finite number in the results."""
        return _number(_at(self.results, path))


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
            elif isinstance(value, list):
                following += [
                    (f"{name}.{place}", value[place])
                    for place in range(len(value))
                    if every or step == str(place)
                ]
        found = following
    yield from ((name.removeprefix("."), value) for name, value in found)


def _at(results: Mapping[str, Any], path: str) -> Any:
    """The value at a path, None where there is none."""
    return next((value for _, value in values_at(results, path)), None)


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # false for NaN and for integers that no float can hold
    return float(value) if abs(value) < 1e300 else None


def _interval(value: object) -> tuple[float, float] | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    low, high = _number(value[0]), _number(value[1])
    return None if low is None or high is None or low > high else (low, high)


def _text(value: object) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    if not isinstance(value, str):
        return ""
    kept = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in value[: 4 * MAX_QUOTE])
    line = " ".join(kept.split())
    return line if len(line) <= MAX_QUOTE else line[: MAX_QUOTE - 1] + "…"


def _why_absent(results: Mapping[str, Any], path: str) -> str:
    """Why there is no number at a path: what the results themselves say of it."""
    steps = [match[0] for match in STEP.finditer(path)]
    for end in range(len(steps), 0, -1):
        for _, value in values_at(results, ".".join(steps[:end])):
            reason = _text(_at(value, "unavailable.reason")) if isinstance(value, dict) else ""
            if reason:
                return f" ({reason.rstrip('.')})"
    axes = results.get("axes")
    if HORIZONTAL in path and isinstance(axes, dict) and not {"north", "east"} <= set(axes):
        return " (it needs the axes north and east, which were not both analysed: leave --axis out)"
    return ""


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
    name, number = evidence.student
    asked = [
        (what, option, value)
        for what, option, value, wanted in (
            ("name", "--student", name, given["name"]),
            ("student id", "--id", number, given["id"]),
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
        there = [value for _, value in values_at(evidence.results, path)]
        if not any(v for v in there if not (isinstance(v, dict) and set(v) == {"unavailable"})):
            missing.append(f"{path}{_why_absent(evidence.results, path)}")
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
        name: message
        for name, severity, message in evidence.findings
        if severity in given["severities"] and name not in given["ignore"]
    }
    if not isinstance(evidence.results.get("findings"), list):
        return 0.0, "Your report has no list of findings, so that none can be looked for."
    if not asked:
        return 1.0, f"Your report has no {' or '.join(given['severities'])} left to explain."
    missing = [name for name in asked if not evidence.names(name)]
    if not missing:
        return 1.0, f"Your notes take up all {len(asked)} findings of your report."
    return 1.0 - len(missing) / len(asked), (
        f"Your notes take up {len(asked) - len(missing)} of {len(asked)} findings; say what causes "
        f"{_listed(missing)} and what you did about it."
    )


def _tuning(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    axis = given["axis"]
    shares, said = [], []
    for name in given["settings"]:
        share, comment = _tuned(evidence, f'tuning."{axis}".{name}', name, given["factor"])
        shares.append(share)
        said.append(comment)
    if not shares:
        return 0.0, "The rubric asks for no setting."
    return sum(shares) / len(shares), f"{'; '.join(said)}."


def _tuned(evidence: Evidence, path: str, name: str, factor: float) -> tuple[float, str]:
    label, unit = {"sigma_z_m": ("SIGMA_Z", "m")}.get(name, ("SIGMA_A", "m/s²"))
    chosen = evidence.number(f"settings.{name}")
    if chosen is None or chosen <= 0.0:
        return 0.0, f"Your report does not say which {label} you chose"
    interval = _interval(_at(evidence.results, f"{path}_interval"))
    bound = evidence.number(f"{path}_upper_bound")
    if interval is None and bound is not None:
        interval = (0.0, bound)
    if interval is None:
        why = _why_absent(evidence.results, path)
        return 0.0, f"Your report has no interval for {label}{why}"
    low, high = interval
    off = max(chosen / high if high > 0.0 else math.inf, low / chosen, 1.0)
    said = f"your {label} {chosen:.3g} {unit} is"
    asked = f"what the data ask for ({low:.3g} to {high:.3g} {unit})"
    if off == 1.0:
        return 1.0, f"{said} within {asked}"
    share = 1.0 - math.log(off) / math.log(factor) if factor > max(off, 1.0) else 0.0
    side = "above" if chosen > high else "below"
    return share, f"{said} {side} {asked}, by a factor of {off:.3g}"


def _number_between(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    found: list[tuple[str, float]] = []
    for path in given["path"]:
        found = [
            (name, number)
            for name, value in values_at(evidence.results, path)
            if (number := _number(value)) is not None
        ]
        if found:
            break
    label = given["name"]
    if not found:
        why = next(
            (why for path in given["path"] if (why := _why_absent(evidence.results, path))), ""
        )
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
        where = (
            f"horizontal.{given['filter']}"
            if axis == "horizontal"
            else f'axes."{axis}".{given["filter"]}'
        )
        verdict = _text(_at(evidence.results, f"{where}.verdict"))
        factor = evidence.number(f"{where}.variance_factor")
        if not verdict or factor is None or factor <= 0.0:
            shares.append(0.0)
            said.append(
                f"there is no verdict on {owner} ({axis}){_why_absent(evidence.results, where)}"
            )
            continue
        off = max(factor, 1.0 / factor)
        good = verdict == "consistent"
        gone = given["factor"] <= off or given["factor"] <= 1.0
        # no noise explains outliers, and none should be made to
        outliers = "understated" in verdict and any(
            name == "source_outliers" for name, *_ in evidence.findings
        )
        explained = outliers and evidence.names("source_outliers")
        shares.append(
            1.0
            if good or explained
            else 0.0
            if gone
            else 1.0 - math.log(off) / math.log(given["factor"])
        )
        because = (
            ", because of outliers that no setting mends, as your notes say"
            if explained
            else ", because of outliers that no setting mends; your notes should say so"
            if outliers
            else ""
        )
        said.append(
            f"{owner} is consistent ({axis})"
            if good
            else f"{verdict} by a factor of {off:.3g} ({owner}, {axis}){because}"
        )
    comment = "; ".join(said) or "the rubric names no axis"
    return sum(shares) / max(len(shares), 1), f"{comment[:1].upper() + comment[1:]}."


def _clock(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    interval = _interval(_at(evidence.results, "clock.interval_s"))
    applied = evidence.number("clock.applied_s")
    if interval is None or applied is None:
        why = _why_absent(evidence.results, "clock")
        return 0.0, f"Your report says nothing about the clock offset{why}."
    if _at(evidence.results, "clock.determinable") is not True:
        reason = _text(_at(evidence.results, "clock.reason"))
        said = "Your flight does not determine the clock offset"
        said += f" ({reason.rstrip('.')})" if reason else ""
        if evidence.key is not None and evidence.key.of_log(evidence.log_sha256) is not None:
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
    error = evidence.number("loop.closure_error_m")
    if error is None:
        return 0.0, f"Your report measures no loop{_why_absent(evidence.results, 'loop')}."
    if _at(evidence.results, "loop.absolute") is True:
        return 0.0, (
            "Your loop is on a track that follows a positioning system and does not drift; measure "
            "it on odometry."
        )
    measured = f"You measured a closure error of {error:.3g} m"
    closures = [v for _, v in values_at(evidence.results, "loop.closures.*") if isinstance(v, dict)]
    if closures and not any(one.get("accepted") is True for one in closures):
        said = f"{measured} and rejected the closure as false, which leaves the path as it is"
        if evidence.names("false_loop_closure"):
            return 1.0, f"{said}."
        return 2 / 3, f"{said}; your notes should say why it cannot be true."
    share, comment = _corrected(evidence, given["without_reference"])
    return (1.0 + share) / 3.0, f"{measured}{comment}"


def _corrected(evidence: Evidence, without_reference: float) -> tuple[float, str]:
    """One for a corrected path and one for an ATE below the uncorrected one."""
    done = [
        name
        for name in CORRECTED
        if evidence.number(f"loop.corrections.{name}.moved_max_m") is not None
    ]
    if not done:
        return 0.0, ", but the path is not corrected."
    before = _ates(evidence, "uncorrected")
    pairs = [
        (before[name], ate)
        for part in done
        for name, ate in _ates(evidence, part).items()
        if before.get(name)
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


def _ates(evidence: Evidence, correction: str) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = _at(evidence.results, f"loop.corrections.{correction}.scores")
    found = {}
    for name, score_ in scores.items() if isinstance(scores, dict) else ():
        ate = _number(_at(score_, "ate.translation_m.rmse")) if isinstance(score_, dict) else None
        if ate is not None:
            found[name] = ate
    return found


def _flight(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    part = "loop" if evidence.kind == "loop" else "settings"
    start, end = evidence.number(f"{part}.start_s"), evidence.number(f"{part}.end_s")
    if start is None or end is None:
        return 0.0, "Your report does not say which part of the flight it is about."
    if any(name == "no_motion" for name, *_ in evidence.findings):
        return 0.0, "Your vehicle hardly moved; fly several passes of 5 m or more."
    value, least, unit = (
        (evidence.number("loop.path_length_m"), given["min_path_m"], "m of path")
        if evidence.kind == "loop"
        else (
            max(
                (
                    number
                    for _, value in values_at(evidence.results, "axes.*.updates.count")
                    if (number := _number(value)) is not None
                ),
                default=None,
            ),
            given["min_measurements"],
            "measurements",
        )
    )
    shares = [_up_to(end - start, given["min_duration_s"]), _up_to(value or 0.0, least)]
    said = f"You analysed {end - start:.3g} s with {value or 0.0:.4g} {unit}"
    if min(shares) == 1.0:
        return 1.0, f"{said}, which is enough."
    return min(shares), (
        f"{said}; {given['min_duration_s']:g} s and {least:g} {unit} were asked for."
    )


def _up_to(value: float, least: float) -> float:
    return 1.0 if value >= least else max(value, 0.0) / least


def _mistakes(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    answer = answer_for(evidence.key, evidence.student[1], evidence.log_sha256)
    if answer is None:
        return 0.0, (
            f"Neither your id ({evidence.student[1] or 'none is given'}) nor your log is in the "
            "answer key; make the report of the log that you were given, with your --id."
        )
    if answer.sha256 != evidence.log_sha256:
        return 0.0, f"This report is not about the log that you were given, {_text(answer.file)}."
    named = [name for name in sorted(POSSIBLE_FINDINGS) if evidence.names(name, affirmed=True)]
    if not answer.findings:
        return _nothing_wrong(evidence, named, given)
    shown = {name for name, *_ in evidence.findings}
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
    applied = evidence.number("settings.clock_offset_s")
    asked = answer.truth.get("clock_offset_to_add_s", 0.0)
    return applied is not None and bool(applied) and abs(applied - asked) < abs(asked) / 2.0


DOES: Mapping[str, Check] = {
    "verified": _verified,
    "student": _student,
    "sections": _sections,
    "notes": _notes,
    "findings": _findings,
    "tuning": _tuning,
    "number": _number_between,
    "consistent": _consistent,
    "clock": _clock,
    "loop": _loop,
    "flight": _flight,
    "mistakes": _mistakes,
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
        share, comment = DOES[item.check](evidence, item.parameters)
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
    """Plain text for the student: the points, why, and where most are to be had.

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
        lines += ["", "Most points are still to be had here:"]
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
        "other log": "The log of your report is none of those that your instructor has.",
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
