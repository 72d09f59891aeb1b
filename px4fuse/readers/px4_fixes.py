"""Reconstruction of GNSS fixes that EKF2 used, but the log does not contain."""

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, rms
from px4fuse.flight.model import Columns, Ekf2, Unavailable, rows_between, time_index

from . import px4_topics as px4
from .common import interpolate_inside_time_span, join_nearest_samples
from .px4_innovations import replace_vision_by_gnss_innovations
from .ulog_topics import Topics

# Maximum time (s) between a logged fix and the EKF2 observation of the same fix
MAX_TIME_DIFFERENCE_OF_SAME_FIX_S = 0.01
# Maximum difference (°) between logged latitude and EKF2's observation of latitude
MAX_DIFFERENCE_FROM_LOGGED_LATITUDE_DEG = 1.0
# Possible intervals (s) between the fixes of a GNSS receiver: 4 to 20 fixes per second
CANDIDATE_FIX_INTERVALS_S = np.arange(0.05, 0.26, 0.0005)
# Times between logged fixes are multiples of the receiver's interval between fixes. Maximum
# deviation (s) from such multiples, 98th percentile
MAX_DEVIATION_FROM_INTERVAL_MULTIPLE_S = 0.006
# Fixes that the log lacks are reconstructed from EKF2's position and innovation. Minimum number of
# logged fixes to measure the error of reconstructed fixes
MIN_LOGGED_FIXES = 10
# Times between logged fixes are multiples of the receiver's interval between fixes. The interval is
# known if two successive multiples (n and n + 1) each occur at least this number of times
MIN_LOGGED_INTERVALS_PER_MULTIPLE = 3
# Maximum RMS difference (m) between reconstructed and logged fixes, to use the reconstructed fixes
MAX_FIX_RECONSTRUCTION_ERROR_M = 0.1


def read_unlogged_fixes(
    topics: Topics, logged_fixes: pd.DataFrame, ekf2: Ekf2 | Unavailable
) -> pd.DataFrame:
    """Read GNSS fixes that only EKF2's topics contain (PX4 v1.16 and newer)."""
    if isinstance(ekf2, Unavailable):
        return pd.DataFrame()
    position, velocity, height = (
        topics.primary_samples(px4.TOPIC_LAYOUTS[f"estimator_aid_src_gnss_{quantity}"])
        for quantity in ("pos", "vel", "hgt")
    )
    # A row that is neither fused nor rejected contains no new fix
    position = position[position[["fused", "rejected"]].any(axis=1)]
    fixes = position.drop(columns=["fused", "rejected"]).join(velocity, how="inner").dropna()
    # Unless GNSS is the height reference, EKF2 corrects the height of a fix by its bias estimate:
    # use the height only if EKF2_HGT_REF is 1 (GNSS)
    if topics.ekf2_parameters.get("EKF2_HGT_REF", 1.0) == 1.0:
        fixes = fixes.join(height)
    # EKF2 shifts GNSS times by half a prediction interval (estimator_interface.cpp)
    fixes = fixes.set_axis(fixes.index + 0.5 * ekf2.step_s)
    # Latitude in the GNSS topic at the same time; NaN if the fix is not logged there
    logged_latitude_deg = join_nearest_samples(
        fixes[[]], logged_fixes[["latitude_deg"]].sort_index(), MAX_TIME_DIFFERENCE_OF_SAME_FIX_S
    )["latitude_deg"]
    # Before v1.16, EKF2's topic contains a local position (m), no latitude and longitude
    is_in_degrees = (
        fixes["latitude_deg"].sub(logged_latitude_deg).abs().median()
        < MAX_DIFFERENCE_FROM_LOGGED_LATITUDE_DEG
    )
    if not is_in_degrees:
        return pd.DataFrame()
    is_logged = logged_latitude_deg.notna()
    return rows_between(fixes[~is_logged], logged_fixes.index[0], logged_fixes.index[-1])


def reconstruct_fixes(
    fixes: pd.DataFrame, ekf2: Ekf2 | Unavailable, delay_s: float
) -> tuple[pd.DataFrame, str]:
    """Reconstruct the GNSS fixes between logged fixes: EKF2 position plus innovation.

    Up to PX4 v1.15, the log may lack some of the fixes that EKF2 fused. Return the missing fixes,
    with heights interpolated between logged fixes, and a note for the user. Both are empty if the
    RMS error, measured at logged fixes, exceeds MAX_FIX_RECONSTRUCTION_ERROR_M.

    Parameters
    ----------
    fixes : DataFrame
        Logged fixes: position (m, NED) and variances, indexed by measurement time (s).
    delay_s : float
        Delay (s) from measurement to timestamp of a fix that EKF2 assumes.
    """
    empty_result = pd.DataFrame(columns=fixes.columns), ""
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.horizon_s, Unavailable) or len(fixes) < 3:
        return empty_result
    gnss_innovations = replace_vision_by_gnss_innovations(ekf2).innovations
    north_innovations, east_innovations = gnss_innovations["north"], gnss_innovations["east"]
    logged_fix_times_s = fixes.index.to_numpy()
    receiver_interval_s = _estimate_receiver_interval(logged_fix_times_s)
    if (
        receiver_interval_s is None
        or isinstance(north_innovations, Unavailable)
        or isinstance(east_innovations, Unavailable)
    ):
        return empty_result
    # 1. Latest possible time of measurement of each fused fix, from the time of its innovation. If
    # a fix is older than the fusion horizon, EKF2 fuses it at the horizon (RingBuffer.h), later
    # than its time of measurement
    delay_beyond_horizon_s = max(0.0, delay_s - ekf2.horizon_s)
    fusion_times_s = north_innovations.index.to_numpy() - delay_beyond_horizon_s
    # 2. Exact time: the receiver sends fixes at multiples of its interval after each logged fix. An
    # innovation belongs to the latest of them
    previous_fix_index = np.searchsorted(logged_fix_times_s, fusion_times_s) - 1
    interval_count, interval_fraction = np.divmod(
        (fusion_times_s - logged_fix_times_s[previous_fix_index]) / receiver_interval_s, 1.0
    )
    rows = np.flatnonzero(
        (previous_fix_index >= 0)
        & (previous_fix_index < len(logged_fix_times_s) - 1)
        # An innovation immediately after a fix may belong to the fix before it
        & (interval_fraction > ekf2.step_s / receiver_interval_s)
    )
    previous_fix_index, interval_count = previous_fix_index[rows], interval_count[rows]
    fix_times_s = logged_fix_times_s[previous_fix_index] + interval_count * receiver_interval_s
    # 3. Position of the fix: EKF2 position at the time of the fusion, plus innovation
    reconstructed_fixes = pd.DataFrame(
        {
            column: interpolate_inside_time_span(
                fix_times_s + delay_beyond_horizon_s, ekf2.state[column]
            )
            + innovations["innovation_m"].to_numpy()[rows]
            for column, innovations in (
                ("north_m", north_innovations),
                ("east_m", east_innovations),
            )
        },
        index=time_index(fix_times_s),
    )
    # 4. The error of the reconstruction is known for logged fixes: an innovation within one
    # receiver interval after a logged fix belongs to this fix
    is_logged = interval_count == 0.0
    previous_fixes = fixes[reconstructed_fixes.columns].to_numpy()[previous_fix_index]
    position_errors_m = (reconstructed_fixes - previous_fixes)[is_logged].dropna().to_numpy()
    reconstructed_fixes = reconstructed_fixes[~is_logged].dropna()
    reconstructed_fixes = reconstructed_fixes[~reconstructed_fixes.index.duplicated()]
    if (
        len(position_errors_m) < MIN_LOGGED_FIXES
        or reconstructed_fixes.empty
        or rms(position_errors_m) > MAX_FIX_RECONSTRUCTION_ERROR_M
    ):
        return empty_result
    for column in ("down_m", *Columns.POSITION_VARIANCE):
        reconstructed_fixes[column] = np.interp(
            reconstructed_fixes.index, logged_fix_times_s, fixes[column]
        )
    return reconstructed_fixes, (
        f"{len(reconstructed_fixes)} GNSS fixes are not logged. They are computed as EKF2 position "
        f"plus innovation, with an RMS error of {rms(position_errors_m):.2f} m along each axis"
    )


def _estimate_receiver_interval(fix_times_s: Array) -> float | None:
    """Estimate the interval (s) between the fixes of a GNSS receiver, from some of its fixes.

    All logged intervals are multiples of this interval. Return None if no interval fits, or if a
    longer interval would also fit.
    """
    logged_intervals_s = np.diff(fix_times_s)
    # Deviation of each logged interval (row) from a multiple of each candidate (column)
    multiples = np.divide.outer(logged_intervals_s, CANDIDATE_FIX_INTERVALS_S)
    deviation_from_multiple_s = np.abs(multiples - np.round(multiples)) * CANDIDATE_FIX_INTERVALS_S
    percentile_98_of_deviation_s = np.percentile(deviation_from_multiple_s, 98, axis=0)
    is_possible = percentile_98_of_deviation_s <= MAX_DEVIATION_FROM_INTERVAL_MULTIPLE_S
    if not np.any(is_possible):
        return None
    # Half or a third of the receiver's interval is possible too, so the longest interval is sought:
    # best fit among the candidates within 10 % of the longest possible interval
    longest_interval_s = CANDIDATE_FIX_INTERVALS_S[is_possible].max()
    is_near_longest = (
        np.abs(CANDIDATE_FIX_INTERVALS_S - longest_interval_s) < 0.1 * longest_interval_s
    )
    best_index = np.argmin(np.where(is_near_longest, percentile_98_of_deviation_s, np.inf))
    interval_multiples = np.round(logged_intervals_s / CANDIDATE_FIX_INTERVALS_S[best_index])
    # Element n is True if enough of the logged intervals are n times the interval of the receiver
    is_frequent = np.bincount(interval_multiples.astype(int)) >= MIN_LOGGED_INTERVALS_PER_MULTIPLE
    # The interval is known only if two successive multiples (n and n + 1) are frequent. If all
    # frequent multiples had a common divisor, such as 2 and 4, the interval could also be twice as
    # long
    if not np.any(is_frequent[1:] & is_frequent[:-1]):
        return None
    return float(np.median(logged_intervals_s / interval_multiples))
