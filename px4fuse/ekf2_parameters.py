"""EKF2's parameters: PX4's names by what they are for, with defaults, units and ranges.

``ekf2_parameters.toml`` has a row for every aid and every parameter. Nothing else in the package
spells the name of a parameter of external vision or GNSS: who needs one asks the aid for it
(``EV_POS.noise``).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from px4fuse.errors import SettingsError, suggest_name
from px4fuse.record import table


@dataclass(frozen=True)
class Aid:
    """One kind of measurement that EKF2 takes, and the names of its parameters.

    Attributes
    ----------
    name : str
        PX4's own, as in ``estimator_aid_src_<name>``.
    switch : str
        What has EKF2 fuse it, from v1.14 on; EKF2_AID_MASK before.
    noise, gate, delay : str
        Standard deviation of the measurement, its gate in standard deviations, its age in ms.
    noise_mode : str
        1: variances of the sender are not used; empty where there is no such choice.
    place : tuple of str
        Where the sensor is in the body (m, FRD).
    label, unit : str
        What it is for a person, and the unit of its innovations.
    reported : str
        What forms its variance where ``noise`` alone does not; empty where it always does.
    default_gate : float
        In force where a log has no ``gate``.
    axes : tuple of str
        Of its innovations, in PX4's order.
    fields : tuple of str
        Of ``estimator_innovations`` and ``_variances``, by axis; empty where they have none.
    before : tuple of str
        Of ``ekf2_innovations`` (v1.8 to v1.10), to which ``_var`` is added for the variance.
    flags : tuple of tuple of str
        Of ``estimator_status_flags``: the first group that the log has tells, by any of its flags,
        whether EKF2 means to fuse the aid.
    bit : int or None
        The same of ``estimator_status.control_mode_flags``.
    """

    name: str
    switch: str = ""
    noise: str = ""
    gate: str = ""
    delay: str = ""
    noise_mode: str = ""
    place: tuple[str, ...] = ()
    label: str = ""
    unit: str = "m"
    reported: str = ""
    default_gate: float = 5.0
    axes: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    flags: tuple[tuple[str, ...], ...] = ()
    bit: int | None = None

    @property
    def own_parameters(self) -> frozenset[str]:
        """Names of parameters that concern its measurements alone."""
        return frozenset((self.noise, self.gate, self.delay, self.noise_mode))

    def logged_parameters(self, logged: Mapping[str, float]) -> dict[str, float]:
        """Its parameters among those of a log, and what switches it."""
        names = (self.noise, self.delay, self.gate, self.noise_mode, self.switch, AID_MASK)
        return {name: float(logged[name]) for name in names if name in logged}


AID_MASK = "EKF2_AID_MASK"
# Since main of 2026 EKF2 takes a fix's own time of measurement, where the driver knows it
GNSS_MODE = "EKF2_GPS_MODE"
# Relative; half of the last digit of a float32 is 6e-8
FLOAT32_ERROR = 1e-6
# Age of a fix since v1.17, of the first receiver: EKF2 then takes the stamp with it taken off
RECEIVER_DELAYS = ("SENS_GNSS0_DELAY", "SENS_GPS0_DELAY")


@dataclass(frozen=True)
class Parameter:
    """One parameter of EKF2.

    Attributes
    ----------
    unit : str
    default : float
        PX4's, from v1.14 on.
    minimum, maximum : float
        PX4's range, both ends included.
    """

    unit: str
    default: float
    minimum: float
    maximum: float

    def outside(self, value: float) -> str:
        """Return the fault of a finite value outside the range; empty if it is inside.

        Logs hold float32, in which the end 0.01 is 0.0099999998.
        """
        low = self.minimum - FLOAT32_ERROR * abs(self.minimum)
        high = self.maximum + FLOAT32_ERROR * abs(self.maximum)
        if low <= value <= high:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return f" {value:g}{unit} is outside PX4's range {self.minimum:g} to {self.maximum:g}"


TABLE = table(__file__, "ekf2_parameters.toml", dict)
AIDS, DISTURBANCES = (
    msgspec.convert({name: {"name": name, **row} for name, row in rows.items()}, dict[str, Aid])
    for rows in (TABLE["aids"], TABLE["disturbances"])
)
EV_POS, GNSS_POS, GNSS_VEL, GNSS_HGT, BAROMETER, FLOW, MAG = map(
    AIDS.__getitem__,
    ("ev_pos", "gnss_pos", "gnss_vel", "gnss_hgt", "baro_hgt", "optical_flow", "mag"),
)
PARAMETERS = msgspec.convert(TABLE["parameters"], dict[str, Parameter])
# Those of the model and all others of a log with which px4fuse computes
RANGES = PARAMETERS | msgspec.convert(TABLE["logged"], dict[str, Parameter])
FIELD_NOISES = ("EKF2_MAG_E_NOISE", "EKF2_MAG_B_NOISE")
# Up to v1.13, ekf2_params.c
OLD_DEFAULTS: Mapping[str, float] = {EV_POS.delay: 175.0}
# Only these enter the results
REPORTED: tuple[str, ...] = tuple(TABLE["reported"])


def settings_in_force(
    logged: Mapping[str, float], aid: Aid = EV_POS, *others: Aid
) -> dict[str, float]:
    """The model's parameters as the log has them, PX4's defaults where it has none.

    Parameters
    ----------
    logged : mapping
        Parameters of the log, by PX4 name.
    aid, *others : Aid
        What EKF2 fused: those of other aids are left out.
    """
    used = {fused_aid.switch for fused_aid in (aid, *others)}
    of_others = {
        name
        for other in (EV_POS, GNSS_POS, GNSS_VEL, MAG, BAROMETER)
        if other.switch not in used
        for name in (*other.own_parameters, *other.place, *(FIELD_NOISES if other == MAG else ()))
    }
    defaults = {
        name: parameter.default for name, parameter in PARAMETERS.items() if name not in of_others
    }
    if fuses_by_mask(logged) and aid == EV_POS:
        defaults |= OLD_DEFAULTS
    return {name: float(logged.get(name, default)) for name, default in defaults.items()}


def fuses_by_mask(logged: Mapping[str, float]) -> bool:
    """Whether the release is one that chooses aiding by EKF2_AID_MASK (up to v1.13)."""
    return AID_MASK in logged and EV_POS.switch not in logged


def valid_parameters(logged: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Replace each parameter of a log that is not finite or outside PX4's range by its default.

    Returns
    -------
    valid : dict
        The same parameters; without those that are not finite and have no default here.
    notes : tuple of str
        One per parameter that was replaced or left out.

    Examples
    --------
    >>> valid_parameters({"EKF2_EVP_GATE": 0.0, "SYS_AUTOSTART": 4001.0})[0]
    {'EKF2_EVP_GATE': 5.0, 'SYS_AUTOSTART': 4001.0}
    """
    valid, notes = {}, []
    defaults = {name: known.default for name, known in RANGES.items()}
    if fuses_by_mask(logged):
        defaults |= OLD_DEFAULTS
    for name, value in logged.items():
        known = RANGES.get(name)
        finite = math.isfinite(value)
        fault = "" if known is None else known.outside(value)
        if finite and not fault:
            valid[name] = value
        elif known is None:
            notes.append(f"{name} is not a finite number and is not used.")
        else:
            valid[name] = defaults[name]
            said = fault if finite else " is not a finite number"
            notes.append(f"{name}{said}; the default {valid[name]:g} is used.")
    return valid, tuple(notes)


def check_parameters(chosen: Mapping[str, float]) -> dict[str, float]:
    """The same parameters, each known to the model and within PX4's range.

    Raises
    ------
    SettingsError
        A name that the model does not know, or a value outside PX4's range.

    Examples
    --------
    >>> check_parameters({"EKF2_EVP_NOISE": 0.2})
    {'EKF2_EVP_NOISE': 0.2}
    """
    for name, value in chosen.items():
        known = PARAMETERS.get(name)
        if known is None:
            raise SettingsError(
                f"{name}: the model of EKF2 does not have this parameter",
                f"{suggest_name(name, PARAMETERS)}It knows {', '.join(PARAMETERS)}.",
            )
        if not known.minimum <= value <= known.maximum or not math.isfinite(value):
            unit = f" {known.unit}" if known.unit else ""
            raise SettingsError.of(
                "parameter_outside", name=name, value=value, known=known, unit=unit
            )
        if name == EV_POS.noise_mode and value not in (0.0, 1.0):
            raise SettingsError(f"{name}={value:g}: only 0 and 1 have a meaning.")
    return {name: float(value) for name, value in chosen.items()}
