"""Write small MAVLink recordings with pymavlink, with chosen times, links, senders and clocks.

The flight moves along the aisle of :func:`flights.motion`, so every message has a closed form. The
other clocks are functions of the boot clock. A message is received ``delay`` after it was sent.
"""

from __future__ import annotations

import contextlib
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flights import GRAVITY_M_S2, motion
from pymavlink.dialects.v20 import all as dialect
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.flight.model import Flight, PositionTrack

Address = tuple[int, int]

AUTOPILOT: Address = (1, 1)
COMPANION: Address = (1, 197)
GROUND: Address = (255, 190)
BOOT_S = 50.0  # s; boot clock at the start of the flight
UNIX_S = 1_700_000_000.0  # s; UNIX time at boot
HEADING_DEG, LENGTH_M = 30.0, 10.0
LEAST_DELAY_S = 0.002
MESSAGES = {message.msgname: message for message in dialect.mavlink_map.values()}
POSE_VARIANCE = (0.01, 0.02, 0.03)
VELOCITY_VARIANCE = (0.04, 0.05, 0.06)


def message(name: str, /, **fields: Any) -> Any:
    """Make a pymavlink message; fields that are not given are zero."""
    kind = MESSAGES[name]
    values = []
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for key, wire in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        zero: Any = b"" if wire == "char" else 0
        if lengths[key] and wire != "char":
            zero = [0] * lengths[key]
        values.append(fields.pop(key, zero))
    assert not fields, f"{name} has no {sorted(fields)}"
    return kind(*values)


def frame(
    made: Any,
    sender: Address = AUTOPILOT,
    sequence: int = 0,
    *,
    v1: bool = False,
    key: bytes | None = None,
) -> bytes:
    """Return the bytes of one frame, signed with ``key`` if given."""
    link = dialect.MAVLink(None, srcSystem=sender[0], srcComponent=sender[1])
    link.seq = sequence % 256
    if key is not None:
        link.signing.secret_key = key
        link.signing.sign_outgoing = True
    return bytes(made.pack(link, force_mavlink1=v1))


def raw_frame(
    number: int,
    payload: bytes,
    *,
    seed: int,
    sender: Address = AUTOPILOT,
    sequence: int = 0,
    flags: int = 0,
    v1: bool = False,
) -> bytes:
    """Return one frame with any payload; ``seed`` is CRC_EXTRA."""
    if v1:
        head = bytes([len(payload), sequence, *sender, number])
    else:
        head = bytes([len(payload), flags, 0, sequence, *sender]) + number.to_bytes(3, "little")
    checksum = dialect.x25crc(head + payload + bytes([seed])).crc
    signature = bytes(13) if flags & 1 else b""
    start = b"\xfe" if v1 else b"\xfd"
    return start + head + payload + checksum.to_bytes(2, "little") + signature


def stamp(received_us: int, link: int | None = None) -> bytes:
    """Return the receive time of a tlog; MAVProxy writes the link number in the lowest bits."""
    us = received_us if link is None else received_us & ~3 | link
    return int(us).to_bytes(8, "big")


@dataclass
class Recorder:
    """Messages that a ground station receives, written in order of receipt.

    ``sent`` contains receive time (s, UNIX), sender, message and link.
    """

    sent: list[tuple[float, Address, Any, int | None]] = field(default_factory=list)
    v1: bool = False

    def hear(
        self, received_s: float, sender: Address, made: Any, link: int | None = None
    ) -> Recorder:
        self.sent.append((received_s, sender, made, link))
        return self

    def frames(self) -> list[tuple[int, int | None, bytes]]:
        """Return receive time (µs), link and frame, with sequence numbers per sender and link."""
        sequence: defaultdict[tuple[Address, int | None], int] = defaultdict(int)
        out = []
        for received, sender, made, link in sorted(self.sent, key=lambda item: item[0]):
            number = sequence[sender, link]
            sequence[sender, link] += 1
            out.append((round(received * 1e6), link, frame(made, sender, number, v1=self.v1)))
        return out

    def tlog(self) -> bytes:
        return b"".join(stamp(us, link) + content for us, link, content in self.frames())

    def raw(self) -> bytes:
        return b"".join(content for _, _, content in self.frames())


def boot(flight: Flight, samples: pd.DataFrame) -> np.ndarray:
    """Return the boot times (s) of samples."""
    return samples.index.to_numpy() + flight.log.boot_time_s


def track_of(flight: Flight, name: str) -> PositionTrack:
    return next(track for track in flight.positions if track.name == name)


def same(boot_s: float) -> float:
    """Return the boot time unchanged."""
    return boot_s


def unix(boot_s: float) -> float:
    """Convert boot time to UNIX time (s) without drift."""
    return UNIX_S + boot_s


@dataclass
class Aisle:
    """Flight along the aisle, recorded as MAVLink.

    Attributes
    ----------
    seconds : float
    start_s : float
        Boot time of the first message.
    system : int
    clock : callable
        Converts boot time to the companion's clock (s).
    receiver : callable
        Converts boot time to the clock of the receive times (s).
    delay : callable
        Draws a link delay (s) from a random generator; at least :data:`LEAST_DELAY_S`.
    asks, replies : bool
        True if the companion sends TIMESYNC requests, or replies to those of the autopilot.
    system_time : bool
        True if the autopilot sends SYSTEM_TIME with UNIX time.
    uwb : str or None
        Message with the position for the autopilot, at 5 Hz.
    estimator : int
        MAV_ESTIMATOR_TYPE if ``uwb`` is ODOMETRY.
    noise_m : float
    imu_hz : float
    state : str or None
        Message with EKF2's state, at 20 Hz.
    """

    seconds: float = 40.0
    start_s: float = BOOT_S
    system: int = 1
    clock: Callable[[float], float] = unix
    receiver: Callable[[float], float] = unix
    delay: Callable[[np.random.Generator], float] = lambda rng: (
        LEAST_DELAY_S + rng.exponential(0.002)
    )
    asks: bool = False
    replies: bool = True
    system_time: bool = False
    uwb: str | None = "VISION_POSITION_ESTIMATE"
    estimator: int = 2
    noise_m: float = 0.0
    imu_hz: float = 50.0
    state: str | None = "ODOMETRY"
    seed: int = 1

    def record(self, into: Recorder | None = None) -> Recorder:
        """Add the messages of the flight to a recorder."""
        rng = np.random.default_rng(self.seed)
        recorder = into or Recorder()
        autopilot, companion = (self.system, AUTOPILOT[1]), (self.system, COMPANION[1])

        def hear(boot_s: float, sender: Address, made: Any) -> None:
            recorder.hear(self.receiver(boot_s + self.delay(rng)), sender, made)

        for boot in self.times(1.0):
            hear(boot, autopilot, heartbeat())
            hear(boot, autopilot, message("EXTENDED_SYS_STATE", landed_state=self.landed(boot)))
            if self.system_time:
                hear(boot, autopilot, message(
                    "SYSTEM_TIME", time_boot_ms=ms(boot), time_unix_usec=us(unix(boot)),
                ))  # fmt: skip
            hear(boot, companion, heartbeat(kind=18, autopilot=8))
        for boot in self.times(self.imu_hz):
            force = self.path(boot)[2] - [0.0, 0.0, GRAVITY_M_S2]
            hear(boot, autopilot, message("HIGHRES_IMU", time_usec=us(boot), **xyz(force, "acc")))
        for boot in self.times(20.0):
            hear(boot, autopilot, message("ATTITUDE_QUATERNION", time_boot_ms=ms(boot), q1=1.0))
            if self.state is not None:
                hear(boot, autopilot, self.own_state(boot))
        for boot in self.times(10.0):
            if self.replies:
                # request at boot; reply after one link delay, received after another
                at = boot + self.delay(rng)
                hear(boot, autopilot, message("TIMESYNC", ts1=ns(boot)))
                hear(at, companion, message("TIMESYNC", tc1=ns(self.clock(at)), ts1=ns(boot)))
            if self.asks:
                asked = self.clock(boot)
                at = boot + self.delay(rng)
                hear(boot, companion, message("TIMESYNC", ts1=ns(asked)))
                hear(at, autopilot, message("TIMESYNC", tc1=ns(at), ts1=ns(asked)))
        if self.uwb is not None:
            for boot in self.times(5.0):
                hear(boot, companion, self.position(boot, rng))
        return recorder

    def times(self, rate_hz: float) -> list[float]:
        """Return the boot times (s) of messages at a fixed rate."""
        return (self.start_s + np.arange(round(self.seconds * rate_hz)) / rate_hz).tolist()

    def path(self, boot_s: float) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration (NED)."""
        return _path(boot_s - self.start_s)

    def landed(self, boot_s: float) -> int:
        """Return MAV_LANDED_STATE: on the ground in the first and the last quarter."""
        share = (boot_s - self.start_s) / self.seconds
        return 2 if 0.25 <= share < 0.75 else 1

    def own_state(self, boot_s: float) -> Any:
        p, v, _ = self.path(boot_s)
        if self.state == "ODOMETRY":
            return odometry(us(boot_s), p, v, estimator=8)
        assert self.state is not None
        return message(self.state, time_boot_ms=ms(boot_s), **xyz(p), **xyz(v, prefix="v"))

    def position(self, boot_s: float, rng: np.random.Generator) -> Any:
        here = self.path(boot_s)[0] + rng.normal(0.0, self.noise_m, 3)
        at = us(self.clock(boot_s))
        if self.uwb == "ODOMETRY":
            return odometry(at, here, np.zeros(3), estimator=self.estimator)
        name = "usec" if self.uwb == "VISION_POSITION_ESTIMATE" else "time_usec"
        assert self.uwb is not None
        return message(self.uwb, covariance=triangle(POSE_VARIANCE), **{name: at}, **xyz(here))


@lru_cache(maxsize=100_000)  # most flights use the same times
def _path(time_s: float) -> tuple[Array, Array, Array]:
    p, v, a = motion(np.array([time_s]), HEADING_DEG, LENGTH_M)
    for each in (p, v, a):
        each.flags.writeable = False
    return p[0], v[0], a[0]


def ms(seconds: float) -> int:
    return round(seconds * 1e3)


def us(seconds: float) -> int:
    return round(seconds * 1e6)


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def xyz(values: Any, suffix: str = "", *, prefix: str = "") -> dict[str, float]:
    return {f"{prefix}{axis}{suffix}": float(v) for axis, v in zip("xyz", values, strict=True)}


def triangle(diagonal: tuple[float, ...]) -> list[float]:
    """Return the upper triangle of a 6×6 covariance, with invalid off-diagonal values."""
    made = np.full(21, 99.0)
    made[[0, 6, 11]] = diagonal
    return made.tolist()


def heartbeat(kind: int = 2, autopilot: int = 12) -> Any:
    return message("HEARTBEAT", type=kind, autopilot=autopilot, mavlink_version=3)


def odometry(
    time_us: int,
    position: Any,
    velocity: Any,
    *,
    estimator: int,
    frame_id: int = 1,
    child: int = 1,
    attitude: Rotation | None = None,
    resets: int = 0,
) -> Any:
    quaternion = (attitude or Rotation.identity()).as_quat(scalar_first=True)
    return message(
        "ODOMETRY", time_usec=time_us, frame_id=frame_id, child_frame_id=child,
        q=quaternion.tolist(), pose_covariance=triangle(POSE_VARIANCE),
        velocity_covariance=triangle(VELOCITY_VARIANCE), estimator_type=estimator,
        reset_counter=resets, quality=100, **xyz(position), **xyz(velocity, prefix="v"),
    )  # fmt: skip


@dataclass
class Heard:
    """Message as read by pymavlink."""

    start: int
    received_us: int
    sender: Address
    sequence: int
    fields: dict[str, Any]


@contextlib.contextmanager
def pymavlink_as_v2() -> Iterator[Any]:
    """Provide pymavlink's file reader with the dialect "all"; restore its globals afterwards."""
    before = {name: os.environ.get(name) for name in ("MAVLINK20", "MAVLINK_DIALECT")}
    os.environ["MAVLINK20"] = "1"
    from pymavlink import mavutil

    dialect_before, module_before = mavutil.current_dialect, mavutil.mavlink
    try:
        yield mavutil
    finally:
        mavutil.current_dialect, mavutil.mavlink = dialect_before, module_before
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def heard_by_pymavlink(path: Path, *, stamped: bool) -> tuple[dict[str, list[Heard]], int]:
    """Return all messages of pymavlink's reader by name, and the number of unknown ids."""
    found: defaultdict[str, list[Heard]] = defaultdict(list)
    unknown = 0
    with pymavlink_as_v2() as mavutil:
        link = mavutil.mavlink_connection(str(path), dialect="all", notimestamps=not stamped)
        while (made := link.recv_match()) is not None:
            name = made.get_type()
            if name == "BAD_DATA":
                continue
            if name.startswith("UNKNOWN"):
                unknown += 1
                continue
            found[name].append(
                Heard(
                    link.f.tell() - link.mav.buf_len() - len(made.get_msgbuf()),
                    round(made._timestamp * 1e6) if stamped else 0,
                    (made.get_srcSystem(), made.get_srcComponent()),
                    made.get_seq(),
                    {key: getattr(made, key) for key in made.get_fieldnames()},
                )
            )
        link.close()
    return dict(found), unknown
