"""What there is to say about the errors of a trajectory, panel by panel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from px4fuse.arrays import Array
from px4fuse.flight import Unavailable
from px4fuse.loop.analysis import SMALLEST_STAMP_S
from px4fuse.report.loop_words import interval_words, score_words, track_words
from px4fuse.report.page import Page
from px4fuse.report.style import SEVERITY_COLOURS
from px4fuse.trajectory.evaluation import AbsoluteError, Evaluation
from px4fuse.trajectory.scores import PairwiseError, Statistics

# Above this share of the squared error the worst tenth of the poses is what there is to look at
FEW_DECIDE = 0.5
# Quarters of a path differ if one is so many times the other
DIFFERS = 1.3
# Rounding: no error to say anything about
NEGLIGIBLE_M = 1e-6
SCORE_HEAD = (
    "error", "RMSE", "95 %", "mean", "median", "std", "max", "n", "rotation\nRMSE (°)",
)  # fmt: skip


def metres(value: float) -> str:
    """A length with the digits that matter.

    >>> metres(0.0512), metres(31.26)
    ('0.051 m', '31.3 m')
    """
    return f"{value:.3f} m" if abs(value) < 10.0 else f"{value:.1f} m"


def zero_s(score: Evaluation) -> float:
    """Where times on the page count from: the first pose where stamps are UNIX time, else zero."""
    start = float(score.time_s[0])
    return start if start > SMALLEST_STAMP_S else 0.0


def summary(score: Evaluation) -> str:
    """The score in one sentence."""
    worst = int(np.argmax(score.position_error_m))
    return (
        f"{score.estimate.name} is {metres(score.ate.translation_m.rmse)} (RMSE) from "
        f"{score.reference.name} {_aligned(score)}; farthest, "
        f"{metres(score.ate.translation_m.max)}, at {score.time_s[worst] - zero_s(score):.1f} s, "
        f"{score.distance_m[worst]:.1f} m along."
    )


def _aligned(score: Evaluation) -> str:
    return "without alignment" if score.alignment == "none" else "after alignment"


def write_evaluation(page: Page, score: Evaluation) -> None:
    """Write what was scored and how, and the statistics of all errors."""
    page.labelled("Estimate", track_words(score.estimate))
    page.labelled("Against", track_words(score.reference))
    page.labelled("How", score_words(score))
    for text in score.warnings:
        page.write(text, bold=True, colour=SEVERITY_COLOURS["warning"])
    page.table(SCORE_HEAD, score_rows(score), right=range(1, len(SCORE_HEAD)))
    page.numbers(" ".join([*reasons(score), *score.notes]))


def score_rows(score: Evaluation) -> list[list[str]]:
    """Of the ATE and every RPE: what :data:`SCORE_HEAD` says."""
    errors: dict[str, AbsoluteError | PairwiseError] = {"ATE (m)": score.ate}
    errors |= {f"RPE {error.delta_words} (m)": error for error in score.rpe}
    rows = []
    for name, error in errors.items():
        moved, turned = error.translation_m, error.rotation_deg
        cells = ["–", *[""] * 6]
        if isinstance(moved, Statistics):
            numbers = (moved.mean, moved.median, moved.std, moved.max)
            cells = [f"{moved.rmse:.4f}", interval_words(error.interval_m)]
            cells += [*(f"{number:.4f}" for number in numbers), f"{moved.count}"]
        rows.append([name, *cells, f"{turned.rmse:.2f}" if isinstance(turned, Statistics) else "–"])
    return rows


def reasons(score: Evaluation) -> list[str]:
    """Why a number is missing, each reason once."""
    parts = [score.ate.interval_m, score.ate.rotation_deg, *(e.translation_m for e in score.rpe)]
    missing = [part for part in parts if isinstance(part, Unavailable)]
    return list(dict.fromkeys(f"No {part.what}: {part.reason}." for part in missing))


def before_words(score: Evaluation) -> str:
    """How far the two are apart as their numbers stand, and what the alignment took away."""
    x, y = score.association.estimate.position_m, score.association.reference.position_m
    apart = float(np.sqrt(((x - y) ** 2).sum(axis=1).mean()))
    fitted = score.transform
    scaled = f", scaled {fitted.scale:.3g} times" if fitted.degrees_of_freedom == 7 else ""
    moved = float(np.linalg.norm(fitted.apply(x.mean(axis=0)) - x.mean(axis=0)))
    return (
        f"As they stand {metres(apart)} apart (RMSE). Turned by "
        f"{np.degrees(fitted.rotation.magnitude()):.1f}°, moved {metres(moved)}{scaled}: a choice "
        "of frame, no error."
    )


def after_words(score: Evaluation) -> str:
    """What the map shows."""
    worst = int(np.argmax(score.position_error_m))
    return (
        f"{metres(score.ate.translation_m.rmse)} (RMSE) {_aligned(score)}. The darker the path, "
        f"the larger its error; × is the largest, {metres(score.ate.translation_m.max)} at "
        f"{score.time_s[worst] - zero_s(score):.1f} s."
    )


def time_words(score: Evaluation) -> str:
    """Whether a few moments decide."""
    squares = np.sort(score.position_error_m**2)
    total = float(squares.sum())
    if score.ate.translation_m.rmse < NEGLIGIBLE_M:
        return "There is no error at any time."
    share = float(squares[-max(1, len(squares) // 10) :].sum()) / total
    said = (
        "a few moments decide, look at these" if share > FEW_DECIDE
        else "it is spread over time, and no matter of a few moments"
    )  # fmt: skip
    return f"The worst tenth of the poses makes {share:.0%} of the squared error: {said}."


def quarters(score: Evaluation) -> list[float]:
    """RMSE over each quarter of the reference's path (m); fewer where one has no pose."""
    along = score.distance_m
    edges = np.linspace(0.0, along[-1], 5)
    parts = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, 3)
    errors = [score.position_error_m[parts == part] for part in range(4)]
    return [float(np.sqrt(np.mean(e**2))) for e in errors if len(e)]


def distance_words(score: Evaluation) -> str:
    """Whether the error grows along the path."""
    found = quarters(score)
    said = f"RMSE by quarters of the path {', '.join(f'{q:.3f}' for q in found)} m: "
    if len(found) < 4:
        return f"{said}the poses do not cover all of it."
    if score.ate.translation_m.rmse < NEGLIGIBLE_M:
        return f"{said}there is no error."
    first, *middle, last = found
    if min(first, last) > DIFFERS * max(middle):
        return f"{said}high at both ends, as drift looks after an alignment."
    if all(a <= b for a, b in pairwise(found)) and last > DIFFERS * first:
        return f"{said}it grows along the path, as drift does."
    where = ("first", "second", "third", "last")[int(np.argmax(found))]
    return f"{said}largest in the {where}, no steady growth as a drift from the start has."


def relative_words(shown: list[PairwiseError], times: Array, zero: float) -> str:
    """Where the motion itself is worst."""
    last = shown[-1]
    worst = int(np.argmax(last.translation_error_m))
    return (
        "What a motion over the delta is wrong by, wherever the path was before, drawn at its end: "
        f"a peak is where it went wrong. Largest over {last.delta}: "
        f"{metres(float(last.translation_error_m[worst]))}, from "
        f"{times[last.start[worst]] - zero:.1f} to {times[last.end[worst]] - zero:.1f} s."
    )


def growth_words(rpe: tuple[PairwiseError, ...]) -> str:
    """How the RPE grows with its delta, which tells noise from drift."""
    boxes = "Box: middle half; whiskers: all; diamond: RMSE with its 95 % interval."
    by_unit: dict[str, list[tuple[float, float]]] = {}
    for error in rpe:
        if isinstance(error.translation_m, Statistics) and error.translation_m.rmse > NEGLIGIBLE_M:
            by_unit.setdefault(error.unit, []).append((error.delta, error.translation_m.rmse))
    several = max(by_unit.values(), key=len, default=[])
    (low, small), (high, large) = min(several, default=(0, 0)), max(several, default=(0, 0))
    if not low < high:
        return f"{boxes} A second distance would tell noise from drift."
    ratio = high / low
    unit = next(unit for unit, found in by_unit.items() if found is several)
    return (
        f"{boxes} From {low:g} to {high:g} {unit}, {ratio:.3g} times, the RMSE is "
        f"{large / small:.2g} times as large: 1 is noise of each pose, {np.sqrt(ratio):.2g} a "
        f"random walk, {ratio:.3g} a wrong scale or heading."
    )
