"""Appendix: the clock. Its page when there is something to say, else a line of provenance."""

from collections.abc import Iterable, Iterator

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.remedy import aid_of, delay_ms
from px4fuse.filter.clock import MAX_CHANGE_P, ClockOffset
from px4fuse.findings import Finding
from px4fuse.findings.source_clock import typed_offset_s
from px4fuse.flight import Unavailable
from px4fuse.plain import format_p_value
from px4fuse.report import say
from px4fuse.report.page import Page, legend_above
from px4fuse.report.style import KF_BAND_COLOUR, KF_LINE, Axes
from px4fuse.results.contract import ComparisonResults

CURVE_HEIGHT = 170.0  # height of the axes in points
# Beyond this the curve tells nothing more
MAX_DROP = 12.0
# How many intervals the curve is drawn over, to either side
CURVE_REACH = 2.5
# One update of EKF2 (EKF2_PREDICT_US)
NEGLIGIBLE_S = 0.010
# What is said about the clock in a finding has its page
CLOCK_FINDINGS = ("source_clock_changes", "source_clock_offset", "ekf2_ev_delay_wrong")


def summary_line(analysis: Analysis, findings: Iterable[Finding]) -> str:
    """What the clock estimate says, in one line."""
    if has_page(analysis, findings):
        return "see its page"
    advice = clock_advice(analysis, analysis.clock)
    return "; ".join(advice[label] for label in ("Reading", "Offset") if label in advice)


def has_page(analysis: Analysis, findings: Iterable[Finding]) -> bool:
    """Whether the flight says more about the clock than that it is right."""
    clock = analysis.clock
    if isinstance(clock, Unavailable):
        return False
    return not clock.determinable or any(one.id in CLOCK_FINDINGS for one in findings)


def clock_advice(comparison: Comparison, clock: ClockOffset | Unavailable) -> dict[str, str]:
    """What the clock estimate says, and what follows from it, as labels and sentences."""
    if isinstance(clock, Unavailable):
        return {"Offset": f"not determinable: {clock.reason}. {clock.remedy}"}
    if not clock.determinable:
        return {
            "Offset": f"not determinable: {clock.reason}.",
            "Next": "fly passes of 5 m or more with clear starts and stops.",
        }
    offset, (low, high) = clock.offset_s, clock.interval_s
    advice = {
        "Offset": say("clock_offset", offset=offset, low=low, high=high),
        "Reading": "the stamps are right as far as this flight can tell",
    }
    if not (low <= 0.0 <= high or abs(offset) < NEGLIGIBLE_S):
        side = "late" if offset < 0.0 else "early"
        advice["Reading"] = f"the stamps are {side} by {abs(offset):.3f} s"
        typed = typed_offset_s(comparison, clock)
        advice["Re-run"] = f"px4fuse compare LOG --clock-offset {typed:.3f}"
    delay, name = delay_ms(comparison), aid_of(comparison).delay
    age_s = comparison.source.age_s
    least, most = age_s - high, age_s - low
    if delay is not None and least - NEGLIGIBLE_S <= delay * 1e-3 <= most + NEGLIGIBLE_S:
        advice["PX4"] = f"{name} {delay:g} ms fits"
    elif delay is not None and offset > age_s and delay <= 0.0:
        advice["PX4"] = f"{name} is 0 ms and cannot be negative: correct the sender's clock"
    elif delay is not None:
        ml_delay_ms, least, most = (max(1e3 * s, 0.0) for s in (age_s - offset, least, most))
        advice["PX4"] = say(
            "delay_asked", name=name, delay=delay, asked=ml_delay_ms, least=least, most=most
        )
    if clock.change_p is not None and clock.change_p < MAX_CHANGE_P:
        offset_texts = ", ".join(f"{p.offset_s:+.2f} s from {p.start_s:.0f} s" for p in clock.parts)
        advice["Changes"] = (
            f"the offset is not the same throughout ({format_p_value(clock.change_p)}): {offset_texts}"
        )
    if clock.drift_ppm is not None and clock.drift_sigma_ppm is not None:
        advice["Drift"] = f"{clock.drift_ppm:+.0f} ± {1.96 * clock.drift_sigma_ppm:.0f} ppm"
    return advice


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw one page; none where a line says it all."""
    clock = analysis.clock
    if isinstance(clock, Unavailable) or not has_page(analysis, results.findings):
        return
    page = Page("Appendix: the clock of the position source", say("clock"))
    page.advice(clock_advice(analysis, clock), size=8.5)
    (low, high), best = clock.interval_s, clock.offset_s
    curve_sentence = say("clock_best", best=best, low=low, high=high, clock=clock)
    title = "ln of how much less likely each offset is than the best"
    draw_curve(page.panel(title, curve_sentence, CURVE_HEIGHT, above=14.0), clock)
    yield page


def draw_curve(axes: Axes, clock: ClockOffset) -> None:
    """Likelihood over the offset."""
    (low, high), best, applied = clock.interval_s, clock.offset_s, clock.applied_s
    axes.axvspan(low, high, color=KF_BAND_COLOUR, lw=0, label="95 % interval")
    axes.plot(clock.curve_s, clock.curve_drop, **KF_LINE)
    axes.axvline(applied, color="black", lw=0.8, ls="--", label="as analysed")
    axes.set_ylim(min(MAX_DROP, float(clock.curve_drop.max()) * 1.05), 0.0)
    reach = CURVE_REACH * max(high - best, best - low)
    ends = clock.curve_s[0], clock.curve_s[-1]
    axes.set_xlim(
        min(max(best - reach, ends[0]), applied - 0.1 * reach),
        max(min(best + reach, ends[1]), applied + 0.1 * reach),
    )
    axes.set_xlabel("offset added to the source's stamps (s)")
    legend_above(axes)
