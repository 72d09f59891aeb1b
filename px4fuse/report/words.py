"""Phrases that the terminal and the PDF share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from px4fuse.comparison.model import AgainstTruth, Comparison, Difference
from px4fuse.filter.clock import CHANGE_P, ClockOffset
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings import Finding
from px4fuse.findings.source_clock import typed_offset_s
from px4fuse.findings.variance import VARIANCE_FACTOR
from px4fuse.flight import Alignment, Unavailable
from px4fuse.plain import factor_words, number_words, p_words
from px4fuse.recording import ClockMap

# One update of EKF2 (EKF2_PREDICT_US)
NEGLIGIBLE_OFFSET_S = 0.010
# Below, "white" is wrong: of the eight verdicts of a flight one in a hundred by chance
WHITE_P = 0.001


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
    return f"{_side(statement)} {factor_words(_factor(statement))}×"


@dataclass(frozen=True)
class VerdictCells:
    """Mean NIS, its band and the verdict, as every table shows them."""

    nis: str
    band: str
    words: str


def statement_cells(statement: Consistency | Unavailable) -> VerdictCells:
    """A verdict and its numbers, empty where there is none."""
    words = verdict_words(statement)
    if isinstance(statement, Unavailable):
        return VerdictCells("", "", words)
    low, high = statement.nis_band
    return VerdictCells(number_words(statement.nis_mean), f"{low:.2f} – {high:.2f}", words)


def error_cells(truth: AgainstTruth | Unavailable) -> tuple[str, str]:
    """RMSE of position (m) and velocity (m/s) to the truth, empty where there is none."""
    if isinstance(truth, Unavailable):
        return "", ""
    velocity = truth.velocity_rmse_m_s
    return f"{truth.position_rmse_m:.3f}", "" if velocity is None else f"{velocity:.3f}"


def difference_cells(difference: Difference | Unavailable) -> tuple[str, str]:
    """RMSE of position (m) and velocity (m/s) of ours against EKF2, empty where there is none."""
    if isinstance(difference, Unavailable):
        return "", ""
    return f"{difference.position_rmse_m:.3f}", f"{difference.velocity_rmse_m_s:.3f}"


def _side(statement: Consistency) -> str:
    return statement.verdict.removeprefix("variance ")


def _factor(statement: Consistency) -> float:
    return max(statement.variance_factor, 1.0 / statement.variance_factor)


def verdict_notes(comparison: Comparison) -> list[str]:
    """What the verdicts mean where they could be misread, a sentence each.

    A source that may drift; factors that are too small for a finding; one mean NIS and two
    verdicts; innovations of the right size that are not white.
    """
    stated = [
        (result.axis.name, owner, statement)
        for result in comparison.axes.values()
        for owner, statement in (("ours", result.filters["kf"]), ("EKF2", result.filters["ekf2"]))
        if isinstance(statement, Consistency)
    ]
    notes = []
    if comparison.source.origin.may_drift:
        notes.append(
            "Consistent with a source that may drift is not correct: these verdicts say how well "
            "each filter follows it. Truth or a loop judges the error."
        )
    small = [
        f"{owner} {axis} {verdict_words(statement)}"
        for axis, owner, statement in stated
        if statement.verdict != "consistent" and _factor(statement) < VARIANCE_FACTOR
    ]
    if small:
        notes.append(
            f"{', '.join(small)}: more than chance, but less than {VARIANCE_FACTOR:g}× "
            f"({np.sqrt(VARIANCE_FACTOR) - 1.0:.0%} in σ), from where it is a finding."
        )
    notes += _same_nis(stated)
    coloured = [
        f"{owner} {axis} {p_words(statement.ljung_box_p)}, lag-1 "
        f"{statement.lag1_autocorrelation:+.2f}"
        for axis, owner, statement in stated
        if statement.verdict == "consistent" and statement.ljung_box_p < WHITE_P
    ]
    if coloured:
        notes.append(
            f"Of the right size but not white (Ljung-Box): {'; '.join(coloured)}. Each "
            "innovation then tells of the next: with a positive lag-1 the filter lags (SIGMA_A is "
            "small), with a negative one it overshoots (SIGMA_A is large)."
        )
    return notes


def _same_nis(stated: Sequence[tuple[str, str, Consistency]]) -> Iterator[str]:
    """Two filters on one axis of which only the one with more samples is called wrong."""
    for axis, owner, wrong in stated:
        for other, fine in ((o, s) for a, o, s in stated if a == axis):
            low, high = wrong.nis_band
            if wrong.verdict == "consistent" or fine.verdict != "consistent":
                continue
            same_side = max(wrong.nis_mean, fine.nis_mean) < low or (
                min(wrong.nis_mean, fine.nis_mean) > high
            )
            wide_low, wide_high = fine.nis_band
            if same_side and fine.count < wrong.count and wide_low < wrong.nis_mean < wide_high:
                bands = " and ".join("{:.2f}-{:.2f}".format(*s.nis_band) for s in (wrong, fine))
                yield (
                    f"Along {axis} only {owner} is called {_side(wrong)} although {other} has "
                    f"nearly the same mean NIS ({wrong.nis_mean:.2f}, {fine.nis_mean:.2f}): with "
                    f"{wrong.count} samples against {fine.count} the band is narrower ({bands})."
                )


def finding_words(finding: Finding) -> str:
    """What a finding says, with when it shows where the message does not say that."""
    said = finding.says_when or not finding.when
    return finding.message if said else f"{finding.message} At {finding.when}."


def consequences_words(followers: Sequence[Finding]) -> str:
    """What the same cause brings with it, each in one sentence."""
    return "With it: " + " ".join(f"{one.headline}." for one in followers)


def clock_words(clock: ClockMap) -> str:
    """How one clock was mapped to the autopilot's, with its figures."""
    told = clock.method in ("boot clock", "arrival time") or "own speed" in clock.note
    if told or clock.distinct_stamps is not None:
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


def tuning_advice(
    comparison: Comparison, tuned: Mapping[str, AxisTuning | Unavailable]
) -> list[str]:
    """What follows from tuning: the command to run again, PX4's parameter, and cautions.

    Lines whose first nine columns are a label; ``px4fuse compare LOG`` as in
    :mod:`px4fuse.report.commands`.
    """
    name = next(
        (n for n in (HORIZONTAL, "aisle", *tuned) if isinstance(tuned.get(n), AxisTuning)), None
    )
    if name is None:
        return []
    found = tuned[name]
    assert isinstance(found, AxisTuning)
    lines = []
    drifts = comparison.source.origin.may_drift
    if drifts:
        noise = found.sigma_z.value or found.sigma_z.high
        lines.append(
            "Drift    the source may drift: these noises make a filter follow it"
            + ("" if noise is None else f", {noise:.2g} m is how it scatters from second to second")
            + ", not how wrong it is. Take no SIGMA_Z and no EKF2_EVP_NOISE below what truth or a "
            "loop shows."
        )
    options = [
        f"{option} {noise.value:.3g}"
        for option, noise in (("--sigma-a", found.filter_sigma_a), ("--sigma-z", found.sigma_z))
        if noise.value is not None and not drifts
    ]
    if options:
        typed = f"px4fuse compare LOG {' '.join(options)}"
        lines.append(f"Re-run   with the noises of {name}: {typed}")
    now = comparison.flight.log.parameters.get("EKF2_EVP_NOISE")
    if found.sigma_z.value is None and found.sigma_z.low is not None:
        lines.append(
            f"SIGMA_Z  is at least {found.sigma_z.low:.2g} m: is this a position source at all?"
        )
    elif found.sigma_z.value is None:
        bound = found.sigma_z.high
        lines.append(
            "SIGMA_Z  is below what this logging rate can show"
            + (f" (at most {bound:.2g} m)" if bound is not None else "")
            + ": between samples the process noise hides it. Log the source at a higher rate."
        )
    elif comparison.flight.log.autopilot == "PX4" and not drifts:
        lines.append(
            f"PX4      EKF2_EVP_NOISE {found.sigma_z.value:.3g}"
            + (f" (now {now:g})" if now is not None else "")
        )
    needed = found.filter_sigma_a
    if needed.value is None:
        lines.append(
            "SIGMA_A  is not determined by this flight: too little motion, or too short."
            if needed.low is None
            else f"SIGMA_A  is at least {needed.low:.2g} m/s²: the acceleration is wrong."
        )
    elif found.biases_fitted:
        lines.append(f"SIGMA_A  {noise_and_bias_words(found)}")
    if len(found.outlier_time_s):
        lines.append(
            f"Outliers {len(found.outlier_time_s)} of {found.count} measurements ({name}), the "
            f"first at {found.outlier_time_s[0]:.1f} s; they do not enter the noises"
        )
    held = found.held_out
    if not isinstance(held, Unavailable) and held.gain_nats <= 0.0:
        lines.append(
            "Held out the settings found on the first half do no better on the second than the "
            "chosen ones: these are as good as any"
        )
    return lines


def noise_and_bias_words(found: AxisTuning) -> str:
    """Why the filter's SIGMA_A is larger than the noise."""
    noise = found.sigma_a
    value = noise.value if noise.value is not None else noise.high
    if value is None:
        return "covers noise, bias and tilt together; this flight does not tell them apart"
    bound = "" if noise.value is not None else "at most "
    return (
        f"of the acceleration alone is {bound}{value:.2g} m/s²; the filter has no state for the "
        f"accelerometer's bias and tilt, and needs {found.filter_sigma_a.value:.2g} m/s² to cover "
        "them"
    )


def stamps_wrong(comparison: Comparison, clock: ClockOffset) -> bool:
    """Whether the stamps of the source are late or early beyond doubt, as they were recorded."""
    low, high = clock.interval_s
    negligible = abs(clock.offset_s) < NEGLIGIBLE_OFFSET_S
    return clock.determinable and not (low <= 0.0 <= high or negligible)


def delay_wrong(comparison: Comparison, clock: ClockOffset) -> bool:
    """Whether PX4's EKF2_EV_DELAY is known, and not what the data ask for."""
    delay = comparison.flight.log.parameters.get("EKF2_EV_DELAY")
    if delay is None or not clock.determinable:
        return False
    asked = clock.interval_s
    margin = NEGLIGIBLE_OFFSET_S
    return not -(asked[1] + margin) <= delay * 1e-3 <= -(asked[0] - margin)


def clock_advice(comparison: Comparison, clock: ClockOffset | Unavailable) -> list[str]:
    """What the clock estimate says, and what follows from it: lines as of tuning_advice."""
    if isinstance(clock, Unavailable):
        return [f"Offset   not determinable: {clock.reason}. {clock.remedy}"]
    offset, (low, high) = clock.offset_s, clock.interval_s
    log = comparison.flight.log
    lines = []
    if not clock.determinable:
        lines.append(f"Offset   not determinable: {clock.reason}.")
        lines.append("Next     fly passes of 5 m or more with clear starts and stops.")
        return lines
    lines.append(
        f"Offset   {offset:+.3f} s, 95 % {low:+.3f} s to {high:+.3f} s, to be "
        "added to the stamps of the source"
    )
    side = "late" if offset < 0.0 else "early"
    if not stamps_wrong(comparison, clock):
        lines.append("Reading  the stamps are right as far as this flight can tell")
    else:
        lines.append(f"Reading  the stamps are {side} by {abs(offset):.3f} s")
        typed = typed_offset_s(comparison, clock)
        lines.append(f"Re-run   px4fuse compare LOG --clock-offset {typed:.3f}")
    delay = log.parameters.get("EKF2_EV_DELAY")
    if delay is not None:
        if not delay_wrong(comparison, clock):
            lines.append(f"PX4      EKF2_EV_DELAY {delay:g} ms fits")
        elif offset > 0.0 and delay <= 0.0:
            lines.append(
                "PX4      EKF2_EV_DELAY is 0 ms and cannot be negative: correct the sender's clock"
            )
        else:
            lines.append(
                f"PX4      EKF2_EV_DELAY is {delay:g} ms, the data ask for "
                f"{max(-offset * 1e3, 0.0):.0f} ms ({max(-high * 1e3, 0.0):.0f} to "
                f"{max(-low * 1e3, 0.0):.0f}); set it, or correct the sender's clock"
            )
    if clock.change_p is not None and clock.change_p < CHANGE_P:
        parts = ", ".join(f"{p.offset_s:+.2f} s from {p.start_s:.0f} s" for p in clock.parts)
        lines.append(
            f"Changes  the offset is not the same throughout ({p_words(clock.change_p)}): {parts}"
        )
    if clock.drift_ppm is not None and clock.drift_sigma_ppm is not None:
        lines.append(f"Drift    {clock.drift_ppm:+.0f} ± {1.96 * clock.drift_sigma_ppm:.0f} ppm")
    return lines
