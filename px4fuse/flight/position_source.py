"""Origin of a position track: kind of position source, and its path from the sender to the log."""

from typing import Literal

from msgspec.structs import replace

from px4fuse.core.record import Record
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS, Aid

PositionKind = Literal["uwb", "vio", "mocap", "gnss", "unknown", "file"]
DataPath = Literal[
    "given file", "as received", "aligned by EKF2", "kept by EKF2", "rebuilt from innovations"
]


class Origin(Record):
    """Kind of a position source, and the path of its positions from the sender to the log."""

    # "vio" is any source with a changing orientation, "uwb" a noisy one without orientation, and
    # "unknown" another one without orientation (kind_without_orientation)
    kind: PositionKind
    path: DataPath
    # Aiding source of EKF2 for these positions; None if EKF2 never fuses them
    aid: Aid | None
    # True if px4fuse may select the source without --position-source
    is_automatic: bool = True

    @property
    def may_drift(self) -> bool:
        """True if the position error may grow with the distance travelled, as for odometry.

        A log does not distinguish odometry from motion capture sent in the same messages, so both
        may drift.
        """
        return self.kind == "vio"

    @property
    def reconstructed(self) -> bool:
        """True if the positions are derived from EKF2's logged data, not logged as received."""
        return self.path in ("kept by EKF2", "rebuilt from innovations")

    @property
    def has_all_samples(self) -> bool:
        """True if the position track contains all samples of the sender."""
        return self.path in ("given file", "as received")

    @property
    def is_vision(self) -> bool:
        return self.aid == EV_POS

    @property
    def fused_as_gnss(self) -> bool:
        return self.aid == GNSS_POS

    @property
    def is_gnss(self) -> bool:
        """True for GNSS.

        Multipath and atmospheric errors are correlated over minutes, so R must be larger than the
        variance of the differences of consecutive positions.
        """
        return self.kind == "gnss"

    @property
    def preference_rank(self) -> int:
        """Index of this origin in :data:`ORIGINS`; a smaller index is preferred."""
        return [(origin.aid, origin.path) for origin in ORIGINS].index((self.aid, self.path))


POSITION_FILE = Origin("file", "given file", EV_POS)
RECEIVED = Origin("uwb", "as received", EV_POS)
MOTION_CAPTURE = Origin("mocap", "as received", None)
ALIGNED = Origin("uwb", "aligned by EKF2", EV_POS)
LOGGED_BY_EKF2 = Origin("uwb", "kept by EKF2", EV_POS)
FROM_INNOVATIONS = Origin("uwb", "rebuilt from innovations", EV_POS)
GNSS = Origin("gnss", "as received", GNSS_POS, is_automatic=False)
# All origins in order of preference
ORIGINS = (POSITION_FILE, RECEIVED, MOTION_CAPTURE, ALIGNED, LOGGED_BY_EKF2, FROM_INNOVATIONS, GNSS)


def find_origin(kind: str, path: str) -> Origin:
    for origin in ORIGINS:
        if (origin.kind, origin.path) == (kind, path):
            return origin
    raise ValueError(f"ORIGINS in {__file__} has no kind and path {(kind, path)}")


def with_orientation(origin: Origin, *, is_changing: bool) -> Origin:
    """Change the kind "uwb" to "vio" if the source sends a changing orientation."""
    return replace(origin, kind="vio") if origin.kind == "uwb" and is_changing else origin
