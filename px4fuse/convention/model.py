"""Records of the axes, unit, clock and orientation of a position source (UWB, vision, ...)."""

from typing import Literal

from px4fuse.core.record import NonNegativeFloat, PositiveFloat, Record

ConventionVerdict = Literal["determined", "ambiguous", "doubtful", "not determinable"]
Direction = Literal["north", "east", "south", "west", "up", "down"]
AxisDirections = tuple[Direction, Direction, Direction]
Unit = Literal["m", "cm", "mm", "feet"]
HeadingSource = Literal["EKF2", "gyroscopes", "GNSS"]
QuaternionOrder = Literal["w x y z", "x y z w"]
BodyAndWorldFrame = Literal["FRD to NED", "FLU to ENU", "FLU to NWU", "FLU to NED", "FRD to ENU"]


class OrientationConvention(Record, kw_only=True, omit_defaults=False):
    """Quaternion order, body frame and world frame of a source's orientation.

    Attributes
    ----------
    verdict : str
        "ambiguous": several conventions fit; "copied": equal to EKF2's attitude; "unrelated": no
        convention fits the attitude.
    order : {"w x y z", "x y z w"}
        Order of the quaternion's components as sent.
    frames : str
        Body frame and world frame of the orientation.
    heading_error_deg : float or None
        Heading error relative to the frame of the positions, clockwise from above.
    tilt_difference_deg : float
        Median tilt difference from the gyroscopes' attitude.
    """

    verdict: Literal["determined", "ambiguous", "copied", "unrelated"]
    order: QuaternionOrder = "w x y z"
    frames: BodyAndWorldFrame = "FRD to NED"
    heading_error_deg: float | None = None
    tilt_difference_deg: NonNegativeFloat = 0.0


class Convention(Record, kw_only=True, omit_defaults=False):
    """Axes, unit and clock of the positions that a source sends.

    Attributes
    ----------
    verdict : str
        "ambiguous": several conventions fit; "doubtful": the residuals are large; "not
        determinable": too little data or motion.
    rotation_deg : float
        Clockwise rotation (°) of the positions, in addition to the directions of x, y and z, which
        are multiples of 90°.
    heading_from : {"EKF2", "gyroscopes", "GNSS"}
        Source of the heading relative to which the rotation is measured.
    late_s : float
        Delay of the timestamps; negative if they are early.
    clock_drift : float
        Rate of the sender's clock minus 1.
    scale : float
        Scale factor of the positions: displacement according to the source ÷ displacement
        according to the IMU.
    log_odds : float or None
        Log odds (nats) of the best convention to the second best.
    log_likelihood_gain : float
        Log likelihood ratio (nats, with prior odds) of this convention to a model in which the
        positions are unrelated to the motion that the IMU measures.
    alternatives : tuple of str
        Other axes, units and delays that fit nearly as well.
    """

    verdict: ConventionVerdict
    x: Direction = "north"
    y: Direction = "east"
    z: Direction = "down"
    unit: Unit = "m"
    is_mirrored: bool = False
    rotation_deg: float = 0.0
    heading_from: HeadingSource = "EKF2"
    late_s: float = 0.0
    clock_drift: float = 0.0
    scale: PositiveFloat = 1.0
    log_odds: float | None = None
    log_likelihood_gain: float = 0.0
    alternatives: tuple[str, ...] = ()
    orientation: OrientationConvention | None = None

    @property
    def axes(self) -> AxisDirections:
        return self.x, self.y, self.z
