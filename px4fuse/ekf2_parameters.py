"""EKF2 aids and parameters: PX4 names by role, defaults, units and ranges.

``ekf2_parameters.toml`` has one row per aid and per parameter. Other modules get the names of
parameters of external vision and GNSS from the aid (``EV_POS.noise``).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from px4fuse.errors import SettingsError, suggest_name
from px4fuse.record import table


@dataclass(frozen=True)
class Aid:
    """Kind of measurement that EKF2 can fuse, and the names of its parameters.

    Attributes
    ----------
    name : str
        PX4's name, as in ``estimator_aid_src_<name>``.
    switch : str
        Parameter that enables fusion of the aid, from v1.14 on; before, EKF2_AID_MASK does.
    noise, gate, delay : str
        Parameters of standard deviation, gate (√S) and age (ms).
    noise_mode : str
        Parameter that ignores reported variances if 1; empty without such a parameter.
    lever_arm : tuple of str
        Parameters of the lever arm of the sensor (m, FRD).
    label, unit : str
        Name for users, and unit of the innovations.
    noise_origin : str
        Origin of the variance if it is not ``noise`` alone; else empty.
    default_gate : float
        Gate if the log does not contain the parameter ``gate``.
    axes : tuple of str
        Axes of the innovations, in PX4's order.
    fields : tuple of str
        Fields of ``estimator_innovations`` and ``_variances``, by axis; empty without such fields.
    old_fields : tuple of str
        Fields of ``ekf2_innovations`` (v1.8 to v1.10); ``_var`` is appended for the variance.
    flags : tuple of tuple of str
        Fields of ``estimator_status_flags``. The aid is enabled if any flag of the first logged
        group is set.
    status_bit : int or None
        Bit in ``estimator_status.control_mode_flags`` that is set if the aid is enabled.
    """

    name: str
    switch: str = ""
    noise: str = ""
    gate: str = ""
    delay: str = ""
    noise_mode: str = ""
    lever_arm: tuple[str, ...] = ()
    label: str = ""
    unit: str = "m"
    noise_origin: str = ""
    default_gate: float = 5.0
    axes: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    old_fields: tuple[str, ...] = ()
    flags: tuple[tuple[str, ...], ...] = ()
    status_bit: int | None = None

    @property
    def own_parameters(self) -> frozenset[str]:
        """Parameters that affect only the measurements of this aid."""
        return frozenset((self.noise, self.gate, self.delay, self.noise_mode))

    def logged_parameters(self, logged: Mapping[str, float]) -> dict[str, float]:
        """Return the logged parameters of this aid and the parameter that enables it."""
        names = (self.noise, self.delay, self.gate, self.noise_mode, self.switch, AID_MASK)
        return {name: float(logged[name]) for name in names if name in logged}


AID_MASK = "EKF2_AID_MASK"
# only in logs of PX4 main since 2026, where EKF2 uses the measurement time of a fix from the driver
GNSS_MODE = "EKF2_GPS_MODE"
# relative tolerance of the limits of a range, because logged values are float32 (rounding 6e-8)
FLOAT32_TOLERANCE = 1e-6
# age of a fix of the first receiver from v1.17 on: EKF2 subtracts it from the timestamp
RECEIVER_DELAYS = ("SENS_GNSS0_DELAY", "SENS_GPS0_DELAY")


@dataclass(frozen=True)
class Parameter:
    """One parameter of EKF2.

    Attributes
    ----------
    unit : str
    default : float
        PX4's default, from v1.14 on.
    minimum, maximum : float
        PX4's range, both ends included.
    """

    unit: str
    default: float
    minimum: float
    maximum: float

    @property
    def printed_unit(self) -> str:
        """Unit with superscripts."""
        return self.unit.replace("^2", "²").replace("^3", "³")

    def describe_range_error(self, value: float) -> str:
        """Return a text if a finite value is outside the range, else "".

        Logged values are float32, in which the limit 0.01 is 0.0099999998.
        """
        low = self.minimum - FLOAT32_TOLERANCE * abs(self.minimum)
        high = self.maximum + FLOAT32_TOLERANCE * abs(self.maximum)
        if low <= value <= high:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f" {value:g}{unit} is outside PX4's range {self.minimum:g} to {self.maximum:g}"


TABLES = table(__file__, "ekf2_parameters.toml", dict)
AIDS, DISTURBANCES = (
    msgspec.convert({name: {"name": name, **row} for name, row in rows.items()}, dict[str, Aid])
    for rows in (TABLES["aids"], TABLES["disturbances"])
)
EV_POS, GNSS_POS, GNSS_VEL, GNSS_HGT, BAROMETER, FLOW, MAG = map(
    AIDS.__getitem__,
    ("ev_pos", "gnss_pos", "gnss_vel", "gnss_hgt", "baro_hgt", "optical_flow", "mag"),
)
PARAMETERS = msgspec.convert(TABLES["parameters"], dict[str, Parameter])
# parameters of the model, and other logged parameters with which px4fuse computes
RANGES = PARAMETERS | msgspec.convert(TABLES["logged"], dict[str, Parameter])
FIELD_NOISES = ("EKF2_MAG_E_NOISE", "EKF2_MAG_B_NOISE")
# defaults up to v1.13 (ekf2_params.c)
OLD_DEFAULTS: Mapping[str, float] = {EV_POS.delay: 175.0}
# parameters that are written to the results
REPORTED: tuple[str, ...] = tuple(TABLES["reported"])


def effective_settings(
    logged: Mapping[str, float], aid: Aid = EV_POS, *others: Aid
) -> dict[str, float]:
    """Return the values of the model's parameters: logged ones, else PX4's defaults.

    Parameters
    ----------
    logged : mapping
        Parameters of the log, by PX4 name.
    aid, *others : Aid
        Fused aids; parameters of other aids are omitted.
    """
    used_switches = {fused_aid.switch for fused_aid in (aid, *others)}
    excluded_names = {
        name
        for other in (EV_POS, GNSS_POS, GNSS_VEL, MAG, BAROMETER)
        if other.switch not in used_switches
        for name in (
            *other.own_parameters,
            *other.lever_arm,
            *(FIELD_NOISES if other == MAG else ()),
        )
    }
    defaults = {
        name: parameter.default
        for name, parameter in PARAMETERS.items()
        if name not in excluded_names
    }
    if fuses_by_mask(logged) and aid == EV_POS:
        defaults |= OLD_DEFAULTS
    return {name: float(logged.get(name, default)) for name, default in defaults.items()}


def fuses_by_mask(logged: Mapping[str, float]) -> bool:
    """Return True for a release that enables aids by EKF2_AID_MASK (up to v1.13)."""
    return AID_MASK in logged and EV_POS.switch not in logged


def replace_invalid_parameters(
    logged: Mapping[str, float],
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Replace logged parameters that are not finite or outside PX4's range by their defaults.

    Returns
    -------
    valid : dict
        All parameters, except non-finite ones without a known default.
    notes : tuple of str
        One per parameter that was replaced or omitted.

    Examples
    --------
    >>> replace_invalid_parameters({"EKF2_EVP_GATE": 0.0, "SYS_AUTOSTART": 4001.0})[0]
    {'EKF2_EVP_GATE': 5.0, 'SYS_AUTOSTART': 4001.0}
    """
    valid, notes = {}, []
    defaults = {name: parameter.default for name, parameter in RANGES.items()}
    if fuses_by_mask(logged):
        defaults |= OLD_DEFAULTS
    for name, value in logged.items():
        parameter = RANGES.get(name)
        finite = math.isfinite(value)
        fault = "" if parameter is None else parameter.describe_range_error(value)
        if finite and not fault:
            valid[name] = value
        elif parameter is None:
            notes.append(f"{name} is not a finite number and is not used.")
        else:
            valid[name] = defaults[name]
            problem = fault if finite else " is not a finite number"
            notes.append(f"{name}{problem}; the default {valid[name]:g} is used.")
    return valid, tuple(notes)


def check_parameters(changes: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters, if all are in the model and within PX4's range.

    Raises
    ------
    SettingsError
        A name that the model does not contain, or a value outside PX4's range.

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
        if not parameter.minimum <= value <= parameter.maximum or not math.isfinite(value):
            unit = f" {parameter.unit}" if parameter.unit else ""
            raise SettingsError(
                f"{name}={value:g} is outside PX4's range of {parameter.minimum:g} to "
                f"{parameter.maximum:g}{unit} (default {parameter.default:g})."
            )
        if name == EV_POS.noise_mode and value not in (0.0, 1.0):
            raise SettingsError(f"{name}={value:g}: give 0 or 1.")
    return {name: float(value) for name, value in changes.items()}
