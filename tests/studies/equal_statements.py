"""Compare all statements of one fact about a flight: results, card, findings, tune, sync, whatif.

``equal_statements.py [LOG …]`` analyses each flight once (default: sample logs, logs and cases of
``../shared``, and simulated faults), collects each number that states one of these facts, from JSON
and texts, and prints the pairs that differ by more than their rounding:

- time offset, its interval, and if it is significant
- proposed EKF2_EV_DELAY (or other delay), proposed noises, current values of parameters
- rejected share, σ ratios and verdicts, position RMSE, numbers before a change
- times at which a source stops or begins

Numbers of EKF2's replay are of the time that the replay covers, so they are facts of their own.
"""

from __future__ import annotations

import argparse
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from px4fuse.analysis import Analysis
from px4fuse.cli.options import comparison_request
from px4fuse.cli.tune import tune as tune_command
from px4fuse.comparison.estimates import estimate_noises, estimate_noises_and_time_offset
from px4fuse.comparison.reruns import rerun_kf_with_time_offset
from px4fuse.diagnose import (
    diagnose_or_check_aids,
    prepare_comparison,
    read_flight,
    run_what_if,
)
from px4fuse.errors import Px4FuseError
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Flight
from px4fuse.report import clock, tuning
from px4fuse.request import ComparisonRequest, WhatIfRequest
from px4fuse.results import build
from px4fuse.results.contract import to_json_dict
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared"
Outputs = dict[str, Any]
NUMBER = r"([+−-]?\d[\d,]*(?<!,)(?:\.\d+)?)"
# Findings about the time offset, and those after which none is reported
OFFSET_FINDINGS = {"source_time_offset", "source_low_pass_filtered"}
UNSUITABLE = {
    "source_time_offset_changes", "source_timestamps_are_arrival_times", "source_timestamp_unit",
    "source_positions_rounded", "source_lever_arm", "source_two_senders",
    "source_timestamps_shared", "source_is_ekf2_estimate", "source_convention_ambiguous",
}  # fmt: skip
PARAMETER = r"((?:EKF2|SENS)_[A-Z0-9_]+)"
Reading = Callable[[re.Match[str], str, str], Iterator["Statement"]]
FILTERS = {"KF": "kf", "EKF2": "ekf2"}


class Statement(NamedTuple):
    """Value of a fact on one surface, with half of the last printed digit."""

    fact: str
    surface: str
    value: float | str
    tolerance: float = 0.0

    def contradicts(self, other: Statement) -> bool:
        if isinstance(self.value, str) or isinstance(other.value, str):
            return self.value != other.value
        limit = self.tolerance + other.tolerance + 1e-6 * abs(self.value) + 1e-9
        return abs(self.value - other.value) > limit


def printed(fact: str, surface: str, text: str, factor: float = 1.0) -> Statement:
    """Return the statement of a printed number, which is rounded in its last digit."""
    plain = text.replace("−", "-").replace(",", "")
    digits = len(plain.partition(".")[2])
    return Statement(fact, surface, factor * float(plain), abs(factor) * 0.5001 * 10.0**-digits)


def flight_outputs(request: ComparisonRequest, flight: Flight | None = None) -> Outputs:
    """Return the outputs of ``compare``, ``tune``, ``sync`` and ``whatif`` of one flight."""
    flight = flight or read_flight(request)
    analysis = diagnose_or_check_aids(request, flight=flight)
    if not isinstance(analysis, Analysis):
        return {}
    outputs: Outputs = {
        "json": to_json_dict(build.make_comparison_results(request, analysis)),
        "parameters": {n: v for n, v in flight.log.parameters.items() if n in MODEL_PARAMETERS},
    }
    comparison = prepare_comparison(flight, request)
    noises = estimate_noises(comparison)
    outputs["tune"] = dict(tuning.list_tuning_advice(comparison, noises))
    outputs["tune_json"] = to_json_dict(build.make_tuning_results(request, comparison, noises))
    _, offset = estimate_noises_and_time_offset(comparison)
    is_late = isinstance(offset, SourceTimeOffset) and offset.is_significant(offset.remaining_s)
    trial = rerun_kf_with_time_offset(comparison, offset) if is_late else None
    outputs["sync"] = clock.make_time_offset_advice(comparison, offset, trial)
    outputs["sync_json"] = to_json_dict(build.make_sync_results(request, comparison, offset))
    if request.position is None:
        asked = WhatIfRequest(log=request.log)
        try:
            replayed = run_what_if(asked, flight=flight)
        except Px4FuseError as error:
            outputs["whatif_error"] = str(error)
        else:
            outputs["whatif_json"] = to_json_dict(build.make_whatif_results(asked, replayed))
    return outputs


def texts_of(outputs: Outputs) -> Iterator[tuple[str, str]]:
    """Yield surface and text of everything that is printed."""
    results = outputs["json"]
    for finding in results["findings"]:
        yield f"finding {finding['id']}", finding["message"]
        yield f"fix of {finding['id']}", finding["remedy"]
    card = results["card"]
    for name in ("headline", "effect_text", "reconcile", "difference"):
        yield f"card {name}", card.get(name, "")
    for sentence in card.get("do_this", ()):
        yield "card do this", sentence
    for cause in card.get("causes", ()):
        groups = [cause.get("actions", ()), *cause.get("alternatives", ())]
        yield f"card cause {cause['id']}", f"{cause['title']}. {cause['why']}"
        for action in (action for group in groups for action in group):
            name = f"card action of {cause['id']}"
            yield name, f"{action.get('sentence', '')} {' '.join(action.get('commands', ()))}"
    for command in ("tune", "sync"):
        for label, text in outputs.get(command, {}).items():
            yield f"{command} {label}", text


def main_axis(outputs: Outputs) -> str:
    """Return the name of the main axis in texts, for example "the axis of largest motion"."""
    effect = outputs["json"]["card"].get("effect") or {}
    return str(effect.get("axis", "")).partition(",")[0].removeprefix("along ")


def json_offsets(outputs: Outputs) -> Iterator[Statement]:
    """Yield the time offset (s) of the logged timestamps, and of a time that is applied."""
    for name in ("json", "sync_json"):
        offset = outputs.get(name, {}).get("clock") or {}
        if offset.get("is_determinable"):
            values = (offset["offset_s"], *offset["interval_s"])
            for end, value in zip(("", " low", " high"), values, strict=True):
                yield Statement(f"offset{end}", name, value)
    results = outputs["json"]
    ids = {one["id"] for one in results["findings"]}
    if "Result" in outputs.get("sync", {}) and not ids & UNSUITABLE:
        is_significant = "Re-run" in outputs["sync"]
        yield Statement("offset is significant", "sync", str(is_significant))
        yield Statement("offset is significant", "findings", str(bool(ids & OFFSET_FINDINGS)))


def json_noises(outputs: Outputs) -> Iterator[Statement]:
    """Yield noise estimates, flown parameters, and those that ``whatif`` proposes."""
    whatif = outputs.get("whatif_json", {}).get("whatif") or {}
    for name, value in whatif.get("changed", {}).items():
        yield Statement(f"set {name}", "whatif", value)
    for name, value in outputs["parameters"].items():
        yield Statement(f"now {name}", "parameters", value, 1e-6)
    for surface in ("json", "tune_json"):
        tuning = outputs.get(surface, {}).get("tuning", {}).get("horizontal", {})
        for label, field in (("SIGMA_A", "sigma_a_two_state_m_s2"), ("SIGMA_Z", "sigma_z_m")):
            value, interval = tuning.get(field), tuning.get(f"{field}_interval") or (None, None)
            for end, number in zip(("", " low", " high"), (value, *interval), strict=True):
                if None not in (value, number):
                    yield Statement(f"estimate {label}{end}", surface, number)


def json_axes(outputs: Outputs) -> Iterator[Statement]:
    """Yield σ ratio, verdict and RMSE of each filter and axis, and the rejected share."""
    for name, axis in outputs["json"]["axes"].items():
        label = "the axis of largest motion" if name == "aisle" else name
        for filter_name, summary in axis["filters"].items():
            if summary.get("sigma_ratio") is None:
                continue
            fact = f"{filter_name} {label}"
            yield Statement(f"σ ratio {fact}", "results", summary["sigma_ratio"])
            yield Statement(f"verdict {fact}", "results", summary["verdict"])
            if "position_rmse_m" in (truth := summary.get("truth") or {}):
                yield Statement(f"RMSE {fact}", "results", truth["position_rmse_m"])
        if label == main_axis(outputs) and axis.get("rejected_fraction") is not None:
            yield Statement("rejected", "results", axis["rejected_fraction"])


def json_card(outputs: Outputs) -> Iterator[Statement]:
    """Yield verdicts and effect of the card."""
    card, label = outputs["json"]["card"], main_axis(outputs)
    for verdict in card.get("verdicts", ()):
        fact = f"{verdict['filter']} {label}"
        against = "σ" if verdict["against"] == "source" else "truth"
        if verdict.get("ratio"):
            yield Statement(f"{against} ratio {fact}", "card", verdict["ratio"])
            if against == "σ":
                yield Statement(f"verdict {fact}", "card", verdict["word"])
    effect = card.get("effect") or {}
    for filter_name, value in effect.get("position_rmse_m", {}).items():
        yield Statement(f"RMSE {filter_name} {label}", "card effect", value)
    if effect.get("rejected_fraction") is not None:
        yield Statement("rejected", "card effect", effect["rejected_fraction"])


def json_trials(outputs: Outputs) -> Iterator[Statement]:
    """Yield the numbers before each re-run; those of EKF2 are of the time of its replay."""
    for trial in outputs["json"]["trials"]:
        surface, before = f"before of {'+'.join(trial['kinds'])}", trial["before"]
        when = "" if trial.get("from_s") is None else ", time of replay"
        # of an axis on which the replay differs from the log, the numbers are from the replay
        basis = "" if trial.get("is_logged", True) else ", replay"
        axis = "the axis of largest motion" if trial["axis"] == "aisle" else trial["axis"]
        fact = f"{trial['filter']} {axis}{when}"
        for name, field, power in (
            (f"σ ratio {fact}", "nis_mean", 0.5), (f"truth ratio {fact}", "nees_mean", 0.5),
            (f"RMSE {fact}", "position_rmse_m", 1.0),
            (f"rejected{when}{basis}", "rejected_fraction", 1.0),
        ):  # fmt: skip
            if before.get(field) is not None:
                yield Statement(name, surface, before[field] ** power)


def json_spans(outputs: Outputs) -> Iterator[Statement]:
    """Yield the times at which a source stops or begins, and rejected shares of findings."""
    results, settings = outputs["json"], outputs["json"]["settings"]
    for finding in results["findings"]:
        evidence, name = finding["evidence"], finding["id"]
        if name in ("source_stops", "source_begins"):
            begins = name == "source_begins"
            yield Statement(name, "evidence", evidence["at_s"])
            yield Statement(name, "span", finding["spans_s"][0][begins])
            yield Statement(name, "segment", settings["start_s" if begins else "end_s"], 0.05)
        if name == "ekf2_rejects_positions" and evidence["axis"] != "down":
            yield Statement("rejected", "finding evidence", evidence["rejected_fraction"])


def offset_estimate(found: re.Match[str], surface: str, text: str) -> Iterator[Statement]:
    late = "late" in text
    ends = ("", " high", " low") if late else ("", " low", " high")
    for end, number in zip(ends, found.groups(), strict=True):
        yield printed(f"offset{end}", surface, number, -1.0 if late else 1.0)


def offset_to_add(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
    for end, number in zip(("", " low", " high"), found.groups(), strict=True):
        yield printed(f"offset{end}", surface, number)


def signed_offset(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
    is_negative = {"late", "subtract"} & {word.lower() for word in found.groups()}
    number = next(
        word for word in found.groups() if word.lstrip("+-−").startswith(tuple("0123456789"))
    )
    yield printed("offset", surface, number, -1.0 if is_negative else 1.0)


def changed_parameter(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
    name, before, after = found.groups()
    yield printed(f"now {name}", surface, before)
    yield printed(f"set {name}", surface, after)


def noise_estimate(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
    label, *numbers = found.groups()
    for end, number in zip(("", " low", " high"), numbers, strict=True):
        yield printed(f"estimate {label}{end}", surface, number)


def sigma_ratio(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
    label, axis, number, size = found.groups()
    one = printed(f"σ ratio {FILTERS[label]} {axis}", surface, number)
    if size == "large":
        value = 1.0 / float(one.value)
        one = one._replace(value=value, tolerance=one.tolerance * value**2)
    yield one


def named(fact: str, factor: float = 1.0) -> Reading:
    """Return the reading of a number as a fact with the name (or filter and axis) in the text."""

    def read(found: re.Match[str], surface: str, _: str) -> Iterator[Statement]:
        groups = found.groupdict()
        groups["filter"] = FILTERS.get(groups.get("filter") or "", "")
        yield printed(fact.format_map(groups), surface, groups["number"] or "", factor)

    return read


NAMED_NUMBER = NUMBER.replace("(", "(?P<number>", 1)
NAME = r"(?P<name>(?:EKF2|SENS)_[A-Z0-9_]+)"
AXIS = r"(?P<axis>the axis of largest motion|north|east|down)"
INTERVAL = rf"\(95 % {NUMBER} to {NUMBER}"
READINGS: tuple[tuple[str, Reading], ...] = (
    (rf"IMU and positions is {NUMBER} s {INTERVAL} s\)", offset_estimate),
    (rf"Add {NUMBER} s {INTERVAL} s\)", offset_to_add),
    (rf"timestamps are {NUMBER} s (late|early)", signed_offset),
    (rf"(?i:(subtract|add) {NUMBER} s (?:from|to) the timestamp)", signed_offset),
    (rf"--clock-offset {NAMED_NUMBER}", named("--clock-offset")),
    (rf"(?i:set|increase) {NAME} to {NAMED_NUMBER}", named("set {name}")),
    (rf" and {NAME} to {NAMED_NUMBER}", named("set {name}")),
    (rf"param set {NAME} {NAMED_NUMBER}", named("set {name}")),
    (rf"{PARAMETER} {NUMBER} → {NUMBER}", changed_parameter),
    (rf"Set {NAME} to [^.]*?\(now {NAMED_NUMBER}", named("now {name}")),
    (rf"(?<!likelihood ){NAME} is {NAMED_NUMBER} (?:ms|m)\b", named("now {name}")),
    (rf"{NAME} {NAMED_NUMBER} ms agrees", named("set {name}")),
    (rf"(?P<name>--sigma-[az]) {NAMED_NUMBER}", named("set {name}")),
    (rf"(SIGMA_[AZ]) [\d.]+ m\S*; maximum-likelihood estimate {NUMBER} m\S* {INTERVAL}",
     noise_estimate),
    (rf"EKF2 reject(?:s|ed) {NAMED_NUMBER} % of the positions", named("rejected", 0.01)),
    (rf"(KF|EKF2) is (?:over|under)confident along {AXIS}: σ is {NUMBER} times too (small|large)",
     sigma_ratio),
    (rf"(?P<filter>KF|EKF2): position RMSE {NAMED_NUMBER} m along {AXIS}",
     named("RMSE {filter} {axis}")),
    (rf"(?:stop|begin) in flight at {NAMED_NUMBER} s", named("source stops or begins")),
)  # fmt: skip


def statements(outputs: Outputs) -> Iterator[Statement]:
    """Yield all statements about one flight."""
    for collect in (
        json_offsets, json_noises, json_axes, json_card, json_trials, json_spans
    ):  # fmt: skip
        yield from collect(outputs)
    for surface, text in texts_of(outputs):
        for pattern, read in READINGS:
            for found in re.finditer(pattern, text):
                yield from read(found, surface, text)


def contradictions(outputs: Outputs) -> list[tuple[Statement, Statement]]:
    """Return the pairs of statements of one fact that differ by more than their rounding."""
    by_fact: Mapping[str, list[Statement]] = defaultdict(list)
    for statement in statements(outputs) if outputs else []:
        by_fact[statement.fact].append(statement)
    return [
        (one, other)
        for same in by_fact.values()
        for number, one in enumerate(same)
        for other in same[number + 1 :]
        if one.contradicts(other)
    ]


class Job(NamedTuple):
    """One flight: arguments of ``px4fuse compare``, or options of a simulated flight."""

    name: str
    arguments: tuple[str, ...] = ()
    kind: str = ""
    seed: int = 0
    mistakes: tuple[str, ...] = ()

    def read(self) -> tuple[ComparisonRequest, Flight]:
        """Return the request and the flight."""
        if self.kind:
            flight = simulate_flight(
                make_scenario(self.kind, seed=self.seed), parse_faults(self.mistakes)
            )
            return ComparisonRequest(log=flight.log.name), flight
        os.chdir(SHARED / "cases")  # arguments of cases are relative to it
        values = dict(tune_command.make_context("tune", list(self.arguments)).params)
        values.pop("json_path")
        request = comparison_request(values.pop("log"), values)
        return request, read_flight(request)


FAULTS = (
    (), ("clock-offset=0.15",), ("clock-offset=-0.4",), ("clock-offset=0.04",), ("nlos=8%",),
    ("dropout=6s",), ("r-scale=0.1",), ("r-scale=20",), ("yaw=12",), ("scale=6%",), ("jump=1.5",),
    ("smoothed=0.5",), ("slow-error=0.4",), ("accel-bias=0.6",), ("ekf2-noise=0.5",),
    ("ekf2-noise=0.02",), ("ekf2-delay=0.2",), ("ekf2-gate=1",), ("vibration=4",),
)  # fmt: skip
FOLDERS = {
    "sample_logs": "*.[ut]l*g", "logs/conventions": "*.ulg", "logs/flown": "*.ulg",
    "logs/gps": "*.ulg", "logs/simulated": "*.ulg", "logs/mavlink": "*.tlog", "logs/real": "*.ulg",
}  # fmt: skip


def jobs() -> Iterator[Job]:
    """Yield all flights: recorded ones, cases, and simulated faults with and without GNSS."""
    for folder, pattern in FOLDERS.items():
        for path in sorted((SHARED / folder).glob(pattern)):
            yield Job(f"{Path(folder).name} {path.name}", (str(path),))
    cases = json.loads((SHARED / "cases" / "EXPECTED.json").read_text())["cases"]
    for name, case in cases.items():
        yield Job(f"case {name}", tuple(word for word in case["command"] if word != "compare"))
    for number, mistakes in enumerate(FAULTS):
        for kind in ("aisle", "outdoor") if number % 2 == 0 else ("aisle",):
            yield Job(f"{kind} {' '.join(mistakes) or 'clean'}", (), kind, 700 + number, mistakes)


def run(job: Job) -> tuple[str, Outputs]:
    """Return the outputs of a flight; empty if it is refused or has no positions."""
    try:
        return job.name, flight_outputs(*job.read())
    except Px4FuseError:
        return job.name, {}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("logs", nargs="*", help="logs instead of all flights")
    parser.add_argument("--only", default="", help="part of the name of the flights")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chosen = [Job(log, (str(Path(log).resolve()),)) for log in options.logs] or list(jobs())
    counts: Counter[str] = Counter()
    with ProcessPoolExecutor(options.jobs) as pool:
        for name, outputs in pool.map(run, [job for job in chosen if options.only in job.name]):
            counts["flights"] += bool(outputs)
            counts["statements"] += len(list(statements(outputs))) if outputs else 0
            for one, other in contradictions(outputs):
                counts["contradictions"] += 1
                print(
                    f"{name}: {one.fact}: {one.surface} {one.value}, {other.surface} {other.value}"
                )
    print(dict(counts))


if __name__ == "__main__":
    main()
