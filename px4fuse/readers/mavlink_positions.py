"""External positions that were sent to the autopilot over MAVLink, and the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from msgspec import structs
from scipy import constants

from px4fuse.flight import Columns, PositionTrack, Truth, Unavailable, best_first
from px4fuse.origin import GNSS, with_orientation
from px4fuse.readers import mavlink_messages as messages
from px4fuse.readers import px4_positions
from px4fuse.readers.layouts import GLOBAL_COLUMNS, Layout
from px4fuse.readers.mavlink_clocks import Mapped
from px4fuse.readers.mavlink_frames import Address
from px4fuse.readers.mavlink_recording import BOOT_CLOCK, RECEIPT_CLOCK, Recording
from px4fuse.readers.mavlink_senders import senders_of
from px4fuse.readers.parts import attitude_of, orientation_of, with_nearest
from px4fuse.readers.px4_positions import Place, projected, unproject
from px4fuse.record import lacking

# A boot clock's stamp is no further from its receipt
OWN_CLOCK_S = 5.0
# Of a global and a local position that tell the origin together, 5 cm at 1 m/s
SAME_STATE_S = 0.05


def read_positions(
    recording: Recording, mapped: dict[Address, Mapped], remedy: str, delay_s: float
) -> tuple[tuple[PositionTrack, ...], tuple[Unavailable, ...]]:
    """Every external position that was sent to the autopilot, the best first.

    Parameters
    ----------
    mapped : mapping from address to Mapped
        Clock of every sender.
    remedy : str
        What would have recorded one that is missing.
    delay_s : float
        By which the autopilot takes a fix to be older than its stamp.
    """
    found: list[PositionTrack | Unavailable] = []
    for message in dict.fromkeys(source.message for source in messages.POSITION_INPUTS):
        senders = senders_of(recording, message)
        tracks = [
            track
            for sender in senders
            for source in messages.POSITION_INPUTS
            if source.message == message
            if (track := _read_track(recording, source, sender, mapped[sender], remedy, senders))
        ]
        lacking = f"no {message} to the autopilot in the recording"
        found += tracks or [px4_positions.unavailable(message, lacking, remedy)]
    fixes = (_read_gnss(recording, layout, delay_s) for layout in messages.GNSS_INPUTS)
    found += [track for track in fixes if track]
    missing = tuple(part for part in found if isinstance(part, Unavailable))
    return best_first(part for part in found if isinstance(part, PositionTrack)), missing


def _read_track(
    recording: Recording,
    source: messages.PositionInput,
    sender: Address,
    clock: Mapped,
    remedy: str,
    senders: list[Address],
) -> PositionTrack | Unavailable | None:
    """What one sender sent of one kind; None where it did not."""
    rows = recording.rows(source.message, sender)
    table = recording.frames.table(source.message, rows)
    if source.estimator is not None:
        own = table["estimator_type"] == source.estimator
        rows, table = rows[own], table[own]
    if not len(rows):
        return None
    name = source.name + (f"_{sender[0]}_{sender[1]}" if len(senders) > 1 else "")
    stamp_s = table[source.stamp] * 1e-6
    boot_s = recording.receipt_boot_s(rows)
    if clock.to_boot is not None:
        boot_s = np.where(stamp_s > 0.0, clock.to_boot.at(stamp_s), np.nan)
    samples = recording.read(source.layout, rows, boot_s, name)
    frame = "NED"
    if "frame_id" in samples and len(samples):
        # one frame per track: that of the last sample, as PX4 would have used it
        reference = messages.TABLE.frames.get(int(samples["frame_id"].iloc[-1]))
        frame = "unknown" if reference is None else reference.name
    if source.drops_covariance:
        samples[Columns.POSITION_VARIANCE + Columns.ROTATION_VARIANCE] = np.nan
    orientation = orientation_of(samples)
    told = clock.statement
    mapped = "" if told.method == "boot clock" else f", mapped to boot time by {told.method}"
    return px4_positions.make_track(
        name,
        samples,
        with_orientation(source.origin, turns=orientation is not None),
        remedy=remedy,
        description=source.description,
        frame=frame,
        clock=told.clock + mapped,
        topics=(source.message,),
        log=recording.frames.name,
        clock_map=told,
        orientation=orientation,
    )


def _read_gnss(
    recording: Recording, layout: Layout, delay_s: float
) -> PositionTrack | Unavailable | None:
    """Fixes of a receiver, about the autopilot's own origin; None where there are none.

    PX4 and ArduPilot stamp a fix with their boot clock, and send it again until the next comes.
    It is what the autopilot's estimator follows where that knows where on the globe it is.
    """
    rows = recording.rows(layout.topic)
    stamp_us = recording.frames.table(layout.topic, rows)["time_usec"]
    rows = rows[np.diff(stamp_us, prepend=0) > 0]
    boot_s = recording.frames.table(layout.topic, rows)["time_usec"] * 1e-6
    receipt_s = recording.receipt_boot_s(rows)
    if len(rows) and np.median(np.abs(receipt_s - boot_s)) > OWN_CLOCK_S:
        boot_s = receipt_s  # UNIX time, or the recording has no boot clock
    fixes = recording.read(layout, rows, boot_s - delay_s)
    fixes = fixes[fixes["fix_type"] >= px4_positions.GPS_3D_FIX]
    if len(fixes) < px4_positions.MIN_TRACK_SAMPLES:
        return None
    samples = projected(fixes, local_origin(recording))
    accuracy = fixes[["eph_m", "eph_m", "epv_m"]].set_axis(Columns.POSITION_VARIANCE, axis=1) ** 2
    automatic = bool(recording.read(messages.LAYOUTS["global_state"])["latitude_deg"].any())
    return px4_positions.make_track(
        layout.topic,
        samples.join(accuracy),
        structs.replace(GNSS, automatic=automatic),
        description="GNSS position",
        frame="NED",
        clock=f"{BOOT_CLOCK}, less {1e3 * delay_s:g} ms",
        topics=(layout.topic,),
        log=recording.frames.name,
        age_s=delay_s,
    )


def pressure_altitude(pressure_hpa: pd.Series[float]) -> pd.Series[float]:
    """Altitude (m) of a pressure in the standard atmosphere, troposphere (ISO 2533:1975)."""
    exponent = constants.R * 0.0065 / (constants.g * 0.0289644)
    return 288.15 / 0.0065 * (1.0 - (pressure_hpa / 1013.25) ** exponent)


def local_origin(recording: Recording) -> Place | None:
    """The autopilot's origin on the globe (degrees, degrees, m), None where it does not tell.

    As it is sent, or else by its global and its local position.
    """
    sent = recording.read(messages.LAYOUTS["origin"]).dropna()
    if len(sent):
        return tuple(sent[GLOBAL_COLUMNS].iloc[-1].tolist())
    state = recording.read(messages.STATES[-1])[Columns.POSITION]
    there = recording.read(messages.LAYOUTS["global_state"])
    both = with_nearest(there, state, SAME_STATE_S).dropna()
    both = both[both["latitude_deg"] != 0.0]
    if both.empty:
        return None
    geo, local = both[GLOBAL_COLUMNS].to_numpy(), both[Columns.POSITION].to_numpy()
    pairs = zip(geo, local, strict=True)
    places = [(*unproject(-n, -e, tuple(at[:2])), at[2] + d) for at, (n, e, d) in pairs]
    return tuple(np.median(places, axis=0).tolist())


def read_truth(
    recording: Recording, positions: tuple[PositionTrack, ...], remedies: Mapping[str, str]
) -> Truth | Unavailable:
    """Simulation truth, or motion capture where another track feeds EKF2.

    Simulation truth carries no usable clock (``HIL_STATE_QUATERNION.time_usec`` is 0 in PX4), so
    the time of receipt is taken, and no local position, so it is projected about its own first
    sample, where the simulated vehicle was put, or about the autopilot's origin where GNSS is.
    """
    for layout in messages.TRUTH:
        rows = recording.rows(layout.topic)
        if len(rows) < px4_positions.MIN_TRACK_SAMPLES:
            continue
        samples = recording.read(layout, rows, recording.receipt_boot_s(rows))
        samples = samples.dropna(subset=GLOBAL_COLUMNS[:2])
        if not samples["latitude_deg"].any():
            continue
        samples = samples.reindex(columns=[*GLOBAL_COLUMNS, *Columns.VELOCITY, *Columns.QUATERNION])
        if not samples[Columns.VELOCITY].to_numpy().any():
            # not sent: a vehicle that never moves has no use for truth
            samples[Columns.VELOCITY] = np.nan
        recording.came_from("truth", layout.topic, clock=RECEIPT_CLOCK)
        origin = local_origin(recording) if positions and positions[0].origin.is_gnss else None
        state = pd.concat([projected(samples, origin), samples[Columns.VELOCITY]], axis=1)
        return Truth(layout.topic, state[Columns.STATE], attitude_of(samples))
    captured = px4_positions.motion_capture(positions, "ATT_POS_MOCAP")
    for track in positions:
        if captured and track.name == captured.name:
            recording.came_from("truth", *track.topics, clock=track.clock)
    return captured or lacking("truth_not_recorded", remedy=remedies["truth"])
