"""Path and sensors of a simulated flight without injected faults."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

from px4fuse.core.text import UNIT_BY_SUFFIX
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS, Aid

ScenarioKind = Literal["aisle", "loop", "outdoor"]
YawMode = Literal["fixed", "follow"]
SCENARIO_KINDS: tuple[ScenarioKind, ...] = get_args(ScenarioKind)

# DT of KF (s): interval for which the acceleration noise SIGMA_A is defined
DT_S = 0.1
# Duration (s) of acceleration and braking on the straight path
SPEED_RAMP_DURATION_S = 1.5
CORNER_DURATION_S = 2.0
# Default values that depend on the kind of flight
DEFAULTS_BY_KIND: Mapping[ScenarioKind, Mapping[str, float]] = {
    "aisle": {},
    "loop": {"passes": 1},
    "outdoor": {"passes": 3, "length_m": 30.0, "speed_m_s": 4.0, "altitude_m": 8.0},
}


@dataclass(frozen=True)
class Bounds:
    """Limits, unit and option of a number on the command line.

    ``help_or_placeholder`` is the help text if the number is the value of an option. If the number
    is the size of a simulated fault, it is the placeholder in the syntax, such as SECONDS.
    :func:`collect_field_bounds` sets ``unit`` and ``option``.
    """

    low: float
    high: float
    help_or_placeholder: str = ""
    unit: str = ""
    option: str = ""

    def check(self, value: float, name: str) -> None:
        """Raise SettingsError if a value is out of range; ``name`` is its name in the message."""
        if not self.low <= value <= self.high:  # also True for NaN
            range_text = f"{self.low:g} to {self.high:g} {self.unit}".rstrip()
            raise SettingsError(f"{name} {value:g} is out of range: give {range_text}.")


def make_bounded_field(default: Any, *bounds: Any) -> Any:
    """Make a dataclass field with a default value and :class:`Bounds`."""
    return field(default=default, metadata={"bounds": Bounds(*bounds)})


def collect_field_bounds(dataclass_type: type) -> dict[str, Bounds]:
    """Return the bounds of dataclass fields that have :class:`Bounds`, by field name.

    Unit and option result from the field name, for example m/s and --speed from speed_m_s.
    """
    bounds_by_field = {}
    for dataclass_field in fields(dataclass_type):
        if bounds := dataclass_field.metadata.get("bounds"):
            name = dataclass_field.name
            suffix = next(filter(name.endswith, UNIT_BY_SUFFIX), "")
            option = f"--{name.removesuffix(suffix).replace('_', '-')}"
            unit = UNIT_BY_SUFFIX.get(suffix, "")
            bounds_by_field[name] = replace(bounds, unit=unit, option=option)
    return bounds_by_field


@dataclass(frozen=True)
class Scenario:
    """Path and sensors of a simulated flight, without injected faults.

    Noises are standard deviations of white noise on each axis.

    Attributes
    ----------
    kind : {"aisle", "loop", "outdoor"}
        UWB along a straight line, VIO around a square, or GNSS around a square.
    yaw : {"fixed", "follow"} or None
        Constant heading, or nose in the direction of flight.
    pause_s : float
        Time of hover at each end of the straight path.
    wander_m : float
        RMS of the slow deviation from the planned path, on each axis.
    vio_walk_m : float
        Random walk of the VIO drift (m/√m), on each axis.
    tilt_error_deg, yaw_error_deg : float
        RMS of the slow error of the logged attitude.

    Raises
    ------
    SettingsError
        A value is out of range, or the length is too short to reach the speed.
    """

    kind: ScenarioKind = "aisle"
    passes: int = make_bounded_field(6, 1, 100)
    length_m: float = make_bounded_field(
        12.0, 2.0, 1000.0, "Length of the straight path, or of each side of the square."
    )
    speed_m_s: float = make_bounded_field(1.0, 0.1, 10.0, "Speed on straight segments.")
    heading_deg: float = make_bounded_field(
        30.0,
        -360.0,
        360.0,
        "Heading of the straight path, or of the first side of the square, clockwise from north.",
    )
    altitude_m: float = 1.5
    yaw: YawMode | None = None
    pause_s: float = 3.0
    wander_m: float = 0.03
    uwb_rate_hz: float = make_bounded_field(5.0, 0.5, 100.0, "UWB rate.")
    sigma_uwb_m: float = make_bounded_field(
        0.10, 0.0, 10.0, "White UWB position noise (1 σ): the true measurement noise."
    )
    vio_rate_hz: float = 30.0
    sigma_vio_m: float = 0.01
    vio_drift: float = make_bounded_field(
        0.015, 0.0, 0.5, "VIO drift, as a fraction of the distance flown."
    )
    vio_walk_m: float = 0.01
    gnss_rate_hz: float = 5.0
    sigma_gnss_m: float = make_bounded_field(
        0.4, 0.0, 10.0, "White GNSS position noise, north and east (1 σ)."
    )
    sigma_gnss_m_s: float = 0.3
    sigma_a_m_s2: float = make_bounded_field(
        0.2, 0.0, 20.0, "True SIGMA_A: white accelerometer noise (1 σ), averaged over 0.1 s."
    )
    accel_bias_sigma_m_s2: float = make_bounded_field(
        0.03, 0.0, 2.0, "Standard deviation of the random constant accelerometer bias."
    )
    gyro_bias_sigma_rad_s: float = 0.002
    gyro_noise_rad_s: float = 0.01
    tilt_error_deg: float = 0.1
    yaw_error_deg: float = 1.0
    imu_rate_hz: float = 250.0
    attitude_rate_hz: float = 50.0
    truth_rate_hz: float = 50.0
    truth: bool = True
    ekf2: bool = True
    seed: int = make_bounded_field(1, 0, 2**128 - 1)

    def __post_init__(self) -> None:
        for name, bounds in collect_field_bounds(Scenario).items():
            bounds.check(getattr(self, name), bounds.option)
        min_length_m = self.speed_m_s * (
            SPEED_RAMP_DURATION_S if self.kind == "aisle" else CORNER_DURATION_S
        )
        if self.length_m < min_length_m:
            raise SettingsError(
                f"--length {self.length_m:g} m is too short for --speed {self.speed_m_s:g} "
                f"m/s: acceleration, braking and corners need {min_length_m:g} m. Increase "
                "--length or reduce --speed."
            )

    @property
    def nose_follows_path(self) -> bool:
        return self.yaw == "follow" or (self.yaw is None and self.kind != "aisle")

    @property
    def source_rate_hz(self) -> float:
        return (self.uwb_rate_hz, self.vio_rate_hz, self.gnss_rate_hz)[
            SCENARIO_KINDS.index(self.kind)
        ]

    @property
    def source_sigma_m(self) -> float:
        return (self.sigma_uwb_m, self.sigma_vio_m, self.sigma_gnss_m)[
            SCENARIO_KINDS.index(self.kind)
        ]

    @property
    def aid(self) -> Aid:
        """EKF2's aiding source for the simulated positions: GNSS outdoors, else external vision."""
        return GNSS_POS if self.kind == "outdoor" else EV_POS

    @property
    def accelerometer_noise_m_s2(self) -> float:
        """White noise (m/s², 1 σ) of one accelerometer sample.

        The mean of the samples in 0.1 s (DT) then has the noise SIGMA_A.
        """
        return self.sigma_a_m_s2 * math.sqrt(DT_S * self.imu_rate_hz)


def make_scenario(kind: ScenarioKind, **field_values: Any) -> Scenario:
    """Make a scenario with the defaults of its kind, except for ``field_values``."""
    return Scenario(kind=kind, **{**DEFAULTS_BY_KIND[kind], **field_values})
