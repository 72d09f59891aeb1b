"""Origin of a position track: kind of source, path to the log, and their properties."""

from typing import Literal

from msgspec.structs import replace

from px4fuse.ekf2_parameters import EV_POS, GNSS_POS, Aid
from px4fuse.record import Record

PositionKind = Literal["uwb", "vio", "mocap", "gnss", "file"]
DataPath = Literal[
    "given file", "as received", "aligned by EKF2", "kept by EKF2", "rebuilt from innovations"
]


class Origin(Record, frozen=True):
    """Kind of a position source and its path to the log.

    Attributes
    ----------
    kind : str
        "uwb" is any positioning system without orientation, "vio" is any odometry.
    path : str
        Path from the sender to the log.
    aid : Aid or None
        EKF2 aid of this source, with its EKF2 parameters; None if EKF2 never fuses it.
    is_automatic : bool
        True if the source may be selected by default; for GNSS only if EKF2 fused it.
    """

    kind: PositionKind
    path: DataPath
    aid: Aid | None
    is_automatic: bool = True

    @property
    def may_drift(self) -> bool:
        """True if the error may grow with the distance travelled, as for odometry.

        A log does not distinguish odometry from motion capture sent in the same messages. UWB,
        motion capture in its own messages, GNSS and position files do not drift.
        """
        return self.kind == "vio"

    @property
    def reconstructed(self) -> bool:
        """True if the positions are derived from EKF2's logged data, not logged as received."""
        return self.path in ("kept by EKF2", "rebuilt from innovations")

    @property
    def has_all_samples(self) -> bool:
        """True if the track contains all samples of the sender."""
        return self.path in ("given file", "as received")

    @property
    def is_vision(self) -> bool:
        """True if EKF2 fuses the source as external vision."""
        return self.aid == EV_POS

    @property
    def fused_as_gnss(self) -> bool:
        """True if EKF2 fuses the source as GNSS."""
        return self.aid == GNSS_POS

    @property
    def is_gnss(self) -> bool:
        """True for satellite navigation, whose errors are mostly time-correlated.

        Multipath and atmospheric errors change over seconds to minutes, so R must be larger than
        the differences of consecutive positions suggest.
        """
        return self.kind == "gnss"

    @property
    def preference(self) -> int:
        """Index in :data:`ORIGINS`; the source with the smallest index is preferred."""
        origins = [(known.aid, known.path) for known in ORIGINS]
        return origins.index((self.aid, self.path))


POSITION_FILE = Origin("file", "given file", EV_POS)
RECEIVED = Origin("uwb", "as received", EV_POS)
MOTION_CAPTURE = Origin("mocap", "as received", None)
ALIGNED = Origin("uwb", "aligned by EKF2", EV_POS)
LOGGED_BY_EKF2 = Origin("uwb", "kept by EKF2", EV_POS)
FROM_INNOVATIONS = Origin("uwb", "rebuilt from innovations", EV_POS)
GNSS = Origin("gnss", "as received", GNSS_POS, is_automatic=False)
# In order of preference. A position file is assumed to be from the system that EKF2 fused
ORIGINS = (POSITION_FILE, RECEIVED, MOTION_CAPTURE, ALIGNED, LOGGED_BY_EKF2, FROM_INNOVATIONS, GNSS)


def find_origin(kind: str, path: str) -> Origin:
    """Return the known origin of this kind and path to the log."""
    return next(
        known_origin
        for known_origin in ORIGINS
        if (known_origin.kind, known_origin.path) == (kind, path)
    )


def with_orientation(origin: Origin, *, turns: bool) -> Origin:
    """Change the kind "uwb" to "vio" if the track has a changing orientation (``turns``)."""
    return replace(origin, kind="vio") if origin.kind == "uwb" and turns else origin
