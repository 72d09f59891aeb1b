"""The inside of EKF2's filter as a ULog holds it, in one layout and unit for all releases.

Sources: PX4-Autopilot ``EKF2.cpp`` (PublishStates), ``EKF/common.h`` (order of the states),
``msg/EstimatorStatusFlags.msg`` and ``msg/EstimatorStatus.msg`` (horizontal aiding).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.flight import (
    DELAYED_STATE_COLUMNS,
    DELAYED_VARIANCE_COLUMNS,
    POSITION_COLUMNS,
    RECORD_NOT_LOGGED,
    FusionRecord,
    Unavailable,
)
from px4fuse.readers.px4_instances import Instances, of_primary
from px4fuse.readers.px4_topics import BIAS_PER_STEP, COVARIANCE_OFFSETS, Layout
from px4fuse.readers.ulog_topics import Topics, measurement_time_us, states_and_covariances

TOPIC = "estimator_states"
VISION = "vehicle_visual_odometry"
STATES = 16  # attitude, velocity, position and both biases; the rest does not concern position
# estimator_status_flags, by the names of all releases from v1.12
_AIDING_FLAGS: Mapping[str, str] = {
    "cs_gps": "GPS",
    "cs_gnss_pos": "GPS position",
    "cs_gnss_vel": "GPS velocity",
    "cs_opt_flow": "optical flow",
    "cs_ev_vel": "vision velocity",
    "cs_aux_gpos": "auxiliary global position",
    "cs_fuse_aspd": "airspeed",
    "cs_rngbcn_fusion": "ranging beacons",
}
# estimator_status.control_mode_flags, where the topic above is missing
_AIDING_BITS: Mapping[str, int] = {"GPS": 2, "optical flow": 3, "vision velocity": 24}


def read_record(topics: Topics, step_s: float, instances: Instances) -> FusionRecord | Unavailable:
    """What the log tells of the inside of EKF2's filter.

    Parameters
    ----------
    step_s : float
        Time between two predictions, for releases that keep biases per prediction.
    instances : tuple of (float, int)
        Primary instance of EKF2 from each time on.
    """
    available = topics.instances(TOPIC)
    if not available:
        return RECORD_NOT_LOGGED
    length = states_and_covariances(topics.tables[TOPIC, available[0]])
    if length not in COVARIANCE_OFFSETS:
        return RECORD_NOT_LOGGED
    per_step = length in BIAS_PER_STEP
    raw = of_primary(topics, _layout(COVARIANCE_OFFSETS[length][0]), instances).dropna()
    norm = np.linalg.norm(raw[[f"state_{i}" for i in range(4)]].to_numpy(), axis=1)
    raw = raw[np.abs(norm - 1.0) < 0.01]
    if raw.empty:
        return RECORD_NOT_LOGGED
    return FusionRecord(
        parameters=topics.ekf2_parameters,
        delayed=_delayed(raw, step_s if per_step else None),
        per_step_biases=per_step,
        other_aiding=_other_aiding(topics),
        vision_age_s=_vision_age(topics),
    )


def _layout(errors: int) -> Layout:
    """States and covariances by number; ``errors`` is how many covariances attitude has."""
    return Layout(
        TOPIC,
        {f"state_{i}": f"states[{i}]" for i in range(STATES)}
        | {f"variance_{i}": f"covariances[{i}]" for i in range(STATES - 4 + errors)},
        "v1.12",
    )


def _delayed(raw: pd.DataFrame, step_s: float | None) -> pd.DataFrame:
    state = raw[[name for name in raw if str(name).startswith("state_")]].to_numpy(copy=True)
    variance = raw[[name for name in raw if str(name).startswith("variance_")]].to_numpy(copy=True)
    if step_s is not None:
        state[:, 10:16] /= step_s
        variance = np.hstack([_attitude_variance(state[:, :4], variance[:, :4]), variance[:, 4:]])
        variance[:, 9:15] /= step_s**2
    frame = pd.DataFrame(
        np.hstack([state, variance]),
        index=raw.index,
        columns=DELAYED_STATE_COLUMNS + DELAYED_VARIANCE_COLUMNS,
    )
    horizontal = POSITION_COLUMNS[:2]
    if not frame[horizontal].to_numpy().any():  # from v1.16 kept as latitude and longitude
        frame[horizontal] = np.nan
    return frame


def _attitude_variance(quaternion: Array, variance: Array) -> Array:
    """Variances of the attitude error about NED's axes, from those of the quaternion.

    δθ = 2 Im(δq ⊗ q*); the log holds no correlations.
    """
    w, x, y, z = quaternion.T
    turns = np.array([[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    squared: Array = 4.0 * np.einsum("ijn,nj->ni", turns**2, variance)
    return squared


def _other_aiding(topics: Topics) -> tuple[str, ...]:
    flags: dict[str, None] = {}
    for number in topics.instances("estimator_status_flags"):
        table = topics.tables["estimator_status_flags", number]
        flags |= dict.fromkeys(
            name for px4, name in _AIDING_FLAGS.items() if px4 in table and np.any(table[px4])
        )
    if not topics.instances("estimator_status_flags"):
        for number in topics.instances("estimator_status"):
            bits = topics.tables["estimator_status", number]["control_mode_flags"]
            flags |= dict.fromkeys(
                name
                for name, bit in _AIDING_BITS.items()
                if np.any(bits.astype(np.uint64) >> np.uint64(bit) & np.uint64(1))
            )
    return tuple(flags)


def _vision_age(topics: Topics) -> pd.Series:
    instances = topics.instances(VISION)
    table = topics.tables[VISION, instances[0]] if instances else {}
    if "timestamp_sample" not in table:
        return pd.Series(dtype=np.float64)
    stamp_us = measurement_time_us(table)
    age_s = (table["timestamp"].astype(np.int64) - stamp_us) * 1e-6
    times = pd.Index((stamp_us - topics.zero_us) * 1e-6, name="time_s")
    age = pd.Series(age_s, index=times).sort_index()
    return age[~age.index.duplicated()]
