"""Settings of KF (noises, prediction interval, input, time offset) with valid ranges."""

from dataclasses import dataclass
from typing import get_args

from px4fuse.errors import SettingsError
from px4fuse.request import DT_S, SIGMA_A_M_S2, SIGMA_Z_M, InputName

INPUT_NAMES: tuple[InputName, ...] = get_args(InputName)

# Valid ranges of KF's settings; values outside are typing errors
SIGMA_A_RANGE_M_S2 = (1e-4, 100.0)
SIGMA_Z_RANGE_M = (1e-4, 100.0)
DT_RANGE_S = (1e-3, 1.0)
CLOCK_OFFSET_RANGE_S = (-10.0, 10.0)
_RANGES = (SIGMA_A_RANGE_M_S2, SIGMA_Z_RANGE_M, DT_RANGE_S, CLOCK_OFFSET_RANGE_S)
# Unit of each numeric setting
SETTING_UNITS = {"sigma_a_m_s2": "m/s²", "sigma_z_m": "m", "dt_s": "s", "clock_offset_s": "s"}


@dataclass(frozen=True)
class Settings:
    """Settings of KF: noises, prediction interval, input and time offset.

    Attributes
    ----------
    sigma_a_m_s2 : float
        Process noise SIGMA_A: standard deviation of the acceleration input over one DT.
    sigma_z_m : float
        Measurement noise SIGMA_Z.
    dt_s : float
        Prediction interval DT.
    input : {"imu", "zero"}
        "zero" is the constant-velocity model.
    clock_offset_s : float
        Time offset added to the timestamps of the position source.

    Raises
    ------
    SettingsError
        A value is out of range or not a number.
    """

    sigma_a_m_s2: float = SIGMA_A_M_S2
    sigma_z_m: float = SIGMA_Z_M
    dt_s: float = DT_S
    input: InputName = "imu"
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for (name, unit), (low, high) in zip(SETTING_UNITS.items(), _RANGES, strict=True):
            value = getattr(self, name)
            if not low <= value <= high:  # also True for NaN
                raise SettingsError(
                    f"`{name}` {value:g} is out of range: give {low:g} to {high:g} {unit}."
                )
        if self.input not in INPUT_NAMES:
            raise SettingsError(
                f"`input` {self.input} is not an input of KF: give {' or '.join(INPUT_NAMES)}."
            )


@dataclass(frozen=True)
class InitialState:
    """Initial state of KF: time (s), position (m) and velocity (m/s)."""

    time_s: float
    position_m: float
    velocity_m_s: float = 0.0
