"""Aiding sources of EKF2, and EKF2 parameters with PX4's defaults, units and ranges.

The data are in ``ekf2_parameters.toml``. Parameter names of an aiding source are its attributes,
for example ``EV_POS.noise``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from px4fuse.core.record import read_toml
from px4fuse.errors import SettingsError, suggest_name


@dataclass(frozen=True)
class Aid:
    """Aiding source of EKF2: a kind of measurement that EKF2 can fuse, and its PX4 parameters.

    The attributes ``switch``, ``noise``, ``gate``, ``delay`` and ``lever_arm`` contain names of
    parameters, not values.
    """

    # Name in PX4, as in ``estimator_aid_src_<name>``
    name: str
    # Parameter that enables fusion from PX4 v1.14 on; EKF2_AID_MASK in older releases
    switch: str = ""
    # Parameters for the measurement noise (σ) and the innovation gate (√S)
    noise: str = ""
    gate: str = ""
    # Parameter for the delay (ms) from measurement to timestamp
    delay: str = ""
    # Parameter that makes EKF2 ignore reported variances if it is 1
    noise_mode_parameter: str = ""
    # Parameters for the position of the sensor (m, FRD)
    lever_arm: tuple[str, ...] = ()
    # Name of the aiding source in reports
    label: str = ""
    # Unit of the innovations
    unit: str = "m"
    # Text for users (noun phrase): data from which EKF2 computes R. "" if R is only ``noise``
    # squared
    noise_source_text: str = ""
    # Gate (√S) for logs without the parameter ``gate``
    default_gate: float = 5.0
    # Axes of the innovations, in the order of PX4
    axes: tuple[str, ...] = ()
    # Fields of the topics estimator_innovations and estimator_innovation_variances, one for each
    # axis: ``ev_hpos[]`` stands for ``ev_hpos[0] ev_hpos[1]``
    fields: str = ""
    # Fields of ekf2_innovations (v1.8 to v1.10); ``_var`` is appended for the variance
    ekf2_innovations_fields: str = ""
    # Flags of estimator_status_flags that are 1 while fusion of the aiding source is enabled. Each
    # element holds the flag of one PX4 release, or several flags separated by commas
    flags: tuple[str, ...] = ()
    # Bit of estimator_status.control_mode_flags that is used if ``flags`` are not logged
    status_bit: int | None = None

    @property
    def measurement_parameters(self) -> frozenset[str]:
        """Names of the parameters for noise, gate and delay, without the parameter ``switch``."""
        return frozenset((self.noise, self.gate, self.delay, self.noise_mode_parameter))

    def logged_parameters(self, logged_values: Mapping[str, float]) -> dict[str, float]:
        """Return the logged parameters for noise, delay, gate and fusion of this aiding source."""
        names = (
            self.noise,
            self.delay,
            self.gate,
            self.noise_mode_parameter,
            self.switch,
            AID_MASK_PARAMETER,
        )
        return {name: float(logged_values[name]) for name in names if name in logged_values}


AID_MASK_PARAMETER = "EKF2_AID_MASK"
# Parameter of PX4 main since 2026, with which EKF2 uses the GNSS driver's measurement times
GNSS_MODE_PARAMETER = "EKF2_GPS_MODE"
# Relative tolerance of PX4's parameter ranges, because logged values are float32 (rounding 6e-8)
FLOAT32_TOLERANCE = 1e-6
# Parameters for the delay (ms) from fix to timestamp of the first GNSS receiver (since PX4 v1.17)
RECEIVER_DELAY_PARAMETERS = ("SENS_GNSS0_DELAY", "SENS_GPS0_DELAY")


class Parameter(NamedTuple):
    """Unit of an EKF2 parameter, PX4's default from v1.14 on, and PX4's range (ends included)."""

    unit: str
    default: float
    minimum: float
    maximum: float

    @property
    def printed_unit(self) -> str:
        """Unit with superscripts: "m/s²" for "m/s^2"."""
        return self.unit.replace("^2", "²").replace("^3", "³")

    def describe_range_error(self, name: str, value: float) -> str:
        """Return "EKF2_EVP_NOISE 9 m is outside PX4's range 0.01 to 5", or "" inside the range."""
        lower_limit = self.minimum - FLOAT32_TOLERANCE * abs(self.minimum)
        upper_limit = self.maximum + FLOAT32_TOLERANCE * abs(self.maximum)
        if lower_limit <= value <= upper_limit:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{name} {value:g}{unit} is outside PX4's range {self.minimum:g} to {self.maximum:g}"


PARAMETER_TABLES = read_toml(__file__, dict)
# Keys of PARAMETER_TABLES whose value is a list of names, separated by blanks
NAME_LIST_KEYS = ("axes", "lever_arm", "flags")
# Aiding sources, and other status flags of EKF2, by name
AIDS, STATUS_FLAGS = (
    {
        name: msgspec.convert(
            {"name": name, **PARAMETER_TABLES["groups"].get(name.partition("_")[0], {}), **row}
            | {key: row[key].split() for key in NAME_LIST_KEYS if key in row},
            Aid,
        )
        for name, row in rows.items()
    }
    for rows in (PARAMETER_TABLES["aids"], PARAMETER_TABLES["disturbances"])
)
EV_POS, GNSS_POS, GNSS_VEL, GNSS_HGT, BAROMETER, FLOW, MAG = map(
    AIDS.__getitem__,
    ("ev_pos", "gnss_pos", "gnss_vel", "gnss_hgt", "baro_hgt", "optical_flow", "mag"),
)
PARAMETERS, _LOGGED_PARAMETERS = (
    msgspec.convert(
        {name: row for names, row in PARAMETER_TABLES[table].items() for name in names.split()},
        dict[str, Parameter],
    )
    for table in ("parameters", "logged")
)
# Parameters of the EKF2 model, and other logged parameters that px4fuse needs
KNOWN_PARAMETERS = PARAMETERS | _LOGGED_PARAMETERS
MAGNETIC_FIELD_NOISE_PARAMETERS = ("EKF2_MAG_E_NOISE", "EKF2_MAG_B_NOISE")
# Value of EKF2_MAG_TYPE with which EKF2 does not use the magnetometer ("None")
MAG_TYPE_NONE = 5
# Bit mask of EKF2_EV_CTRL: EKF2 fuses the yaw of external vision
EV_CTRL_YAW_MASK = 8
# Defaults of PX4 up to v1.13 that differ from the defaults of later releases (ekf2_params.c)
DEFAULTS_BEFORE_V1_14: Mapping[str, float] = {EV_POS.delay: 175.0}
# Names of the logged parameters that the results contain
PARAMETERS_IN_RESULTS: tuple[str, ...] = tuple(PARAMETER_TABLES["reported"].split())


def fill_with_defaults(
    logged_values: Mapping[str, float], aid: Aid = EV_POS, *other_aids: Aid
) -> dict[str, float]:
    """Return all parameters of the EKF2 model: the logged value or, if not logged, PX4's default.

    Parameters of aiding sources other than ``aid`` and ``other_aids`` are omitted.
    """
    # One parameter enables all aiding sources of one sensor, such as GNSS position and velocity, so
    # their parameters are returned together
    used_switches = {fused_aid.switch for fused_aid in (aid, *other_aids)}
    excluded_names = {
        name
        for other_aid in (EV_POS, GNSS_POS, GNSS_VEL, MAG, BAROMETER)
        if other_aid.switch not in used_switches
        for name in (
            *other_aid.measurement_parameters,
            *other_aid.lever_arm,
            *(MAGNETIC_FIELD_NOISE_PARAMETERS if other_aid == MAG else ()),
        )
    }
    defaults = {
        name: parameter.default
        for name, parameter in PARAMETERS.items()
        if name not in excluded_names
    }
    if uses_aid_mask(logged_values) and aid == EV_POS:
        defaults |= DEFAULTS_BEFORE_V1_14
    return {name: float(logged_values.get(name, default)) for name, default in defaults.items()}


def uses_aid_mask(logged_values: Mapping[str, float]) -> bool:
    """Return True if EKF2_AID_MASK selects the aiding sources in this log (PX4 up to v1.13)."""
    return AID_MASK_PARAMETER in logged_values and EV_POS.switch not in logged_values


def replace_invalid_parameters(
    logged_values: Mapping[str, float],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Replace invalid logged parameters by their defaults, and return a note on each.

    Parameters without a known default are omitted.

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
    """Check changes of EKF2 parameters.

    Raises
    ------
    SettingsError
        The EKF2 model does not contain a parameter, or a value is outside PX4's range.

    Examples
    --------
    >>> check_parameters({"EKF2_EVP_NOISE": 0.2})
    {'EKF2_EVP_NOISE': 0.2}
    """
    for name, value in changes.items():
        parameter = PARAMETERS.get(name)
        if parameter is None:
            raise SettingsError(
                f"{name} is not a parameter of the EKF2 replay",
                f"{suggest_name(name, PARAMETERS)}Choose from {', '.join(PARAMETERS)}.",
            )
        if fault := parameter.describe_range_error(name, value):
            raise SettingsError(f"{fault} (default {parameter.default:g}).")
        if name == EV_POS.noise_mode_parameter and value not in (0.0, 1.0):
            raise SettingsError(f"{name} {value:g} is neither 0 nor 1.")
    return {name: float(value) for name, value in changes.items()}
