"""MAVLink recordings (``.tlog`` and raw streams) to :class:`~px4fuse.flight.Flight`.

Which message is what, its direction and its clock follow PX4's ``src/modules/mavlink`` (v1.13 to
v1.16) and MAVLink's ``common.xml``; ``mavlink_messages`` holds them as tables.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pandas as pd

from px4fuse.ekf2_parameters import EV_POS, GNSS_POS, REPORTED, settings_in_force, valid_parameters
from px4fuse.flight import AXIS_NAMES, Columns, Ekf2, Flight, FlightMode, Unavailable
from px4fuse.readers import mavlink_messages as messages
from px4fuse.readers import mavlink_senders as senders
from px4fuse.readers import parts
from px4fuse.readers.mavlink_clocks import UNIX_FROM_S
from px4fuse.readers.mavlink_frames import MESSAGE_IDS, read_frames
from px4fuse.readers.mavlink_positions import pressure_altitude, read_positions, read_truth
from px4fuse.readers.mavlink_recording import RECEIPT_CLOCK, Recording, read_recording, unix_of_boot
from px4fuse.readers.px4_positions import barometer
from px4fuse.readers.ulog_topics import NO_SELECTOR, dropped_note
from px4fuse.record import missing_data
from px4fuse.recording import LogInfo, Unused

VARIANCE_COLUMNS = Columns.POSITION_VARIANCE + Columns.VELOCITY_VARIANCE
# MAV_PARAM_TYPE: below, an integer
PARAMETER_REAL = 9


# hostile values become NaN or infinite without a word, and are dropped where samples are made
@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def read_mavlink(name: str, content: bytes, system: int | None = None) -> Flight:
    """Read a MAVLink recording.

    Parameters
    ----------
    name : str
        Of the file.
    content : bytes
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
        It holds no MAVLink.
    SettingsError
        No autopilot in it has that system id.
    """
    frames = read_frames(name, content)
    address, autopilot = senders.choose_autopilot(frames, system)
    recording = read_recording(frames, address)
    mapped = senders.map_senders(recording)
    parameters, faults = valid_parameters(_read_parameters(recording, autopilot))
    remedies, _ = messages.remedies_of_autopilot(autopilot)
    imu = _read_imu(recording, remedies["imu"])
    attitude = _read_attitude(recording, remedies["attitude"])
    ekf2 = _read_ekf2(recording, parameters, autopilot)
    # other autopilots do not tell by how much they take a fix to be older than its stamp
    known = settings_in_force(parameters, GNSS_POS) if autopilot == "PX4" else {}
    delay_s = 1e-3 * known.get(GNSS_POS.delay, 0.0)
    positions, missing_positions = read_positions(recording, mapped, remedies["position"], delay_s)
    truth = read_truth(recording, positions, remedies)
    airborne = _read_airborne(recording, remedies["landed"])
    in_flight = parts.ends_in_flight(airborne, recording.duration_s)
    pressure = recording.read(messages.LAYOUTS["pressure"])["pressure_hpa"]
    modes = _read_modes(recording) if autopilot == "PX4" else messages.NO_MODES
    return Flight(
        # after all that is read, since it tells what was dropped
        log=_describe(recording, parameters, faults, autopilot, in_flight),
        imu=imu,
        attitude=attitude,
        positions=positions,
        ekf2=ekf2,
        truth=truth,
        airborne=airborne,
        barometer=barometer(pressure_altitude(pressure)),
        modes=modes,
        missing=(*parts.collect_unavailable(imu, attitude, ekf2, truth), *missing_positions),
        streams=MappingProxyType(recording.streams),
        clocks=senders.clock_maps(recording, mapped),
        unused=tuple(
            Unused(name, count, reason)
            for name, reason in messages.UNUSED.items()
            if (count := int(np.count_nonzero(frames.message_id == MESSAGE_IDS[name])))
        ),
    )


def _read_imu(recording: Recording, remedy: str) -> pd.DataFrame | Unavailable:
    found = [(layout, recording.rows(layout.topic)) for layout in messages.IMU]
    # HIGHRES_IMU has units and µs; of the others the densest
    layout, rows = found[0] if len(found[0][1]) > 1 else max(found, key=lambda pair: len(pair[1]))
    if len(rows) < 2:
        raw = len(recording.rows("RAW_IMU"))
        refused = f"; {raw} RAW_IMU were refused, since raw counts have no unit" if raw else ""
        return Unavailable("IMU", f"no HIGHRES_IMU or SCALED_IMU{refused}", remedy)
    table = recording.frames.table(layout.topic, rows)
    if "id" in (table.dtype.names or ()):
        rows = rows[table["id"] == np.bincount(table["id"]).argmax()]
    del table
    imu = recording.read(layout, rows)
    imu = parts.finite_rows(imu, imu.columns.tolist(), parts.BEYOND_IMU)
    if len(imu) < 2:
        return missing_data("imu_few", topic=layout.topic, count=len(imu))
    recording.record_stream("imu", layout.topic)
    return imu


def _read_attitude(recording: Recording, remedy: str) -> pd.DataFrame | Unavailable:
    layout = max(messages.ATTITUDE, key=lambda layout: len(recording.rows(layout.topic)))
    attitude = parts.with_attitude(recording.read(layout))[Columns.QUATERNION]
    if len(attitude) < 2:
        *other_topics, last = (layout.topic for layout in messages.ATTITUDE)
        return Unavailable("attitude", f"no usable {', '.join(other_topics)} or {last}", remedy)
    recording.record_stream("attitude", layout.topic)
    return attitude


def _read_ekf2(
    recording: Recording, parameters: Mapping[str, float], autopilot: str
) -> Ekf2 | Unavailable:
    """EKF2's output as the autopilot sent it, or why there is none."""
    remedies, replay = messages.remedies_of_autopilot(autopilot)
    counts = {layout.topic: len(recording.rows(layout.topic)) for layout in messages.STATES}
    # the one with variances as long as it is not much sparser than the one without
    dense = (
        layout_candidate
        for layout_candidate in messages.STATES
        if 2 * counts[layout_candidate.topic] >= max(counts.values())
    )
    layout = next(dense)
    message = layout.topic
    if counts[message] < 2:
        return missing_data("ekf2_not_sent", remedy=remedies["state"])
    samples = recording.read(layout)
    state = samples[Columns.STATE].dropna()
    if len(state) < 2:
        return Unavailable("EKF2", f"{message} holds no finite state", "Wait for EKF2 to start.")
    recording.record_stream("ekf2_state", message)
    notes = [f"EKF2's state is {message} as the autopilot sent it"]
    if autopilot != "PX4":
        notes.append(f"this is {autopilot}: what is called EKF2 here is its own estimator")
    if "reset_counter" in samples and (
        count := np.count_nonzero(samples["reset_counter"].diff()[1:])
    ):
        reset = f"EKF2 reset its state {count} times in the recording"
        notes.append(f"{reset}; ODOMETRY does not say by how much, so nothing was undone")
    found = samples.reindex(columns=VARIANCE_COLUMNS)
    found = found[(found > 0.0).all(axis=1)]
    if found.empty:
        message, found = messages.LAYOUTS["accuracy"].topic, _variance_by_accuracy(recording)
        if len(found):
            by = "from ESTIMATOR_STATUS: its horizontal accuracy squared, half to each axis"
            notes.append(f"EKF2's position variances are {by}; velocity variances are not sent")
    variance: pd.DataFrame | Unavailable = found
    if found.empty:
        variance = missing_data("variances_not_sent", remedy=remedies["variance"])
    else:
        recording.record_stream("ekf2_variance", message)
    return Ekf2(
        state=state,
        variance=variance,
        innovations={
            axis: missing_data("inside_not_sent", axis=axis, remedy=remedies["inside"])
            for axis in AXIS_NAMES
        },
        innovation_topics=(),
        fusing=missing_data("fusion_not_sent", remedy=remedies["inside"]),
        resets=(),
        instances=NO_SELECTOR,
        gate=settings_in_force(parameters)[EV_POS.gate],
        notes=tuple(notes),
        record=replay,
    )


def _variance_by_accuracy(recording: Recording) -> pd.DataFrame:
    """Position variances from the accuracies of ESTIMATOR_STATUS, which are one σ.

    PX4's horizontal accuracy is the root of the sum over both axes (``get_ekf_lpos_accuracy``).
    """
    accuracy = recording.read(messages.LAYOUTS["accuracy"])
    variance = pd.DataFrame(np.nan, index=accuracy.index, columns=VARIANCE_COLUMNS)
    variance["north_m2"] = variance["east_m2"] = accuracy["horizontal_m"] ** 2 / 2.0
    variance["down_m2"] = accuracy["vertical_m"] ** 2
    return variance[(variance[Columns.POSITION_VARIANCE] > 0.0).all(axis=1)]


def _read_airborne(
    recording: Recording, remedy: str
) -> tuple[tuple[float, float], ...] | Unavailable:
    """Stretches of flight by the land detector, each from take-off to touch-down."""
    rows = recording.rows("EXTENDED_SYS_STATE")
    table = recording.frames.table("EXTENDED_SYS_STATE", rows)
    known = table["landed_state"] > 0
    if not np.any(known):
        return Unavailable("land detector", "no usable EXTENDED_SYS_STATE", remedy)
    recording.record_stream("airborne", "EXTENDED_SYS_STATE", clock=RECEIPT_CLOCK)
    time_s = recording.receipt_boot_s(rows[known]) - recording.zero_s
    landed = pd.Series(table["landed_state"][known] == messages.LANDED, index=time_s)
    return parts.flight_spans(landed, recording.duration_s)


def _read_modes(recording: Recording) -> tuple[FlightMode, ...] | Unavailable:
    rows = recording.rows("HEARTBEAT")
    if not len(rows):
        return messages.NO_MODES
    modes = recording.frames.table("HEARTBEAT", rows)["custom_mode"].astype(np.int64)
    names = [
        messages.AUTO_MODES.get(mode >> 24 & 0xFF, "Auto")
        if (main := mode >> 16 & 0xFF) == messages.AUTO_MODE
        else messages.MAIN_MODES.get(main, f"mode {main}")
        for mode in modes.tolist()
    ]
    time_s = recording.receipt_boot_s(rows) - recording.zero_s
    return parts.mode_spans(pd.Series(names, index=time_s), recording.duration_s)


def _read_parameters(recording: Recording, autopilot: str) -> dict[str, float]:
    """Parameters as first sent; PX4 puts the bytes of an integer into the float."""
    table = recording.frames.table("PARAM_VALUE", recording.rows("PARAM_VALUE"))
    by_bytes = (autopilot == "PX4") & (table["param_type"] < PARAMETER_REAL)
    raw = np.ascontiguousarray(table["param_value"])
    values = np.where(by_bytes, raw.view(np.int32), raw)
    found: dict[str, float] = {}
    for name, value in zip(table["param_id"].tolist(), values.tolist(), strict=True):
        text = name.decode(errors="replace")
        if text in REPORTED:
            found.setdefault(text, float(value))
    return found


def _describe(
    recording: Recording,
    parameters: Mapping[str, float],
    faults: tuple[str, ...],
    autopilot: str,
    in_flight: bool,
) -> LogInfo:
    frames = recording.frames
    end = (
        (parts.format_truncation("frame", recording.duration_s, in_flight),)
        if frames.in_frame
        else ()
    )
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
    first = next(iter(beats["type"].tolist()), -1)
    kind = messages.VEHICLE_TYPES.get(first, "vehicle")
    why = "zero, go back, or lie outside the recording"
    dropped = [dropped_note(n, message, why) for message, n in sorted(recording.dropped.items())]
    return LogInfo(
        name=frames.name,
        sha256=frames.sha256,
        bytes=len(frames.content),
        format="MAVLink stream" if frames.received_us is None else "MAVLink tlog",
        firmware=firmware,
        firmware_hash=firmware_hash,
        hardware=f"{kind} (MAVLink system {recording.address[0]})",
        boot_time_s=recording.zero_s,
        duration_s=recording.duration_s,
        parameters=MappingProxyType(parameters),
        notes=(*recording.notes, *faults, *dropped),
        restarts=recording.restarts,
        receipt_went_back=recording.receipt_went_back,
        dropped=dict(sorted(recording.dropped.items())),
        autopilot=autopilot,
        start_unix_s=_start_unix_s(recording),
        senders=senders.describe_senders(recording),
        vehicle=vehicle,
        damage=(*end, *recording.damage),
        ends_in_flight=in_flight,
        bytes_read=len(frames.content) - frames.bad_bytes,
    )


def _start_unix_s(recording: Recording) -> float | None:
    """UNIX time of time zero: the autopilot's own, or else the recording computer's."""
    if recording.zero_s >= UNIX_FROM_S:
        return recording.zero_s
    unix = unix_of_boot(recording)
    if unix is not None:
        return float(unix.at(recording.zero_s))
    received_us = recording.frames.received_us
    if received_us is None or not recording.boot_of_receipt.pairs:
        return None
    return float(received_us[0] * 1e-6 + recording.boot_of_receipt.inverse().at(recording.zero_s))
