"""Loops, scores and pose graphs on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from px4fuse.findings import Finding, by_root
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.report.evaluation_words import reasons
from px4fuse.report.loop_words import (
    by_distance_words,
    closure_name,
    interval_words,
    loop_lines,
    moved_words,
    redundancy_words,
    refusals,
    score_words,
    track_words,
    unscored,
)
from px4fuse.report.screen import plain_table, print_line, say
from px4fuse.report.terminal import print_finding
from px4fuse.request import LoopRequest
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import MANY_CLOSURES, SOLUTIONS, SolvedGraph
from px4fuse.trajectory.scores import Statistics

MOST_ROWS = 10


def print_loop(
    console: Console, loop: Loop, findings: tuple[Finding, ...], request: LoopRequest
) -> None:
    """Print what was found about a loop."""
    for label, text in loop_lines(loop):
        print_line(console, label, text)
    _print_paths(console, loop)
    if len(loop.closures) > 1:
        closures = _table("closure", "missed by (m)", "d²", "p", "gate", "DCS", "GNC")
        for closure in loop.closures:
            weights = closure.weight_dcs, closure.weight_gnc
            closures.add_row(
                closure_name(closure, loop),
                f"{closure.distance_m:.2f}",
                f"{closure.d2:.1f}",
                f"{closure.p:.2g}",
                Text("accepted", "green") if closure.accepted else Text("REJECTED", "bold red"),
                *("nan" if weight is None else f"{weight:.2f}" for weight in weights),
            )
        console.print(closures)
    for text in (
        by_distance_words(loop), redundancy_words(loop), *refusals(loop), *unscored(loop),
    ):  # fmt: skip
        if text:
            say(console, Text(text, "dim"))
    for group in by_root(findings):
        print_finding(console, group, request)


def _print_paths(console: Console, loop: Loop) -> None:
    """Every path with how far it moved, and a table of its scores for each reference."""
    table = _table("path", "moved RMS (m)", "max (m)")
    for part in loop.reported:
        table.add_row(part.name, *moved_words(part).split(" / "))
    console.print(table)
    for name in (reference.name for reference in loop.references):
        scores = {part.name: part.scores[name] for part in loop.reported}
        known = [score for score in scores.values() if isinstance(score, Evaluation)]
        if not known:
            continue
        over = [e.delta_words for e in known[0].rpe if e.unit == "m"][-2:]
        say(console, Text(f"Against {name}", "bold"))
        table = _table("path", "ATE (m)", "95 %", *(f"RPE {distance} (m)" for distance in over))
        for path, score in scores.items():
            table.add_row(path, *_scores(score, over))
        console.print(table)


def _scores(score: Evaluation | Unavailable, over: list[str]) -> list[str]:
    """ATE, its interval, and RPE over some distances."""
    if isinstance(score, Unavailable):
        return ["–"]
    by_distance = {e.delta_words: e.translation_m for e in score.rpe}
    rpe = [by_distance[distance] for distance in over]
    return [
        f"{score.ate.translation_m.rmse:.3f}",
        interval_words(score.ate.interval_m).strip(" ()"),
        *(f"{e.rmse:.3f}" if isinstance(e, Statistics) else "–" for e in rpe),
    ]


def print_evaluation(console: Console, score: Evaluation) -> None:
    """Print the scores of one trajectory against another."""
    print_line(console, "Estimate", track_words(score.estimate))
    print_line(console, "Against", track_words(score.reference))
    print_line(console, "How", score_words(score))
    ate = score.ate
    table = _table("error", "RMSE", "95 %", "mean", "median", "max", "n")
    _statistics(table, "ATE (m)", ate.translation_m, interval_words(ate.interval_m).strip(" ()"))
    if isinstance(ate.rotation_deg, Statistics):
        _statistics(table, "rotation (°)", ate.rotation_deg)
    for error in score.rpe:
        if isinstance(error.translation_m, Statistics):
            interval = interval_words(error.interval_m).strip(" ()")
            _statistics(table, f"RPE {error.delta_words} (m)", error.translation_m, interval)
        if isinstance(error.rotation_deg, Statistics):
            _statistics(table, f"RPE {error.delta_words} (°)", error.rotation_deg)
    console.print(table)
    for text in (*reasons(score), *score.notes):
        say(console, Text(text, "dim"))
    for text in score.warnings:
        say(console, Text(text, "yellow"))


def print_graph(console: Console, solved: SolvedGraph) -> None:
    """Print how a pose graph was solved, and the closures that the gate rejects."""
    print_line(
        console,
        "Graph",
        f"{solved.name}: {solved.dimension}-D, {solved.poses} poses, {solved.edges} edges; poses "
        f"from {solved.initialised}",
    )
    gates = solved.gates
    if isinstance(gates, Unavailable):
        print_line(console, "Gate", f"none: {gates.reason}")
    elif not gates:
        print_line(console, "Gate", "no closures to judge: every edge is odometry")
    else:
        rejected = [gate for gate in gates if not gate.accepted]
        print_line(console, "Gate", f"rejects {len(rejected)} of {len(gates)} closures")
        for gate in rejected[:MOST_ROWS]:
            ends = f"{gate.first} – {gate.second}"
            console.print(f"         {ends}: d² {gate.d2:.1f}, p {gate.p:.2g}", markup=False)
        if len(rejected) > MOST_ROWS:
            console.print(f"         and {len(rejected) - MOST_ROWS} more", markup=False)
    if len(solved.solutions) == 1 and (~solved.graph.successive).sum() > MANY_CLOSURES:
        print_line(console, "Robust", "left out for so many closures: --robust takes minutes")
    table = _table("path", "cost before", "cost", "iterations", "closures dropped")
    for key, solution in solved.solutions.items():
        table.add_row(
            SOLUTIONS[key],
            f"{solution.cost_initial:.6g}",
            f"{solution.cost:.6g}",
            f"{solution.iterations}" + ("" if solution.converged else " (not converged)"),
            "" if key == "all" else f"{solution.dropped}",
        )
    console.print(table)


def _statistics(table: Table, label: str, values: Statistics, interval: str = "") -> None:
    numbers = (values.mean, values.median, values.max)
    table.add_row(
        label, f"{values.rmse:.4f}", interval, *(f"{n:.4f}" for n in numbers), f"{values.count}"
    )


def _table(*names: str) -> Table:
    left = ("path", "closure", "error", "gate", "edge")
    return plain_table(*((name, "left" if name in left else "right") for name in names))
