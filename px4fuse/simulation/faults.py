"""Injected faults of a simulated flight, described in ``faults.toml``.

Examples of sizes on the command line: ``0.08``, ``80ms``, ``5%``, ``8s,40s``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from px4fuse.core.record import read_toml
from px4fuse.core.text import UNIT_NAME_BY_SYMBOL, convert_to_unit
from px4fuse.errors import SettingsError, suggest_name

from .scenario import (
    SCENARIO_KINDS,
    ScenarioKind,
    collect_field_bounds,
    make_bounded_field,
)


def _make_start_time_field() -> Any:
    return make_bounded_field(None, 0.0, 1e4, "AT")


@dataclass(frozen=True)
class FaultSizes:
    """Sizes of the faults in a simulated flight; ``faults.toml`` explains each fault.

    Fields that end in ``_at_s`` are start times. By default, no fault is injected.
    ``ekf2_noise_m`` 0 and ``ekf2_delay_s`` None are the correct noise and delay of EKF2.
    """

    clock_offset_s: float = make_bounded_field(0.0, -5.0, 5.0, "SECONDS")
    clock_drift_ppm: float = make_bounded_field(0.0, -20_000.0, 20_000.0, "PPM")
    clock_jump_s: float = make_bounded_field(0.0, 0.0, 5.0, "SECONDS")
    # Percentage of positions that are outliers, as when the line of sight is blocked (NLOS)
    nlos_percent: float = make_bounded_field(0.0, 0.0, 50.0, "PERCENT")
    # Mean error of an outlier
    nlos_size_m: float = make_bounded_field(2.0, 0.0, 100.0, "SIZE")
    # Length of the gap of the position source
    dropout_s: float = make_bounded_field(0.0, 0.0, 600.0, "SECONDS")
    dropout_at_s: float | None = _make_start_time_field()
    # Length of the gap of the IMU
    imu_dropout_s: float = make_bounded_field(0.0, 0.0, 600.0, "SECONDS")
    imu_dropout_at_s: float | None = _make_start_time_field()
    # Reduced rate of the position source
    decimate_hz: float = make_bounded_field(0.0, 0.1, 100.0, "HZ")
    # Ratio of reported to true position variance
    r_scale: float = make_bounded_field(1.0, 1e-4, 1e4, "FACTOR")
    # Rotation of the position frame about the vertical
    yaw_deg: float = make_bounded_field(0.0, -180.0, 180.0, "DEG")
    scale_percent: float = make_bounded_field(0.0, -50.0, 50.0, "PERCENT")
    # Lasting jump of the positions
    jump_m: float = make_bounded_field(0.0, -100.0, 100.0, "METRES")
    jump_at_s: float | None = _make_start_time_field()
    # Time constant of the low-pass filter of the position source
    smoothed_s: float = make_bounded_field(0.0, 0.0, 10.0, "SECONDS")
    # σ of the time-correlated position error
    slow_error_m: float = make_bounded_field(0.0, 0.0, 100.0, "METRES")
    # Correlation time of the time-correlated position error
    slow_error_s: float = make_bounded_field(30.0, 0.1, 1e4, "TIME")
    # Error of EKF2's heading
    heading_deg: float = make_bounded_field(0.0, -180.0, 180.0, "DEG")
    heading_at_s: float | None = _make_start_time_field()
    # Disturbance of the magnetic field
    mag_gauss: float = make_bounded_field(0.0, -1.0, 1.0, "GAUSS")
    mag_at_s: float | None = _make_start_time_field()
    accel_bias_m_s2: float = make_bounded_field(0.0, -5.0, 5.0, "M/S2")
    vibration_m_s2: float = make_bounded_field(0.0, 0.0, 20.0, "M/S2")
    imu_rate_hz: float = make_bounded_field(0.0, 1.0, 1000.0, "HZ")
    # The vehicle only hovers
    no_motion: bool = False
    # Distance from start to end of the path
    open_end_m: float = make_bounded_field(0.0, 0.0, 100.0, "METRES")
    # The topic vehicle_visual_odometry is not logged
    no_vvo: bool = False
    ekf2_noise_m: float = make_bounded_field(0.0, 0.01, 100.0, "METRES")
    ekf2_delay_s: float | None = make_bounded_field(None, 0.0, 0.3, "SECONDS")
    ekf2_gate: float = make_bounded_field(5.0, 1.0, 1000.0, "SD")
    # EKF2 does not fuse the positions
    ekf2_off: bool = False


BOUNDS_BY_FIELD = collect_field_bounds(FaultSizes)
# ASCII spelling of units on the command line
_ASCII_UNITS = {"°": "deg", "m/s²": "m/s2"}


@dataclass(frozen=True)
class FaultType:
    """Fault that can be injected into a simulated flight, from ``faults.toml``.

    Attributes
    ----------
    default : float or True
        Default size of the fault; True for a fault without a size.
    finding : str
        Result that a student is expected to find in the report.
    field_names : tuple of str
        Fields of :class:`FaultSizes` that the fault sets; the size is the first.
    """

    default: float | bool
    help: str
    finding: str
    kinds: tuple[ScenarioKind, ...] = SCENARIO_KINDS
    field_names: tuple[str, ...] = ()

    @property
    def value_field_names(self) -> tuple[str, ...]:
        """Fields of FaultSizes with values that the user can set."""
        return () if self.default is True else self.field_names

    @property
    def usage(self) -> str:
        """Syntax of the values after the name of the fault, such as ``=PERCENT[,SIZE]``."""
        placeholders = [
            BOUNDS_BY_FIELD[field_name].help_or_placeholder for field_name in self.value_field_names
        ]
        return f"={'[,'.join(placeholders)}{']' * len(placeholders[1:])}" if placeholders else ""


FAULT_TYPES: Mapping[str, FaultType] = {
    name: replace(
        fault_type,
        # field names begin with the name of the fault
        field_names=tuple(
            field for field in vars(FaultSizes()) if field.startswith(name.replace("-", "_"))
        ),
    )
    for name, fault_type in read_toml(__file__, dict[str, FaultType]).items()
}


def parse_faults(texts: Iterable[str]) -> FaultSizes:
    """Parse injected faults from the command line.

    >>> parse_faults(["clock-offset=80ms", "nlos=5%,3m"]).clock_offset_s
    0.08

    Parameters
    ----------
    texts : iterable of str
        ``NAME``, ``NAME=VALUE`` or ``NAME=VALUE,VALUE``; a repeated name replaces the previous one.

    Raises
    ------
    SettingsError
        Unknown name, or a value that is not a number, has an unknown unit or is out of range.
    """
    value_by_field: dict[str, float] = {}
    for option_text in texts:
        name, separator, values_text = option_text.strip().partition("=")
        if name not in FAULT_TYPES:
            raise SettingsError(
                f"--mistake {option_text}: px4fuse cannot inject the fault {name}",
                f"{suggest_name(name, FAULT_TYPES)}Choose from {', '.join(FAULT_TYPES)}.",
            )
        fault_type = FAULT_TYPES[name]
        value_texts = values_text.split(",") if separator else []
        if len(value_texts) > len(fault_type.value_field_names):
            raise SettingsError(
                f"--mistake {option_text}: the fault has too many values. "
                f"Use {name}{fault_type.usage}."
            )
        value_by_field[fault_type.field_names[0]] = fault_type.default
        for field_name, value_text in zip(fault_type.value_field_names, value_texts, strict=False):
            bounds = BOUNDS_BY_FIELD[field_name]
            size = convert_to_unit(value_text, bounds.unit)
            if size is None:
                raise SettingsError(
                    f"--mistake {option_text}: {value_text!r} is not a valid value: give "
                    f"{UNIT_NAME_BY_SYMBOL[bounds.unit]}, as in {name}{fault_type.usage}."
                )
            bounds.check(size, f"--mistake {option_text}: {bounds.help_or_placeholder}")
            value_by_field[field_name] = size
    return FaultSizes(**value_by_field)  # type: ignore[arg-type]


def injected_fault_names(faults: FaultSizes) -> tuple[str, ...]:
    """Return the names of the faults with a size that is not the default."""
    defaults = FaultSizes()
    return tuple(
        name
        for name, fault_type in FAULT_TYPES.items()
        if getattr(faults, fault_type.field_names[0])
        != getattr(defaults, fault_type.field_names[0])
    )


def format_fault(name: str, faults: FaultSizes) -> str:
    """Format one injected fault with its values, in the notation of the option --mistake.

    >>> format_fault("nlos", parse_faults(["nlos=5"]))
    'nlos=5%,2m'
    """
    value_texts = []
    for field_name in FAULT_TYPES[name].value_field_names:
        value, unit = getattr(faults, field_name), BOUNDS_BY_FIELD[field_name].unit
        if value is not None:
            value_texts.append(f"{value:g}{_ASCII_UNITS.get(unit, unit)}")
    return f"{name}={','.join(value_texts)}" if value_texts else name
