"""Text of a cause that a re-run has shown: the change, its effect, and the action."""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.comparison import causal_replays, remedy
from px4fuse.comparison.causal_replays import Intervention
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.settings import UNITS
from px4fuse.findings import cause_grouping as kinds
from px4fuse.flight import Unavailable
from px4fuse.request import COMPARISON_OPTIONS
from px4fuse.text import capitalise_first, format_number

# Findings that state the same fault as a re-run, by kind of cause; the summary omits them
FINDINGS_OF_CAUSE: Mapping[str, frozenset[str]] = {
    kinds.OUTLIERS: frozenset(("source_outliers",)),
    kinds.CLOCK: frozenset(("source_time_offset", "ekf2_ev_delay_wrong")),
    kinds.FRAME: frozenset(("source_frame_misaligned", "ekf2_heading_error")),
    kinds.GATE: frozenset(("ekf2_gate_too_small",)),
    kinds.ACCELEROMETER: frozenset(("accelerometer_bias",)),
}
# Test of a re-run by kind of cause; for other kinds the mean NIS must be nearer to 1
REMEDY_TESTS = {kinds.CLOCK: remedy.delay_helps, kinds.GATE: remedy.rejects_less}


def classify_cause(analysis: Analysis, cause: Intervention | None) -> str:
    """Return the kind of a cause; of several changes, that of the source determines the kind."""
    if cause is None:
        return kinds.ELSEWHERE
    aid = remedy.aid_of(analysis)
    kind_by_change = {
        causal_replays.OUTLIERS: kinds.OUTLIERS,
        causal_replays.CLOCK_OFFSET: kinds.CLOCK,
        aid.delay: kinds.CLOCK,
        causal_replays.ROTATION: kinds.FRAME,
        causal_replays.FORWARD_BIAS: kinds.ACCELEROMETER,
        causal_replays.SIGMA_Z: kinds.NOISE,
        aid.noise: kinds.NOISE,
        aid.gate: kinds.GATE,
    }
    return next(
        (kind for name, kind in kind_by_change.items() if name in cause.change), kinds.PROCESS
    )


def format_rerun(analysis: Analysis, cause: Intervention) -> str:
    """Format a re-run: "re-run with SIGMA_Z 0.4 m instead of 0.1 m: mean NIS 16 → 1 ..."."""
    return f"re-run with {format_change(analysis, cause)}: {format_effect(cause)}"


def format_change(analysis: Analysis, cause: Intervention) -> str:
    """Format the changes of a re-run as a noun phrase."""
    changes = [
        _format_one_change(analysis, cause, name)
        for name in cause.change
        if name not in causal_replays.ACCOMPANYING_CHANGES
    ]
    return " and ".join(changes)


def format_explained_share(cause: Intervention) -> str:
    """Format the share of a deviation that the re-run with a change explains."""
    if cause.contradicts_truth:
        return "contradicts ground truth"
    if cause.is_sufficient:
        return "all"
    if cause.explained_fraction > 1.0 and cause.statistic != "difference":
        return "too much"
    return (
        f"{100.0 * cause.explained_fraction:.0f} %" if cause.explained_fraction > 0.0 else "nothing"
    )


def format_remedy(analysis: Analysis, cause: Intervention) -> str:
    """Format the action against a cause, one sentence per change."""
    actions, change = [], dict(cause.change)
    is_gnss = analysis.source.origin.is_gnss
    if change.pop(causal_replays.OUTLIERS, None):
        check = "place of the antenna" if is_gnss else "line of sight, anchor survey"
        actions.append(f"Remove the outliers ({check}). Do not increase a noise for outliers.")
    if change.pop(causal_replays.FORWARD_BIAS, None) is not None:
        actions.append("Calibrate the accelerometer and the level horizon.")
        change.pop(causal_replays.RIGHT_BIAS)
    if turn_deg := change.pop(causal_replays.ROTATION, None):
        # GNSS positions refer to true north, so EKF2's heading is wrong
        actions.append(
            f"Calibrate the magnetometer (heading error {turn_deg:+.0f}°), away from metal."
            if is_gnss
            else f"Rotate the positions by {turn_deg:+.0f}° before they are sent."
        )
    settings = (causal_replays.SIGMA_Z, causal_replays.SIGMA_A, causal_replays.CLOCK_OFFSET)
    options = [
        f"{COMPARISON_OPTIONS[name]} {change.pop(name):g}" for name in settings if name in change
    ]
    if change:
        actions.append(f"Set {remedy.format_settings(change)}.")
    if options:
        actions.append(f"Re-run with {remedy.COMMAND} {' '.join(options)}.")
    return " ".join(actions)


def format_effect(cause: Intervention) -> str:
    """Format the statistic before and after a re-run."""
    if cause.statistic == "difference":
        return f"difference KF - EKF2 {cause.before:.2f} → {cause.after:.2f} m RMS"
    power = 1.0 if cause.statistic == "nis" else 0.5
    before, after = (format_number(value**power, 2) for value in (cause.before, cause.after))
    label = "mean NIS" if cause.statistic == "nis" else "RMS of error / reported σ"
    return f"{label} {before} → {after} (expected 1)"


def format_remedy_of_ekf2(analysis: Analysis, cause: Intervention) -> str:
    """Format the action against a cause in EKF2, with its replayed effect on the whole flight."""
    if not cause.change.keys() <= PARAMETERS.keys():
        return format_remedy(analysis, cause)
    return remedy.format_ekf2_remedy(
        analysis.ekf2_model,
        cause.change,
        REMEDY_TESTS.get(classify_cause(analysis, cause), remedy.noise_helps),
        fallback_remedy=f"{capitalise_first(format_rerun(analysis, cause))}.",
    )


def _format_one_change(analysis: Analysis, cause: Intervention, name: str) -> str:
    value, settings = cause.change[name], analysis.settings
    match name:
        case causal_replays.OUTLIERS:
            return f"{value:.0f} outlier{'s' if value > 1 else ''} removed"
        case causal_replays.CLOCK_OFFSET:
            offset_s = value - (settings.clock_offset_s if cause.filter == "kf" else 0.0)
            late = "late" if offset_s < 0 else "early"
            return f"timestamps corrected ({abs(offset_s):.2g} s {late})"
        case causal_replays.FORWARD_BIAS:
            right = cause.change[causal_replays.RIGHT_BIAS]
            return f"accelerometer bias removed ({value:+.2f} m/s² forward, {right:+.2f} right)"
        case causal_replays.ROTATION:
            is_drifting = isinstance(analysis.heading, HeadingError) and analysis.heading.drifts
            mean = " on average" if is_drifting else ""
            return (
                f"EKF2's heading corrected (error {value:+.0f}°{mean})"
                if analysis.source.origin.is_gnss
                else f"positions rotated by {value:+.0f}°{mean}"
            )
        case causal_replays.SIGMA_A | causal_replays.SIGMA_Z:
            label, unit = name[:7].upper(), UNITS[name]
            return f"{label} {value:.2g} {unit} instead of {getattr(settings, name):g} {unit}"
    assert not isinstance(analysis.ekf2_model, Unavailable)  # it was replayed
    flown_value, unit = analysis.ekf2_model.inputs.settings[name], PARAMETERS[name].unit
    unit = unit.replace("^2", "²").replace("^3", "³")
    return f"{name} {value:.3g} {unit} instead of {flown_value:.4g} {unit}".replace(
        "  ", " "
    ).rstrip()
