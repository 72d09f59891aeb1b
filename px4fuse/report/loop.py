"""Report page on a loop flight: loop closure error and corrected paths."""

from collections.abc import Iterator

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.core.text import (
    capitalise_first_letter,
    format_count,
    format_number,
    format_p_value,
    join_first_names,
)
from px4fuse.finding import Finding
from px4fuse.flight.model import Unavailable
from px4fuse.loop.analysis import MIN_UNIX_TIME_S
from px4fuse.loop.corrections import CORRECTION_LABELS
from px4fuse.loop.model import Loop, PathResult
from px4fuse.results.contract import LoopResults
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.covariance import GATE_ALPHA
from px4fuse.trajectory.graph.solver import MAX_GNC_CLOSURES, SOLUTION_LABELS, Graph
from px4fuse.trajectory.model import AXES_OF_FRAME, format_vector

from .evaluation import (
    describe_method,
    format_error,
    format_rmse,
    plot_path,
)
from .page import Page
from .phrases import write_findings
from .style import (
    EKF2_COLOUR,
    KF_COLOUR,
    SEVERITY_COLOURS,
    TEXT_COLOUR,
    TRACK_STYLES,
    Axes,
    line_style,
    set_map_axes,
)

LEAD_TEXT = (
    "The closure error is the distance between the end of the odometry and the true end. "
    "px4fuse distributes the error in proportion to the distance from the start (course UAT 366, "
    "module 2, Example 2), or by pose graph optimisation."
)
MAX_LISTED_CLOSURES = 10
ERROR_COLOUR = SEVERITY_COLOURS["error"]
PATH_STYLES = {
    CORRECTION_LABELS["uncorrected"]: TRACK_STYLES["EKF2"],
    CORRECTION_LABELS["by_distance_plain"]: line_style("#79b294", 1.3, (0, (1.2, 1.2))),
    CORRECTION_LABELS["by_distance"]: line_style("#3a7d5c", 1.0, (0, (6, 1.2, 1, 1.2))),
    CORRECTION_LABELS["pose_graph_gated"]: line_style(KF_COLOUR, 1.2),
}
MAP_HEIGHT = 290.0  # points


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the page on loop closure if the flight contains a loop."""
    if isinstance(analysis.loop, Loop):
        page = Page("Appendix: loop closure", LEAD_TEXT)
        _write_page(page, analysis.loop)
        yield page


def draw_report(loop: Loop, results: LoopResults) -> Iterator[Page]:
    """Draw the report page of ``px4fuse loop``."""
    page = Page("Loop closure", LEAD_TEXT)
    write_findings(page, results.findings)
    _write_page(page, loop)
    yield page


def _write_page(page: Page, loop: Loop) -> None:
    """Write closure error, missing corrections, ATE, map, loop closures and RPE."""
    page.write(_describe_closure_error(loop))
    _write_segment(page, loop)
    # The first line of the page already states why the true end of the path is unknown, so this
    # reason is not repeated
    missing_reasons = (
        f"No {correction.what}: {correction.reason}"
        for correction in loop.corrections.values()
        if isinstance(correction, Unavailable) and correction != loop.true_end
    )
    for reason in dict.fromkeys(missing_reasons):
        page.write_muted_text(reason)
    _write_ate(page, loop)
    axes = page.add_panel("Map in the frame of the odometry", MAP_HEIGHT)
    draw_map(axes, loop)
    page.add_legend(axes.get_legend_handles_labels()[0])
    page.write_heading("Loop closures and RPE")
    page.write_muted_text(
        "d²: squared Mahalanobis distance of the error, given drift and closure noise. p: "
        "probability that a true closure has a larger d²; the χ² test rejects p below "
        f"{GATE_ALPHA:g}. Weight of GNC (graduated non-convexity): 1 "
        "for a used closure, 0 for an excluded closure."
    )
    _write_closures(page, loop)
    _write_rpe(page, loop)


def draw_map(axes: Axes, loop: Loop) -> None:
    """Draw the uncorrected and corrected paths from above, and the loop closure error."""
    odometry_path = loop.odometry.trajectory
    axis_names = AXES_OF_FRAME[odometry_path.frame]
    _draw_reference(axes, loop)
    for corrected_path in loop.select_reported_paths():
        track, name = corrected_path.trajectory, corrected_path.name
        if name in PATH_STYLES:
            map_xy_m = track.position_m[:, (1, 0)]
            plot_path(axes, map_xy_m, track.time_s, label=name, **PATH_STYLES[name])
    start, end = odometry_path.position_m[[0, -1]][:, (1, 0)]
    axes.plot(*start, "o", color="black", ms=5, label="start", zorder=5)
    end_label = "end of the odometry path"
    axes.plot(*end, "s", color=EKF2_COLOUR, mec="black", mew=0.6, ms=5, label=end_label, zorder=5)
    if loop.closure_error_axes_m is not None:
        true_end = end - np.array(list(loop.closure_error_axes_m.values()))[[1, 0]]
        label = f"closure error {loop.closure_error_m:.2f} m"
        axes.plot(*np.transpose([end, true_end]), color=ERROR_COLOUR, lw=1.2, label=label)
        axes.plot(*true_end, "x", color=ERROR_COLOUR, ms=5, mew=1.2, zorder=6, label="true end")
    set_map_axes(axes, axis_names[1], axis_names[0])


def _draw_reference(axes: Axes, loop: Loop) -> None:
    """Draw the first reference trajectory in the frame of the odometry."""
    if not loop.references:
        return
    name = loop.references[0].name
    evaluation = loop.choose_best_path().scores.get(name)
    if isinstance(evaluation, Evaluation):
        reference_m = evaluation.transform.apply_inverse(evaluation.reference_position_m)
        line = TRACK_STYLES["ground truth"] | {"label": name, "zorder": 4}
        plot_path(axes, reference_m[:, (1, 0)], evaluation.time_s, **line)


def make_loop_page(loop: Loop, findings: tuple[Finding, ...]) -> Page:
    """Make the terminal output of ``px4fuse loop`` for a trajectory."""
    page = Page()
    page.write(_describe_closure_error(loop))
    _write_closures(page, loop)
    _write_ate(page, loop)
    write_findings(page, findings)
    _write_segment(page, loop)
    return page


def _write_ate(page: Page, loop: Loop) -> None:
    """Write the ATE of each path against each reference, or advice to add a reference."""
    for reference in loop.references:
        page.write(f"ATE against {reference.name} (position RMSE after alignment):")
        for path in loop.select_reported_paths():
            score = path.scores[reference.name]
            text = score.reason if isinstance(score, Unavailable) else format_error(score.ate)
            page.write(f"ATE, {path.name}: {text}")
    if not loop.references:
        page.write_muted_text(
            "The error of the path is unknown. Add a reference trajectory with --reference FILE."
        )


def _write_segment(page: Page, loop: Loop) -> None:
    """Write the source of the true end, and the evaluated part of the odometry."""
    odometry, true_end = loop.odometry.trajectory, loop.true_end
    true_end_text = "not used" if isinstance(true_end, Unavailable) else true_end.source
    page.write_labelled_text("True end", true_end_text)
    page.write_labelled_text(
        "Track",
        f"{odometry.name}, {_format_span(loop)}, {loop.part_reason}: {len(odometry)} poses, "
        f"{loop.key_frames} key frames, spacing {loop.key_frame_spacing_m:.2g} m",
    )


def _write_closures(page: Page, loop: Loop) -> None:
    """Write the result of the χ² test of each loop closure, with rejected closures in red."""
    for closure in loop.closures:
        verb = "accepted" if closure.accepted else "rejected"
        text = (
            f"{capitalise_first_letter(f'{closure}'.removeprefix('the '))}: {verb} by the χ² test "
            f"(error {closure.distance_m:.2f} m, d² {closure.d2:.1f}, "
            f"{closure.degrees_of_freedom} degrees of freedom, {format_p_value(closure.p)})"
        )
        if closure.weight_gnc is not None:
            text += f"; GNC weight {closure.weight_gnc:.2f}"
        page.write(text, colour=TEXT_COLOUR if closure.accepted else ERROR_COLOUR)


def _write_rpe(page: Page, loop: Loop) -> None:
    """Write a table of the RPE of the uncorrected and corrected paths, for each reference."""
    for reference in loop.references:
        page.write_heading(f"RPE against {reference.name}, with 95 % intervals")
        scores = [(path, path.scores[reference.name]) for path in loop.select_reported_paths()]
        notes = [score.reason for _, score in scores if isinstance(score, Unavailable)]
        evaluations = [(path, score) for path, score in scores if isinstance(score, Evaluation)]
        if evaluations:
            # all paths have the same deltas, method and notes
            _, first = evaluations[0]
            deltas = (error.delta_text for error in first.rpe)
            head = ["path", "RMS correction (m)", *deltas, "rotation RMSE (°)"]
            notes += [describe_method(first), *first.notes, *first.warnings]
            page.add_table(head, [_make_rpe_row(*evaluation) for evaluation in evaluations])
        for note in dict.fromkeys(notes):
            page.write_muted_text(capitalise_first_letter(note))


def _make_rpe_row(path: PathResult, evaluation: Evaluation) -> list[str]:
    """Return the table row of a path: correction, RPE over each distance or time, rotation RMSE."""
    # "RMSE m (95 % low to high)" becomes "RMSE m" with "low–high" on a second line, so that the
    # columns are narrow
    error_texts = [
        "–"
        if isinstance(error.translation_m, Unavailable)
        else format_error(error).replace(" (95 % ", "\n").replace(" to ", "–").rstrip(")")
        for error in evaluation.rpe
    ]
    rotation_text = format_rmse(evaluation.ate.rotation_deg)
    return [path.name, f"{path.correction_rms_m:.2f}", *error_texts, rotation_text]


def _format_span(loop: Loop) -> str:
    if loop.start_s > MIN_UNIX_TIME_S:
        return f"{loop.end_s - loop.start_s:.1f} s from timestamp {loop.start_s:.2f} s"
    return f"{loop.start_s:.1f} s to {loop.end_s:.1f} s"


def _describe_closure_error(loop: Loop) -> str:
    """State the loop closure error, its components and the heading error, if they are known."""
    error_m, error_components_m = loop.closure_error_m, loop.closure_error_axes_m
    length_m, heading_error_deg = loop.path_length_m, loop.heading_error_deg
    if error_m is None or error_components_m is None:
        if loop.is_assessed:
            return (
                f"Loop closure error not shown (student assignment); path length {length_m:.1f} m"
            )
        reason = f": {loop.true_end.reason}" if isinstance(loop.true_end, Unavailable) else ""
        return f"Loop closure error unknown{reason}; path length {length_m:.1f} m"
    heading_text = (
        f"heading error unknown: {heading_error_deg.reason}"
        if isinstance(heading_error_deg, Unavailable)
        else f"heading error {heading_error_deg:+.1f}°"
    )
    return (
        f"Loop closure error {error_m:.2f} m after a path of {length_m:.1f} m "
        f"({100.0 * error_m / length_m:.1f} %): {format_vector(error_components_m)}; {heading_text}"
    )


def make_pose_graph_page(graph: Graph) -> Page:
    """Make the terminal output of ``px4fuse loop`` for a solved pose graph."""
    page, gates = Page(), graph.gates
    page.write_labelled_text(
        "Graph",
        f"{graph.name}: {graph.dimension}-D, {graph.poses} poses, {graph.edges} edges; initial "
        f"poses: {graph.initialised}",
    )
    if graph.reduced_chi2_interval[1] > 0.0:  # 0: no degree of freedom, so no statement on the fit
        page.write_labelled_text("Fit", _describe_graph_fit(graph))
    if isinstance(gates, Unavailable):
        page.write_labelled_text("Gate", f"not applied: {gates.reason}")
    elif not gates:
        page.write_labelled_text("Gate", "the graph has no loop closures to test")
    else:
        rejected_closure_texts = [
            f"{gate.first} – {gate.second}: d² {gate.d2:.1f}, p {gate.p:.2g}"
            for gate in gates
            if not gate.accepted
        ]
        count_text = f"{len(rejected_closure_texts)} of {len(gates)} loop closures rejected"
        rejected_closure_lines = join_first_names(
            rejected_closure_texts, MAX_LISTED_CLOSURES, "\n"
        ).split("\n")
        page.write_labelled_text("Gate", count_text, *rejected_closure_lines)
        if len(gates) > MAX_GNC_CLOSURES and len(graph.solutions) == 1:
            page.write_labelled_text(
                "Robust",
                "not solved, because the graph has many loop closures. Add --robust to solve it.",
            )
    for key, solution in graph.solutions.items():
        label = SOLUTION_LABELS[key]
        if not solution.converged:
            not_converged_text = f"not converged: {label}. The cost is not at its minimum."
            page.write_labelled_text("Solver", not_converged_text)
        text = (
            f"{capitalise_first_letter(label)}: cost {solution.cost_initial:.6g} → "
            f"{solution.cost:.6g} in "
            f"{format_count(solution.iterations, 'iteration')}"
        )
        if key != "all":
            text += f"; {format_count(solution.dropped, 'dropped loop closure')}"
        page.write(text)
    return page


def _describe_graph_fit(graph: Graph) -> str:
    """State χ² per degree of freedom, and the cause if it is outside its 95 % interval."""
    chi2, (expected_low, expected_high) = graph.reduced_chi2, graph.reduced_chi2_interval
    cause_text = ""
    if (factor := graph.information_factor) > 1.0:
        cause_text = (
            f"Probable cause: all information matrices are about {format_number(factor, 2)} "
            "times too large. Gate and robust optimisation therefore divide the information "
            "matrices by this factor."
        )
    elif chi2 > expected_high:
        cause_text = (
            "χ² is too large. Possible causes: false closures, or information matrices "
            "that are too large."
        )
    elif chi2 < expected_low:
        cause_text = (
            "The information matrices are too small, so the gate may accept false closures."
        )
    return (
        f"χ² per degree of freedom {format_number(chi2)} (expected "
        f"{format_number(expected_low)} to {format_number(expected_high)}, 95 %). {cause_text}"
    )
