"""Clock: the offset of the position source's stamps, how sure it is, and whether it changed."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.figure import Figure

from px4fuse.flight import Unavailable
from px4fuse.report.document import Document
from px4fuse.report.style import LEFT, OURS, OURS_BAND, OURS_LINE, RIGHT, caption, page
from px4fuse.report.words import clock_advice

HEIGHT = 0.24
# Beyond this the curve tells nothing more
MAX_DROP = 12.0


def draw(document: Document) -> Iterator[Figure]:
    """Draw one page."""
    comparison = document.comparison
    clock = document.analysis.clock
    figure, cursor = page(
        "Clock",
        "Late or early stamps hardly show in the innovations, since the filter follows. They show "
        "in when the positions answer to what the IMU felt. So the likelihood of the positions is "
        "maximised over the offset, jointly with sensor biases, attitude errors and noises; the "
        "attitude is from the gyros alone, because EKF2's was corrected by these very positions.",
    )
    for line in clock_advice(comparison, clock):
        cursor.write(line, size=8.5)
        cursor.skip(1)
    if isinstance(clock, Unavailable):
        yield figure
        return
    applied = comparison.settings.clock_offset_s
    cursor.skip(20)
    bottom = cursor.y - HEIGHT
    axes = figure.add_axes((LEFT + 0.03, bottom, RIGHT - LEFT - 0.03, HEIGHT))
    axes.set_title("log-likelihood below its maximum, against the offset")
    axes.axvspan(applied + clock.interval_s[0], applied + clock.interval_s[1], color=OURS_BAND,
                 lw=0, label="95 % interval")  # fmt: skip
    axes.plot(applied + clock.curve_s, clock.curve_drop, **OURS_LINE)
    axes.axhline(clock.interval_drop, color="black", lw=0.6, ls=":")
    axes.axvline(applied, color="black", lw=0.8, ls="--", label="as analysed")
    axes.set_ylim(min(MAX_DROP, float(clock.curve_drop.max()) * 1.05), 0.0)
    axes.set_xlabel("offset added to the source's stamps (s)")
    axes.legend(loc="lower left")
    low, high = clock.interval_s
    caption(
        axes,
        f"most likely {applied + clock.offset_s:+.3f} s, 95 % {applied + low:+.3f} to "
        f"{applied + high:+.3f} s, from {clock.count} measurements. Dotted: where the "
        "interval ends, with the noise of the IMU counted",
    )
    if clock.parts:
        bottom -= HEIGHT + 0.09
        axes = figure.add_axes((LEFT + 0.03, bottom, RIGHT - LEFT - 0.03, HEIGHT))
        axes.set_title("offset of each part of the flight by itself (s)")
        axes.axhspan(applied + low, applied + high, color=OURS_BAND, lw=0)
        for part in clock.parts:
            middle = (part.start_s + part.end_s) / 2.0
            axes.errorbar(
                middle, applied + part.offset_s, xerr=(part.end_s - part.start_s) / 2.0,
                yerr=1.96 * part.sigma_s, fmt="o", color=OURS, ms=4, lw=1.0, capsize=2,
            )  # fmt: skip
        axes.set_xlabel("time since first data (s)")
        change = (
            "one part only: nothing to compare"
            if clock.change_p is None
            else f"p {clock.change_p:.2g} for one and the same offset throughout"
        )
        drift = (
            ""
            if clock.drift_ppm is None or clock.drift_sigma_ppm is None
            else f"; drift {clock.drift_ppm:+.0f} ± {1.96 * clock.drift_sigma_ppm:.0f} ppm"
        )
        caption(axes, f"{change}{drift}. Band: 95 % interval of the whole flight.")
    yield figure
