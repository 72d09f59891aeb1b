"""Texts of findings on the cause of an inconsistent filter.

A re-run of KF or EKF2 with one change of a setting or of the data shows the cause. The texts name
the kind of cause, the change, its effect in the re-run, and the recommended action.
"""

from collections.abc import Iterator, Mapping

from px4fuse.analysis import Analysis
from px4fuse.comparison import changes, rerun_effects
from px4fuse.comparison.model import FilterName
from px4fuse.comparison.remedy import find_aid, format_changes, select_changed_settings
from px4fuse.comparison.rerun_effects import (
    Rerun,
    Statistic,
    brings_inside_limits,
    can_show_improvement,
    classify_improvement,
    compute_explained_fraction,
    makes_overconfident,
)
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.settings import SETTING_RANGES
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import PositionTrack, Unavailable
from px4fuse.request import COMPARISON_OPTIONS

from .model import (
    ACCELEROMETER_CAUSE,
    CLOCK_CAUSE,
    MEASUREMENT_NOISE_CAUSE,
    MISALIGNED_FRAME_CAUSE,
    OUTLIER_CAUSE,
    PROCESS_NOISE_CAUSE,
    UNKNOWN_CAUSE,
    WRONG_GATE_CAUSE,
    find_source_texts,
    format_percent,
    magnetometer_advice,
)


def classify_cause(analysis: Analysis, cause: Rerun | None) -> str:
    """Return the kind of fault that a re-run corrects, such as "measurement noise"."""
    if cause is None:
        return UNKNOWN_CAUSE
    aid = find_aid(analysis)
    cause_kind_by_change = {
        rerun_effects.OUTLIERS_KEY: OUTLIER_CAUSE,
        rerun_effects.TIME_OFFSET_KEY: CLOCK_CAUSE,
        aid.delay: CLOCK_CAUSE,
        rerun_effects.ROTATION_KEY: MISALIGNED_FRAME_CAUSE,
        rerun_effects.FORWARD_BIAS_KEY: ACCELEROMETER_CAUSE,
        changes.SIGMA_Z_KEY: MEASUREMENT_NOISE_CAUSE,
        aid.noise: MEASUREMENT_NOISE_CAUSE,
        aid.gate: WRONG_GATE_CAUSE,
    }
    for name, kind in cause_kind_by_change.items():
        if name in cause.change:
            return kind
    return PROCESS_NOISE_CAUSE


def rerun_refutes_cause(analysis: Analysis, filter_name: FilterName, cause: Rerun) -> bool:
    """Return True if a re-run with the suspected cause removed does not improve a filter.

    Neither reported σ nor position RMSE is better along the axis of largest motion.
    """
    return any(
        (rerun.filter, rerun.change) == (filter_name, cause.change)
        and can_show_improvement(rerun)
        and classify_improvement(rerun) == "nothing"
        for rerun in analysis.select_main_reruns()
    )


def format_change(analysis: Analysis, cause: Rerun) -> str:
    """Format the changes of a re-run: "SIGMA_Z 0.1 m instead of 0.05 m"."""
    changed = select_changed_settings(cause.change, _find_used_settings(analysis))
    names = changed.keys() - rerun_effects.CHANGE_KEYS_WITHOUT_EFFECT_ALONE or changed
    texts = (_format_one_change(analysis, cause, name) for name in changed if name in names)
    return " and ".join(texts)


def _find_used_settings(analysis: Analysis) -> Mapping[str, float]:
    ekf2_model = analysis.ekf2_model
    return {} if isinstance(ekf2_model, Unavailable) else ekf2_model.inputs.settings


def describe_part_explained_by_change(cause: Rerun, statistic: Statistic) -> str:
    """Describe the part of a deviation that disappears in a re-run with changed settings.

    The deviation is a wrong mean NIS, a wrong mean NEES, or the difference KF - EKF2.
    """
    if makes_overconfident(cause, statistic):
        return "makes σ too small"
    if statistic != "difference" and brings_inside_limits(cause, statistic):
        return "all"
    fraction = compute_explained_fraction(cause, statistic)
    if fraction > 1.0:
        return "too much"
    return format_percent(fraction) if fraction > 0.0 else "nothing"


def format_action(analysis: Analysis, change: Mapping[str, float]) -> str:
    """Format the user's actions that correspond to the changes of a re-run."""
    return " ".join(_list_actions(analysis, change))


def _list_actions(analysis: Analysis, change: Mapping[str, float]) -> Iterator[str]:
    """Yield one sentence on the user's action for each changed setting or data of a re-run."""
    if change.get(rerun_effects.OUTLIERS_KEY):
        yield find_source_texts(analysis).outlier_action
    if rerun_effects.FORWARD_BIAS_KEY in change:
        yield "Calibrate the accelerometer and the level horizon."
    if rotation_deg := change.get(rerun_effects.ROTATION_KEY):
        # GNSS refers to true north, so a rotation of its positions is a heading error of EKF2
        if analysis.source.origin.is_gnss:
            yield magnetometer_advice(analysis.flight) or "Check the heading source of EKF2."
        else:
            yield f"Rotate the positions by {rotation_deg:+.0f}° before they are sent."
    if rerun_effects.TIME_OFFSET_KEY in change:
        yield f"{format_timestamp_action(change[rerun_effects.TIME_OFFSET_KEY])} before sending."
    if parameters := {name: change[name] for name in change if name in MODEL_PARAMETERS}:
        parameters = select_changed_settings(parameters, _find_used_settings(analysis))
        yield f"Set {format_changes(parameters)}."
    if kf_settings := {name: change[name] for name in changes.KF_NOISE_SETTINGS & change.keys()}:
        yield format_kf_settings(kf_settings)


def format_sender_action(source: PositionTrack, shift_s: float) -> str:
    """Format the action on the sender of the positions that corrects a time offset.

    The text has no full stop. PX4 ignores the timestamps of a sender that does not answer TIMESYNC.
    """
    if source.clock_map is not None and source.clock_map.method == "arrival time":
        return (
            "Answer TIMESYNC, so that PX4 uses the timestamps of the sender. Then measure the time "
            "offset in a new flight (px4fuse sync)"
        )
    return format_timestamp_action(shift_s)


def format_timestamp_action(shift_s: float) -> str:
    """Format the action for a time offset: "Add 0.1 s to the timestamp of each position"."""
    shift_text = f"Subtract {-shift_s:.3f} s from" if shift_s < 0 else f"Add {shift_s:.3f} s to"
    return f"{shift_text} the timestamp of each position"


def format_kf_settings(settings: Mapping[str, float]) -> str:
    """Format an action for KF settings: "Set SIGMA_Z to 0.1 m (--sigma-z 0.1)."."""
    setting_texts = (
        f"{SETTING_RANGES[name].label} to {value:g} {SETTING_RANGES[name].unit} "
        f"({COMPARISON_OPTIONS[name]} {value:g})"
        for name, value in sorted(settings.items())
    )
    return f"Set {' and '.join(setting_texts)}."


def _format_one_change(analysis: Analysis, cause: Rerun, name: str) -> str:
    """Format one change of a re-run, for example "12 outliers removed"."""
    value, settings = cause.change[name], analysis.settings
    match name:
        case rerun_effects.OUTLIERS_KEY:
            return f"{value:.0f} outlier{'s' if value > 1 else ''} removed"
        case rerun_effects.TIME_OFFSET_KEY:
            offset_s = value - (settings.clock_offset_s if cause.filter == "kf" else 0.0)
            late_or_early = "late" if offset_s < 0 else "early"
            return f"timestamps corrected ({abs(offset_s):.2g} s {late_or_early})"
        case rerun_effects.FORWARD_BIAS_KEY:
            right_bias_m_s2 = cause.change[rerun_effects.RIGHT_BIAS_KEY]
            return (
                f"accelerometer bias removed ({value:+.2f} m/s² forward, {right_bias_m_s2:+.2f} "
                "m/s² right)"
            )
        case rerun_effects.ROTATION_KEY:
            is_drifting = isinstance(analysis.heading, HeadingError) and analysis.heading.drifts
            angle_text = f"{value:+.0f}°{' on average' if is_drifting else ''}"
            return (
                f"heading error of EKF2 removed ({angle_text})"
                if analysis.source.origin.is_gnss
                else f"positions rotated in yaw by {angle_text}"
            )
        case changes.SIGMA_A_KEY | changes.SIGMA_Z_KEY:
            unit, label = SETTING_RANGES[name][2:]
            return f"{label} {value:.2g} {unit} instead of {getattr(settings, name):g} {unit}"
    assert not isinstance(analysis.ekf2_model, Unavailable)
    used_value, unit = (
        analysis.ekf2_model.inputs.settings[name],
        MODEL_PARAMETERS[name].printed_unit,
    )
    unit_text = f" {unit}" if unit else ""
    return f"{name} {value:.3g}{unit_text} instead of {used_value:.4g}{unit_text}"
