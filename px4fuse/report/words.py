"""Phrases that the terminal and the PDF share."""

from __future__ import annotations

from px4fuse.consistency import Consistency
from px4fuse.flight import Alignment, ClockMap, Unavailable
from px4fuse.kalman import Settings


def settings_words(settings: Settings) -> str:
    """The filter's settings in one phrase."""
    offset = f", clock offset {settings.clock_offset_s:+g} s" if settings.clock_offset_s else ""
    return (
        f"SIGMA_A {settings.sigma_a_m_s2:g} m/s², SIGMA_Z {settings.sigma_z_m:g} m, "
        f"DT {settings.dt_s:g} s, input {settings.input}{offset}"
    )


def verdict_words(statement: Consistency | Unavailable) -> str:
    """Verdict with its factor, or why there is none."""
    if isinstance(statement, Unavailable):
        return "not available"
    if statement.verdict == "consistent":
        return "consistent"
    factor = max(statement.variance_factor, 1.0 / statement.variance_factor)
    return f"{statement.verdict.removeprefix('variance ')} {factor:.3g}×"


def clock_words(clock: ClockMap) -> str:
    """How one clock was mapped to the autopilot's, with its figures."""
    if clock.method == "boot clock" or clock.distinct_stamps is not None:
        return f"{clock.clock}: {clock.note}"
    return (
        f"{clock.clock} by {clock.method}: offset {clock.offset_s:+.4f} s, drift "
        f"{clock.drift_ppm:+.3g} ppm, jitter {clock.jitter_s * 1e3:.2g} ms, {clock.pairs} pairs"
        + (f"; {clock.note}" if clock.note else "")
    )


def alignment_words(alignment: Alignment) -> list[tuple[str, str]]:
    """How a position file was placed into the flight: labels and sentences."""
    yaw_sigma, clock_sigma = alignment.yaw_sigma_deg, alignment.clock_offset_sigma_s
    north, east, down = alignment.origin_m
    lines = [
        ("frame", f"{alignment.frame} ({alignment.frame_reason})"),
        (
            "yaw",
            f"{alignment.yaw_deg:.2f}°"
            + (f" ± {yaw_sigma:.2f}°" if yaw_sigma is not None else "")
            + f" ({alignment.yaw_reason})",
        ),
        ("origin", f"north {north:.3f} m, east {east:.3f} m, down {down:.3f} m"),
        (
            "clock",
            f"{alignment.clock_offset_s:+.3f} s"
            + (f" ± {clock_sigma:.3f} s" if clock_sigma is not None else "")
            + f" to the boot clock ({alignment.clock_reason})",
        ),
    ]
    if alignment.correlation is not None:
        residual = alignment.residual_rms_m
        lines.append(
            (
                "match",
                f"correlation {alignment.correlation:.4f} with {alignment.reference}"
                + (f", {residual:.3f} m RMS per axis" if residual is not None else ""),
            )
        )
    return lines
