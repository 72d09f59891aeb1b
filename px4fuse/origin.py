"""Where a position comes from and how it got here, with all that follows from it."""

from typing import Literal

from msgspec.structs import replace

from px4fuse.ekf2_parameters import EV_POS, GNSS_POS, Aid
from px4fuse.record import Record

PositionKind = Literal["uwb", "vio", "mocap", "gnss", "file"]
Passage = Literal[
    "given file", "as it arrived", "aligned by EKF2", "kept by EKF2", "rebuilt from innovations"
]


class Origin(Record, frozen=True):
    """What a position source is; the tracks of a flight have one each.

    Attributes
    ----------
    kind : str
        "uwb" stands for any positioning system that sends no orientation, "vio" for any odometry.
    passage : str
        How it got from the sender into the flight.
    aid : Aid or None
        What EKF2 takes it as, with EKF2's parameters for it; None where EKF2 never fuses it.
    is_automatic : bool
        Whether it may be chosen without being asked for: GNSS only where EKF2 fused it.
    """

    kind: PositionKind
    passage: Passage
    aid: Aid | None
    is_automatic: bool = True

    @property
    def may_drift(self) -> bool:
        """Whether its error may grow with the way, as that of an odometry does.

        A log does not tell odometry from motion capture that is sent in the same messages, hence
        "may". What drifts in no case: a positioning system without orientation (UWB), motion
        capture sent as such, GNSS, and a positioning system's own file.
        """
        return self.kind == "vio"

    @property
    def reconstructed(self) -> bool:
        """Whether it was derived from what EKF2 logs instead of being logged as it arrived."""
        return self.passage in ("kept by EKF2", "rebuilt from innovations")

    @property
    def has_all_samples(self) -> bool:
        """Whether it holds the samples of the sender, all of them."""
        return self.passage in ("given file", "as it arrived")

    @property
    def is_vision(self) -> bool:
        """Whether EKF2 takes it as external vision."""
        return self.aid == EV_POS

    @property
    def fused_as_gnss(self) -> bool:
        """Whether EKF2 takes it as GNSS."""
        return self.aid == GNSS_POS

    @property
    def is_gnss(self) -> bool:
        """Whether it is satellite navigation, whose errors are slow for the most part.

        Multipath and the atmosphere change over seconds to minutes: what R has to cover is larger
        than what differs from one position to the next.
        """
        return self.kind == "gnss"

    @property
    def preference(self) -> int:
        """Its place in :data:`ORIGINS`; the least is the best."""
        places = [(known.aid, known.passage) for known in ORIGINS]
        return places.index((self.aid, self.passage))


POSITION_FILE = Origin("file", "given file", EV_POS)
RECEIVED = Origin("uwb", "as it arrived", EV_POS)
MOTION_CAPTURE = Origin("mocap", "as it arrived", None)
ALIGNED = Origin("uwb", "aligned by EKF2", EV_POS)
LOGGED_BY_EKF2 = Origin("uwb", "kept by EKF2", EV_POS)
FROM_INNOVATIONS = Origin("uwb", "rebuilt from innovations", EV_POS)
GNSS = Origin("gnss", "as it arrived", GNSS_POS, is_automatic=False)
# In order of preference. A file given by hand is taken to be of the system that was sent to EKF2
ORIGINS = (POSITION_FILE, RECEIVED, MOTION_CAPTURE, ALIGNED, LOGGED_BY_EKF2, FROM_INNOVATIONS, GNSS)


def find_origin(kind: str, passage: str) -> Origin:
    """The origin of this kind that got here in this way."""
    return next(
        known_origin
        for known_origin in ORIGINS
        if (known_origin.kind, known_origin.passage) == (kind, passage)
    )


def with_orientation(origin: Origin, *, turns: bool) -> Origin:
    """The same, as an odometry where the external vision has an orientation that turns."""
    return replace(origin, kind="vio") if origin.kind == "uwb" and turns else origin
