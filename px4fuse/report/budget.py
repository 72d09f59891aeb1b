"""Difference budget: how much of the difference to EKF2 each cause explains, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from px4fuse.comparison.budget import Budget, Effect, Fit
from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import (
    BOTTOM,
    LEFT,
    MUTED,
    OURS,
    OURS_BAND,
    POINTS_PER_HEIGHT,
    RIGHT,
    Cursor,
    page,
)

AXES_PER_PAGE = 2
ROW_POINTS = 13.0
LABELS = 0.17  # of the page's width, for the names of the causes
GAP = 0.03
# Room right of the longest bar for its numbers, in bars
ROOM = 0.75
SMALLEST_SHARE = 0.005


def draw(document: Document) -> Iterator[Figure]:
    """Draw as many axes on a page as fit, at most two; none where the budget was not made."""
    started = None
    on_page = 0
    for name, budget in document.analysis.budget.items():
        if started is not None and (
            on_page == AXES_PER_PAGE or started[1].y - _height(started[1], budget) < BOTTOM
        ):
            yield started[0]
            started = _started(" (continued)")
            on_page = 0
        started = started or _started("")
        figure, cursor = started
        on_page += 1
        cursor.skip(6)
        if isinstance(budget, Unavailable):
            cursor.write(f"{name}: no budget", size=9.5, weight="bold")
            cursor.write(f"{budget.reason}. {budget.remedy}", colour=MUTED)
        else:
            _axis(figure, cursor, name, budget)
    if started is not None:
        yield started[0]


def _started(continued: str) -> tuple[Figure, Cursor]:
    return page(
        f"Difference budget{continued}",
        "Our filter is replayed with one thing made like EKF2's. Where the bar is shorter than "
        "the dashed line, that thing explains part of the difference (its share of the mean "
        "square); where it is longer, it hides another cause. A square is everything made like "
        "EKF2's but that one: the further right of the lowest bar, the more it matters. Shares "
        "overlap and do not add up.",
    )


def _height(cursor: Cursor, budget: Budget | Unavailable) -> float:
    """Height that an axis takes, as a fraction of the page."""
    heading = cursor.height("heading", size=9.5) + 6.0 / POINTS_PER_HEIGHT
    if isinstance(budget, Unavailable):
        return heading + cursor.height(f"{budget.reason}. {budget.remedy}")
    reading = _reading(budget)
    words = sum(cursor.height(sentence, size=8.0) for sentence in reading)
    words += sum(cursor.height(line, size=7.0) for line in _made(budget))
    gaps = 16.0 + 20.0 + len(reading) + 2.0
    return heading + words + (gaps + ROW_POINTS * (len(_rows(budget)) + 1)) / POINTS_PER_HEIGHT


@dataclass(frozen=True)
class _Bar:
    """One row: its label, its effect (None for the filter as set), its colour and hatch."""

    label: str
    effect: Effect | None
    colour: str
    hatch: str = ""


def _rows(budget: Budget) -> list[_Bar]:
    bars = [_Bar("ours as set", None, OURS)]
    bars += [
        _Bar(cause, effect, OURS_BAND)
        for cause, effect in budget.causes.items()
        if isinstance(effect, Effect)
    ]
    bars.append(_Bar("all of these together", budget.together, OURS))
    if isinstance(budget.clock, Effect):
        bars.append(_Bar("clock offset removed", budget.clock, "white", "////"))
    return bars


def _axis(figure: Figure, cursor: Cursor, name: str, budget: Budget) -> None:
    cursor.write(f"{name}: RMS difference to EKF2, {budget.count} samples", size=9.5, weight="bold")
    bars = _rows(budget)
    height = ROW_POINTS * (len(bars) + 1) / POINTS_PER_HEIGHT
    cursor.skip(16)
    width = (RIGHT - LEFT - LABELS - GAP) / 2.0
    for column, (title, of, share_of) in enumerate(_QUANTITIES):
        left = LEFT + LABELS + column * (width + GAP)
        axes = figure.add_axes((left, cursor.y - height, width, height))
        axes.set_title(title)
        _bars(axes, bars, budget.baseline, of, share_of)
        if column:
            axes.set_yticklabels([])
    cursor.y -= height
    cursor.skip(20)
    for sentence in _reading(budget):
        cursor.write(sentence, size=8.0)
        cursor.skip(1)
    cursor.skip(2)
    for line in _made(budget):
        cursor.write(line, size=7.0, colour=MUTED)


_QUANTITIES: tuple[tuple[str, Callable[[Fit], float], Callable[[Effect], float]], ...] = (
    ("position (m)", lambda fit: fit.position_rms_m, lambda effect: effect.position_share),
    ("velocity (m/s)", lambda fit: fit.velocity_rms_m_s, lambda effect: effect.velocity_share),
)


def _bars(
    axes: Axes,
    bars: list[_Bar],
    baseline: Fit,
    of: Callable[[Fit], float],
    share_of: Callable[[Effect], float],
) -> None:
    longest = max(_ends(bar, baseline, of) for bar in bars)
    for row, bar in enumerate(bars):
        value = of(baseline if bar.effect is None else bar.effect.alone)
        axes.barh(row, value, height=0.68, color=bar.colour, edgecolor=OURS, lw=0.6,
                  hatch=bar.hatch)  # fmt: skip
        if bar.effect is not None and bar.effect.without is not None:
            axes.plot(of(bar.effect.without), row, marker="s", ms=3.6, mfc="white", mec="black",
                      mew=0.8, ls="none")  # fmt: skip
        words = f"{value:.3f}"
        if bar.effect is not None:
            words += f" {share_words(share_of(bar.effect))}"
        axes.text(1.05 * longest, row, words, va="center", size=6.5)
    axes.axvline(of(baseline), color="black", lw=0.7, ls=(0, (3, 2)))
    axes.set_yticks(range(len(bars)), [bar.label for bar in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(0.0, (1.0 + ROOM) * longest)
    axes.set_xticks([tick for tick in MaxNLocator(4).tick_values(0.0, longest) if tick <= longest])
    axes.grid(visible=False)


def _ends(bar: _Bar, baseline: Fit, of: Callable[[Fit], float]) -> float:
    """Right end of what is drawn in a row."""
    if bar.effect is None:
        return of(baseline)
    without = bar.effect.without
    return max(of(bar.effect.alone), 0.0 if without is None else of(without))


def share_words(share: float) -> str:
    """What a share of the mean square difference means."""
    if share >= SMALLEST_SHARE:
        return f"explains {share:.0%}"
    return "changes nothing" if share > -SMALLEST_SHARE else "makes it larger"


def _reading(budget: Budget) -> list[str]:
    """What is left over, and which filter is closer to the truth and why."""
    base, left = budget.baseline, budget.together
    lines = [
        f"By itself, {_largest(budget, lambda effect: effect.position_share)} in position and "
        f"{_largest(budget, lambda effect: effect.velocity_share)} in velocity.",
        f"Left over with all of them: {left.alone.position_rms_m:.3f} m of "
        f"{base.position_rms_m:.3f} m in position, which {share_words(left.position_share)}, and "
        f"{left.alone.velocity_rms_m_s:.3f} m/s of {base.velocity_rms_m_s:.3f} m/s in velocity, "
        f"which {share_words(left.velocity_share)}. Not replayed are EKF2's other sensors, its "
        "uncertain biases and attitude, and the smoothing of its output (EKF2_TAU_POS and "
        "EKF2_TAU_VEL).",
    ]
    if isinstance(budget.truth, Unavailable):
        return [*lines, f"Which is closer to the truth: {budget.truth.reason}."]
    return [*lines, *budget.truth.reasons]


def _largest(budget: Budget, share_of: Callable[[Effect], float]) -> str:
    shares = {
        name: share_of(effect)
        for name, effect in budget.causes.items()
        if isinstance(effect, Effect)
    }
    name = max(shares, key=lambda cause: shares[cause])
    if shares[name] < SMALLEST_SHARE:
        return "nothing explains any of it"
    return f"{name} explains most ({shares[name]:.0%})"


def _made(budget: Budget) -> list[str]:
    """What was made like EKF2's, and what could not be, by reason."""
    lines = []
    reasons: dict[str, list[str]] = {}
    for name, effect in (*budget.causes.items(), ("clock offset removed", budget.clock)):
        if isinstance(effect, Effect):
            lines.append(f"{name}: {effect.made}")
        else:
            reasons.setdefault(effect.reason, []).append(name)
    return lines + [
        f"{', '.join(names)}: not replayed, {reason}" for reason, names in reasons.items()
    ]
