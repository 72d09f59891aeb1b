"""A cause that a replay has shown, in words: what it is, what it does, and what puts it right."""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.comparison import interventions as changed
from px4fuse.comparison import remedy
from px4fuse.comparison.interventions import Intervention
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.heading import HeadingError
from px4fuse.findings import causes as kinds
from px4fuse.flight import Unavailable
from px4fuse.plain import capitalise_first, format_length, format_number
from px4fuse.request import OPTIONS

# Findings that say the same as the first sentence does, by what is changed
FINDINGS_OF_CAUSE: Mapping[str, frozenset[str]] = {
    kinds.OUTLIERS: frozenset(("source_outliers",)),
    kinds.CLOCK: frozenset(("source_clock_offset", "ekf2_ev_delay_wrong")),
    kinds.FRAME: frozenset(("source_frame_turned", "ekf2_heading_wrong")),
    kinds.GATE: frozenset(("ekf2_gate_small",)),
    kinds.ACCELEROMETER: frozenset(("accelerometer_bias",)),
}
# What a change of a kind is there for; else to bring the mean NIS nearer to 1
REMEDY_TESTS = {kinds.CLOCK: remedy.delay_helps, kinds.GATE: remedy.rejects_less}


def kind_of(analysis: Analysis, cause: Intervention | None) -> str:
    """What sort of cause it is, as findings name it: of the source where there are two."""
    if cause is None:
        return kinds.ELSEWHERE
    aid = remedy.aid_of(analysis)
    of = {
        changed.OUTLIERS: kinds.OUTLIERS,
        changed.CLOCK: kinds.CLOCK,
        aid.delay: kinds.CLOCK,
        changed.TURN: kinds.FRAME,
        changed.FORWARD: kinds.ACCELEROMETER,
        changed.SIGMA_Z: kinds.NOISE,
        aid.noise: kinds.NOISE,
        aid.gate: kinds.GATE,
    }
    return next((kind for name, kind in of.items() if name in cause.change), kinds.PROCESS)


def format_cause(analysis: Analysis, cause: Intervention | None) -> str:
    """What stands behind a verdict: its cause, and the replay that shows it; or nothing."""
    return "" if cause is None else f", since {format_reason(analysis, cause)}"


def format_reason(analysis: Analysis, cause: Intervention) -> str:
    """A cause as a clause, and the replay that shows it."""
    return f"{format_change(analysis, cause)} ({format_effect(cause)})"


def format_change(analysis: Analysis, cause: Intervention) -> str:
    """What is wrong, as a clause: what was changed to see what it does."""
    clauses = [
        _format_one_change(analysis, cause, name)
        for name in cause.change
        if name not in changed.ACCOMPANYING_CHANGES
    ]
    return " and ".join(clauses)


def format_explained_share(cause: Intervention) -> str:
    """How much of a discrepancy a change explains."""
    if cause.denied_by_truth:
        return "denied by the truth"
    if cause.brings_into_band:
        return "all"
    if cause.explains > 1.0 and cause.of != "apart":
        return "too much"
    return f"{cause.explains:.0%}" if cause.explains > 0.0 else "nothing"


def format_remedy(analysis: Analysis, cause: Intervention) -> str:
    """What to do about a cause."""
    actions, change = [], dict(cause.change)
    if change.pop(changed.OUTLIERS, None):
        gnss = analysis.source.origin.is_gnss
        where = "place of the antenna" if gnss else "line of sight, anchor survey"
        actions.append(f"remove the outliers ({where}) rather than raise a noise for them")
    if change.pop(changed.FORWARD, None) is not None:
        actions.append("calibrate the accelerometer and the level horizon")
        change.pop(changed.RIGHT)
    if turn_deg := change.pop(changed.TURN, None):
        # GNSS knows north
        actions.append(
            f"calibrate the magnetometer, away from metal and motors ({turn_deg:+.0f}°)"
            if analysis.source.origin.is_gnss
            else f"turn the positions by {turn_deg:+.0f}° before they are sent"
        )
    settings = (changed.SIGMA_Z, changed.SIGMA_A, changed.CLOCK)
    options = [f"{OPTIONS[name].name} {change.pop(name):g}" for name in settings if name in change]
    if change:
        actions.append(f"set {remedy.format_settings(change)}")
    if options:
        actions.append(f"type {remedy.COMMAND} {' '.join(options)}")
    return f"{capitalise_first(', and '.join(actions))}."


def format_effect(cause: Intervention) -> str:
    """What a change does to the number in question, by the replay."""
    if cause.of == "nis":
        before, after = (format_number(nis, 2) for nis in (cause.before, cause.after))
        return f"replayed: mean NIS {before} → {after}"
    if cause.of == "apart":
        before, after = (format_length(metres) for metres in (cause.before, cause.after))
        return f"replayed: {before} → {after} apart"
    before, after = (format_number(nees**0.5, 2) for nees in (cause.before, cause.after))
    return f"replayed: errors of {before} → {after} σ"


def format_remedy_of_ekf2(analysis: Analysis, cause: Intervention) -> str:
    """What to do about a cause of EKF2's, with what a parameter would do to all of the flight."""
    if not cause.change.keys() <= PARAMETERS.keys():
        return format_remedy(analysis, cause)
    return remedy.format_ekf2_remedy(
        analysis.ekf2_model,
        cause.change,
        REMEDY_TESTS.get(kind_of(analysis, cause), remedy.noise_helps),
        fallback_remedy=f"{capitalise_first(format_reason(analysis, cause))}.",
    )


def _format_one_change(analysis: Analysis, cause: Intervention, name: str) -> str:
    """What is wrong, for one of the things that were changed."""
    value, settings = cause.change[name], analysis.settings
    match name:
        case changed.OUTLIERS:
            return f"{value:.0f} position{'s are outliers' if value > 1 else ' is an outlier'}"
        case changed.CLOCK:
            missing_s = value - (settings.clock_offset_s if cause.filter == "kf" else 0.0)
            return f"the stamps are {abs(missing_s):.2g} s {'late' if missing_s < 0 else 'early'}"
        case changed.FORWARD:
            right = cause.change[changed.RIGHT]
            return f"the accelerometer reads {value:+.2f} m/s² too much forward, {right:+.2f} right"
        case changed.TURN:
            drifts = isinstance(analysis.heading, HeadingError) and analysis.heading.drifts
            what, turn_deg = "the positions are turned", -value
            if analysis.source.origin.is_gnss:
                what, turn_deg = "EKF2's heading is off", value
            return f"{what} by {turn_deg:+.0f}°{' on average' * drifts}"
        case changed.SIGMA_A | changed.SIGMA_Z:
            label, unit = name[:7].upper(), OPTIONS[name].unit
            return f"{label} is {getattr(settings, name):g} instead of {value:.2g} {unit}"
    assert not isinstance(analysis.ekf2_model, Unavailable)  # it was replayed
    flown, unit = analysis.ekf2_model.inputs.settings[name], PARAMETERS[name].unit
    unit = unit.replace("^2", "²").replace("^3", "³")
    return f"{name} is {flown:.4g} instead of {value:.3g} {unit}".rstrip()
