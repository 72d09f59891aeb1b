"""What three students would earn on assigned flights: one ideal, one who does nothing, one guesser.

``python tests/studies/fairness.py`` flies assignments, hands in what the three would, and writes
``fairness.csv`` beside this file: one row per flight. ``--students`` gives another
number of flights, ``--only TEXT`` takes those whose mistakes hold it and writes nothing, and
``--cache DIR`` keeps analyses, so that another rubric is measured in seconds; delete it when the
analysis changes.

The default student hands in the report as the command makes it, without notes. The ideal one sets
what the report advises and names the mistakes in sentences, in two wordings. The guesser names one
to three mistakes drawn at random in the same sentences, with default and with random settings: the
mean of 32 guesses. All of them hand in honest numbers, which are taken for verified.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from statistics import fmean
from typing import cast

import fairness_notes
import msgspec
import numpy as np
import pandas as pd
from fairness_notes import WORDINGS

from px4fuse.analysis import run
from px4fuse.assignment.assignment import answer_to
from px4fuse.assignment.drawing import CHOICES, EASIEST, HARDEST, Choice, Drawn, draw
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.assignment.roster import Student as Assigned
from px4fuse.filter.tuning import HORIZONTAL, Tuned
from px4fuse.findings import find, find_loop
from px4fuse.flight import Flight
from px4fuse.grading.model import Graded, Rubric
from px4fuse.grading.rubric import read_rubric
from px4fuse.grading.scoring import assess
from px4fuse.loop.analysis import analyse
from px4fuse.loop.sources import Source
from px4fuse.loop.tracks import trajectory_of
from px4fuse.request import ComparisonRequest, LoopRequest, command_line
from px4fuse.results.build import results as comparison_results
from px4fuse.results.build_trajectories import loop_results
from px4fuse.results.comparison import ASKED
from px4fuse.results.contract import ComparisonResults, Reported, to_json
from px4fuse.results.model import Student
from px4fuse.results.reading import read_results
from px4fuse.simulation.flights import simulate, to_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.verification.model import Report, Verdict

TABLE = Path(__file__).with_name("fairness.csv")
SECRET = b"px4fuse fairness"
FLIGHTS = 300
VERIFIED = Verdict("verified", ("taken for verified",), with_log=True, page_status="same")
NONE = "none"
# Of half the guesses, whose settings come to mind: the factor from the default is log-uniform
WILD = 3.0
MOST_GUESSES = 3
# The ideal student runs again until what the report asks for is what was set
MOST_RUNS = 3
GUESSES = 32
Request = ComparisonRequest | LoopRequest
# Reports with their notes: what one kind of student hands in, of which the mean counts
HandIns = tuple[tuple[Reported, str], ...]


@dataclass(frozen=True)
class Flown:
    """One assigned flight, analysed on demand.

    Attributes
    ----------
    number : int
        Of the student.
    cache : Path or None
        Folder of analyses that were made before.
    """

    number: int
    drawn: Drawn
    cache: Path | None = None

    @property
    def student(self) -> Assigned:
        """As in a roster."""
        return Assigned(f"s{self.number}", f"Student {self.number}", f"s{self.number}.ulg")

    def answer(self) -> Answer:
        """The key's."""
        made = self._kept("answer", lambda: msgspec.json.encode(self._answer()).decode())
        return msgspec.json.decode(made, type=Answer)

    def report(self, request: Request) -> Reported:
        """Results of ``px4fuse compare`` or ``px4fuse loop``, without a student."""
        made = self._kept(repr(request), lambda: to_json(_results(self._flight(), request)))
        return cast("Reported", read_results(made.encode()))

    def _kept(self, what: str, make: Callable[[], str]) -> str:
        if self.cache is None:
            return make()
        drawn = self.drawn
        identity = repr(
            (metadata.version("px4fuse"), self.number, drawn.scenario, drawn.typed, what)
        )
        path = self.cache / f"{hashlib.sha256(identity.encode()).hexdigest()}.json"
        if not path.exists():
            path.write_text(make(), encoding="utf-8")
        return path.read_text(encoding="utf-8")

    def _flight(self) -> Flight:
        return to_flight(simulate(self.drawn.scenario, parse(self.drawn.typed)), self.student.file)

    def _answer(self) -> Answer:
        simulation = simulate(self.drawn.scenario, parse(self.drawn.typed))
        return answer_to(self.student, self.drawn, simulation, to_flight(simulation).log.sha256)


def flown(number: int, cache: Path | None = None) -> Flown:
    """The flight that a student of a mixed class is given."""
    return Flown(number, draw(SECRET, f"s{number}", "mixed"), cache)


def _results(flight: Flight, request: Request) -> Reported:
    command = command_line(request)
    if isinstance(request, LoopRequest):
        # as it is read from the log: trajectories of a flight by their part
        source = Source(trajectory_of(flight, "vio"), flight)
        loop = analyse(source, came_back=request.came_back)
        return loop_results(request, loop, find_loop(loop), Student(), command)
    analysis = run(request, flight=flight)
    return comparison_results(request, analysis, find(analysis), Student(), command)


def by_default(one: Flown) -> HandIns:
    """The report as the command makes it, without notes."""
    return ((one.report(_asked(one)), ""),)


def _asked(one: Flown) -> Request:
    if one.drawn.scenario.kind == "loop":
        return LoopRequest(source=one.student.file)
    return ComparisonRequest(log=one.student.file)


def ideal(one: Flown) -> HandIns:
    """Settings as the report advises, and notes that name the mistakes: in each wording."""
    handed_in = []
    for wording in range(WORDINGS):
        request = _asked(one)
        report = one.report(request)
        for _ in range(MOST_RUNS):
            better = _advised(request, report, leaves_open=wording == 0)
            if better == request:
                break
            request, report = better, one.report(better)
        handed_in.append((report, fairness_notes.notes(report, one.drawn, wording)))
    return tuple(handed_in)


def _advised(request: Request, report: Reported, leaves_open: bool) -> Request:
    """What the report asks for."""
    found = {each.id: each for top in report.findings for each in (top, *top.consequences)}
    if isinstance(request, LoopRequest):
        # the finding advises to leave the landing out; who does not has it rejected, which is right
        wrong = "false_loop_closure" in found and leaves_open
        return msgspec.structs.replace(request, came_back=request.came_back and not wrong)
    changes: dict[str, float] = {}
    arrival, offset = found.get("source_stamps_of_arrival"), found.get("source_clock_offset")
    if arrival is not None and request.start_s is None:
        changes["start_s"] = math.ceil(float(arrival.evidence["until_s"]))
    elif offset is not None:
        changes["clock_offset_s"] = round(float(offset.evidence["offset_s"]), 3)
    tuned = report.tuning.get(HORIZONTAL) if isinstance(report, ComparisonResults) else None
    for name, asked in ASKED.items() if isinstance(tuned, Tuned) else ():
        value, (low, high) = getattr(tuned, asked), getattr(tuned, f"{asked}_interval")
        if not low <= getattr(request, name) <= (high or math.inf):
            changes[name] = float(f"{high if value is None else value:.3g}")
    return msgspec.structs.replace(request, **changes)


def guesser(one: Flown) -> HandIns:
    """Mistakes drawn at random, named in sentences: with default settings, and with random ones."""
    rng = np.random.default_rng(one.number)
    choices = [choice for kind in CHOICES.values() for choice in kind]
    requests = [_asked(one)]
    if isinstance(requests[0], ComparisonRequest):
        wild = {
            name: float(f"{getattr(requests[0], name) * WILD ** rng.uniform(-1.0, 1.0):.3g}")
            for name in ASKED
        }
        requests.append(msgspec.structs.replace(requests[0], **wild))
    reports = [one.report(request) for request in requests]
    handed_in = []
    for guess in range(GUESSES):
        count = rng.integers(1, MOST_GUESSES, endpoint=True)
        picked = rng.choice(len(choices), count, replace=False)
        named = [choices[at].typed(rng.uniform(EASIEST, HARDEST)) for at in picked]
        report = reports[guess % len(reports)]
        handed_in.append((report, fairness_notes.guessed(report, named, guess // 2)))
    return tuple(handed_in)


STUDENTS: Mapping[str, Callable[[Flown], HandIns]] = {
    "ideal": ideal,
    "default": by_default,
    "guesser": guesser,
}


def earned(one: Flown, results: Reported, notes: str, rubric: Rubric) -> Graded:
    """What a report with its notes earns, part by part."""
    answer = one.answer()
    student = Student(name=answer.name, id=answer.student_id, notes=notes)
    # the pages of a report that px4fuse drew
    pages = {page for item in rubric.items for page in item.parameters.get("pages", ())}
    results = msgspec.structs.replace(results, student=student)
    report = Report("", "intact", results, (" ".join(sorted(pages)),), b"")
    return assess(report, VERIFIED, rubric, AnswerKey("mixed", (answer,)))


def measured(one: Flown, rubric: Rubric) -> dict[str, object]:
    """A row of the table.

    ``missed``: what the key names and the report as the command makes it does not list.
    """
    answer = one.answer()
    found = {i for top in by_default(one)[0][0].findings for i in top.ids}
    row: dict[str, object] = {
        "student": answer.student_id,
        "kind": one.drawn.scenario.kind,
        "mistakes": " ".join(answer.mistakes) or NONE,
        "difficulty": answer.difficulty,
        "missed": " ".join(sorted({*answer.findings} - found)),
    }
    for who, hand_in in STUDENTS.items():
        made = [earned(one, *each, rubric) for each in hand_in(one)]
        row[who] = round(fmean(each.points / each.of for each in made), 4)
    return row


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Means by mistake and size.

    Parameters
    ----------
    table : DataFrame
        One row per flight, as in fairness.csv.

    Returns
    -------
    DataFrame
        One row per mistake and size ("plain" or "small", above and below the middle of the band),
        with ``flights``, ``found`` (share of them whose report lists it) and the means of the
        three. A flight with two mistakes is in two rows.
    """
    choices = {choice.mistake: choice for kind in CHOICES.values() for choice in kind}
    rows = []
    for row in table.to_dict("records"):
        for typed in row["mistakes"].split():
            choice = choices.get(typed.partition("=")[0])
            rows.append(
                {
                    "mistake": f"{NONE}, {row['kind']}" if choice is None else choice.mistake,
                    "size": _size(choice, typed),
                    "found": choice is None or choice.finding not in row["missed"].split(),
                    **{who: row[who] for who in STUDENTS},
                }
            )
    return (
        pd.DataFrame(rows)
        .groupby(["mistake", "size"])
        .agg(flights=("found", "size"), **{key: (key, "mean") for key in ("found", *STUDENTS)})
        .round(3)
        .reset_index()
    )


def _size(choice: Choice | None, typed: str) -> str:
    if choice is None or choice.limit is None:
        return ""
    return "small" if choice.difficulty(typed) >= (EASIEST + HARDEST) / 2.0 else "plain"


def _row(number: int, cache: Path | None) -> dict[str, object]:
    return measured(flown(number, cache), read_rubric(None))


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--students", type=int, default=FLIGHTS)
    parser.add_argument("--only", default="")
    parser.add_argument("--cache", type=Path, default=None)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    given = parser.parse_args()
    if given.cache is not None:
        given.cache.mkdir(parents=True, exist_ok=True)
    numbers = [
        number
        for number in range(given.students)
        if given.only in (" ".join(flown(number).drawn.typed) or NONE)
    ]
    with ProcessPoolExecutor(given.processes) as pool:
        table = pd.DataFrame(pool.map(partial(_row, cache=given.cache), numbers))
    print(summary(table).to_string(index=False))
    if given.only or given.students != FLIGHTS:
        return
    table.to_csv(TABLE, index=False, lineterminator="\n")


if __name__ == "__main__":
    _main()
