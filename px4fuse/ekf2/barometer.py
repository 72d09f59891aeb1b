"""Barometer samples that EKF2 fused, including samples that the logger dropped.

PX4's default profile logs only 5 of the 10 or 20 samples per second. More samples are computed from
``estimator_aid_src_baro_hgt`` and from the innovations in ``estimator_baro_bias``. The mean of the
remaining samples is known since PX4 v1.16 from the logged low-pass filtered innovation; their
scatter is simulated.

Sources: PX4-Autopilot ``EKF/ekf_helper.cpp`` (updateAidSourceStatus),
``EKF/aid_sources/barometer/baro_height_control.cpp``, ``EKF/bias_estimator/bias_estimator.cpp``.
"""

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.ekf2.bias import SENSOR_BIAS_NOISE_DENSITY
from px4fuse.ekf2.replay_segments import INNOVATION_TIME_CONSTANT_S
from px4fuse.flight.ekf2_parameters import BAROMETER
from px4fuse.flight.model import GROUND_EFFECT_FLAG, Ekf2, FusionRecord

# Default rate (Hz) at which EKF2 fuses the barometer, PX4 v1.15 and later
BAROMETER_HZ = 10.0
# Rate (Hz) at which EKF2 fuses the barometer before PX4 v1.15
BAROMETER_HZ_BEFORE_V1_15 = 15.0
# The barometer interval is computed from the logged bias variance only if interquartile range /
# median of the computed intervals is below this value
MAX_RELATIVE_INTERVAL_IQR = 0.1
# Two logged times belong to one barometer sample if they differ by less than this fraction of the
# sample interval
MATCH_INTERVAL_FRACTION = 0.3
# Maximum number of barometer samples that are reconstructed between two rows of the log
MAX_SAMPLES_PER_ROW = 30
# Maximum weight of a barometer sample: number of fused samples that it stands for (1 plus half of
# the missing samples before and after it)
MAX_SAMPLE_WEIGHT = 4.0
# Minimum divisor (sum of sample weights), for intervals without a missing barometer sample
MIN_WEIGHT_SUM = 1e-9


def estimate_barometer_interval_s(fusion_record: FusionRecord) -> float:
    """Return the interval (s) of the barometer samples that EKF2 fuses.

    The interval is computed from the variance p of EKF2's barometer bias. In the steady state, an
    update reduces p as much as the random walk increases p: p' = p - p²/S and p = p' + q² Δt.
    """
    bias_updates = fusion_record.height_bias_updates.get(BAROMETER.name)
    if bias_updates is not None and len(bias_updates) > 1:
        variance_m2 = bias_updates["variance_m2"] * _compute_bias_gain(bias_updates)
        intervals_s = (variance_m2 - bias_updates["bias_m2"])[
            len(bias_updates) // 5 :
        ] / SENSOR_BIAS_NOISE_DENSITY**2
        lower_quartile_s, median_s, upper_quartile_s = np.percentile(
            intervals_s, [25.0, 50.0, 75.0]
        )
        if upper_quartile_s - lower_quartile_s < MAX_RELATIVE_INTERVAL_IQR * median_s:
            return float(median_s)
    return 1.0 / (
        BAROMETER_HZ_BEFORE_V1_15 if fusion_record.stores_bias_increments else BAROMETER_HZ
    )


def _compute_bias_gain(bias: pd.DataFrame) -> Array:
    """Return the Kalman gain K = p/S of the logged updates of the barometer bias.

    p is the bias variance before the update. The log contains the variance after it, p - p²/S.
    """
    bias_variance_ratio = (bias["bias_m2"] / bias["variance_m2"]).to_numpy()
    return np.asarray(0.5 - 0.5 * np.sqrt(np.maximum(1.0 - 4.0 * bias_variance_ratio, 0.0)))


def find_fused_barometer_samples(
    ekf2: Ekf2, fusion_record: FusionRecord, logged_down_m: "pd.Series[float]"
) -> pd.DataFrame:
    """Return the barometer samples that EKF2 fused, indexed by EKF2's measurement time.

    Columns: ``down_m`` (height) and ``weight`` (above 1 if neighbouring samples are missing).
    ``logged_down_m`` is the logged height (m, down) at measurement times.
    """
    interval_s = estimate_barometer_interval_s(fusion_record)
    samples = _combine_barometer_samples(ekf2, fusion_record, logged_down_m, interval_s)
    distance_s = np.diff(np.pad(samples.index.to_numpy(), 1, mode="edge"))
    weight = 0.5 * np.rint((distance_s[1:] + distance_s[:-1]) / interval_s)
    return pd.DataFrame({"down_m": samples, "weight": np.clip(weight, 1.0, MAX_SAMPLE_WEIGHT)})


def _combine_barometer_samples(
    ekf2: Ekf2, fusion_record: FusionRecord, logged_down_m: "pd.Series[float]", interval_s: float
) -> "pd.Series[float]":
    logged_rows = ekf2.aids[BAROMETER.name].samples
    if "observation_down" not in logged_rows or len(logged_rows) < 2:
        return logged_down_m
    row_times_s = logged_rows.index.to_numpy()
    velocity_down_m_s = ekf2.state["down_m_s"]
    velocity_times_s = velocity_down_m_s.index.to_numpy()
    displacement_m = cumulative_trapezoid(velocity_down_m_s.to_numpy(), velocity_times_s, initial=0)
    default_bias_update = dict.fromkeys(("bias_m", "bias_m2"), 0.0)
    default_bias_update |= {"innovation_m": np.nan, "variance_m2": 1.0}
    bias_updates = fusion_record.height_bias_updates.get(
        BAROMETER.name, pd.DataFrame(default_bias_update, index=row_times_s[:1])
    )
    # The logged barometer bias is the bias after an update, but the innovation of the update uses
    # the bias before it. The logged bias therefore counts from half an interval later on
    bias_times_s = np.column_stack(
        [bias_updates.index, bias_updates.index + 0.5 * interval_s]
    ).ravel()
    previous_bias_m = bias_updates["bias_m"] - (
        _compute_bias_gain(bias_updates) * bias_updates["innovation_m"]
    ).fillna(0.0)
    fused_bias_m = np.column_stack([previous_bias_m, bias_updates["bias_m"]]).ravel()
    # Innovations in ground effect are not used: EKF2 subtracts a dead zone from them
    rows_outside_ground_effect = logged_rows[
        ~fusion_record.was_flag_set(GROUND_EFFECT_FLAG, row_times_s)
    ]
    prediction_offset_m = (
        rows_outside_ground_effect["observation_down"]
        - rows_outside_ground_effect["innovation_down"]
    )
    prediction_offset_m -= np.interp(
        rows_outside_ground_effect.index, velocity_times_s, displacement_m
    )

    def interpolate_bias_m(time_s: Array) -> Array:
        return np.asarray(np.interp(time_s, bias_times_s, fused_bias_m))

    def predict_measured_down_m(time_s: Array) -> Array:
        """Return EKF2's predicted barometer measurement (m, down): state minus bias."""
        state_down_m = np.interp(
            time_s, rows_outside_ground_effect.index, prediction_offset_m
        ) + np.interp(time_s, velocity_times_s, displacement_m)
        return np.asarray(state_down_m - interpolate_bias_m(time_s))

    # Two-dimensional arrays have one row for each interval between logged samples, and one column
    # for each sample that EKF2 fused in the interval
    span_s = np.diff(row_times_s)
    sample_count = np.maximum(np.rint(span_s / interval_s), 1.0).astype(int)
    is_regular = np.abs(span_s - sample_count * interval_s) < MATCH_INTERVAL_FRACTION * interval_s
    is_regular &= sample_count <= MAX_SAMPLES_PER_ROW
    sample_interval_by_row_s = span_s / sample_count
    sample_indices = np.arange(sample_count[is_regular].max(initial=1))
    innovation_m = np.full((len(sample_count), len(sample_indices)), np.nan)
    # If several topics contain a sample, the last topic in this order is used
    time_s = np.concatenate([bias_updates.index, logged_down_m.index, row_times_s])
    down_m = np.concatenate(
        [
            predict_measured_down_m(bias_updates.index.to_numpy()) - bias_updates["innovation_m"],
            logged_down_m,
            logged_rows["observation_down"] - interpolate_bias_m(row_times_s),
        ]
    )
    row_index = np.searchsorted(row_times_s[1:], time_s - MATCH_INTERVAL_FRACTION * interval_s)
    row_index = np.minimum(row_index, len(sample_count) - 1)
    intervals_since_row = (time_s - row_times_s[row_index]) / sample_interval_by_row_s[row_index]
    is_matched = is_regular[row_index] & (
        np.abs(intervals_since_row - np.rint(intervals_since_row)) < MATCH_INTERVAL_FRACTION
    )
    is_matched &= (intervals_since_row > MATCH_INTERVAL_FRACTION) & (
        intervals_since_row < sample_count[row_index] + MATCH_INTERVAL_FRACTION
    )
    innovation_m[
        row_index[is_matched], np.rint(intervals_since_row[is_matched]).astype(int) - 1
    ] = (down_m - predict_measured_down_m(time_s))[is_matched]
    if "filtered_down" in logged_rows:
        # The sign is changed, because PX4 logs state minus measurement
        filtered_nu_m = -logged_rows["filtered_down"].to_numpy()
        age_in_samples = sample_count[:, None] - 1.0 - sample_indices
        is_missing = np.isnan(innovation_m) & (age_in_samples >= 0.0) & is_regular[:, None]
        innovation_m = _simulate_missing_innovations(
            innovation_m,
            is_missing,
            sample_interval_by_row_s[:, None],
            age_in_samples,
            filtered_nu_m,
        )
    sample_times_s = row_times_s[:-1, None] + sample_interval_by_row_s[:, None] * (
        sample_indices + 1
    )
    has_sample = np.isfinite(innovation_m)
    sample_times_s = sample_times_s[has_sample]
    time_s = np.concatenate([sample_times_s, time_s[~is_matched]])
    down_m = np.concatenate(
        [predict_measured_down_m(sample_times_s) + innovation_m[has_sample], down_m[~is_matched]]
    )
    height_samples = pd.Series(down_m, pd.Index(time_s, name="time_s")).dropna().sort_index()
    return height_samples[
        np.diff(height_samples.index, prepend=-np.inf) > MATCH_INTERVAL_FRACTION * interval_s
    ]


def _simulate_missing_innovations(
    innovation_m: Array,
    is_missing: BoolArray,
    interval_s: Array,
    age_in_samples: Array,
    filtered_nu_m: Array,
) -> Array:
    """Fill in random innovations for missing ones; their low-pass filter gives ``filtered_nu_m``.

    Parameters
    ----------
    innovation_m, is_missing : ndarray, shape (n, k)
        Innovations of the k samples before each of n logged rows.
    interval_s : ndarray, shape (n, 1)
        Time between two samples.
    age_in_samples : ndarray, shape (n, k)
        Number of samples from each sample to the next logged row.
    filtered_nu_m : ndarray, shape (n + 1,)
        Low-pass filtered innovation at the start and at each logged row.
    """
    new_sample_weight = interval_s / (interval_s + INNOVATION_TIME_CONSTANT_S)
    filter_weight = new_sample_weight * (1.0 - new_sample_weight) ** np.maximum(age_in_samples, 0.0)
    missing_weight = filter_weight * is_missing
    simulated_nu_m = np.random.default_rng(0).normal(
        scale=np.nanstd(innovation_m), size=innovation_m.shape
    )
    previous_value_weight = (1.0 - new_sample_weight[:, 0]) ** (age_in_samples[:, 0] + 1.0)
    weighted_innovation_sum_m = np.nansum(filter_weight * innovation_m, axis=1) + (
        missing_weight * simulated_nu_m
    ).sum(axis=1)
    simulated_nu_correction_m = (
        filtered_nu_m[1:] - previous_value_weight * filtered_nu_m[:-1] - weighted_innovation_sum_m
    )
    simulated_nu_correction_m /= np.maximum(missing_weight.sum(axis=1), MIN_WEIGHT_SUM)
    return np.where(is_missing, simulated_nu_m + simulated_nu_correction_m[:, None], innovation_m)
