"""Loops, scores and pose graphs on the terminal."""

from __future__ import annotations

from rich.console import Console

from px4fuse.findings import Finding
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.report.cover import write_finding
from px4fuse.report.evaluation_words import write_evaluation
from px4fuse.report.loop_words import write_loop, write_scores
from px4fuse.report.page import Page
from px4fuse.report.screen import show
from px4fuse.request import LoopRequest
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import MANY_CLOSURES, SOLUTIONS, SolvedGraph

MOST_ROWS = 10


def print_loop(
    console: Console, loop: Loop, findings: tuple[Finding, ...], request: LoopRequest
) -> None:
    """Print what was found about a loop."""
    page = Page()
    write_loop(page, loop)
    write_scores(page, loop)
    for finding in findings:
        write_finding(page, finding)
    show(console, page.blocks, request)


def print_evaluation(console: Console, score: Evaluation) -> None:
    """Print the scores of one trajectory against another."""
    page = Page()
    write_evaluation(page, score)
    show(console, page.blocks)


def print_graph(console: Console, name: str, solved: SolvedGraph) -> None:
    """Print how a pose graph was solved, and the closures that the gate rejects."""
    graph, page = solved.graph, Page()
    page.labelled(
        "Graph",
        f"{name}: {graph.dimension}-D, {len(graph)} poses, {len(graph.first)} edges; poses from "
        f"{graph.initialised}",
    )
    gates = solved.gates
    if isinstance(gates, Unavailable):
        page.labelled("Gate", f"none: {gates.reason}")
    elif not gates:
        page.labelled("Gate", "no closures to judge: every edge is odometry")
    else:
        rejected = [gate for gate in gates if not gate.accepted]
        said = [
            f"{graph.ids[graph.first[gate.edge]]} – {graph.ids[graph.second[gate.edge]]}: "
            f"d² {gate.d2:.1f}, p {gate.p:.2g}"
            for gate in rejected[:MOST_ROWS]
        ]
        said += [f"and {len(rejected) - MOST_ROWS} more"] if len(rejected) > MOST_ROWS else []
        page.labelled("Gate", f"rejects {len(rejected)} of {len(gates)} closures", *said)
    if len(solved.solutions) == 1 and (~graph.successive).sum() > MANY_CLOSURES:
        page.labelled("Robust", "left out for so many closures: --robust takes minutes")
    rows = [
        [
            SOLUTIONS[key], f"{solution.initial_cost:.6g}", f"{solution.cost:.6g}",
            f"{solution.iterations}" + ("" if solution.converged else " (not converged)"),
            "" if key == "all" else f"{(solution.weights < 0.5).sum()}",
        ]
        for key, solution in solved.solutions.items()
    ]  # fmt: skip
    head = ("path", "cost before", "cost", "iterations", "closures dropped")
    page.table(head, rows, right=(1, 2, 3, 4))
    show(console, page.blocks)
