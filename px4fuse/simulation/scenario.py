"""What is flown, and with which sensors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from px4fuse.ekf2_parameters import EV_POS, GNSS_POS, Aid
from px4fuse.errors import SettingsError

Kind = Literal["aisle", "loop", "outdoor"]
Yaw = Literal["fixed", "follow"]
KINDS: tuple[Kind, ...] = ("aisle", "loop", "outdoor")
YAWS: tuple[Yaw, Yaw] = ("fixed", "follow")

# DT to which SIGMA_A refers, the lesson's (px4fuse.filter.kalman)
DT_S = 0.1
# How long it takes to start or stop along the aisle, and to turn a corner of the loop
START_STOP_S = 1.5
CORNER_S = 2.0
# What a kind of flight has where nothing is chosen, beside the defaults of all
DEFAULTS_OF_KIND: Mapping[Kind, Mapping[str, float]] = {
    "aisle": {},
    "loop": {"passes": 1},
    "outdoor": {"passes": 3, "length_m": 30.0, "speed_m_s": 4.0, "altitude_m": 8.0},
}


@dataclass(frozen=True)
class Bounds:
    """What a number of a simulation may be; beyond it, it is a slip of the keyboard.

    Attributes
    ----------
    low, high : float
    unit : str
        As :data:`px4fuse.units.NAMES` has it.
    typed : str
        The option that sets it, or what stands for it in the usage of a mistake.
    meaning : str
        The option's help; empty where no option sets it.
    """

    low: float
    high: float
    unit: str = ""
    typed: str = ""
    meaning: str = ""

    def check(self, value: float, name: str) -> None:
        """Refuse a value of this name that is out of range.

        Raises
        ------
        SettingsError
        """
        if not self.low <= value <= self.high:  # false for NaN too
            allowed = f"give {self.low:g} to {self.high:g} {self.unit}".rstrip()
            raise SettingsError(f"{name} {value:g} is out of range: {allowed}.")


def number(usual: Any, *about: Any) -> Any:
    """A field of a record that is a number, its default, and what it may be."""
    return field(default=usual, metadata={"quantity": Bounds(*about)})


def quantities(record: type) -> dict[str, Bounds]:
    """The fields of a record that :func:`number` made."""
    return {one.name: one.metadata["quantity"] for one in fields(record) if one.metadata}


@dataclass(frozen=True)
class Scenario:
    """A flight without mistakes.

    Attributes
    ----------
    kind : {"aisle", "loop", "outdoor"}
        Passes back and forth along a straight line with UWB, or laps around a square with VIO or,
        outdoors, with GNSS.
    passes : int
        Passes of the aisle, or laps of the square.
    length_m : float
        Of the aisle, or of a side of the square.
    speed_m_s : float
    heading_deg : float
        Of the aisle or of the square's first side, clockwise from north.
    altitude_m : float
    yaw : {"fixed", "follow"} or None
        Whether the nose keeps its heading or turns into the direction of flight; None is fixed
        in the aisle and following around the square.
    pause_s : float
        Hover at either end of the aisle.
    wander_m : float
        Root mean square of the slow wander about the path, on each axis.
    uwb_rate_hz, sigma_uwb_m : float
        Of the UWB, whose noise is white and equal on all axes.
    vio_rate_hz, sigma_vio_m : float
        Likewise of the VIO.
    vio_drift : float
        Drift of the VIO in one horizontal direction, as a share of the distance flown.
    vio_walk_m : float
        And its random part, m per square root of the distance in m, on each axis.
    gnss_rate_hz, sigma_gnss_m, sigma_gnss_m_s : float
        Likewise of GNSS, horizontally, with the noise of its velocity; down it is half as much
        again.
    sigma_a_m_s2 : float
        White noise of the accelerometer, as the standard deviation of its mean over 0.1 s: the
        SIGMA_A of the filter. A single sample has √(0.1 s · ``imu_rate_hz``) times that.
    accel_bias_sigma_m_s2, gyro_bias_sigma_rad_s : float
        The constant biases are drawn from normal distributions of these widths, per body axis.
    gyro_noise_rad_s : float
        Of a single sample.
    tilt_error_deg, yaw_error_deg : float
        Root mean square of the slow error (periods of 20 to 60 s) of the logged attitude, whose
        heading EKF2 is given too, where it fuses no magnetometer.
    imu_rate_hz, attitude_rate_hz, truth_rate_hz : float
    truth : bool
        Whether the log holds the ground truth.
    ekf2 : bool
        Whether px4fuse's model of EKF2 flies along.
    seed : int
        Decides everything random; each sensor draws from a stream of its own, so that a mistake
        in one leaves the noise of the others as it was.

    Raises
    ------
    SettingsError
        A value is outside its range, or the speed is not reached within the length.
    """

    kind: Kind = "aisle"
    passes: int = number(6, 1, 100, "", "--passes")
    length_m: float = number(
        12.0, 2.0, 1000.0, "m", "--length", "Of the aisle, or of a side of the square."
    )
    speed_m_s: float = number(1.0, 0.1, 10.0, "m/s", "--speed", "On the straight.")
    heading_deg: float = number(
        30.0, -360.0, 360.0, "°", "--heading", "Of the aisle or of the first side, from north."
    )
    altitude_m: float = number(1.5, 0.5, 50.0, "m")
    yaw: Yaw | None = None
    pause_s: float = number(3.0, 0.0, 600.0, "s")
    wander_m: float = number(0.03, 0.0, 1.0, "m")
    uwb_rate_hz: float = number(5.0, 0.5, 100.0, "Hz", "--uwb-rate", "Rate of the UWB.")
    sigma_uwb_m: float = number(
        0.10, 0.0, 10.0, "m", "--sigma-uwb", "White noise of the UWB: the true SIGMA_Z."
    )
    vio_rate_hz: float = number(30.0, 1.0, 200.0, "Hz")
    sigma_vio_m: float = number(0.01, 0.0, 10.0, "m")
    vio_drift: float = number(
        0.015, 0.0, 0.5, "", "--vio-drift", "Drift of the VIO, as a share of the distance."
    )
    vio_walk_m: float = number(0.01, 0.0, 1.0)
    gnss_rate_hz: float = number(5.0, 1.0, 10.0, "Hz")
    sigma_gnss_m: float = number(
        0.4, 0.0, 10.0, "m", "--sigma-gnss", "White noise of GNSS, north and east."
    )
    sigma_gnss_m_s: float = number(0.3, 0.0, 5.0, "m/s")
    sigma_a_m_s2: float = number(
        0.2, 0.0, 20.0, "m/s²", "--sigma-a", "White noise of the IMU over 0.1 s: the true SIGMA_A."
    )
    accel_bias_sigma_m_s2: float = number(
        0.03, 0.0, 2.0, "m/s²", "--accel-bias-sigma", "Spread of the accelerometer's constant bias."
    )
    gyro_bias_sigma_rad_s: float = number(0.002, 0.0, 0.5)
    gyro_noise_rad_s: float = number(0.01, 0.0, 1.0)
    tilt_error_deg: float = number(0.1, 0.0, 10.0, "°")
    yaw_error_deg: float = number(1.0, 0.0, 45.0, "°")
    imu_rate_hz: float = number(250.0, 50.0, 1000.0, "Hz")
    attitude_rate_hz: float = number(50.0, 5.0, 250.0, "Hz")
    truth_rate_hz: float = number(50.0, 1.0, 250.0, "Hz")
    truth: bool = True
    ekf2: bool = True
    seed: int = number(1, 0, 2**32 - 1, "", "--seed")

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise SettingsError(f"--kind {self.kind}: give {' or '.join(KINDS)}.")
        if self.yaw is not None and self.yaw not in YAWS:
            raise SettingsError(f"--yaw {self.yaw}: give {' or '.join(YAWS)}.")
        for name, bounds in quantities(Scenario).items():
            bounds.check(getattr(self, name), bounds.typed or name)
        needed = self.speed_m_s * (START_STOP_S if self.kind == "aisle" else CORNER_S)
        if self.length_m < needed:
            raise SettingsError.of(
                "side_short", length_m=self.length_m, speed_m_s=self.speed_m_s, needed=needed
            )

    @property
    def follows(self) -> bool:
        """Whether the nose turns into the direction of flight."""
        return self.yaw == "follow" or (self.yaw is None and self.kind != "aisle")

    @property
    def source_rate_hz(self) -> float:
        """Rate of the position source."""
        rates = {"aisle": self.uwb_rate_hz, "loop": self.vio_rate_hz, "outdoor": self.gnss_rate_hz}
        return rates[self.kind]

    @property
    def source_sigma_m(self) -> float:
        """White noise of the position source."""
        sigmas = {"aisle": self.sigma_uwb_m, "loop": self.sigma_vio_m, "outdoor": self.sigma_gnss_m}
        return sigmas[self.kind]

    @property
    def aid(self) -> Aid:
        """What EKF2 takes the positions as."""
        return GNSS_POS if self.kind == "outdoor" else EV_POS

    @property
    def accelerometer_noise_m_s2(self) -> float:
        """White noise of a single sample."""
        return self.sigma_a_m_s2 * math.sqrt(DT_S * self.imu_rate_hz)


def make_scenario(kind: Kind, **chosen: Any) -> Scenario:
    """A flight of a kind as it is usual for it, but for what is chosen."""
    return Scenario(kind=kind, **{**DEFAULTS_OF_KIND[kind], **chosen})
