"""Phrases that the terminal and the PDF share."""

from __future__ import annotations

from px4fuse.consistency import Consistency
from px4fuse.flight import Unavailable
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
