"""MAVLink recordings (``.tlog`` and raw streams) to :class:`~px4fuse.flight.Flight`.

Which message is what, its direction and its clock follow PX4's ``src/modules/mavlink`` (v1.13 to
v1.16) and MAVLink's ``common.xml``; ``mavlink_messages`` holds them as tables.
"""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.ekf2_parameters import REPORTED
from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    Flight,
    FlightMode,
    Unavailable,
)
from px4fuse.readers.mavlink_clocks import UNIX_FROM_S
from px4fuse.readers.mavlink_ekf2 import MIN_NORM, read_ekf2
from px4fuse.readers.mavlink_frames import Frames, message_ids, read_frames
from px4fuse.readers.mavlink_messages import (
    ATTITUDE,
    AUTO_MODE,
    AUTO_MODES,
    IMU,
    LANDED,
    MAIN_MODES,
    NO_MODES,
    UNUSED,
    VEHICLE_TYPES,
    Remedies,
    remedies_of,
)
from px4fuse.readers.mavlink_positions import read_positions, read_truth
from px4fuse.readers.mavlink_recording import (
    BOOT_CLOCK,
    RECEIPT_CLOCK,
    Recording,
    quaternions_of_angles,
    settle_clocks,
    unix_of_boot,
    vector,
)
from px4fuse.readers.mavlink_senders import (
    choose_autopilot,
    clock_maps,
    describe_senders,
    map_senders,
)
from px4fuse.readers.parts import (
    ends_in_flight,
    missing_parts,
    stretches_of_flight,
    stretches_of_modes,
)
from px4fuse.readers.ulog_topics import dropped_note
from px4fuse.recording import LogInfo, Unused

# MAV_PARAM_TYPE: below, an integer
PARAMETER_REAL = 9


# hostile values become NaN or infinite without a word, and are dropped where samples are made
@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def read_mavlink(path: Path, system: int | None = None) -> Flight:
    """Read a MAVLink recording.

    Parameters
    ----------
    path : Path
        ``.tlog`` of QGroundControl or MAVProxy, or a raw stream of MAVLink 1 and 2.
    system : int, optional
        MAVLink system id of the vehicle; by default the autopilot with the most messages.

    Returns
    -------
    Flight
        Parts that the recording lacks are ``Unavailable``.

    Raises
    ------
    LogError
        The file cannot be read or holds no MAVLink.
    SettingsError
        No autopilot in it has that system id.
    """
    frames = read_frames(path)
    address, autopilot = choose_autopilot(frames, system)
    recording = settle_clocks(frames, address)
    mapped = map_senders(recording)
    parameters = _read_parameters(recording, autopilot)
    remedies = remedies_of(autopilot)
    imu = _read_imu(recording, remedies)
    attitude = _read_attitude(recording, remedies)
    ekf2 = read_ekf2(recording, parameters, autopilot)
    positions, missing_positions = read_positions(recording, mapped, remedies)
    truth = read_truth(recording, positions, remedies)
    airborne = _read_airborne(recording, remedies)
    modes = _read_modes(recording) if autopilot == "PX4" else NO_MODES
    return Flight(
        log=structs.replace(
            _describe(recording, parameters, autopilot),
            ends_in_flight=ends_in_flight(airborne, recording.duration_s),
        ),
        imu=imu,
        attitude=attitude,
        positions=positions,
        ekf2=ekf2,
        truth=truth,
        airborne=airborne,
        modes=modes,
        missing=(*missing_parts(imu, attitude, ekf2, truth), *missing_positions),
        streams=MappingProxyType(recording.streams),
        clocks=clock_maps(recording, mapped),
        unused=_unused(frames),
    )


def _read_imu(recording: Recording, remedies: Remedies) -> pd.DataFrame | Unavailable:
    found = [(source, recording.rows(source.message)) for source in IMU]
    # HIGHRES_IMU has units and µs; of the others the densest
    source, rows = found[0] if len(found[0][1]) > 1 else max(found, key=lambda pair: len(pair[1]))
    if len(rows) < 2:
        raw = len(recording.rows("RAW_IMU"))
        refused = f"; {raw} RAW_IMU were refused, since raw counts have no unit" if raw else ""
        return Unavailable("IMU", f"no HIGHRES_IMU or SCALED_IMU{refused}", remedies.imu)
    table = recording.frames.table(source.message, rows)
    if "id" in (table.dtype.names or ()):
        busiest = table["id"] == np.bincount(table["id"]).argmax()
        if not np.all(busiest):
            rows, table = rows[busiest], table[busiest]
    boot_s = recording.boot_s(table, rows)
    # an hour of it is hundreds of megabytes, so that nothing is kept twice
    values = np.empty((len(rows), 6))
    values[:, :3] = vector(table, "xacc", "yacc", "zacc", scale=source.acceleration_unit)
    values[:, 3:] = vector(table, "xgyro", "ygyro", "zgyro", scale=source.angular_rate_unit)
    del table
    columns = SPECIFIC_FORCE_COLUMNS + ANGULAR_RATE_COLUMNS
    usable = np.isfinite(values).all(axis=1)
    if not np.all(usable):
        boot_s, values = boot_s[usable], values[usable]
    imu = recording.frame(source.message, boot_s, columns, values)
    if len(imu) < 2:
        return Unavailable(
            "IMU",
            f"{source.message} holds {len(imu)} usable samples",
            "Check that the sensors ran while the link was recorded.",
        )
    recording.came_from("imu", BOOT_CLOCK, source.message)
    return imu


def _read_attitude(recording: Recording, remedies: Remedies) -> pd.DataFrame | Unavailable:
    found = [(message, recording.rows(message)) for message in ATTITUDE]
    message, rows = max(found, key=lambda pair: len(pair[1]))
    table = recording.frames.table(message, rows)
    if message == "ATTITUDE":
        quaternion = quaternions_of_angles(table)
    elif message == "ODOMETRY":
        quaternion = table["q"].astype(np.float64)
    else:
        quaternion = vector(table, "q1", "q2", "q3", "q4")
    norm = np.linalg.norm(quaternion, axis=1)
    good = np.isfinite(norm) & (norm > MIN_NORM)
    boot_s = recording.boot_s(table, rows)[good]
    attitude = recording.frame(message, boot_s, QUATERNION_COLUMNS, quaternion[good])
    if len(attitude) < 2:
        return Unavailable(
            "attitude", f"no usable {', '.join(ATTITUDE[:-1])} or {ATTITUDE[-1]}", remedies.attitude
        )
    recording.came_from("attitude", BOOT_CLOCK, message)
    return attitude


def _read_airborne(
    recording: Recording, remedies: Remedies
) -> tuple[tuple[float, float], ...] | Unavailable:
    """Stretches of flight by the land detector, each from take-off to touch-down."""
    rows = recording.rows("EXTENDED_SYS_STATE")
    table = recording.frames.table("EXTENDED_SYS_STATE", rows)
    known = table["landed_state"] > 0
    if not np.any(known):
        return Unavailable("land detector", "no usable EXTENDED_SYS_STATE", remedies.landed)
    recording.came_from("airborne", RECEIPT_CLOCK, "EXTENDED_SYS_STATE")
    time_s = recording.receipt_boot_s(rows[known]) - recording.zero_s
    landed = pd.Series(table["landed_state"][known] == LANDED, index=time_s)
    return stretches_of_flight(landed, recording.duration_s)


def _read_modes(recording: Recording) -> tuple[FlightMode, ...] | Unavailable:
    rows = recording.rows("HEARTBEAT")
    if not len(rows):
        return NO_MODES
    modes = recording.frames.table("HEARTBEAT", rows)["custom_mode"].astype(np.int64)
    names = [
        AUTO_MODES.get(mode >> 24 & 0xFF, "Auto")
        if (main := mode >> 16 & 0xFF) == AUTO_MODE
        else MAIN_MODES.get(main, f"mode {main}")
        for mode in modes.tolist()
    ]
    time_s = recording.receipt_boot_s(rows) - recording.zero_s
    return stretches_of_modes(pd.Series(names, index=time_s), recording.duration_s)


def _read_parameters(recording: Recording, autopilot: str) -> MappingProxyType[str, float]:
    """Parameters as first sent; PX4 puts the bytes of an integer into the float."""
    table = recording.frames.table("PARAM_VALUE", recording.rows("PARAM_VALUE"))
    by_bytes = (autopilot == "PX4") & (table["param_type"] < PARAMETER_REAL)
    raw = np.ascontiguousarray(table["param_value"])
    values = np.where(by_bytes, raw.view(np.int32), raw)
    found: dict[str, float] = {}
    for name, value in zip(table["param_id"].tolist(), values.tolist(), strict=True):
        text = name.decode(errors="replace")
        if text in REPORTED and np.isfinite(value):
            found.setdefault(text, float(value))
    return MappingProxyType(found)


def _describe(
    recording: Recording, parameters: MappingProxyType[str, float], autopilot: str
) -> LogInfo:
    frames = recording.frames
    firmware, firmware_hash = f"{autopilot} (version not in the recording)", "unknown"
    vehicle = ""
    rows = recording.rows("AUTOPILOT_VERSION")
    if len(rows):
        version = frames.table("AUTOPILOT_VERSION", rows[:1])[0]
        major, minor, patch, _ = int(version["flight_sw_version"]).to_bytes(4, "big")
        if major or minor or patch:
            firmware = f"{autopilot} v{major}.{minor}.{patch}"
        text = bytes(version["flight_custom_version"][::-1]).hex()
        firmware_hash = text if text.strip("0") else "unknown"
        uid = bytes(version["uid2"]).hex()
        vehicle = uid if uid.strip("0") else ""
    beats = frames.table("HEARTBEAT", recording.rows("HEARTBEAT"))
    kind = VEHICLE_TYPES.get(int(beats["type"][0]), "vehicle") if len(beats) else "vehicle"
    dropped = [
        dropped_note(count, message, "zero, go back, or lie outside the recording")
        for message, count in sorted(recording.dropped.items())
    ]
    return LogInfo(
        name=frames.name,
        sha256=frames.sha256,
        bytes=len(frames.content),
        format="MAVLink stream" if frames.received_us is None else "MAVLink tlog",
        firmware=firmware,
        firmware_hash=firmware_hash,
        hardware=f"{kind} (MAVLink system {recording.system})",
        boot_time_s=recording.zero_s,
        duration_s=recording.duration_s,
        parameters=parameters,
        notes=(*recording.notes, *dropped),
        autopilot=autopilot,
        start_unix_s=_start_unix_s(recording),
        senders=describe_senders(recording),
        vehicle=vehicle,
        damage=recording.damage,
        bytes_read=len(frames.content) - frames.bad_bytes,
    )


def _start_unix_s(recording: Recording) -> float | None:
    """UNIX time of time zero: the autopilot's own, or else the recording computer's."""
    if recording.zero_s >= UNIX_FROM_S:
        return recording.zero_s
    zero = np.array([recording.zero_s])
    unix = unix_of_boot(recording)
    if unix is not None:
        return float(unix.at(zero)[0])
    received_us = recording.frames.received_us
    if received_us is None or not recording.boot_of_receipt.pairs:
        return None
    return float(received_us[0] * 1e-6 + recording.boot_of_receipt.inverse().at(zero)[0])


def _unused(frames: Frames) -> tuple[Unused, ...]:
    found = []
    for name, reason in UNUSED.items():
        count = int(np.count_nonzero(frames.message_id == message_ids()[name]))
        if count:
            found.append(Unused(name, count, reason))
    return tuple(found)
