"""Explanation of the difference between KF and EKF2 along each horizontal axis, in sentences."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import structs

from px4fuse.core.text import format_count
from px4fuse.ekf2 import steps
from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.ekf2.model import Ekf2Model
from px4fuse.ekf2.replay import is_inside_spans
from px4fuse.ekf2.steps import DifferenceExplanation, DifferenceOutsideReplay, PropertyReplacement
from px4fuse.filter.kalman import KfRun, predict_track, run_kf
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight.model import Spans, Unavailable
from px4fuse.request import COMPARISON_OPTIONS

from .estimates import TuningByAxis, find_first_available_tuning
from .model import AxisComparison, Comparison
from .remedy import find_used_noise_m

# Below this relative difference, the position RMSEs of KF and EKF2 are reported as equal
MAX_RELATIVE_RMSE_DIFFERENCE = 0.05
# The second largest contribution to the mean square position difference KF - EKF2 is reported if it
# is at least this fraction of the difference
MIN_CONTRIBUTION_FRACTION = 0.05
# The user's SIGMA_A or SIGMA_Z is wrong if it differs from its estimate by this factor or more
MIN_SETTING_TO_ESTIMATE_RATIO = 4.0
# KF takes over one property of EKF2 after another (for example delay, innovation gate). A property
# is reported only if it changes KF's position by more than this value (m)
MIN_REPORTED_KF_POSITION_CHANGE_M = 1e-6
RANK_TEXTS = ("Largest", "Second largest")
# A position difference KF - EKF2 outside the replayed time is reported only above this value (m)
MIN_DIFFERENCE_OUTSIDE_REPLAY_M = 0.5
# A position difference KF - EKF2 outside the replayed time is reported only if it is larger by this
# factor than the difference inside the replayed time
MIN_DIFFERENCE_RATIO_OUTSIDE_REPLAY = 3.0


def explain_ekf2_difference(
    comparison: Comparison,
    model: Ekf2Model | Unavailable,
    time_offset: SourceTimeOffset | Unavailable,
    estimate_by_setting: Mapping[str, Any],
) -> dict[str, DifferenceExplanation | Unavailable]:
    """Explain the difference between KF and EKF2 along each horizontal axis.

    ``estimate_by_setting`` contains the estimates that replace wrong noise settings of KF (SIGMA_A,
    SIGMA_Z).
    """
    axis_results = {name: result for name, result in comparison.axes.items() if name != "down"}
    if not axis_results:
        reason = "EKF2 can be replayed for horizontal positions only"
        action = "Analyse a horizontal axis, too (for example --axis north)."
        return {"down": Unavailable(steps.DIFFERENCE_ANALYSIS_NAME, reason, action)}
    if isinstance(model, Unavailable):
        unavailable = structs.replace(model, what=steps.DIFFERENCE_ANALYSIS_NAME)
        return dict.fromkeys(axis_results, unavailable)
    kf_settings = _make_comparable_settings(comparison, model.inputs, estimate_by_setting)
    changed_settings = replace(comparison.settings, **estimate_by_setting)
    kf_runs = {
        name: run_kf(axis.axis, changed_settings, fast=True) if estimate_by_setting else axis.kf_run
        for name, axis in axis_results.items()
    }
    explanations = steps.explain_difference_by_replacements(model, kf_settings, kf_runs)
    if isinstance(explanations, Unavailable):
        return dict.fromkeys(axis_results, explanations)
    reasons = _describe_property_differences(
        replace(comparison, settings=changed_settings), model, time_offset
    )
    explanation_by_axis: dict[str, DifferenceExplanation | Unavailable] = {}
    for name, by_steps in explanations.items():
        explanation = structs.replace(
            by_steps,
            corrected=dict(estimate_by_setting),
            steps=tuple(
                replacement
                for replacement in by_steps.steps
                if replacement.position_moved_m > MIN_REPORTED_KF_POSITION_CHANGE_M
            ),
            outside=_find_difference_at_times_without_replay(
                axis_results[name], kf_runs[name], by_steps.spans_s
            ),
        )
        explanation_by_axis[name] = add_cause_sentences(
            explanation, axis_results[name].axis.label, reasons
        )
    return explanation_by_axis


def find_corrected_noise_settings(comparison: Comparison, tuning: TuningByAxis) -> dict[str, float]:
    """Return the estimates of SIGMA_A and SIGMA_Z that replace wrong settings of KF.

    A setting from the user is wrong if it differs from its estimate by a large factor.
    """
    axis_tuning = find_first_available_tuning(tuning, HORIZONTAL, AISLE_AXIS, "north", "east")
    if axis_tuning is None or comparison.source.origin.is_gnss:
        return {}
    estimate_by_setting = {}
    for name, estimate in (
        ("sigma_a_m_s2", axis_tuning.sigma_a_two_state.value),
        ("sigma_z_m", axis_tuning.sigma_z.value),
    ):
        setting = getattr(comparison.settings, name)
        if (
            estimate is not None
            and setting != getattr(Settings(), name)
            and max(setting / estimate, estimate / setting) >= MIN_SETTING_TO_ESTIMATE_RATIO
        ):
            estimate_by_setting[name] = float(f"{estimate:.3g}")
    return estimate_by_setting


def list_explanation_configurations(
    comparison: Comparison, ekf2_inputs: ReplayInputs, estimate_by_setting: Mapping[str, Any]
) -> list[FilterConfiguration]:
    """Return the EKF2 configurations whose replays explain the difference KF - EKF2."""
    return list(
        steps.make_stepwise_configurations(
            ekf2_inputs, _make_comparable_settings(comparison, ekf2_inputs, estimate_by_setting)
        ).values()
    )


def _make_comparable_settings(
    comparison: Comparison, ekf2_inputs: ReplayInputs, estimate_by_setting: Mapping[str, Any]
) -> Settings:
    settings = replace(comparison.settings, **estimate_by_setting)
    is_same_source = comparison.source.name == ekf2_inputs.received_positions.source
    return settings if is_same_source else replace(settings, clock_offset_s=0.0)


def _find_difference_at_times_without_replay(
    axis_result: AxisComparison, kf_run: KfRun, spans_s: Spans
) -> DifferenceOutsideReplay | None:
    """Return the largest |position difference| KF - EKF2 outside the replayed time spans."""
    if isinstance(state := axis_result.ekf2_tracks.state, Unavailable):
        return None
    position_m = state["position_m"]
    position_m = position_m[~is_inside_spans(position_m.index, spans_s)]
    kf_track = predict_track(kf_run, position_m.index.to_numpy())
    difference_m = (position_m - kf_track["position_m"].to_numpy()).abs()
    if not np.isfinite(difference_m).any():
        return None
    return DifferenceOutsideReplay(float(difference_m.max()), float(difference_m.idxmax()))


def add_cause_sentences(
    explanation: DifferenceExplanation, axis_label: str, reason_by_property_name: dict[str, str]
) -> DifferenceExplanation:
    """Add sentences on the causes of the difference KF - EKF2, largest first.

    The largest contribution is described, and the second largest if it is not small. Further
    sentences state the unexplained fraction, the RMSE against ground truth, and a large difference
    outside the replayed times.

    Parameters
    ----------
    explanation : DifferenceExplanation
    axis_label : str
        Name of the axis, for example "north".
    reason_by_property_name : mapping from str to str
        Text for each possible cause, for example the measurement noise.
    """
    sentences = []
    if explanation.corrected:
        settings_text = " and ".join(
            f"{COMPARISON_OPTIONS[name]} {value:g}" for name, value in explanation.corrected.items()
        )
        sentences.append(
            f"The following sentences explain a run of KF with the estimated noise "
            f"({settings_text})."
        )
    min_contribution_m2 = MIN_CONTRIBUTION_FRACTION * explanation.position_mean_square_m2
    # The properties of KF whose replacement reduces the difference most
    largest_contributions = sorted(
        explanation.steps, key=lambda replacement: -replacement.position_mean_square_m2
    )
    for rank_text, replacement in zip(RANK_TEXTS, largest_contributions, strict=False):
        # The largest contribution is always stated, the second largest only if it matters
        is_small = replacement.position_mean_square_m2 < min_contribution_m2
        if is_small and replacement is not largest_contributions[0]:
            break
        reason = reason_by_property_name[replacement.name]
        if replacement.name == steps.REJECTION_PROPERTY_NAME:
            reason += _describe_rejections(explanation)
        sentences.append(
            f"{rank_text} contribution to the difference KF - EKF2 along {axis_label}: "
            f"{replacement.name}. {reason}. "
            f"{_describe_replacement_effect(replacement, explanation)}"
        )
    sentences += [_describe_unexplained_fractions(explanation), *_describe_rmse(explanation)]
    outside = explanation.outside
    max_difference_inside_replay_m = np.max(np.abs(explanation.kf_minus_ekf2_m))
    if outside is not None and outside.maximum_m > max(
        MIN_DIFFERENCE_OUTSIDE_REPLAY_M,
        MIN_DIFFERENCE_RATIO_OUTSIDE_REPLAY * max_difference_inside_replay_m,
    ):
        sentences.append(
            "Outside the replayed times (while EKF2 initialises or does not fuse positions) the "
            f"positions of KF and EKF2 differ by up to {outside.maximum_m:.1f} m (at "
            f"{outside.at_s:.0f} s)."
        )
    return structs.replace(explanation, sentences=tuple(sentences))


def _describe_replacement_effect(
    replacement: PropertyReplacement, explanation: DifferenceExplanation
) -> str:
    """Describe the effect of replacing one property of KF by that of EKF2."""
    explained_fraction = replacement.position_mean_square_m2 / explanation.position_mean_square_m2
    # A decrease by more than 100 % is possible only if other replacements increase the difference
    increase_text = " Other replacements increase the difference."
    return (
        f"If KF uses EKF2's {replacement.name}, KF's position changes by up to "
        f"{replacement.position_moved_m:.2f} m (at {replacement.moved_at_s:.1f} s), and the mean "
        f"square difference KF - EKF2 decreases by {100 * explained_fraction:.0f} % "
        f"of its original value.{increase_text * (explained_fraction > 1.0)}"
    )


def _describe_rejections(explanation: DifferenceExplanation) -> str:
    """Describe the longest series of positions that EKF2 rejected; "" if it rejected none."""
    longest_rejection = explanation.longest_rejection
    if longest_rejection is None:
        return ""
    return (
        f". From {longest_rejection.start_s:.0f} s on, EKF2 rejected "
        f"{format_count(longest_rejection.samples, 'position')} in a row for "
        f"{longest_rejection.duration_s:.1f} s. Replays with and without gate differ by up to "
        f"{longest_rejection.distance_m:.2g} m in EKF2's position"
    )


def _describe_property_differences(
    comparison: Comparison, model: Ekf2Model, time_offset: SourceTimeOffset | Unavailable
) -> dict[str, str]:
    """Describe how each property of EKF2 that KF can take over differs from that of KF."""
    kf_settings, inputs, source = comparison.settings, model.inputs, comparison.source
    parameters, aid, ekf2_position_source = (
        inputs.settings,
        inputs.aid,
        inputs.received_positions.source,
    )
    # KF and EKF2 may use different accelerations, positions or sample times. Describe only the
    # first of these differences that applies
    if kf_settings.input == "zero":
        sample_time_text = "KF uses no acceleration (--input zero); EKF2 uses the IMU"
    elif source.name != ekf2_position_source:
        sample_time_text = f"KF uses positions of {source.name}; EKF2 uses {ekf2_position_source}"
    else:
        sample_time_text = (
            f"KF predicts every {kf_settings.dt_s:g} s, starting at its first position; EKF2 "
            f"predicts every {1e3 * inputs.mean_step_s:.0f} ms"
        )
    # KF assumes that a position is this old at its timestamp. The correction --clock-offset is
    # negative for late timestamps, that is, for old positions
    position_age_ms = 1e3 * (source.assumed_delay_s - kf_settings.clock_offset_s)
    delay_text = (
        f"EKF2 assumes that positions are {parameters[aid.delay]:g} ms old ({aid.delay}), KF "
        f"assumes {position_age_ms:.0f} ms"
    )
    if isinstance(time_offset, SourceTimeOffset) and time_offset.is_determinable:
        low_offset_s, high_offset_s = time_offset.interval_s
        # Age = assumed delay - offset, so the upper limit of the offset gives the lower limit of
        # the age
        estimated_position_age_ms, low_ms, high_ms = (
            1e3 * (source.assumed_delay_s - offset_s)
            for offset_s in (time_offset.offset_s, high_offset_s, low_offset_s)
        )
        delay_text += (
            f". The maximum-likelihood age is {estimated_position_age_ms:.0f} ms "
            f"(95 % {low_ms:.0f} to {high_ms:.0f} ms)"
        )
    # White acceleration noise adds the variance (σ · step)² per step: the same variance per second
    # needs σ in proportion to 1 / √step
    acc_noise = parameters["EKF2_ACC_NOISE"]
    acc_noise_as_sigma_a = acc_noise * np.sqrt(inputs.mean_step_s / kf_settings.dt_s)
    higher_weighted_input = (
        "IMU" if acc_noise_as_sigma_a < kf_settings.sigma_a_m_s2 else "positions"
    )
    return {
        steps.SAMPLE_TIMES_PROPERTY_NAME: sample_time_text,
        steps.TIMESTAMPS_PROPERTY_NAME: delay_text,
        steps.MEASUREMENT_NOISE_PROPERTY_NAME: (
            f"EKF2 uses a measurement noise of {find_used_noise_m(inputs):.2g} m "
            f"({aid.noise}), KF uses {kf_settings.sigma_z_m:.2g} m"
        ),
        steps.ACCELEROMETER_BIAS_PROPERTY_NAME: (
            "EKF2 estimates the accelerometer bias; KF does not"
        ),
        steps.PROCESS_NOISE_PROPERTY_NAME: (
            f"EKF2_ACC_NOISE {acc_noise:g} has the same effect as SIGMA_A "
            f"{acc_noise_as_sigma_a:.2g} m/s²; KF has SIGMA_A {kf_settings.sigma_a_m_s2:.2g} m/s². "
            f"EKF2 gives the {higher_weighted_input} more weight than KF does"
        ),
        steps.ATTITUDE_PROPERTY_NAME: (
            "EKF2 corrects its attitude with the positions; KF uses EKF2's logged attitude"
        ),
        steps.MAGNETOMETER_PROPERTY_NAME: (
            "EKF2 estimates its heading with the magnetometer; KF uses EKF2's published heading"
        ),
        steps.GNSS_VELOCITY_PROPERTY_NAME: (
            "EKF2 also fuses GNSS velocity; KF uses GNSS position only"
        ),
        steps.FLOW_PROPERTY_NAME: "EKF2 also fuses optical flow; KF uses positions only",
        steps.VISION_PROPERTY_NAME: (
            "EKF2 fuses external vision and GNSS; KF uses one position source"
        ),
        steps.REJECTION_PROPERTY_NAME: (
            f"EKF2 rejects {100 * model.agreement.rejected_fraction_logged:.1f} % of the "
            f"positions of {ekf2_position_source}; KF has no innovation gate and uses all positions"
        ),
        steps.OUTPUT_PREDICTOR_PROPERTY_NAME: (
            f"EKF2 fuses positions with a delay of {1e3 * inputs.horizon_s:.0f} ms. EKF2's "
            f"output predictor (EKF2_TAU_POS {parameters['EKF2_TAU_POS']:g} s) extrapolates "
            "to the present. KF has no delay"
        ),
    }


def _describe_unexplained_fractions(explanation: DifferenceExplanation) -> str:
    """State the RMS difference KF - EKF2, and the fraction that remains after all replacements."""
    velocity_mean_square_m2_s2 = explanation.velocity_mean_square_m2_s2
    unexplained_position_text, unexplained_velocity_text = (
        f"{100 * min(fraction, 1.0):.1f} %"
        for fraction in (
            explanation.unexplained_fraction,
            explanation.unexplained_velocity_mean_square_m2_s2 / velocity_mean_square_m2_s2,
        )
    )
    return (
        "RMS difference KF - EKF2 over the replayed times: "
        f"{explanation.position_mean_square_m2**0.5:.3f} m and "
        f"{velocity_mean_square_m2_s2**0.5:.3f} m/s. The replay does not explain "
        f"{unexplained_position_text} of the mean square position difference and "
        f"{unexplained_velocity_text} of the mean square velocity difference."
    )


def _describe_rmse(explanation: DifferenceExplanation) -> list[str]:
    """Compare the position RMSE of KF and EKF2 in a sentence; [] without ground truth."""
    kf_rmse_m, ekf2_rmse_m = (explanation.position_rmse_to_truth_m[name] for name in ("kf", "ekf2"))
    if isinstance(kf_rmse_m, Unavailable) or isinstance(ekf2_rmse_m, Unavailable):
        return []
    if abs(kf_rmse_m - ekf2_rmse_m) <= MAX_RELATIVE_RMSE_DIFFERENCE * max(kf_rmse_m, ekf2_rmse_m):
        return [
            "KF and EKF2 have the same position RMSE (within "
            f"{100 * MAX_RELATIVE_RMSE_DIFFERENCE:.0f} %): KF {kf_rmse_m:.3f} m, EKF2 "
            f"{ekf2_rmse_m:.3f} m."
        ]
    # KF's properties are replaced by those of EKF2 one after the other: element i is KF's RMSE
    # after i replacements. Find the replacement that changes KF's mean square error most towards
    # that of EKF2
    rmses_m = [
        kf_rmse_m,
        *(replacement.position_rmse_to_truth_m or 0.0 for replacement in explanation.steps),
    ]
    mean_square_changes = np.diff(np.square(rmses_m)) * np.sign(ekf2_rmse_m - kf_rmse_m)
    index = int(np.argmax(mean_square_changes))
    return [
        f"Position RMSE: EKF2 {ekf2_rmse_m:.3f} m, KF {kf_rmse_m:.3f} m. KF's RMSE changes "
        f"most if KF uses EKF2's {explanation.steps[index].name}: from {rmses_m[index]:.3f} to "
        f"{rmses_m[index + 1]:.3f} m."
    ]
