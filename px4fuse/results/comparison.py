"""Results of a comparison that are put together from several records: log, source, settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from px4fuse.flight import Alignment
from px4fuse.origin import Passage, PositionKind
from px4fuse.record import Count, Positive, Record, Unavailable
from px4fuse.recording import ClockMap, InputFile, LogInfo
from px4fuse.request import InputName


class Log(LogInfo, frozen=True, kw_only=True):
    """The recording, the files that were read beside it, and the clocks that were mapped."""

    joined: tuple[InputFile, ...]
    clocks: tuple[ClockMap, ...]


class AvailableTrack(Record, frozen=True):
    """A position track of the flight."""

    name: str
    kind: PositionKind
    passage: Passage
    samples: Count
    rate_hz: Positive | None = None


class PositionSource(Record, frozen=True, kw_only=True):
    """The position that both filters are judged by.

    ``kind`` and ``passage`` say where it comes from and how it got into the flight,
    ``ekf2_parameters`` what the log has of EKF2's parameters for it, by PX4 name and in PX4's
    units; ``log`` is the file that it was read from.
    """

    name: str
    kind: PositionKind
    passage: Passage
    ekf2_parameters: Mapping[str, float]
    description: str
    reason: str
    rate_hz: Positive
    frame: Literal["NED", "FRD", "unknown"]
    clock: str
    reconstructed: bool
    topics: tuple[str, ...]
    available: tuple[AvailableTrack, ...]
    not_in_log: tuple[Unavailable, ...]
    log: str
    alignment: Alignment | None = None


class ChosenSettings(Record, frozen=True, kw_only=True):
    """Settings of the filter; ``clock_offset_s`` was added to the source's time stamps."""

    sigma_a_m_s2: Positive
    sigma_z_m: Positive
    dt_s: Positive
    input: InputName
    start_s: float
    end_s: float
    segment_reason: str
    clock_offset_s: float


# Field of Tuned that says what each setting of the filter should be
ASKED = {"sigma_a_m_s2": "filter_sigma_a_m_s2", "sigma_z_m": "sigma_z_m"}
