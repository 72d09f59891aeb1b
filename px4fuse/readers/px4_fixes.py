"""GNSS fixes that EKF2 used and that only EKF2's own topics contain."""

import numpy as np
import pandas as pd

from px4fuse.flight.model import Ekf2, Unavailable
from px4fuse.readers import px4_topics as px4
from px4fuse.readers.ulog_topics import Topics

# Maximum time difference (s) of a logged fix and an EKF2 observation of the same fix: receivers
# send a fix every 0.05 s or less often
MAX_SAME_FIX_S = 0.01
# Maximum difference (°, about 100 km) of observed and logged latitude: a larger difference shows
# that the observation is in m
MAX_LATITUDE_DISTANCE_DEG = 1.0


def read_unlogged_fixes(
    topics: Topics, gps: pd.DataFrame, ekf2: Ekf2 | Unavailable
) -> pd.DataFrame:
    """Read the fixes that are missing in ``gps`` from EKF2's GNSS topics (PX4 v1.16 and newer).

    ``gps`` contains the logged fixes. The logger drops fixes above its limit of 10 per second.
    """
    layouts = px4.LAYOUTS["fused_position"], px4.LAYOUTS["fused_velocity"]
    if isinstance(ekf2, Unavailable) or not all(map(topics.find, layouts)):
        return pd.DataFrame()
    position, velocity = map(topics.primary_samples, layouts)
    # Rows of EKF2's GNSS topic that are neither fused nor rejected contain no new fix
    is_fix = position[["fused", "rejected"]].any(axis=1)
    position = position.loc[is_fix].drop(columns=["fused", "rejected"])
    # EKF2 shifts GNSS times back by half a prediction step (estimator_interface.cpp)
    fixes = position.join(velocity, how="inner").dropna()
    # Unless GNSS is the height reference, EKF2's estimate of the GNSS bias is part of the height
    height = px4.LAYOUTS["fused_height"]
    if topics.find(height) and topics.ekf2_parameters.get("EKF2_HGT_REF", 1.0) == 1.0:
        fixes = fixes.join(topics.primary_samples(height))
    fixes = fixes.set_axis(fixes.index + 0.5 * ekf2.step_s)
    next_row = np.clip(np.searchsorted(gps.index, fixes.index), 1, len(gps) - 1)
    distance_s = np.minimum(
        *(np.abs(gps.index.to_numpy()[next_row - k] - fixes.index) for k in (0, 1))
    )
    is_between_fixes = (fixes.index > gps.index[0]) & (fixes.index < gps.index[-1])
    logged_fixes = fixes[distance_s <= MAX_SAME_FIX_S]
    unlogged_fixes = fixes[(distance_s > MAX_SAME_FIX_S) & is_between_fixes]
    # Before v1.16 the observation is a local position in m
    is_in_degrees = (
        logged_fixes["latitude_deg"].sub(gps["latitude_deg"].median()).abs().median()
        < MAX_LATITUDE_DISTANCE_DEG
    )
    return unlogged_fixes if is_in_degrees else pd.DataFrame()
