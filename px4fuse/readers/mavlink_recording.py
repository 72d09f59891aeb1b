"""One MAVLink recording with its vehicle chosen and its clocks settled."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import Columns
from px4fuse.readers.layouts import IMPOSSIBLE, Layout
from px4fuse.readers.mavlink_clocks import UNIX_FROM_S, Line, least_delay, tells_time
from px4fuse.readers.mavlink_frames import LONGEST_FRAME, Address, Frames, message_name, wire_layout
from px4fuse.readers.mavlink_messages import FRAMES_OF_REFERENCE, STAMPED_BY_BOOT_CLOCK
from px4fuse.readers.parts import MIN_NORM
from px4fuse.readers.ulog_topics import increasing
from px4fuse.recording import Stream

BOOT_CLOCK = "autopilot boot clock"
RECEIPT_CLOCK = "time of receipt, less the link's least delay"
# The boot clock going back by more than this is a restart, not a late packet
RESTART_S = 5.0
# Messages so far before and after a restart must say so too
RESTART_MESSAGES = 20
# Stamps apart from the rest by OUTSIDE_S and fewer than this share of it are impossible
STRAY_SHARE = 0.01
# Samples further than this before or after the session have an impossible stamp
OUTSIDE_S = 60.0
# More bytes than this outside of frames are damage; a stream may begin in mid-frame
DAMAGED_SHARE = 0.002
# From this number on, stamps of the autopilot that stand still are no clock
MIN_STAMPS = 10


@dataclass(frozen=True)
class Recording:
    """One recording with its clocks settled.

    Attributes
    ----------
    frames : Frames
    address : Address
        Of the autopilot whose flight this is.
    session : slice
        The frames between two restarts of the autopilot.
    received_s : ndarray, shape (n,)
        Time of receipt (s) of every frame, from the first one; in a stream without stamps the
        boot time of the autopilot's last stamped message before it.
    boot_of_receipt : Line
        From time of receipt to the boot clock, both s.
    zero_s, duration_s : float
        Boot time of the flight's time zero, and the span of the session.
    damage : tuple of str
        What could not be read: sentences.
    notes : list of str
    restarts, receipt_went_back : int or None
        As :class:`~px4fuse.recording.LogInfo` has them.
    dropped : dict
        Samples dropped for an impossible time stamp, by message; :meth:`frame` fills it.
    streams : dict
        Where each part of the flight came from; :meth:`came_from` fills it.
    """

    frames: Frames
    address: Address
    session: slice
    received_s: Array
    boot_of_receipt: Line
    zero_s: float
    duration_s: float
    notes: list[str]
    damage: tuple[str, ...] = ()
    restarts: int | None = None
    receipt_went_back: int | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    streams: dict[str, Stream] = field(default_factory=dict)

    def of_anybody(self, message: str) -> IntArray:
        """Frames of one message within the session, whoever sent it."""
        rows = self.frames.rows(message)
        return np.asarray(rows[(rows >= self.session.start) & (rows < self.session.stop)])

    def rows(self, message: str, address: Address | None = None) -> IntArray:
        """Frames of one message within the session, from the autopilot unless said otherwise."""
        rows = self.of_anybody(message)
        return np.asarray(rows[self.frames.sent_by(address or self.address, rows)])

    def read(
        self,
        layout: Layout,
        rows: IntArray | None = None,
        boot_s: Array | None = None,
        name: str = "",
    ) -> pd.DataFrame:
        """Samples of one message by seconds of the flight, strictly increasing.

        Parameters
        ----------
        layout : Layout
            Angles become quaternions, and what is in a frame of its own comes in NED (or FRD).
        rows : ndarray, shape (n,), optional
            Of :meth:`rows`; by default all of the autopilot.
        boot_s : ndarray, shape (n,), optional
            Boot clock; NaN drops the sample. By default the message's own stamp.
        name : str, optional
            Under which dropped samples are counted, by default the message's.
        """
        rows = self.rows(layout.topic) if rows is None else rows
        table = self.frames.table(layout.topic, rows)
        boot_s = self.boot_s(table, rows) if boot_s is None else boot_s
        keep = self._keep(name or layout.topic, boot_s)
        if len(keep) < len(table):
            table = table[keep]
        # an hour of the IMU is hundreds of megabytes, so that nothing is kept twice
        values = np.empty((len(keep), len(layout.columns)))
        for at, (column, field_name) in enumerate(layout.columns.items()):
            base, _, index = field_name.removesuffix("]").partition("[")
            field_values = table[base][:, int(index)] if index else table[base]
            values[:, at] = field_values.astype(np.float64) * layout.scale.get(column, 1.0)
        del table
        values[~(np.abs(values) < IMPOSSIBLE)] = np.nan
        times = pd.Index(boot_s[keep] - self.zero_s, name="time_s")
        samples = pd.DataFrame(values, times, list(layout.columns), copy=False)
        if "roll" in samples:
            turns = Rotation.from_euler("ZYX", samples[["yaw", "pitch", "roll"]].to_numpy())
            samples[Columns.QUATERNION] = turns.as_quat(scalar_first=True)
        return _in_ned(samples) if "frame_id" in samples else samples

    def _keep(self, name: str, boot_s: Array) -> IntArray:
        """Samples with a possible time stamp, strictly increasing; the others are counted."""
        # false for NaN too
        late_s = boot_s - self.zero_s
        inside = (late_s >= -OUTSIDE_S) & (late_s <= self.duration_s + OUTSIDE_S)
        rows = np.flatnonzero(inside & (boot_s > 0.0))
        time_us = np.rint(boot_s[rows] * 1e6).astype(np.int64)
        # one message that came over two links is one sample
        first = np.sort(np.unique(time_us, return_index=True)[1])
        keep: IntArray = rows[first[increasing(time_us[first])]]
        dropped = len(boot_s) - len(rows) + len(first) - len(keep)
        if dropped:
            self.dropped[name] = dropped
        return keep

    def receipt_boot_s(self, rows: IntArray) -> Array:
        """Boot clock (s) at which frames were received, less the link's least delay."""
        return self.boot_of_receipt.at(self.received_s[rows])

    def boot_s(self, table: NDArray[Any], rows: IntArray) -> Array:
        """Boot clock (s) of the autopilot's own messages; by receipt where they are not on it."""
        if not self.boot_of_receipt.pairs:  # no message carries it
            return self.receipt_boot_s(rows)
        if "time_boot_ms" in (table.dtype.names or ()):
            return np.asarray(table["time_boot_ms"] * 1e-3, dtype=np.float64)
        stamp = table["time_usec"] * 1e-6
        on_boot = (stamp > 0.0) & ((stamp < UNIX_FROM_S) == (self.zero_s < UNIX_FROM_S))
        return np.asarray(np.where(on_boot, stamp, self.receipt_boot_s(rows)), dtype=np.float64)

    def came_from(self, part: str, *messages: str, clock: str = BOOT_CLOCK) -> None:
        """Note where a part of the flight came from."""
        self.streams[part] = Stream(messages, clock, self.frames.name)


def _in_ned(samples: pd.DataFrame) -> pd.DataFrame:
    """ODOMETRY in NED (or FRD); NaN where a frame is not one of those that PX4 knows.

    The velocity is in the child frame, which PX4 sets to the body up to v1.13 and to NED later
    (``streams/ODOMETRY.hpp``). Orientations are given up where the frame is not NED or FRD: what
    such a sender calls its body is not known.
    """
    turned = np.linalg.norm(samples[Columns.QUATERNION].to_numpy(), axis=1) > MIN_NORM
    orientation = Columns.QUATERNION + Columns.ROTATION_VARIANCE
    made = samples.copy()
    made[Columns.STATE + Columns.POSITION_VARIANCE] = np.nan
    made[Columns.VELOCITY_VARIANCE + orientation] = np.nan
    used = {*samples["frame_id"].unique(), *samples["child_frame_id"].unique()}
    for number in used & FRAMES_OF_REFERENCE.keys():
        frame = FRAMES_OF_REFERENCE[number]
        order, signs, turns = frame.order, frame.signs, frame.body
        own = samples[(samples["frame_id"] == number) & (not turns)]
        position = own[Columns.POSITION].to_numpy()[:, order]
        variance = own[Columns.POSITION_VARIANCE].to_numpy()[:, order]
        made.loc[own.index, Columns.POSITION] = position * signs
        made.loc[own.index, Columns.POSITION_VARIANCE] = variance
        if min(signs) > 0.0:
            made.loc[own.index, orientation] = own[orientation]
        moving = samples[(samples["child_frame_id"] == number) & (turned | (not turns))]
        speed = moving[Columns.VELOCITY].to_numpy()[:, order] * signs
        spread = moving[Columns.VELOCITY_VARIANCE].to_numpy()[:, order]
        if turns and len(moving):
            quaternion = moving[Columns.QUATERNION].to_numpy(copy=True)
            rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            speed = np.einsum("nij,nj->ni", rotation, speed)
            # diagonal of R diag(s) Rᵀ
            spread = np.einsum("nij,nj->ni", rotation**2, spread)
        made.loc[moving.index, Columns.VELOCITY] = speed
        made.loc[moving.index, Columns.VELOCITY_VARIANCE] = spread
    return made


def _boot_stamps(frames: Frames, address: Address) -> tuple[IntArray, Array]:
    """Frames of the autopilot that carry its boot clock, in file order, and that clock (s)."""
    own = frames.sent_by(address)
    all_rows, all_stamps = [np.zeros(0, dtype=np.intp)], [np.zeros(0)]
    for number in np.unique(frames.message_id[own]).tolist():
        name = message_name(number)
        if "time_boot_ms" in (wire_layout(number).names or ()):
            stamp, unit = "time_boot_ms", 1e-3
        elif name in STAMPED_BY_BOOT_CLOCK:
            stamp, unit = "time_usec", 1e-6
        else:
            continue
        rows = frames.rows(name)
        rows = rows[own[rows]]
        all_rows.append(rows)
        all_stamps.append(frames.table(name, rows)[stamp] * unit)
    rows, stamps = np.concatenate(all_rows), np.concatenate(all_stamps)
    from_boot, from_1970 = (stamps > 0.0) & (stamps < UNIX_FROM_S), stamps >= UNIX_FROM_S
    good = from_boot if np.any(from_boot) else from_1970
    if np.count_nonzero(good) >= MIN_STAMPS and not tells_time(stamps[good]):
        good = np.zeros_like(good)
    rows, stamps = rows[good], stamps[good]
    order = np.argsort(rows, kind="stable")
    return rows[order], stamps[order]


def settle_clocks(frames: Frames, address: Address) -> Recording:
    """Choose the session and map the time of receipt to the boot clock."""
    notes: list[str] = []
    rows, stamps = _boot_stamps(frames, address)
    session = slice(0, len(frames))
    restarts = np.flatnonzero(np.diff(stamps) < -RESTART_S) + 1
    # one late or early packet is no restart: its neighbours must say so too
    before = stamps[np.maximum(restarts - 1 - RESTART_MESSAGES, 0)]
    later = stamps[np.minimum(restarts + RESTART_MESSAGES, len(stamps) - 1)]
    restarts = restarts[later < np.minimum(before, stamps[restarts - 1]) - RESTART_S]
    if len(restarts):
        parts = np.split(np.arange(len(rows)), restarts)
        longest = max(range(len(parts)), key=lambda part: len(parts[part]))
        part = parts[longest]
        low = int(rows[part[0]]) if longest else 0
        high = len(frames) if longest == len(parts) - 1 else int(rows[part[-1]]) + 1
        session = slice(low, high)
        notes.append(
            f"the autopilot's boot clock went back {len(restarts)} "
            f"{'times' if len(restarts) > 1 else 'time'} (restart): only part {longest + 1} of "
            f"{len(parts)} was read, from {stamps[part[0]]:.1f} s to {stamps[part[-1]]:.1f} s of "
            f"its boot clock, {len(part) / len(rows):.0%} of the data"
        )
        rows, stamps = rows[part], stamps[part]
    kept = _without_strays(stamps, increasing(np.rint(stamps * 1e6).astype(np.int64)))
    rows, stamps = rows[kept], stamps[kept]
    line = Line(0.0, 0.0, 1.0, 0.0, len(rows))
    received = np.zeros(len(frames))
    if frames.received_us is not None:
        received = (frames.received_us - frames.received_us[0]) * 1e-6
        if len(rows):
            line = least_delay(stamps, received[rows]).inverse()
    elif len(rows):
        # no time of receipt: the boot clock of the last stamped message stands in for it
        at = np.clip(np.searchsorted(rows, np.arange(len(frames)), side="right") - 1, 0, None)
        received = stamps[at]
    else:
        notes.append("no message in the stream carries a time: nothing in it can be placed in time")
    back = int(np.count_nonzero(np.diff(received) < 0.0))
    said = {
        "whole frames of messages that px4fuse does not know were passed over: "
        f"{frames.passed_over}": frames.passed_over,
        f"{frames.bad_stamps} times of receipt are damaged and were interpolated": (
            frames.bad_stamps
        ),
        f"the time of receipt went back {back} {'times' if back > 1 else 'time'}": back,
    }
    notes += [note for note, count in said.items() if count]
    share = frames.bad_bytes / len(frames.content)
    lost = f"{frames.bad_bytes:,} bytes ({share:.2%}) belong to no whole MAVLink frame"
    # a first and a last frame that are cut are no damage
    inside = frames.bad_bytes - 2 * LONGEST_FRAME
    is_damaged = inside > DAMAGED_SHARE * len(frames.content)
    damage = (f"the file is damaged: {lost}",) if is_damaged else ()
    if frames.bad_bytes and not is_damaged:
        notes.append(lost)
    # without a boot clock the receipt must do
    span = stamps if len(stamps) else np.array([0.0, received.max()])
    zero_s, end_s = float(span[0]), float(span[-1])
    return Recording(
        frames,
        address,
        session,
        received,
        line,
        zero_s,
        end_s - zero_s,
        notes,
        damage,
        len(restarts) or None,
        back or None,
    )


def _without_strays(stamps: Array, rows: IntArray) -> IntArray:
    """IntArray of increasing stamps without a few at either end that are far from all others."""
    parts = np.split(rows, np.flatnonzero(np.diff(stamps[rows]) > OUTSIDE_S) + 1)
    enough = STRAY_SHARE * max(len(part) for part in parts)
    many = [number for number, part in enumerate(parts) if len(part) >= enough]
    return np.concatenate(parts[many[0] : many[-1] + 1])


def unix_of_boot(recording: Recording) -> Line | None:
    """Boot clock to UNIX time by the autopilot's SYSTEM_TIME, where a receiver has set it."""
    table = recording.frames.table("SYSTEM_TIME", recording.rows("SYSTEM_TIME"))
    boot, unix = table["time_boot_ms"] * 1e-3, table["time_unix_usec"] * 1e-6
    known = unix > UNIX_FROM_S
    if not np.any(known):
        return None
    return least_delay(boot[known], unix[known])
