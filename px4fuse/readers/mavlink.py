"""Reader of MAVLink recordings of a flight: ``.tlog`` files and raw streams.

Sources: PX4's ``src/modules/mavlink`` (v1.13 to v1.16) and MAVLink's ``common.xml``.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.flight.ekf2_parameters import (
    EV_POS,
    GNSS_POS,
    PARAMETERS_IN_RESULTS,
    fill_parameters_with_defaults,
    replace_invalid_parameters,
)
from px4fuse.flight.model import (
    AXIS_NAMES,
    RECORD_NOT_LOGGED,
    Columns,
    Ekf2,
    Flight,
    LogInfo,
    Spans,
    TableOrUnavailable,
    Unavailable,
    UnusedData,
)

from . import common
from . import mavlink_senders as senders
from .mavlink_frames import (
    MAX_FRAME_BYTES,
    VEHICLE_TYPES,
    read_frames,
)
from .mavlink_messages import (
    ARDUPILOT_REPLAY_UNAVAILABLE,
    ATTITUDE_LAYOUTS,
    HIGHRES_IMU_LAYOUT,
    IMU_LAYOUTS,
    LOCAL_POSITION_LAYOUT,
    MESSAGE_LAYOUTS,
    ON_GROUND_STATE,
    REASON_BY_UNUSED_MESSAGE,
)
from .mavlink_positions import (
    compute_pressure_altitude_m,
    read_positions,
    read_truth,
)
from .mavlink_recording import (
    MIN_UNIX_TIME_S,
    RECEIPT_CLOCK_TEXT,
    Recording,
    map_boot_to_unix,
    read_recording,
)
from .px4_positions import barometer
from .ulog_topics import NO_EKF2_INSTANCE_SWITCHES, describe_dropped_samples

VARIANCE_COLUMNS = Columns.POSITION_VARIANCE + Columns.VELOCITY_VARIANCE
# Maximum fraction of bytes outside MAVLink frames in an undamaged file
MAX_STRAY_BYTE_FRACTION = 0.002
# MAV_PARAM_TYPE_REAL32; types with smaller numbers are integers
REAL32_PARAMETER_TYPE = 9


# NumPy gives no warnings for damaged values, because samples with such values are dropped
@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def read_mavlink(name: str, content: bytes, system_id: int | None = None) -> Flight:
    """Read a MAVLink recording: a ``.tlog``, or a raw stream of MAVLink 1 and 2.

    ``system_id`` is the MAVLink id of the vehicle, by default of the one with most messages.

    Raises
    ------
    LogError
        The content is not MAVLink.
    SettingsError
        No autopilot in the recording has the id ``system_id``.
    """
    frames = read_frames(name, content)
    address, autopilot = senders.choose_autopilot(frames, system_id)
    recording = read_recording(frames, address, autopilot)
    clock_conversions = senders.map_sender_clocks(recording)
    parameters, replaced_parameter_notes = replace_invalid_parameters(_read_parameters(recording))
    imu = _read_imu(recording)
    attitude = _read_attitude(recording)
    ekf2 = _read_ekf2(recording, parameters)
    # Only PX4 has a parameter for the delay of GNSS
    gnss_delay_s = 0.0
    if autopilot == "PX4":
        gnss_delay_s = 1e-3 * fill_parameters_with_defaults(parameters, GNSS_POS)[GNSS_POS.delay]
    positions, unavailable_positions = read_positions(recording, clock_conversions, gnss_delay_s)
    truth = read_truth(recording, positions)
    airborne_spans_s = _read_airborne_spans(recording)
    ends_in_flight = common.ends_in_flight(airborne_spans_s, recording.duration_s)
    pressure_hpa = recording.read(MESSAGE_LAYOUTS["SCALED_PRESSURE"])["pressure_hpa"]
    return Flight(
        # Called after the readers, because the description counts the samples that they dropped
        log=_describe_log(recording, parameters, replaced_parameter_notes, ends_in_flight),
        imu=imu,
        attitude=attitude,
        positions=positions,
        ekf2=ekf2,
        truth=truth,
        airborne=airborne_spans_s,
        barometer=barometer(compute_pressure_altitude_m(pressure_hpa)),
        missing=(*common.collect_unavailable(imu, attitude, ekf2, truth), *unavailable_positions),
        streams=recording.data_source_by_data_kind,
        clocks=senders.describe_clock_conversions(recording, clock_conversions),
        unused=tuple(
            UnusedData(name, count, reason)
            for name, reason in REASON_BY_UNUSED_MESSAGE.items()
            if (count := len(frames.rows(name)))
        ),
    )


def _read_imu(recording: Recording) -> TableOrUnavailable:
    """Read valid IMU samples; Unavailable if the recording has fewer than two."""
    # HIGHRES_IMU is preferred, because it has SI units and µs timestamps
    layout = HIGHRES_IMU_LAYOUT
    if len(recording.rows(layout.topic)) < 2:
        layout = recording.find_most_frequent_layout(IMU_LAYOUTS)
    rows = recording.rows(layout.topic)
    if layout == HIGHRES_IMU_LAYOUT:
        imu_ids = recording.frames.table(layout.topic, rows)["id"]
        most_frequent_id = np.bincount(imu_ids, minlength=1).argmax()
        rows = rows[imu_ids == most_frequent_id]
    imu = recording.read(layout, rows)
    imu = common.select_valid_rows(imu, imu.columns.tolist(), common.MAX_IMU_READING)
    if len(imu) < 2:
        return Unavailable(
            "IMU",
            "the recording contains no usable HIGHRES_IMU or SCALED_IMU",
            recording.remedies["imu"],
        )
    recording.record_data_source("imu", layout.topic)
    return imu


def _read_attitude(recording: Recording) -> TableOrUnavailable:
    """Read the attitude from the most frequent message; Unavailable with fewer than two samples."""
    layout = recording.find_most_frequent_layout(ATTITUDE_LAYOUTS)
    attitude = common.select_rows_with_attitude(recording.read(layout))[Columns.QUATERNION]
    if len(attitude) < 2:
        names = " or ".join(layout.topic for layout in ATTITUDE_LAYOUTS)
        return Unavailable(
            "attitude", f"the recording contains no usable {names}", recording.remedies["attitude"]
        )
    recording.record_data_source("attitude", layout.topic)
    return attitude


def _read_ekf2(recording: Recording, parameters: Mapping[str, float]) -> Ekf2 | Unavailable:
    """Read the state and variances that the autopilot's estimator sent."""
    autopilot, remedies = recording.autopilot, recording.remedies
    layout = MESSAGE_LAYOUTS["ODOMETRY"]
    # ODOMETRY has variances, so it is preferred unless its rate is much lower
    local_position_count = len(recording.rows(LOCAL_POSITION_LAYOUT.topic))
    if 2 * len(recording.rows(layout.topic)) < local_position_count:
        layout = LOCAL_POSITION_LAYOUT
    message_name = layout.topic
    samples = recording.read(layout)
    state = samples[Columns.STATE].dropna()
    if len(state) < 2:
        return Unavailable(
            "EKF2", "the autopilot sent no usable ODOMETRY or LOCAL_POSITION_NED", remedies["state"]
        )
    recording.record_data_source("ekf2_state", message_name)
    notes = [f"the EKF2 state is from the autopilot's {message_name} messages"]
    if autopilot != "PX4":
        notes.append(f"in the results, EKF2 stands for the estimator of {autopilot}")
    if "reset_counter" in samples:
        reset_count = np.count_nonzero(samples["reset_counter"].diff()[1:])
        if reset_count:
            notes.append(
                f"EKF2 reset its state {reset_count} times. The state contains a jump at each reset"
            )
    variance = _read_ekf2_variance(recording, samples, message_name, notes)
    return Ekf2(
        state=state,
        variance=variance,
        innovations={
            axis: Unavailable(
                f"EKF2 innovations, {axis}",
                "MAVLink does not transmit EKF2 innovations",
                remedies["innovations"],
            )
            for axis in AXIS_NAMES
        },
        innovation_topics=(),
        fusion_flags=Unavailable(
            "EKF2 fusion flags",
            "MAVLink does not transmit EKF2 fusion flags",
            remedies["innovations"],
        ),
        resets=(),
        primary_instances=NO_EKF2_INSTANCE_SWITCHES,
        gate=fill_parameters_with_defaults(parameters)[EV_POS.gate],
        notes=tuple(notes),
        record=ARDUPILOT_REPLAY_UNAVAILABLE if autopilot == "ArduPilot" else RECORD_NOT_LOGGED,
    )


def _read_ekf2_variance(
    recording: Recording, samples: pd.DataFrame, message_name: str, notes: list[str]
) -> TableOrUnavailable:
    """Return the variances that were sent with the state, or else those from ESTIMATOR_STATUS."""
    variance = samples.reindex(columns=VARIANCE_COLUMNS)
    variance = variance[(variance > 0.0).all(axis=1)]
    if variance.empty:
        message_name = "ESTIMATOR_STATUS"
        accuracy = recording.read(MESSAGE_LAYOUTS[message_name])
        # Accuracies (1 σ, m). PX4's horizontal accuracy is √(σ_north² + σ_east²)
        # (get_ekf_lpos_accuracy)
        variance = accuracy[["horizontal_m", "horizontal_m", "vertical_m"]] ** 2 / [2.0, 2.0, 1.0]
        variance = variance[(variance > 0.0).all(axis=1)]
        variance = variance.set_axis(Columns.POSITION_VARIANCE, axis=1).reindex(
            columns=VARIANCE_COLUMNS
        )
        if variance.empty:
            remedies = recording.remedies
            return Unavailable(
                "EKF2 variances",
                "the recording has no ODOMETRY with covariance and no ESTIMATOR_STATUS",
                remedies.get("variance", remedies["state"]),
            )
        notes.append(
            "EKF2's position variances are from ESTIMATOR_STATUS: pos_horiz_accuracy² / 2 "
            "along each horizontal axis. Velocity variances are not sent"
        )
    recording.record_data_source("ekf2_variance", message_name)
    return variance


def _read_airborne_spans(recording: Recording) -> Spans | Unavailable:
    """Return the time spans in which the vehicle was not on the ground, from EXTENDED_SYS_STATE."""
    landed_states = recording.table("EXTENDED_SYS_STATE")["landed_state"]
    is_known = landed_states > 0
    if not np.any(is_known):
        return Unavailable(
            "land detector",
            "the recording contains no usable EXTENDED_SYS_STATE",
            recording.remedies["landed"],
        )
    recording.record_data_source("airborne", "EXTENDED_SYS_STATE", clock=RECEIPT_CLOCK_TEXT)
    rows = recording.rows("EXTENDED_SYS_STATE")[is_known]
    time_s = recording.compute_receipt_boot_times_s(rows) - recording.time_origin_s
    is_airborne = pd.Series(landed_states[is_known] != ON_GROUND_STATE, time_s)
    return common.find_spans(is_airborne, recording.duration_s)


def _read_parameters(recording: Recording) -> dict[str, float]:
    """Read the first value of each parameter. PX4 sends integers as raw bytes in a float field."""
    table = recording.table("PARAM_VALUE")
    is_sent_as_bytes = (recording.autopilot == "PX4") & (
        table["param_type"] < REAL32_PARAMETER_TYPE
    )
    raw_values = np.ascontiguousarray(table["param_value"])
    values = np.where(is_sent_as_bytes, raw_values.view(np.int32), raw_values)
    value_by_name: dict[str, float] = {}
    for raw_name, value in zip(table["param_id"].tolist(), values.tolist(), strict=True):
        name = raw_name.decode(errors="replace")
        if name in PARAMETERS_IN_RESULTS:
            value_by_name.setdefault(name, float(value))
    return value_by_name


def _describe_log(
    recording: Recording,
    parameters: Mapping[str, float],
    replaced_parameter_notes: tuple[str, ...],
    ends_in_flight: bool,
) -> LogInfo:
    """Describe the recording: firmware, vehicle, duration, damage and dropped samples."""
    frames, autopilot = recording.frames, recording.autopilot
    notes, damage_notes = [*recording.notes], []
    if frames.unknown_frame_count:
        notes.append(
            "number of ignored MAVLink frames with unknown message type: "
            f"{frames.unknown_frame_count}"
        )
    if frames.is_last_frame_incomplete:
        damage_notes.append(common.format_truncation("frame", recording.duration_s, ends_in_flight))
    stray_byte_count, byte_count = frames.byte_count_outside_frames, len(frames.content)
    stray_bytes_note = (
        f"{stray_byte_count:,} bytes ({stray_byte_count / byte_count:.2%}) are not part of a "
        "complete MAVLink frame"
    )
    # Incomplete frames at the beginning and end of the file are not damage
    if stray_byte_count - 2 * MAX_FRAME_BYTES > MAX_STRAY_BYTE_FRACTION * byte_count:
        damage_notes.append(f"the file is damaged: {stray_bytes_note}")
    elif stray_byte_count:
        notes.append(stray_bytes_note)
    firmware, firmware_hash, vehicle_id = f"{autopilot}, unknown version", "unknown", ""
    for version in recording.table("AUTOPILOT_VERSION")[:1]:
        major, minor, patch, _ = int(version["flight_sw_version"]).to_bytes(4, "big")
        if major or minor or patch:
            firmware = f"{autopilot} v{major}.{minor}.{patch}"
        if version["flight_custom_version"].any():
            firmware_hash = bytes(version["flight_custom_version"][::-1]).hex()
        if version["uid2"].any():
            vehicle_id = bytes(version["uid2"]).hex()
    vehicle_types = recording.table("HEARTBEAT")["type"].tolist()
    vehicle_name = VEHICLE_TYPES.get(next(iter(vehicle_types), -1), "vehicle")
    dropped_counts = dict(sorted(recording.dropped_count_by_message.items()))
    return LogInfo(
        name=frames.name,
        sha256=frames.sha256,
        bytes=byte_count,
        format="MAVLink stream" if frames.receive_times_us is None else "MAVLink tlog",
        firmware=firmware,
        firmware_hash=firmware_hash,
        hardware=f"{vehicle_name} (MAVLink system {recording.address[0]})",
        boot_time_s=recording.time_origin_s,
        duration_s=recording.duration_s,
        parameters=parameters,
        notes=(
            *notes,
            *replaced_parameter_notes,
            *describe_dropped_samples(dropped_counts),
        ),
        restarts=recording.restart_count,
        receive_time_reversals=int(np.sum(np.diff(recording.receive_times_s) < 0.0)) or None,
        dropped=dropped_counts,
        autopilot=autopilot,
        start_unix_s=_estimate_start_unix_s(recording),
        senders=senders.describe_senders(recording),
        vehicle=vehicle_id,
        damage=tuple(damage_notes),
        ends_in_flight=ends_in_flight,
        bytes_read=byte_count - stray_byte_count,
    )


def _estimate_start_unix_s(recording: Recording) -> float | None:
    """Return the UNIX time (s) at flight time zero; None if the recording has no UNIX time."""
    if recording.time_origin_s >= MIN_UNIX_TIME_S:
        return recording.time_origin_s
    receive_times_us = recording.frames.receive_times_us
    if boot_to_unix_fit := map_boot_to_unix(recording):
        return float(boot_to_unix_fit.at(recording.time_origin_s))
    if receive_times_us is None or not recording.receive_to_boot_time_fit.reading_pair_count:
        return None
    receive_time_of_origin_s = recording.receive_to_boot_time_fit.inverse().at(
        recording.time_origin_s
    )
    return float(receive_times_us[0] * 1e-6 + receive_time_of_origin_s)
