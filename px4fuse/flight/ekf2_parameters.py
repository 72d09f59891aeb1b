"""Aiding sources of EKF2, and EKF2 parameters with PX4's defaults, units and ranges.

The data are in ``ekf2_parameters.toml``, ``model_parameters.csv`` and ``logged_parameters.csv``.
"""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from px4fuse.core.record import read_toml
from px4fuse.errors import SettingsError, suggest_name


@dataclass(frozen=True)
class Aid:
    """Aiding source of EKF2, such as GNSS position, with the names of its PX4 parameters."""

    # Name in PX4's topic ``estimator_aid_src_<name>``
    name: str
    # Name of the parameter that enables fusion (since PX4 v1.14)
    switch: str = ""
    # Names of the parameters for measurement noise (σ) and innovation gate (√S)
    noise: str = ""
    gate: str = ""
    # Name of the parameter for the delay (ms) from measurement to timestamp
    delay: str = ""
    # Name of the parameter that is 1 if EKF2 ignores reported variances
    noise_mode_parameter: str = ""
    # Names of the parameters for the sensor position (m, body FRD)
    lever_arm: tuple[str, ...] = ()
    # Name of the aiding source in reports
    label: str = ""
    # Unit of the innovations
    unit: str = "m"
    # Data from which EKF2 computes the measurement variance R, as noun phrase for users; "" if R is
    # the square of the parameter ``noise``
    noise_source_text: str = ""
    # Innovation gate (√S) if the log contains no gate parameter
    default_gate: float = 5.0
    # Axes of the innovations, in the order of PX4
    axes: tuple[str, ...] = ("north", "east")
    # Fields of the topic estimator_innovations, one for each axis
    fields: str = ""
    # Fields of the topic ekf2_innovations (PX4 v1.8 to v1.10)
    ekf2_innovations_fields: str = ""
    # Flags of the topic estimator_status_flags that are 1 while fusion is enabled; by default
    # cs_NAME. PX4 has no such flag for auxiliary velocity
    flags: tuple[str, ...] = ()
    # Bit of estimator_status.control_mode_flags that is 1 while fusion is enabled
    status_bit: int | None = None

    @property
    def measurement_parameters(self) -> tuple[str, ...]:
        """Names of the PX4 parameters for noise, delay, gate and noise mode."""
        return self.noise, self.delay, self.gate, self.noise_mode_parameter

    def logged_parameters(self, logged_values: Mapping[str, float]) -> dict[str, float]:
        """Return the logged PX4 parameters of this aiding source, such as noise and gate."""
        names = (*self.measurement_parameters, self.switch, AID_MASK_PARAMETER)
        return {name: float(logged_values[name]) for name in names if name in logged_values}


AID_MASK_PARAMETER = "EKF2_AID_MASK"
# PX4 parameter since 2026: EKF2 uses the measurement times of the GNSS driver
GNSS_MODE_PARAMETER = "EKF2_GPS_MODE"
# Relative tolerance of parameter ranges, because logged values are rounded to float32
FLOAT32_TOLERANCE = 1e-6
# Minimum similarity (difflib ratio, 0 to 1) of an unknown name to a parameter of the EKF2 model, to
# suggest this parameter; the names of other PX4 parameters are less similar
MIN_SIMILARITY_OF_MISTYPED_PARAMETER = 0.9
# Delay (ms) from fix to timestamp of the first GNSS receiver (since PX4 v1.17)
RECEIVER_DELAY_PARAMETERS = ("SENS_GNSS0_DELAY", "SENS_GPS0_DELAY")


class Parameter(NamedTuple):
    """Unit, default (since PX4 v1.14) and permitted range of an EKF2 parameter."""

    unit: str
    default: float
    minimum: float
    maximum: float

    @property
    def printed_unit(self) -> str:
        """Unit with superscripts, for example "m/s²" instead of "m/s^2"."""
        return self.unit.replace("^2", "²").replace("^3", "³")

    def describe_range_error(self, name: str, value: float) -> str:
        """Return an error message if the value is outside PX4's range, otherwise ""."""
        lower_limit = self.minimum - FLOAT32_TOLERANCE * abs(self.minimum)
        upper_limit = self.maximum + FLOAT32_TOLERANCE * abs(self.maximum)
        if lower_limit <= value <= upper_limit:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{name} {value:g}{unit} is outside PX4's range {self.minimum:g} to {self.maximum:g}"


_PARAMETER_TABLES = read_toml(__file__, dict)
# TOML keys for lists of names, separated by commas
NAME_LIST_KEYS = ("axes", "lever_arm", "flags")
# Aiding sources and other status flags of EKF2, by PX4 name
AIDS, STATUS_FLAGS = (
    {
        name: msgspec.convert(
            {"name": name, "flags": [f"cs_{name}"]}
            | _PARAMETER_TABLES["groups"].get(name.partition("_")[0], {})
            | row
            | {key: row[key].split(",") for key in NAME_LIST_KEYS if key in row},
            Aid,
        )
        for name, row in rows.items()
    }
    for rows in (_PARAMETER_TABLES["aids"], _PARAMETER_TABLES["disturbances"])
)
EV_POS = AIDS["ev_pos"]
GNSS_POS = AIDS["gnss_pos"]
GNSS_VEL = AIDS["gnss_vel"]
GNSS_HGT = AIDS["gnss_hgt"]
BAROMETER = AIDS["baro_hgt"]
FLOW = AIDS["optical_flow"]
MAG = AIDS["mag"]


def _read_parameters(file_name: str) -> dict[str, Parameter]:
    """Read a table of EKF2 parameters; a row contains one or more names."""
    lines = Path(__file__).with_name(file_name).read_text("utf-8").splitlines()[1:]
    return {
        name: Parameter(unit, *map(float, limits))
        for names, unit, *limits in csv.reader(lines)
        for name in names.split()
    }


# Parameters of the EKF2 model. PX4 limits neither innovation gates (maximum) nor positions of
# sensors: 1000 SD and 100 m are limits of px4fuse
MODEL_PARAMETERS = _read_parameters("model_parameters.csv")
# All parameters with a known unit, default and range
KNOWN_PARAMETERS = MODEL_PARAMETERS | _read_parameters("logged_parameters.csv")
MAGNETIC_FIELD_NOISE_PARAMETERS = ("EKF2_MAG_E_NOISE", "EKF2_MAG_B_NOISE")
# Value of EKF2_MAG_TYPE for "None": EKF2 does not use the magnetometer
MAG_TYPE_NONE = 5
# Bit of EKF2_EV_CTRL that enables fusion of the yaw of external vision
EV_CTRL_YAW_MASK = 8
# Parameter defaults up to PX4 v1.13 that differ from later releases (ekf2_params.c)
DEFAULTS_BEFORE_V1_14: Mapping[str, float] = {EV_POS.delay: 175.0}
# Logged parameters that px4fuse writes to its results
PARAMETERS_IN_RESULTS: tuple[str, ...] = tuple(_PARAMETER_TABLES["reported"].split(","))


def fill_parameters_with_defaults(
    logged_values: Mapping[str, float], aid: Aid = EV_POS, *other_aids: Aid
) -> dict[str, float]:
    """Return the parameters of EKF2: logged values, or PX4's defaults if not logged.

    Parameters of other aiding sources are omitted.
    """
    # One parameter enables all aiding sources of a sensor, such as GNSS position and velocity
    used_switches = {fused_aid.switch for fused_aid in (aid, *other_aids)}
    excluded_parameter_names: set[str] = set()
    for other_aid in (EV_POS, GNSS_POS, GNSS_VEL, MAG, BAROMETER):
        if other_aid.switch not in used_switches:
            excluded_parameter_names.update(other_aid.measurement_parameters, other_aid.lever_arm)
    if MAG.switch not in used_switches:
        excluded_parameter_names.update(MAGNETIC_FIELD_NOISE_PARAMETERS)
    defaults = {
        name: parameter.default
        for name, parameter in MODEL_PARAMETERS.items()
        if name not in excluded_parameter_names
    }
    # Before PX4 v1.14, the default delay of external vision was different
    if uses_aid_mask(logged_values) and aid == EV_POS:
        defaults |= DEFAULTS_BEFORE_V1_14
    return {name: float(logged_values.get(name, default)) for name, default in defaults.items()}


def uses_aid_mask(logged_values: Mapping[str, float]) -> bool:
    """Return True if EKF2_AID_MASK selects the aiding sources (PX4 up to v1.13)."""
    return AID_MASK_PARAMETER in logged_values and EV_POS.switch not in logged_values


def replace_invalid_parameters(
    logged_values: Mapping[str, float],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Replace invalid logged parameters by PX4's defaults, and return a note on each.

    Examples
    --------
    >>> replace_invalid_parameters({"EKF2_EVP_GATE": 0.0, "SYS_AUTOSTART": 4001.0})[0]
    {'EKF2_EVP_GATE': 5.0, 'SYS_AUTOSTART': 4001.0}
    """
    valid_values, notes = {}, []
    defaults = {name: parameter.default for name, parameter in KNOWN_PARAMETERS.items()}
    if uses_aid_mask(logged_values):
        defaults |= DEFAULTS_BEFORE_V1_14
    for name, value in logged_values.items():
        parameter_range = KNOWN_PARAMETERS.get(name)
        fault = "" if parameter_range is None else parameter_range.describe_range_error(name, value)
        if not math.isfinite(value):
            fault = f"{name} is not a finite number"
        if not fault:
            valid_values[name] = value
        elif parameter_range is None:
            notes.append(f"{fault}. px4fuse ignores {name}.")
        else:
            valid_values[name] = defaults[name]
            notes.append(f"{fault}. px4fuse uses the parameter default {valid_values[name]:g}.")
    return valid_values, tuple(notes)


def check_parameters(changes: Mapping[str, float]) -> dict[str, float]:
    """Check names and values of changed EKF2 parameters.

    Raises
    ------
    SettingsError
        A parameter is unknown, or its value is outside PX4's range.

    Examples
    --------
    >>> check_parameters({"EKF2_EVP_NOISE": 0.2})
    {'EKF2_EVP_NOISE': 0.2}
    """
    for name, value in changes.items():
        parameter = MODEL_PARAMETERS.get(name)
        if parameter is None:
            # EKF2_EV_CTRL is a parameter of PX4 and not a typing error of EKF2_EV_DELAY
            suggestion = suggest_name(
                name, MODEL_PARAMETERS, cutoff=MIN_SIMILARITY_OF_MISTYPED_PARAMETER
            )
            raise SettingsError(
                f"The EKF2 replay does not contain the parameter {name}",
                f"{suggestion}Choose from {', '.join(MODEL_PARAMETERS)}.",
            )
        if fault := parameter.describe_range_error(name, value):
            raise SettingsError(f"{fault} (default {parameter.default:g}).")
        if name == EV_POS.noise_mode_parameter and value not in (0.0, 1.0):
            raise SettingsError(f"{name} {value:g} is neither 0 nor 1.")
    return {name: float(value) for name, value in changes.items()}
