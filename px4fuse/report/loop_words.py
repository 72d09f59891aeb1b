"""What there is to say about a loop, for the terminal and the PDF."""

from __future__ import annotations

from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.loop.corrections import SINGLE_LOOP
from px4fuse.loop.loop import Loop
from px4fuse.loop.model import LANDING, Closure, CorrectedPath
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.analysis import GATE_ALPHA
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import Interval, Statistics

KINDS = {
    "vio": "odometry (external vision)",
    "ekf2": "EKF2's track",
    "kf": "our filter's track",
    "truth": "ground truth",
    "slam": "a SLAM system's trajectory",
    "unknown": "a trajectory",
}


def loop_lines(loop: Loop) -> list[tuple[str, str]]:
    """Label and sentence, in the order of interest."""
    path = loop.odometry.trajectory
    lines = [
        (
            "Track",
            f"{path.name}: {KINDS[path.kind]}, {len(path)} poses, {loop.key_frames} key frames "
            f"{loop.key_frame_spacing_m:.2g} m apart",
        ),
        ("Part", f"{_span(loop)}, {loop.part_reason}"),
        ("Closure", closure_words(loop)),
        ("End", "not used" if isinstance(loop.known_end, Unavailable) else loop.known_end.source),
    ]
    lines += [("Gate", gate_words(closure)) for closure in loop.closures[:1]]
    return lines


def _span(part: Loop) -> str:
    if part.start_s > SMALLEST_STAMP_S:
        return f"{part.end_s - part.start_s:.1f} s from stamp {part.start_s:.2f} s"
    return f"{part.start_s:.1f} s to {part.end_s:.1f} s"


def closure_words(loop: Loop) -> str:
    """The closure error in m, in percent, per axis and in heading."""
    error, misclosure = loop.closure_error_m, loop.closure_error_axes_m
    if error is None or misclosure is None:
        return f"path {loop.path_length_m:.1f} m; no closure error is stated: it did not come back"
    text = (
        f"{error:.2f} m after {loop.path_length_m:.1f} m = {error / loop.path_length_m:.2%} "
        f"({', '.join(f'{name} {part:+.2f} m' for name, part in misclosure.items())})"
    )
    turned = loop.heading_error_deg
    if isinstance(turned, Unavailable):
        return f"{text}; heading: not known, {turned.reason}"
    return f"{text}; heading {turned:+.1f}°"


def gate_words(closure: Closure) -> str:
    """What the gate says about one closure."""
    verdict = (
        "as the stated drift allows"
        if closure.accepted
        else "REJECTED: the drift cannot explain it"
    )
    return (
        f"d² {closure.d2:.1f} with {closure.degrees_of_freedom} degrees of freedom, p "
        f"{closure.p:.2g} (rejected below {GATE_ALPHA:g}): {verdict}"
    )


def closure_name(closure: Closure, loop: Loop) -> str:
    """Which closure; long stamps count from the first pose."""
    if closure.source == LANDING:
        return "take-off and landing"
    start = loop.start_s
    zero = start if start > SMALLEST_STAMP_S else 0.0
    return f"{closure.time_1_s - zero:.2f} s and {closure.time_2_s - zero:.2f} s"


def by_distance_words(loop: Loop) -> str:
    """What the corrections by distance are; nothing where there is none."""
    if "by_distance_plain" not in loop.paths:
        return ""
    example = (
        "By distance, positions only, is the lesson's Example 2: each position moves by its share "
        "of the gap, and the path keeps the bend of its headings."
    )
    turned = loop.heading_error_deg
    if isinstance(turned, Unavailable):
        return f"{example} Headings are not turned: {turned.reason}."
    return (
        f"{example} Headings too: each step is first turned back by its share of the {turned:+.1f}°"
        " that the heading is off at the end, and what is left of the gap is spread as before."
    )


def redundancy_words(loop: Loop) -> str:
    """That one loop has no redundancy, or nothing."""
    return SINGLE_LOOP if len(loop.closures) == 1 else ""


def refusals(loop: Loop) -> list[str]:
    """Why a correction is missing, each reason once."""
    parts = loop.corrections.values()
    reasons = [f"{p.what}: {p.reason}" for p in parts if isinstance(p, Unavailable)]
    return [r for r in dict.fromkeys(reasons) if SINGLE_LOOP not in r]


def unscored(loop: Loop) -> list[str]:
    """Why a reference scores nothing, each reason once."""
    reasons = [
        f"{name}: {score.reason}"
        for part in loop.reported
        for name, score in part.scores.items()
        if isinstance(score, Unavailable)
    ]
    return list(dict.fromkeys(reasons))


def ate_words(score: Evaluation | Unavailable) -> str:
    """RMSE of the ATE in m, with its interval where there is one."""
    if isinstance(score, Unavailable):
        return "–"
    return f"{score.ate.translation_m.rmse:.3f}{interval_words(score.ate.interval_m)}"


def interval_words(interval: Interval | Unavailable) -> str:
    """An interval in brackets; nothing where there is none."""
    return f" ({interval.low:.3f}–{interval.high:.3f})" if isinstance(interval, Interval) else ""


def statistics_words(
    moved: Statistics | Unavailable,
    interval: Interval | Unavailable,
    turned: Statistics | Unavailable,
) -> list[str]:
    """RMSE, its interval, RMSE of rotation, and how many errors: cells of a table."""
    return [
        f"{moved.rmse:.3f}" if isinstance(moved, Statistics) else "–",
        f"{interval.low:.3f} – {interval.high:.3f}" if isinstance(interval, Interval) else "–",
        f"{turned.rmse:.2f}" if isinstance(turned, Statistics) else "–",
        f"{moved.count}" if isinstance(moved, Statistics) else "",
    ]


def moved_words(correction: CorrectedPath) -> str:
    """How far the poses moved."""
    if not correction.moved_max_m:
        return "–"
    return f"{correction.moved_rms_m:.2f} / {correction.moved_max_m:.2f}"


def track_words(path: Trajectory) -> str:
    """A trajectory by its name, what it is, its length in time and its frame."""
    return (
        f"{path.name}: {path.kind}, {len(path)} poses over "
        f"{path.time_s[-1] - path.time_s[0]:.1f} s, frame {path.frame}"
    )


def score_words(score: Evaluation) -> str:
    """How a score was made, in one sentence."""
    matched = score.association
    offset = score.time_offset.offset_s
    clock = "" if not offset else f"; clocks matched by {offset:+.3f} s"
    return (
        f"alignment {score.alignment} ({score.alignment_reason.rstrip('.')}); "
        f"{matched.poses} poses, "
        f"{matched.coverage_estimate:.0%} of the estimate, {matched.coverage_reference:.0%} of the "
        f"reference's time{clock}"
    )
