"""EKF2's state and variances from what the autopilot sends, and ODOMETRY in NED."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.ekf2_parameters import EV_POS, settings_in_force
from px4fuse.flight import (
    AXIS_NAMES,
    POSITION_VARIANCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_VARIANCE_COLUMNS,
    Ekf2,
    Unavailable,
)
from px4fuse.readers.mavlink_messages import (
    EXTENDED_COVARIANCE_DIAGONAL,
    FRAMES_OF_REFERENCE,
    POSE_DIAGONAL,
    Remedies,
    remedies_of,
)
from px4fuse.readers.mavlink_recording import BOOT_CLOCK, Recording, vector
from px4fuse.readers.px4_instances import NO_SELECTOR

VARIANCE_COLUMNS = POSITION_VARIANCE_COLUMNS + VELOCITY_VARIANCE_COLUMNS
COVARIANT_POSITION = "LOCAL_POSITION_NED_COV"
MIN_NORM = 0.5  # a zero quaternion is no attitude


def read_ekf2(
    recording: Recording, parameters: Mapping[str, float], autopilot: str
) -> Ekf2 | Unavailable:
    """EKF2's output as the autopilot sent it, or why there is none."""
    remedies = remedies_of(autopilot)
    messages = ("ODOMETRY", COVARIANT_POSITION, "LOCAL_POSITION_NED")
    found = [(message, recording.rows(message)) for message in messages]
    # the one with variances as long as it is not much sparser than the one without
    densest = max(len(rows) for _, rows in found)
    message, rows = next((m, r) for m, r in found if 2 * len(r) >= densest)
    if len(rows) < 2:
        return Unavailable(
            "EKF2", "no ODOMETRY or LOCAL_POSITION_NED of the autopilot", remedies.state
        )
    table = recording.frames.table(message, rows)
    notes = [f"EKF2's state is {message} as the autopilot sent it"]
    if autopilot != "PX4":
        notes.append(f"this is {autopilot}: what is called EKF2 here is its own estimator")
    boot_s = recording.boot_s(table, rows)
    variance: pd.DataFrame | Unavailable = Unavailable("EKF2 variances", "", remedies.variance)
    if message == "ODOMETRY":
        state_values, variances = odometry(table)
        count = int(np.count_nonzero(np.diff(table["reset_counter"].astype(np.int64))))
        if count:
            notes.append(
                f"EKF2 reset its state {count} times in the recording; ODOMETRY does not say by "
                "how much, so nothing was undone"
            )
        variance = recording.frame(message, boot_s, VARIANCE_COLUMNS, variances)
    else:
        state_values = vector(table, "x", "y", "z", "vx", "vy", "vz")
        if message == COVARIANT_POSITION:
            variances = table["covariance"][:, EXTENDED_COVARIANCE_DIAGONAL].astype(np.float64)
            variance = recording.frame(message, boot_s, VARIANCE_COLUMNS, variances)
    state = recording.frame(message, boot_s, STATE_COLUMNS, state_values).dropna()
    if len(state) < 2:
        return Unavailable("EKF2", f"{message} holds no finite state", "Wait for EKF2 to start.")
    recording.came_from("ekf2_state", BOOT_CLOCK, message)
    if isinstance(variance, pd.DataFrame):
        variance = variance[(variance > 0.0).all(axis=1)]
        recording.came_from("ekf2_variance", BOOT_CLOCK, message)
    if isinstance(variance, Unavailable) or variance.empty:
        variance = _variance_by_accuracy(recording, notes, remedies)
    return Ekf2(
        state=state,
        variance=variance,
        innovations={
            axis: Unavailable(
                f"EKF2 innovations, {axis}",
                "MAVLink does not carry EKF2's innovations",
                remedies.innovations,
            )
            for axis in AXIS_NAMES
        },
        innovation_topics=(),
        fusing=Unavailable(
            "EKF2 fusion flags", "MAVLink does not carry EKF2's fusion flags", remedies.fusing
        ),
        resets=(),
        instances=NO_SELECTOR,
        gate=settings_in_force(parameters)[EV_POS.gate],
        notes=tuple(notes),
        record=remedies.replay,
    )


def odometry(table: NDArray[Any]) -> tuple[Array, Array]:
    """Position and velocity of ODOMETRY, NED (or FRD), and their variances.

    The velocity is in the child frame, which PX4 sets to the body up to v1.13 and to NED later
    (``streams/ODOMETRY.hpp``).

    Returns
    -------
    state : ndarray, shape (n, 6), m and m/s
        NaN where a frame is not one of those that PX4 knows.
    variance : ndarray, shape (n, 6), m² and m²/s²
    """
    state, variance = np.full((len(table), 6), np.nan), np.full((len(table), 6), np.nan)
    position, velocity = vector(table, "x", "y", "z"), vector(table, "vx", "vy", "vz")
    quaternion = table["q"].astype(np.float64)
    norm = np.linalg.norm(quaternion, axis=1)
    turned = np.isfinite(norm) & (norm > MIN_NORM)
    position_variance = table["pose_covariance"][:, POSE_DIAGONAL].astype(np.float64)
    velocity_variance = table["velocity_covariance"][:, POSE_DIAGONAL].astype(np.float64)
    for number, frame in FRAMES_OF_REFERENCE.items():
        fixed = np.flatnonzero((table["frame_id"] == number) & (not frame.body))
        state[fixed, :3] = frame.turn(position[fixed])
        variance[fixed, :3] = frame.permute(position_variance[fixed])
        moving = table["child_frame_id"] == number
        rows = np.flatnonzero(moving & turned if frame.body else moving)
        speed, spread = frame.turn(velocity[rows]), frame.permute(velocity_variance[rows])
        if frame.body and len(rows):
            rotation = Rotation.from_quat(quaternion[rows], scalar_first=True).as_matrix()
            speed = np.einsum("nij,nj->ni", rotation, speed)
            # diagonal of R diag(s) Rᵀ
            spread = np.einsum("nij,nj->ni", rotation**2, spread)
        state[rows, 3:], variance[rows, 3:] = speed, spread
    return state, variance


def _variance_by_accuracy(
    recording: Recording, notes: list[str], remedies: Remedies
) -> pd.DataFrame | Unavailable:
    """Position variances from the accuracies of ESTIMATOR_STATUS, which are one σ.

    PX4's horizontal accuracy is the root of the sum over both axes (``get_ekf_lpos_accuracy``).
    """
    rows = recording.rows("ESTIMATOR_STATUS")
    table = recording.frames.table("ESTIMATOR_STATUS", rows)
    values = np.full((len(table), 6), np.nan)
    values[:, 0] = values[:, 1] = table["pos_horiz_accuracy"].astype(np.float64) ** 2 / 2.0
    values[:, 2] = table["pos_vert_accuracy"].astype(np.float64) ** 2
    boot_s = recording.boot_s(table, rows)
    frame = recording.frame("ESTIMATOR_STATUS", boot_s, VARIANCE_COLUMNS, values)
    frame = frame[(frame[POSITION_VARIANCE_COLUMNS] > 0.0).all(axis=1)]
    if frame.empty:
        return Unavailable(
            "EKF2 variances",
            "no ODOMETRY with covariance and no ESTIMATOR_STATUS of the autopilot",
            remedies.variance,
        )
    recording.came_from("ekf2_variance", BOOT_CLOCK, "ESTIMATOR_STATUS")
    notes.append(
        "EKF2's position variances are from ESTIMATOR_STATUS: its horizontal accuracy squared, "
        "half to each axis; velocity variances are not sent"
    )
    return frame
