"""Barometer samples that EKF2 fused, including samples that the logger dropped.

PX4's default profile logs fewer barometer samples than EKF2 fuses. The missing samples are computed
from ``estimator_aid_src_baro_hgt`` and ``estimator_baro_bias``, or simulated.

Sources: PX4-Autopilot ``EKF/ekf_helper.cpp`` (updateAidSourceStatus),
``EKF/aid_sources/barometer/baro_height_control.cpp``, ``EKF/bias_estimator/bias_estimator.cpp``.
"""

from collections.abc import Callable

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray, integrate_cumulatively
from px4fuse.flight.ekf2_parameters import BAROMETER
from px4fuse.flight.model import GROUND_EFFECT_FLAG, Ekf2, FusionRecord

from .bias import POSITION_BIAS_NOISE_M_PER_SQRT_S
from .replay_segments import INNOVATION_LOW_PASS_TIME_CONSTANT_S

# Default rate (Hz) at which EKF2 fuses the barometer, PX4 v1.15 and later
BAROMETER_FUSION_RATE_HZ = 10.0
# Rate (Hz) at which EKF2 fuses the barometer before PX4 v1.15
BAROMETER_FUSION_RATE_HZ_BEFORE_V1_15 = 15.0
# Each logged update of the barometer bias gives an estimate of EKF2's barometer sample interval.
# Their median is used only if their interquartile range ÷ median is below this value
MAX_RELATIVE_SPREAD_OF_INTERVALS = 0.1
# Several topics of the log contain barometer samples. Samples of two topics are the same sample if
# their times differ by less than this fraction of the sample interval
SAME_SAMPLE_TOLERANCE_IN_INTERVALS = 0.3
# Maximum number of barometer samples that are reconstructed between two rows of
# estimator_aid_src_baro_hgt
MAX_SAMPLES_PER_LOGGED_INTERVAL = 30
# Maximum weight of a logged barometer sample: the number of EKF2 samples that it represents in the
# replay, above 1 if neighbouring samples are missing
MAX_BAROMETER_SAMPLE_WEIGHT = 4.0
# Lower limit of the sum of the low-pass filter weights of all missing samples in an interval; it
# avoids a division by zero if no sample is missing
MIN_WEIGHT_SUM_OF_MISSING_SAMPLES = 1e-9


def estimate_barometer_interval_s(fusion_record: FusionRecord) -> float:
    """Return the interval (s) of the barometer samples that EKF2 fuses.

    The interval is computed from the growth of the logged barometer bias variance between updates.
    """
    barometer_bias_updates = fusion_record.height_bias_updates.get(BAROMETER.name)
    if barometer_bias_updates is not None and len(barometer_bias_updates) > 1:
        # P of the barometer bias before an update is K S. In the steady state, it exceeds P after
        # an update by the process noise of one sample interval. The first fifth of the updates is
        # omitted, because it may not be in the steady state
        prior_variance_m2 = barometer_bias_updates["variance_m2"] * _compute_bias_gain(
            barometer_bias_updates
        )
        variance_growth_m2 = prior_variance_m2 - barometer_bias_updates["bias_m2"]
        intervals_s = variance_growth_m2 / POSITION_BIAS_NOISE_M_PER_SQRT_S**2
        lower_quartile_s, median_s, upper_quartile_s = np.percentile(
            intervals_s[len(intervals_s) // 5 :], [25.0, 50.0, 75.0]
        )
        if upper_quartile_s - lower_quartile_s < MAX_RELATIVE_SPREAD_OF_INTERVALS * median_s:
            return float(median_s)
    # Without usable bias updates: the default rate of the release. Only releases before v1.15 log
    # delta angle biases
    if fusion_record.has_delta_angle_biases:
        return 1.0 / BAROMETER_FUSION_RATE_HZ_BEFORE_V1_15
    return 1.0 / BAROMETER_FUSION_RATE_HZ


def _compute_bias_gain(barometer_bias_updates: pd.DataFrame) -> Array:
    """Return the Kalman gain K of the logged updates of the barometer bias.

    The log contains the innovation variance S and the bias variance P after the update. The bias is
    the only state, so P = (1 - K) K S. The result is the smaller solution of K - K² = P / S.
    """
    posterior_to_innovation_variance_ratio = (
        barometer_bias_updates["bias_m2"] / barometer_bias_updates["variance_m2"]
    ).to_numpy()
    return 0.5 - 0.5 * np.sqrt(np.maximum(1.0 - 4.0 * posterior_to_innovation_variance_ratio, 0.0))


def find_fused_barometer_samples(
    ekf2: Ekf2, fusion_record: FusionRecord, logged_down_m: pd.Series
) -> pd.DataFrame:
    """Return the barometer samples that EKF2 fused, indexed by EKF2's measurement time (s).

    Columns: ``down_m`` (height, m) and ``weight`` (above 1 if neighbouring samples are missing).
    """
    interval_s = estimate_barometer_interval_s(fusion_record)
    samples = _combine_barometer_samples(ekf2, fusion_record, logged_down_m, interval_s)
    sample_intervals_s = np.diff(np.pad(samples.index.to_numpy(), 1, mode="edge"))
    weight = 0.5 * np.rint((sample_intervals_s[1:] + sample_intervals_s[:-1]) / interval_s)
    return pd.DataFrame(
        {"down_m": samples, "weight": np.clip(weight, 1.0, MAX_BAROMETER_SAMPLE_WEIGHT)}
    )


def _compute_bias_over_time(bias_updates: pd.DataFrame, interval_s: float) -> pd.Series:
    """Return the barometer bias (m) before and after each update, by time (s).

    EKF2 computes innovations with the bias before an update, but logs the bias after the update.
    The bias changes in the half sample interval after the update.
    """
    bias_change_m = _compute_bias_gain(bias_updates) * bias_updates["innovation_m"]
    bias_m = bias_updates["bias_m"]
    bias_after_update_m = bias_m.set_axis(bias_m.index + 0.5 * interval_s)
    changes = pd.concat([bias_m - bias_change_m.fillna(0.0), bias_after_update_m])
    return pd.Series(changes).sort_index()


def _make_measurement_prediction(
    ekf2: Ekf2, fusion_record: FusionRecord, bias_m: pd.Series
) -> Callable[[Array], Array]:
    """Return the function of time (s) for EKF2's predicted barometer measurement (m, down).

    The prediction is EKF2's height at the logged height updates, minus the barometer bias. Between
    two updates, the integral of EKF2's vertical velocity is added.
    """
    updates = ekf2.aids[BAROMETER.name].samples
    # In ground effect, EKF2 reduces innovations by a dead zone, so these innovations are not used
    updates = updates[~fusion_record.was_flag_set(GROUND_EFFECT_FLAG, updates.index.to_numpy())]
    velocity_times_s = ekf2.state.index.to_numpy()
    displacement_m = integrate_cumulatively(ekf2.state["down_m_s"].to_numpy(), velocity_times_s)
    height_minus_displacement_m = (
        updates["observation_down"]
        - updates["innovation_down"]
        - np.interp(updates.index, velocity_times_s, displacement_m)
    )

    def predict_measured_down_m(time_s: Array) -> Array:
        return np.asarray(
            np.interp(time_s, updates.index, height_minus_displacement_m)
            + np.interp(time_s, velocity_times_s, displacement_m)
            - np.interp(time_s, bias_m.index, bias_m)
        )

    return predict_measured_down_m


def _combine_barometer_samples(
    ekf2: Ekf2, fusion_record: FusionRecord, logged_down_m: pd.Series, interval_s: float
) -> pd.Series:
    """Return the barometer heights (m, down) that EKF2 fused, by time (s).

    EKF2's logged height updates contain only some of the fused samples. Missing heights are taken
    from ``logged_down_m`` (barometer topic), or computed from the logged updates of the barometer
    bias. Heights that no topic contains cannot be recovered: they get random innovations that are
    consistent with the low-pass filtered innovation in the log.

    ``interval_s`` is the interval of the samples that EKF2 fused. Without logged height updates,
    return ``logged_down_m``.
    """
    logged_updates = ekf2.aids[BAROMETER.name].samples
    if "observation_down" not in logged_updates or len(logged_updates) < 2:
        return logged_down_m
    row_times_s = logged_updates.index.to_numpy()
    zero_bias_update = {"bias_m": 0.0, "bias_m2": 0.0, "innovation_m": np.nan, "variance_m2": 1.0}
    bias_updates = fusion_record.height_bias_updates.get(
        BAROMETER.name, pd.DataFrame(zero_bias_update, index=row_times_s[:1])
    )
    bias_m = _compute_bias_over_time(bias_updates, interval_s)
    predict_measured_down_m = _make_measurement_prediction(ekf2, fusion_record, bias_m)
    # The log contains the heights in three forms, listed in increasing priority: if it contains a
    # sample several times, the last is used
    time_s = np.concatenate([bias_updates.index, logged_down_m.index, row_times_s])
    down_m = np.concatenate(
        [
            predict_measured_down_m(bias_updates.index.to_numpy()) - bias_updates["innovation_m"],
            logged_down_m,
            # The logged observation is corrected for the bias
            logged_updates["observation_down"] - np.interp(row_times_s, bias_m.index, bias_m),
        ]
    )
    # Length of each interval between two logged height updates, and number of samples that EKF2
    # fused in it
    span_s = np.diff(row_times_s)
    sample_count = np.maximum(np.rint(span_s / interval_s), 1.0).astype(int)
    # An interval is regular if its length is a multiple of the sample interval. The rows of other
    # intervals remain empty (NaN)
    is_regular = (
        np.abs(span_s - sample_count * interval_s) < SAME_SAMPLE_TOLERANCE_IN_INTERVALS * interval_s
    )
    is_regular &= sample_count <= MAX_SAMPLES_PER_LOGGED_INTERVAL
    sample_interval_by_row_s = span_s / sample_count
    sample_indices = np.arange(sample_count[is_regular].max(initial=1))
    innovation_m = np.full((len(sample_count), len(sample_indices)), np.nan)
    # Find the place of each height in the grid: row, and number of the sample from 1 to
    # sample_count
    row_index = np.searchsorted(
        row_times_s[1:], time_s - SAME_SAMPLE_TOLERANCE_IN_INTERVALS * interval_s
    )
    row_index = np.minimum(row_index, len(sample_count) - 1)
    intervals_since_row = (time_s - row_times_s[row_index]) / sample_interval_by_row_s[row_index]
    sample_number = np.rint(intervals_since_row).astype(int)
    is_on_sample_grid = (
        is_regular[row_index]
        & (np.abs(intervals_since_row - sample_number) < SAME_SAMPLE_TOLERANCE_IN_INTERVALS)
        & (sample_number >= 1)
        & (sample_number <= sample_count[row_index])
    )
    innovation_m[row_index[is_on_sample_grid], sample_number[is_on_sample_grid] - 1] = (
        down_m - predict_measured_down_m(time_s)
    )[is_on_sample_grid]
    # Simulate the samples that are still missing
    if "filtered_down" in logged_updates:
        age_in_samples = sample_count[:, None] - 1.0 - sample_indices
        is_missing = np.isnan(innovation_m) & (age_in_samples >= 0.0) & is_regular[:, None]
        innovation_m = _simulate_missing_innovations(
            innovation_m,
            is_missing,
            sample_interval_by_row_s[:, None],
            age_in_samples,
            # PX4 logs the filtered innovation with the opposite sign: state minus measurement
            -logged_updates["filtered_down"].to_numpy(),
        )
    # The height of a sample is the predicted measurement plus the innovation. Heights at other
    # times are added unchanged
    has_sample = np.isfinite(innovation_m)
    grid_times_s = row_times_s[:-1, None] + sample_interval_by_row_s[:, None] * (sample_indices + 1)
    grid_times_s = grid_times_s[has_sample]
    grid_down_m = predict_measured_down_m(grid_times_s) + innovation_m[has_sample]
    height_samples = pd.Series(
        np.append(grid_down_m, down_m[~is_on_sample_grid]),
        pd.Index(np.append(grid_times_s, time_s[~is_on_sample_grid]), name="time_s"),
    )
    height_samples = height_samples.dropna().sort_index()
    return height_samples[
        np.diff(height_samples.index, prepend=-np.inf)
        > SAME_SAMPLE_TOLERANCE_IN_INTERVALS * interval_s
    ]


def _simulate_missing_innovations(
    innovation_m: Array,
    is_missing: BoolArray,
    interval_s: Array,
    age_in_samples: Array,
    low_pass_filtered_innovation_m: Array,
) -> Array:
    """Replace missing innovations by random values that agree with the logged filtered innovation.

    EKF2 logs fewer rows than it fuses samples: up to k samples are fused between two logged rows.
    Each logged row contains the low-pass filtered innovation, which restricts the mean of the
    missing innovations before the row. Their scatter is random.

    Parameters
    ----------
    innovation_m, is_missing : ndarray, shape (n, k)
        Innovations of the samples in n intervals between logged rows, and True for unknown ones.
    interval_s : ndarray, shape (n, 1)
        Sample interval.
    age_in_samples : ndarray, shape (n, k)
        Number of samples from each sample to the next logged row.
    low_pass_filtered_innovation_m : ndarray, shape (n + 1,)
        Logged low-pass filtered innovations.
    """
    # EKF2 logs the filtered innovation f. Each innovation ν updates it: f ← (1 - w) f + w ν. After
    # the k samples of an interval, f = (1 - w)^k f_previous + Σ w (1 - w)^age ν. The last sample
    # has age 0
    w = interval_s / (interval_s + INNOVATION_LOW_PASS_TIME_CONSTANT_S)
    sample_weight = w * (1.0 - w) ** np.maximum(age_in_samples, 0.0)
    sample_count = age_in_samples[:, 0] + 1.0
    previous_weight = (1.0 - w[:, 0]) ** sample_count
    # Random innovations with the scatter of the known innovations. The padding after the last
    # sample of an interval stays NaN
    random_innovation_m = np.random.default_rng(0).normal(
        scale=np.nanstd(innovation_m), size=innovation_m.shape
    )
    filled_innovation_m = np.where(is_missing, random_innovation_m, innovation_m)
    # Shift all random innovations of an interval by one offset, so that the computed low-pass
    # filtered innovation equals the logged one. The offset is the difference of the two filtered
    # innovations ÷ sum of the weights of the random innovations
    filtered_innovation_error_m = (
        low_pass_filtered_innovation_m[1:]
        - previous_weight * low_pass_filtered_innovation_m[:-1]
        - np.nansum(sample_weight * filled_innovation_m, axis=1)
    )
    offset_m = filtered_innovation_error_m / np.maximum(
        (sample_weight * is_missing).sum(axis=1), MIN_WEIGHT_SUM_OF_MISSING_SAMPLES
    )
    return np.where(is_missing, random_innovation_m + offset_m[:, None], innovation_m)
