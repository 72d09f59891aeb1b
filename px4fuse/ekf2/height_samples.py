"""Height sensors that EKF2 fused, and their samples for the EKF2 replay.

Sources: PX4-Autopilot ``EKF/height_control.cpp`` (height reference), ``EKF/bias_estimator``.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, GNSS_HGT, uses_aid_mask
from px4fuse.flight.model import (
    GROUND_EFFECT_FLAG,
    Ekf2,
    Flight,
    FusionRecord,
    sample_step_function,
)

from .barometer import find_fused_barometer_samples
from .replay_segments import HeightSamples, ReplaySegment, find_sample_steps

# State index of the height
POSITION_DOWN = 8
HEIGHT_SENSORS = (BAROMETER, GNSS_HGT)
HEIGHT_AIDS = (*HEIGHT_SENSORS, AIDS["rng_hgt"], AIDS["ev_hgt"])
# Default (m) of EKF2_GND_EFF_DZ, the barometer's dead zone near the ground
DEFAULT_GROUND_EFFECT_DEAD_ZONE_M = 4.0
# PX4's name of the height reference, by value of EKF2_HGT_REF
HEIGHT_AID_BY_REFERENCE = {0: BAROMETER.name, 1: GNSS_HGT.name}
# Maximum time (s) from the start of the replay to the first logged height bias
MAX_FIRST_HEIGHT_BIAS_DELAY_S = 1.0
# Minimum logging rate (Hz) of the barometer for a replay of its fusion
MIN_BAROMETER_LOG_HZ = 4.0


def add_heights(
    flight: Flight, ekf2: Ekf2, fusion_record: FusionRecord, segments: Sequence[ReplaySegment]
) -> tuple[ReplaySegment, ...] | str:
    """Add height measurements to the replay, or return the reason why this is impossible."""
    parameters = fusion_record.parameters
    if uses_aid_mask(parameters):
        return "EKF2 before PX4 v1.14 fuses only one height sensor"
    # 1. Fused height sensors, and height reference
    replayed_times_s = np.concatenate([segment.time_s for segment in segments])
    enabled_fractions = {
        name: np.mean(sample_step_function(aid_log.enabled, replayed_times_s) > 0.0)
        for name, aid_log in ekf2.aids.items()
        if aid_log.enabled is not None
    }
    # Sensors that EKF2 fused all the time
    fused_aids = [aid.name for aid in HEIGHT_SENSORS if enabled_fractions.get(aid.name) == 1.0]
    for aid in HEIGHT_AIDS:
        if enabled_fractions.get(aid.name) and aid.name not in fused_aids:
            return f"EKF2 also fused {aid.label} in part of the flight"
    reference = HEIGHT_AID_BY_REFERENCE.get(int(parameters.get("EKF2_HGT_REF", 1.0)))
    # A single height sensor is the height reference
    if len(fused_aids) == 1:
        (reference,) = fused_aids
    if reference not in fused_aids:
        return "EKF2's height reference is neither GNSS nor barometer, or not logged"
    # 2. Barometer samples
    barometer_samples = pd.DataFrame(columns=["down_m", "weight"], dtype=float)
    if BAROMETER.name in fused_aids and flight.barometer is not None:
        # EKF2 subtracts half a prediction step from the sample times
        barometer_down_m = flight.barometer["down_m"]
        barometer_down_m = barometer_down_m.set_axis(barometer_down_m.index - 0.5 * ekf2.step_s)
        barometer_samples = find_fused_barometer_samples(ekf2, fusion_record, barometer_down_m)
    barometer_samples["down_m"] += fusion_record.altitude_m
    sample_times_s = barometer_samples.index.to_numpy(float)
    # The dead zone is 0 outside ground effect
    barometer_samples["dead_zone_m"] = fusion_record.was_flag_set(
        GROUND_EFFECT_FLAG, sample_times_s
    ) * parameters.get("EKF2_GND_EFF_DZ", DEFAULT_GROUND_EFFECT_DEAD_ZONE_M)
    # 3. Initial bias, barometer samples and initial height of each segment
    segments_with_heights = []
    delayed_down_m = fusion_record.delayed_state["down_m"]
    for segment in segments:
        start_s = float(segment.time_s[0])
        bias_and_variance = np.zeros(2)
        if len(fused_aids) > 1:
            # EKF2 estimates the bias of the sensor that is not the reference
            (name,) = {*fused_aids} - {reference}
            bias = fusion_record.height_bias_updates.get(name)
            if (
                bias is None
                or not bias.index[0] - MAX_FIRST_HEIGHT_BIAS_DELAY_S < start_s < bias.index[-1]
            ):
                return f"EKF2's estimate of the {AIDS[name].label} bias is not logged"
            bias_and_variance = np.array(
                [np.interp(start_s, bias.index, bias[column]) for column in ("bias_m", "bias_m2")]
            )
        step_indices, is_inside = find_sample_steps(segment, sample_times_s)
        rate_hz = len(step_indices) / (segment.time_s[-1] - start_s)
        if BAROMETER.name in fused_aids and rate_hz < MIN_BAROMETER_LOG_HZ:
            return (
                f"the barometer is logged at {rate_hz:.1f} Hz; a replay of its fusion needs "
                f"{MIN_BAROMETER_LOG_HZ:g} Hz"
            )
        initial_state = segment.state.copy()
        initial_state[POSITION_DOWN] = np.interp(start_s, delayed_down_m.index, delayed_down_m)
        height_samples = HeightSamples(
            tuple(fused_aids),
            reference,
            bias_and_variance,
            step_indices,
            barometer_samples[is_inside],
        )
        segments_with_heights.append(
            replace(segment, state=initial_state, height_samples=height_samples)
        )
    return tuple(segments_with_heights)
