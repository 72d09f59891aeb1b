"""Records of the axes, unit, clock and orientation that a position source uses."""

from typing import Literal

from px4fuse.core.record import NotNegative, Positive, Record

Verdict = Literal["determined", "ambiguous", "doubtful", "not determinable"]
Direction = Literal["north", "east", "south", "west", "up", "down"]
Axes = tuple[Direction, Direction, Direction]
Unit = Literal["m", "cm", "mm", "feet"]
HeadingSource = Literal["EKF2", "gyroscopes"]
Order = Literal["w x y z", "x y z w"]
Frames = Literal["FRD to NED", "FLU to ENU", "FLU to NWU", "FLU to NED", "FRD to ENU"]


class OrientationConvention(Record, frozen=True, kw_only=True, omit_defaults=False):
    """Order and frames of the orientation of a position source.

    Attributes
    ----------
    verdict : str
        "determined" or "ambiguous"; "copied": equal to the autopilot's attitude; "unrelated": no
        convention relates the orientation to the attitude.
    order : {"w x y z", "x y z w"}
        Order of the components as sent.
    frames : str
        Body frame and world frame of the orientation.
    heading_error_deg : float or None
        Heading of the orientation relative to the positions, clockwise from above; None if it
        cannot be determined.
    tilt_difference_deg : float
        Median tilt difference from the gyroscopes' attitude, after conversion to FRD and NED.
    """

    verdict: Literal["determined", "ambiguous", "copied", "unrelated"]
    order: Order = "w x y z"
    frames: Frames = "FRD to NED"
    heading_error_deg: float | None = None
    tilt_difference_deg: NotNegative = 0.0


class Convention(Record, frozen=True, kw_only=True):
    """Axes, unit and clock of the positions of a source, as sent.

    Attributes
    ----------
    verdict : str
        "determined", "ambiguous", "not determinable", or "doubtful": the residuals of the best
        hypothesis exceed the noise of source and IMU.
    x, y, z : str
        Directions of the axes as sent, to the nearest quarter turn about the vertical.
    unit : {"m", "cm", "mm", "feet"}
    is_mirrored : bool
        True for a left-handed frame.
    rotation_deg : float
        Further rotation of the positions from these axes, clockwise from above; 0 if not
        significant.
    heading_from : {"EKF2", "gyroscopes"}
        Heading that fits the positions: logged by EKF2, or integrated from the gyroscopes.
    late_s : float
        Delay of the timestamps; negative if they are early.
    clock_drift : float
        Rate of the sender's clock minus 1.
    scale : float
        Distances of the source relative to those of the IMU, with the unit applied.
    log_odds : float or None
        Log likelihood ratio (with priors) to the second best convention; None without it.
    log_likelihood_gain : float
        Log likelihood ratio to positions without relation to the motion.
    alternatives : tuple of str
        Other conventions that fit nearly as well, as texts.
    orientation : OrientationConvention or None
    """

    verdict: Verdict
    x: Direction = "north"
    y: Direction = "east"
    z: Direction = "down"
    unit: Unit = "m"
    is_mirrored: bool = False
    rotation_deg: float = 0.0
    heading_from: HeadingSource = "EKF2"
    late_s: float = 0.0
    clock_drift: float = 0.0
    scale: Positive = 1.0
    log_odds: float | None = None
    log_likelihood_gain: float = 0.0
    alternatives: tuple[str, ...] = ()
    orientation: OrientationConvention | None = None

    @property
    def axes(self) -> Axes:
        return self.x, self.y, self.z
