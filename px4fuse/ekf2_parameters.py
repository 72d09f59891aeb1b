"""EKF2's parameters: PX4's names by what they are for, with defaults, units and ranges.

Nothing else in the package spells the name of a parameter of external vision or GNSS: who needs
one asks the aid for it (``EV_POS.noise``).

Source: PX4-Autopilot ``src/modules/ekf2/module.yaml`` and ``params_*.yaml`` (before v1.15
``ekf2_params.c``), read from v1.12 to main.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.errors import SettingsError, did_you_mean


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
    """

    name: str
    switch: str
    noise: str
    gate: str
    delay: str
    noise_mode: str = ""
    place: tuple[str, ...] = ()
    label: str = ""
    unit: str = "m"
    reported: str = ""
    default_gate: float = 5.0

    @property
    def own(self) -> frozenset[str]:
        """Names of parameters that concern its measurements alone."""
        return frozenset((self.noise, self.gate, self.delay, self.noise_mode))

    def in_log(self, logged: Mapping[str, float]) -> dict[str, float]:
        """Its parameters among those of a log, and what switches it."""
        names = (self.noise, self.delay, self.gate, self.noise_mode, self.switch, AID_MASK)
        return {name: float(logged[name]) for name in names if name in logged}


AID_MASK = "EKF2_AID_MASK"
# Since main of 2026 EKF2 takes a fix's own time of measurement, where the driver knows it
GNSS_MODE = "EKF2_GPS_MODE"
# Age of a fix since v1.17, of the first receiver: EKF2 then takes the stamp with it taken off
RECEIVER_DELAYS = ("SENS_GNSS0_DELAY", "SENS_GPS0_DELAY")
_SENDER, _RECEIVER = "the variance that the sender states", "the accuracy that the receiver states"
EV_POS = Aid(
    "ev_pos", "EKF2_EV_CTRL", "EKF2_EVP_NOISE", "EKF2_EVP_GATE", "EKF2_EV_DELAY",
    "EKF2_EV_NOISE_MD", ("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z"),
    "external vision, position", reported=_SENDER,
)  # fmt: skip
GNSS_POS = Aid(
    "gnss_pos", "EKF2_GPS_CTRL", "EKF2_GPS_P_NOISE", "EKF2_GPS_P_GATE", "EKF2_GPS_DELAY",
    place=("EKF2_GPS_POS_X", "EKF2_GPS_POS_Y", "EKF2_GPS_POS_Z"),
    label="GNSS position", reported=_RECEIVER,
)  # fmt: skip


def _gnss(name: str, label: str, noise: str, gate: str, unit: str) -> Aid:
    return Aid(name, GNSS_POS.switch, noise, gate, GNSS_POS.delay, label=label, unit=unit,
               reported=_RECEIVER)  # fmt: skip


def _vision(name: str, label: str, noise: str, gate: str, unit: str) -> Aid:
    return Aid(name, EV_POS.switch, noise, gate, EV_POS.delay, EV_POS.noise_mode,
               label=f"external vision, {label}", unit=unit, reported=_SENDER)  # fmt: skip


BAROMETER = Aid(
    "baro_hgt", "EKF2_BARO_CTRL", "EKF2_BARO_NOISE", "EKF2_BARO_GATE", "EKF2_BARO_DELAY",
    label="barometer", reported="EKF2_BARO_NOISE and the variance of its bias",
)  # fmt: skip
GNSS_HGT = _gnss("gnss_hgt", "GNSS height", GNSS_POS.noise, GNSS_POS.gate, "m")
GNSS_VEL = _gnss("gnss_vel", "GNSS velocity", "EKF2_GPS_V_NOISE", "EKF2_GPS_V_GATE", "m/s")
FLOW = Aid(
    "optical_flow", "EKF2_OF_CTRL", "EKF2_OF_N_MIN", "EKF2_OF_GATE", "EKF2_OF_DELAY",
    label="optical flow", unit="rad/s", default_gate=3.0,
    reported="EKF2_OF_N_MIN to EKF2_OF_N_MAX, by quality",
)  # fmt: skip
MAG = Aid("mag", "EKF2_MAG_TYPE", "EKF2_MAG_NOISE", "EKF2_MAG_GATE", "EKF2_MAG_DELAY",
          label="magnetometer", unit="gauss", default_gate=3.0)  # fmt: skip
# What EKF2 can fuse, in the order in which it is told. gate, noise and what else forms R: PX4's
# EKF/aid_sources of v1.13 to main
AIDS: Mapping[str, Aid] = {
    aid.name: aid
    for aid in (
        GNSS_POS,
        GNSS_VEL,
        GNSS_HGT,
        _gnss("gnss_yaw", "GNSS yaw", "", "EKF2_HDG_GATE", "rad"),
        EV_POS,
        _vision("ev_vel", "velocity", "EKF2_EVV_NOISE", "EKF2_EVV_GATE", "m/s"),
        _vision("ev_hgt", "height", EV_POS.noise, EV_POS.gate, "m"),
        _vision("ev_yaw", "yaw", "EKF2_EVA_NOISE", "EKF2_HDG_GATE", "rad"),
        BAROMETER,
        Aid("rng_hgt", "EKF2_RNG_CTRL", "EKF2_RNG_NOISE", "EKF2_RNG_GATE", "EKF2_RNG_DELAY",
            label="range to the ground",
            reported="EKF2_RNG_NOISE, EKF2_RNG_SFE and the height's own variance"),
        FLOW,
        MAG,
        Aid("mag_heading", "EKF2_MAG_TYPE", "EKF2_HEAD_NOISE", "EKF2_HDG_GATE", "EKF2_MAG_DELAY",
            label="magnetic heading", unit="rad", default_gate=2.6),
        Aid("airspeed", "EKF2_ARSP_THR", "EKF2_EAS_NOISE", "EKF2_TAS_GATE", "EKF2_ASP_DELAY",
            label="airspeed", unit="m/s"),
        Aid("sideslip", "EKF2_FUSE_BETA", "EKF2_BETA_NOISE", "EKF2_BETA_GATE", "",
            label="sideslip", unit="rad"),
        Aid("drag", "EKF2_DRAG_CTRL", "EKF2_DRAG_NOISE", "", "", label="drag", unit="m/s²"),
        Aid("gravity", "EKF2_IMU_CTRL", "EKF2_GRAV_NOISE", "", "", label="gravity", unit="",
            default_gate=0.25),
        Aid("aux_vel", "", "", "", "EKF2_AVEL_DELAY", label="auxiliary velocity", unit="m/s",
            reported=_SENDER),
        Aid("aux_global_position", "EKF2_AGP_CTRL", "EKF2_AGP_NOISE", "EKF2_AGP_GATE",
            "EKF2_AGP_DELAY", label="auxiliary position", reported=_SENDER, default_gate=3.0),
        Aid("fake_pos", "", "EKF2_NOAID_NOISE", "", "", label="fake position", default_gate=3.0),
    )
}  # fmt: skip


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


FIELD_NOISES = {
    "EKF2_MAG_E_NOISE": Parameter("gauss/s", 0.001, 0.0, 0.1),
    "EKF2_MAG_B_NOISE": Parameter("gauss/s", 0.0001, 0.0, 0.1),
}
PARAMETERS: Mapping[str, Parameter] = {
    EV_POS.noise: Parameter("m", 0.1, 0.01, 1e3),
    EV_POS.noise_mode: Parameter("", 0.0, 0.0, 1.0),
    EV_POS.gate: Parameter("SD", 5.0, 1.0, 1e3),
    EV_POS.delay: Parameter("ms", 0.0, 0.0, 300.0),
    GNSS_POS.noise: Parameter("m", 0.5, 0.01, 10.0),
    GNSS_POS.gate: Parameter("SD", 5.0, 1.0, 1e3),
    GNSS_POS.delay: Parameter("ms", 110.0, 0.0, 300.0),
    GNSS_VEL.noise: Parameter("m/s", 0.3, 0.01, 5.0),
    GNSS_VEL.gate: Parameter("SD", 5.0, 1.0, 1e3),
    MAG.noise: Parameter("gauss", 0.05, 0.001, 1.0),
    MAG.gate: Parameter("SD", 3.0, 1.0, 1e3),
    **FIELD_NOISES,
    BAROMETER.noise: Parameter("m", 3.5, 0.01, 15.0),
    BAROMETER.gate: Parameter("SD", BAROMETER.default_gate, 1.0, 1e3),
    "EKF2_DELAY_MAX": Parameter("ms", 200.0, 0.0, 1e3),
    **dict.fromkeys((*EV_POS.place, *GNSS_POS.place), Parameter("m", 0.0, -math.inf, math.inf)),
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
    GNSS_POS.noise, GNSS_POS.gate, GNSS_POS.delay, GNSS_MODE, *RECEIVER_DELAYS,
    "SDLOG_PROFILE", "SYS_AUTOSTART", "SYS_MC_EST_GROUP",
)  # fmt: skip


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
    used = {one.switch for one in (aid, *others)}
    of_others = {
        name
        for other in (EV_POS, GNSS_POS, GNSS_VEL, MAG, BAROMETER)
        if other.switch not in used
        for name in (*other.own, *other.place, *(FIELD_NOISES if other == MAG else ()))
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
                f"{did_you_mean(name, PARAMETERS)}It knows {', '.join(PARAMETERS)}.",
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
