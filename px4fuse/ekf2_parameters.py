"""EKF2's parameters: PX4's names by what they are for, with defaults, units and ranges.

Nothing else in the package spells the name of a parameter of external vision or GNSS: who needs
one asks the aid for it (``EV_POS.noise``).

Source: PX4-Autopilot ``src/modules/ekf2/module.yaml`` and ``params_*.yaml`` (before v1.15
``ekf2_params.c``), read from v1.12 to main.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.errors import SettingsError


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
    """

    name: str
    switch: str
    noise: str
    gate: str
    delay: str
    noise_mode: str = ""
    place: tuple[str, ...] = ()

    def in_log(self, logged: Mapping[str, float]) -> dict[str, float]:
        """Its parameters among those of a log, and what switches it."""
        names = (self.noise, self.delay, self.gate, self.noise_mode, self.switch, AID_MASK)
        return {name: float(logged[name]) for name in names if name in logged}


AID_MASK = "EKF2_AID_MASK"
EV_POS = Aid(
    "ev_pos", "EKF2_EV_CTRL", "EKF2_EVP_NOISE", "EKF2_EVP_GATE", "EKF2_EV_DELAY",
    "EKF2_EV_NOISE_MD", ("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z"),
)  # fmt: skip
GNSS_POS = Aid("gnss_pos", "EKF2_GPS_CTRL", "EKF2_GPS_P_NOISE", "EKF2_GPS_P_GATE", "EKF2_GPS_DELAY")


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


PARAMETERS: Mapping[str, Parameter] = {
    EV_POS.noise: Parameter("m", 0.1, 0.01, 1e3),
    EV_POS.noise_mode: Parameter("", 0.0, 0.0, 1.0),
    EV_POS.gate: Parameter("SD", 5.0, 1.0, 1e3),
    EV_POS.delay: Parameter("ms", 0.0, 0.0, 300.0),
    "EKF2_DELAY_MAX": Parameter("ms", 200.0, 0.0, 1e3),
    **dict.fromkeys(EV_POS.place, Parameter("m", 0.0, -math.inf, math.inf)),
    "EKF2_ACC_NOISE": Parameter("m/s^2", 0.35, 0.01, 1.0),
    "EKF2_GYR_NOISE": Parameter("rad/s", 0.015, 0.0001, 0.1),
    "EKF2_ACC_B_NOISE": Parameter("m/s^3", 0.003, 0.0, 0.01),
    "EKF2_GYR_B_NOISE": Parameter("rad/s^2", 0.001, 0.0, 0.01),
    "EKF2_TAU_POS": Parameter("s", 0.25, 0.1, 1.0),
    "EKF2_TAU_VEL": Parameter("s", 0.25, 0.0, 1.0),
}
# Up to v1.13, ekf2_params.c
OLD_DEFAULTS: Mapping[str, float] = {EV_POS.delay: 175.0}
# Parameters that bear on fusion and on what is logged, and the airframe; only these enter the
# results
REPORTED = (
    AID_MASK, "EKF2_EN", EV_POS.gate, EV_POS.noise, EV_POS.switch, EV_POS.delay, EV_POS.noise_mode,
    "EKF2_HGT_MODE", "EKF2_HGT_REF", "EKF2_ACC_NOISE", "EKF2_PREDICT_US", GNSS_POS.switch,
    "SDLOG_PROFILE", "SYS_AUTOSTART", "SYS_MC_EST_GROUP",
)  # fmt: skip


def settings_in_force(logged: Mapping[str, float]) -> dict[str, float]:
    """The model's parameters as the log has them, PX4's defaults where it has none.

    Parameters
    ----------
    logged : mapping
        Parameters of the log, by PX4 name.
    """
    defaults = {name: parameter.default for name, parameter in PARAMETERS.items()}
    if fuses_by_mask(logged):
        defaults |= OLD_DEFAULTS
    return {name: float(logged.get(name, default)) for name, default in defaults.items()}


def fuses_by_mask(logged: Mapping[str, float]) -> bool:
    """Whether the release is one that chooses aiding by EKF2_AID_MASK (up to v1.13)."""
    return AID_MASK in logged and EV_POS.switch not in logged


def check(chosen: Mapping[str, float]) -> dict[str, float]:
    """The same parameters, each known to the model and within PX4's range.

    Raises
    ------
    SettingsError
        A name that the model does not know, or a value outside PX4's range.

    Examples
    --------
    >>> check({"EKF2_EVP_NOISE": 0.2})
    {'EKF2_EVP_NOISE': 0.2}
    """
    for name, value in chosen.items():
        known = PARAMETERS.get(name)
        if known is None:
            raise SettingsError(
                f"{name}: the model of EKF2 does not have this parameter",
                f"It knows {', '.join(PARAMETERS)}.",
            )
        if not known.minimum <= value <= known.maximum or not math.isfinite(value):
            unit = f" {known.unit}" if known.unit else ""
            raise SettingsError(
                f"{name}={value:g} is outside PX4's range, {known.minimum:g} to "
                f"{known.maximum:g}{unit} (default {known.default:g})."
            )
        if name == EV_POS.noise_mode and value not in (0.0, 1.0):
            raise SettingsError(f"{name}={value:g}: only 0 and 1 have a meaning.")
    return {name: float(value) for name, value in chosen.items()}
