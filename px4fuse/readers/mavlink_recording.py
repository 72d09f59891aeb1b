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
from px4fuse.readers.mavlink_clocks import UNIX_FROM_S, Line, fit_least_delay, is_running_clock
from px4fuse.readers.mavlink_frames import LONGEST_FRAME, Address, Frames, message_name, wire_layout
from px4fuse.readers.mavlink_messages import FRAMES_OF_REFERENCE, STAMPED_BY_BOOT_CLOCK
from px4fuse.readers.parts import MIN_NORM
from px4fuse.readers.ulog_topics import longest_increasing_run
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
        Where each part of the flight came from; :meth:`record_stream` fills it.
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

    def rows_of_all_senders(self, message: str) -> IntArray:
        """Frames of one message within the session, whoever sent it."""
        rows = self.frames.rows(message)
        return np.asarray(rows[(rows >= self.session.start) & (rows < self.session.stop)])

    def rows(self, message: str, address: Address | None = None) -> IntArray:
        """Frames of one message within the session, from the autopilot unless said otherwise."""
        rows = self.rows_of_all_senders(message)
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
        selected_rows = self._select_rows(name or layout.topic, boot_s)
        if len(selected_rows) < len(table):
            table = table[selected_rows]
        # an hour of the IMU is hundreds of megabytes, so that nothing is kept twice
        values = np.empty((len(selected_rows), len(layout.columns)))
        for at, (column, field_name) in enumerate(layout.columns.items()):
            base, _, index = field_name.removesuffix("]").partition("[")
            field_values = table[base][:, int(index)] if index else table[base]
            values[:, at] = field_values.astype(np.float64) * layout.scale.get(column, 1.0)
        del table
        values[~(np.abs(values) < IMPOSSIBLE)] = np.nan
        times = pd.Index(boot_s[selected_rows] - self.zero_s, name="time_s")
        samples = pd.DataFrame(values, times, list(layout.columns), copy=False)
        if "roll" in samples:
            is_body = Rotation.from_euler("ZYX", samples[["yaw", "pitch", "roll"]].to_numpy())
            samples[Columns.QUATERNION] = is_body.as_quat(scalar_first=True)
        return _to_ned(samples) if "frame_id" in samples else samples

    def _select_rows(self, name: str, boot_s: Array) -> IntArray:
        """Samples with a possible time stamp, strictly increasing; the others are counted."""
        # false for NaN too
        time_s = boot_s - self.zero_s
        inside = (time_s >= -OUTSIDE_S) & (time_s <= self.duration_s + OUTSIDE_S)
        rows = np.flatnonzero(inside & (boot_s > 0.0))
        time_us = np.rint(boot_s[rows] * 1e6).astype(np.int64)
        # one message that came over two links is one sample
        first = np.sort(np.unique(time_us, return_index=True)[1])
        selected_rows: IntArray = rows[first[longest_increasing_run(time_us[first])]]
        dropped = len(boot_s) - len(rows) + len(first) - len(selected_rows)
        if dropped:
            self.dropped[name] = dropped
        return selected_rows

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

    def record_stream(self, part: str, *messages: str, clock: str = BOOT_CLOCK) -> None:
        """Note where a part of the flight came from."""
        self.streams[part] = Stream(messages, clock, self.frames.name)


def _to_ned(samples: pd.DataFrame) -> pd.DataFrame:
    """ODOMETRY in NED (or FRD); NaN where a frame is not one of those that PX4 knows.

    The velocity is in the child frame, which PX4 sets to the body up to v1.13 and to NED later
    (``streams/ODOMETRY.hpp``). Orientations are given up where the frame is not NED or FRD: what
    such a sender calls its body is not known.
    """
    has_quaternion = np.linalg.norm(samples[Columns.QUATERNION].to_numpy(), axis=1) > MIN_NORM
    orientation = Columns.QUATERNION + Columns.ROTATION_VARIANCE
    ned_samples = samples.copy()
    ned_samples[Columns.STATE + Columns.POSITION_VARIANCE] = np.nan
    ned_samples[Columns.VELOCITY_VARIANCE + orientation] = np.nan
    used = {*samples["frame_id"].unique(), *samples["child_frame_id"].unique()}
    for number in used & FRAMES_OF_REFERENCE.keys():
        frame = FRAMES_OF_REFERENCE[number]
        order, signs, is_body = frame.order, frame.signs, frame.body
        frame_samples = samples[(samples["frame_id"] == number) & (not is_body)]
        position = frame_samples[Columns.POSITION].to_numpy()[:, order]
        variance = frame_samples[Columns.POSITION_VARIANCE].to_numpy()[:, order]
        ned_samples.loc[frame_samples.index, Columns.POSITION] = position * signs
        ned_samples.loc[frame_samples.index, Columns.POSITION_VARIANCE] = variance
        if min(signs) > 0.0:
            ned_samples.loc[frame_samples.index, orientation] = frame_samples[orientation]
        child_samples = samples[
            (samples["child_frame_id"] == number) & (has_quaternion | (not is_body))
        ]
        velocity = child_samples[Columns.VELOCITY].to_numpy()[:, order] * signs
        velocity_variance = child_samples[Columns.VELOCITY_VARIANCE].to_numpy()[:, order]
        if is_body and len(child_samples):
            quaternion = child_samples[Columns.QUATERNION].to_numpy(copy=True)
            rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            velocity = np.einsum("nij,nj->ni", rotation, velocity)
            # diagonal of R diag(s) Rᵀ
            velocity_variance = np.einsum("nij,nj->ni", rotation**2, velocity_variance)
        ned_samples.loc[child_samples.index, Columns.VELOCITY] = velocity
        ned_samples.loc[child_samples.index, Columns.VELOCITY_VARIANCE] = velocity_variance
    return ned_samples


def _boot_stamps(frames: Frames, address: Address) -> tuple[IntArray, Array]:
    """Frames of the autopilot that carry its boot clock, in file order, and that clock (s)."""
    frame_samples = frames.sent_by(address)
    all_rows, all_stamps = [np.zeros(0, dtype=np.intp)], [np.zeros(0)]
    for number in np.unique(frames.message_id[frame_samples]).tolist():
        name = message_name(number)
        if "time_boot_ms" in (wire_layout(number).names or ()):
            stamp, unit = "time_boot_ms", 1e-3
        elif name in STAMPED_BY_BOOT_CLOCK:
            stamp, unit = "time_usec", 1e-6
        else:
            continue
        rows = frames.rows(name)
        rows = rows[frame_samples[rows]]
        all_rows.append(rows)
        all_stamps.append(frames.table(name, rows)[stamp] * unit)
    rows, stamps = np.concatenate(all_rows), np.concatenate(all_stamps)
    is_boot_time, is_unix_time = (stamps > 0.0) & (stamps < UNIX_FROM_S), stamps >= UNIX_FROM_S
    is_usable = is_boot_time if np.any(is_boot_time) else is_unix_time
    if np.count_nonzero(is_usable) >= MIN_STAMPS and not is_running_clock(stamps[is_usable]):
        is_usable = np.zeros_like(is_usable)
    rows, stamps = rows[is_usable], stamps[is_usable]
    order = np.argsort(rows, kind="stable")
    return rows[order], stamps[order]


def read_recording(frames: Frames, address: Address) -> Recording:
    """Choose the session and map the time of receipt to the boot clock."""
    notes: list[str] = []
    rows, stamps = _boot_stamps(frames, address)
    session = slice(0, len(frames))
    restarts = np.flatnonzero(np.diff(stamps) < -RESTART_S) + 1
    # one late or early packet is no restart: its neighbours must say so too
    stamps_before = stamps[np.maximum(restarts - 1 - RESTART_MESSAGES, 0)]
    stamps_after = stamps[np.minimum(restarts + RESTART_MESSAGES, len(stamps) - 1)]
    restarts = restarts[stamps_after < np.minimum(stamps_before, stamps[restarts - 1]) - RESTART_S]
    if len(restarts):
        session_rows = np.split(np.arange(len(rows)), restarts)
        longest_index = max(
            range(len(session_rows)), key=lambda rows_of_session: len(session_rows[rows_of_session])
        )
        rows_of_session = session_rows[longest_index]
        low = int(rows[rows_of_session[0]]) if longest_index else 0
        high = (
            len(frames)
            if longest_index == len(session_rows) - 1
            else int(rows[rows_of_session[-1]]) + 1
        )
        session = slice(low, high)
        notes.append(
            f"the autopilot's boot clock went back {len(restarts)} "
            f"{'times' if len(restarts) > 1 else 'time'} (restart): only part {longest_index + 1} of "
            f"{len(session_rows)} was read, from {stamps[rows_of_session[0]]:.1f} s to {stamps[rows_of_session[-1]]:.1f} s of "
            f"its boot clock, {len(rows_of_session) / len(rows):.0%} of the data"
        )
        rows, stamps = rows[rows_of_session], stamps[rows_of_session]
    increasing_rows = _remove_stray_stamps(
        stamps, longest_increasing_run(np.rint(stamps * 1e6).astype(np.int64))
    )
    rows, stamps = rows[increasing_rows], stamps[increasing_rows]
    line = Line(0.0, 0.0, 1.0, 0.0, len(rows))
    received = np.zeros(len(frames))
    if frames.received_us is not None:
        received = (frames.received_us - frames.received_us[0]) * 1e-6
        if len(rows):
            line = fit_least_delay(stamps, received[rows]).inverse()
    elif len(rows):
        # no time of receipt: the boot clock of the last stamped message stands in for it
        at = np.clip(np.searchsorted(rows, np.arange(len(frames)), side="right") - 1, 0, None)
        received = stamps[at]
    else:
        notes.append("no message in the stream carries a time: nothing in it can be placed in time")
    receipt_reversals = int(np.count_nonzero(np.diff(received) < 0.0))
    counted_notes = {
        "whole frames of messages that px4fuse does not know were passed over: "
        f"{frames.unknown_frame_count}": frames.unknown_frame_count,
        f"{frames.bad_stamps} times of receipt are damaged and were interpolated": (
            frames.bad_stamps
        ),
        f"the time of receipt went back {receipt_reversals} {'times' if receipt_reversals > 1 else 'time'}": receipt_reversals,
    }
    notes += [note for note, count in counted_notes.items() if count]
    share = frames.bad_bytes / len(frames.content)
    lost = f"{frames.bad_bytes:,} bytes ({share:.2%}) belong to no whole MAVLink frame"
    # a first and a last frame that are cut are no damage
    bytes_inside = frames.bad_bytes - 2 * LONGEST_FRAME
    is_damaged = bytes_inside > DAMAGED_SHARE * len(frames.content)
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
        receipt_reversals or None,
    )


def _remove_stray_stamps(stamps: Array, rows: IntArray) -> IntArray:
    """IntArray of increasing stamps without a few at either end that are far from all others."""
    groups = np.split(rows, np.flatnonzero(np.diff(stamps[rows]) > OUTSIDE_S) + 1)
    min_count = STRAY_SHARE * max(len(group) for group in groups)
    large_groups = [number for number, group in enumerate(groups) if len(group) >= min_count]
    return np.concatenate(groups[large_groups[0] : large_groups[-1] + 1])


def unix_of_boot(recording: Recording) -> Line | None:
    """Boot clock to UNIX time by the autopilot's SYSTEM_TIME, where a receiver has set it."""
    table = recording.frames.table("SYSTEM_TIME", recording.rows("SYSTEM_TIME"))
    boot, unix = table["time_boot_ms"] * 1e-3, table["time_unix_usec"] * 1e-6
    known = unix > UNIX_FROM_S
    if not np.any(known):
        return None
    return fit_least_delay(boot[known], unix[known])
