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
from px4fuse.plain import capital, length_words, number_words
from px4fuse.request import OPTIONS

# Findings that say the same as the first sentence does, by what is changed
TOLD_BY: Mapping[str, frozenset[str]] = {
    kinds.OUTLIERS: frozenset(("source_outliers",)),
    kinds.CLOCK: frozenset(("source_clock_offset", "ekf2_ev_delay_wrong")),
    kinds.FRAME: frozenset(("source_frame_turned", "ekf2_heading_wrong")),
    kinds.GATE: frozenset(("ekf2_gate_small",)),
    kinds.ACCELEROMETER: frozenset(("accelerometer_bias",)),
}
# What a change of a kind is there for; else to bring the mean NIS nearer to 1
HELPS = {kinds.CLOCK: remedy.delay_helps, kinds.GATE: remedy.rejects_less}


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


def since_words(analysis: Analysis, cause: Intervention | None) -> str:
    """What stands behind a verdict: its cause, and the replay that shows it; or nothing."""
    return "" if cause is None else f", since {reason_words(analysis, cause)}"


def reason_words(analysis: Analysis, cause: Intervention) -> str:
    """A cause as a clause, and the replay that shows it."""
    return f"{change_words(analysis, cause)} ({effect_words(cause)})"


def change_words(analysis: Analysis, cause: Intervention) -> str:
    """What is wrong, as a clause: what was changed to see what it does."""
    said = [_one(analysis, cause, name) for name in cause.change if name not in changed.ALONG]
    return " and ".join(said)


def share_words(cause: Intervention) -> str:
    """How much of a discrepancy a change explains."""
    if cause.denied_by_truth:
        return "denied by the truth"
    if cause.brings_into_band:
        return "all"
    if cause.explains > 1.0 and cause.of != "apart":
        return "too much"
    return f"{cause.explains:.0%}" if cause.explains > 0.0 else "nothing"


def cure_words(analysis: Analysis, cause: Intervention) -> str:
    """What to do about a cause."""
    parts, change = [], dict(cause.change)
    if change.pop(changed.OUTLIERS, None):
        gnss = analysis.source.origin.is_gnss
        where = "place of the antenna" if gnss else "line of sight, anchor survey"
        parts.append(f"remove the outliers ({where}) rather than raise a noise for them")
    if change.pop(changed.FORWARD, None) is not None:
        parts.append("calibrate the accelerometer and the level horizon")
        change.pop(changed.RIGHT)
    if turn_deg := change.pop(changed.TURN, None):
        # GNSS knows north
        parts.append(
            f"calibrate the magnetometer, away from metal and motors ({turn_deg:+.0f}°)"
            if analysis.source.origin.is_gnss
            else f"turn the positions by {turn_deg:+.0f}° before they are sent"
        )
    settings = (changed.SIGMA_Z, changed.SIGMA_A, changed.CLOCK)
    typed = [f"{OPTIONS[name].name} {change.pop(name):g}" for name in settings if name in change]
    if change:
        parts.append(f"set {remedy.settings_words(change)}")
    if typed:
        parts.append(f"type {remedy.COMMAND} {' '.join(typed)}")
    return f"{capital(', and '.join(parts))}."


def effect_words(cause: Intervention) -> str:
    """What a change does to the number in question, by the replay."""
    if cause.of == "nis":
        before, after = (number_words(nis, 2) for nis in (cause.before, cause.after))
        return f"replayed: mean NIS {before} → {after}"
    if cause.of == "apart":
        before, after = (length_words(metres) for metres in (cause.before, cause.after))
        return f"replayed: {before} → {after} apart"
    before, after = (number_words(nees**0.5, 2) for nees in (cause.before, cause.after))
    return f"replayed: errors of {before} → {after} σ"


def ekf2_cure_words(analysis: Analysis, cause: Intervention) -> str:
    """What to do about a cause of EKF2's, with what a parameter would do to all of the flight."""
    if not cause.change.keys() <= PARAMETERS.keys():
        return cure_words(analysis, cause)
    return remedy.remedy_words(
        analysis.ekf2_model,
        cause.change,
        HELPS.get(kind_of(analysis, cause), remedy.noise_helps),
        otherwise=f"{capital(reason_words(analysis, cause))}.",
    )


def _one(analysis: Analysis, cause: Intervention, name: str) -> str:
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
