"""Settings of KF (noises, prediction interval, input, time offset) with valid ranges."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, get_args

from px4fuse.errors import SettingsError
from px4fuse.request import (
    AUTO,
    DT_S,
    SIGMA_A_M_S2,
    SIGMA_Z_M,
    ComparisonRequest,
    KfInputName,
)

if TYPE_CHECKING:  # numpy is slow to import
    from px4fuse.core.arrays import Array

INPUT_NAMES: tuple[KfInputName, ...] = get_args(KfInputName)


class Range(NamedTuple):
    """Valid range of a numeric setting, with its unit (empty: none) and name."""

    low: float
    high: float
    unit: str
    label: str

    def format_limits(self) -> str:
        """Format the valid range: "0.0001 to 100 m"."""
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def format_value(self, value: float) -> str:
        """Format a value with its name: "SIGMA_Z 0.1 m"."""
        return f"{self.label} {value:g} {self.unit}".rstrip()

    def format_label(self) -> str:
        """Format the name with the unit: "SIGMA_Z (m)"."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


SETTING_RANGES = {
    "sigma_a_m_s2": Range(1e-4, 100.0, "m/s²", "SIGMA_A"),
    "sigma_z_m": Range(1e-4, 100.0, "m", "SIGMA_Z"),
    "dt_s": Range(1e-3, 1.0, "s", "DT"),
    "clock_offset_s": Range(-10.0, 10.0, "s", "time offset added to the source timestamps"),
}
# Numeric settings of KF; the time offset belongs to the position source
KF_NUMERIC_SETTINGS = tuple(name for name in SETTING_RANGES if name != "clock_offset_s")


@dataclass(frozen=True)
class Settings:
    """Settings of KF: noises, prediction interval, input and time offset.

    Attributes
    ----------
    sigma_a_m_s2 : float
        Process noise SIGMA_A: standard deviation of the acceleration over one DT.
    sigma_z_m : float
        Measurement noise SIGMA_Z.
    dt_s : float
        Prediction interval DT.
    input : {"imu", "zero"}
        IMU acceleration, or zero acceleration (constant-velocity model).
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
    input: KfInputName = "imu"
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        """Reject a value that is out of range or not a number, and an unknown input of KF."""
        for name, valid_range in SETTING_RANGES.items():
            value = getattr(self, name)
            if not valid_range.low <= value <= valid_range.high:  # NaN is out of range, too
                raise SettingsError(
                    f"`{name}` {value:g} is out of range: give {valid_range.format_limits()}."
                )
        if self.input not in INPUT_NAMES:
            raise SettingsError(
                f"`input` {self.input} is not an input of KF: give {' or '.join(INPUT_NAMES)}."
            )

    def compute_noise_density(self, additional_variance_m2_s4: "Array") -> "Array":
        """Return the acceleration noise density (m²/s³): (SIGMA_A² + additional variance) · DT.

        The additional acceleration variance of each step is 0 outside IMU gaps.
        """
        return (self.sigma_a_m_s2**2 + additional_variance_m2_s4) * self.dt_s


def requested_settings(request: ComparisonRequest) -> Settings:
    """Return the KF settings that the user requested; all others have default values."""
    values = {name: getattr(request, name) for name in Settings.__dataclass_fields__}
    # With auto, the time offset is estimated later. For a position file, read_flight adds the given
    # time offset to the timestamps, so KF must not add it again
    if request.clock_offset_s == AUTO or request.position is not None:
        del values["clock_offset_s"]
    return Settings(**{name: value for name, value in values.items() if value is not None})
