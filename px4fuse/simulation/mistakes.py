"""The mistakes that a simulated flight can have, as a table of data.

Values are typed with their unit (``0.08``, ``80ms``, ``5%``, ``8s,40s``) or left out, which gives a
clear case.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from px4fuse.errors import SettingsError, did_you_mean
from px4fuse.simulation.scenario import KINDS, Kind

_Units = Mapping[str, float]
SECONDS: _Units = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6}
METRES: _Units = {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3}
PERCENT: _Units = {"": 1.0, "%": 1.0}
HERTZ: _Units = {"": 1.0, "Hz": 1.0}
DEGREES: _Units = {"": 1.0, "deg": 1.0, "°": 1.0}
ACCELERATION: _Units = {"": 1.0, "m/s2": 1.0, "m/s²": 1.0}
PPM: _Units = {"": 1.0, "ppm": 1.0}
NUMBER: _Units = {"": 1.0}
_VALUE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D.*)?")


@dataclass(frozen=True)
class Mistakes:
    """What goes wrong; the defaults are a flight without mistakes.

    :data:`MISTAKES` says what each is. Besides: outliers come in bursts, each in one horizontal
    direction, and ``nlos_size_m`` is their mean size. A drop-out without a time lies around the
    middle, a jump at two thirds; a wrong heading is wrong from the start. A rate of 0 leaves the
    rate as it is, an EKF2 noise of 0 what the source reports, an EKF2 delay of None the right one.
    ``r_scale`` is a factor on the variance. A yaw is about the start, clockwise seen from above.
    ``vibration_m_s2`` is the standard deviation of the noise's mean over 0.1 s.
    """

    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0
    clock_jump_s: float = 0.0
    nlos_percent: float = 0.0
    nlos_size_m: float = 2.0
    dropout_s: float = 0.0
    dropout_at_s: float | None = None
    imu_dropout_s: float = 0.0
    imu_dropout_at_s: float | None = None
    decimate_hz: float = 0.0
    r_scale: float = 1.0
    yaw_deg: float = 0.0
    scale_percent: float = 0.0
    jump_m: float = 0.0
    jump_at_s: float | None = None
    smoothed_s: float = 0.0
    slow_error_m: float = 0.0
    slow_error_s: float = 30.0
    heading_deg: float = 0.0
    heading_at_s: float | None = None
    accel_bias_m_s2: float = 0.0
    vibration_m_s2: float = 0.0
    imu_rate_hz: float = 0.0
    no_motion: bool = False
    open_end_m: float = 0.0
    no_vvo: bool = False
    ekf2_noise_m: float = 0.0
    ekf2_delay_s: float | None = None
    ekf2_gate: float = 5.0
    ekf2_off: bool = False


@dataclass(frozen=True)
class Argument:
    """One value of a mistake: the field of :class:`Mistakes`, what to type, unit and range."""

    field: str
    metavar: str
    units: _Units
    low: float
    high: float


@dataclass(frozen=True)
class Mistake:
    """One row of the table.

    Attributes
    ----------
    arguments : tuple of Argument
        The first is the mistake's size, the others may be left out; empty for a switch.
    default : float
        Size where none is given.
    help : str
        What is wrong with the log, for instructors.
    finding : str
        What a student should find.
    switch : str
        The field that a mistake without arguments sets.
    kinds : tuple of str
        The kinds of flight that it applies to.
    of_ekf2 : bool
        Whether it is in EKF2's own parameters.
    """

    arguments: tuple[Argument, ...]
    default: float
    help: str
    finding: str
    switch: str = ""
    kinds: tuple[Kind, ...] = KINDS
    of_ekf2: bool = False

    @property
    def usage(self) -> str:
        """What may follow its name, as in ``=PERCENT[,SIZE]``."""
        if not self.arguments:
            return ""
        first, *rest = [argument.metavar for argument in self.arguments]
        return f"={first}" + "".join(f"[,{name}]" for name in rest)


def _at(name: str) -> Argument:
    return Argument(name, "AT", SECONDS, 0.0, 1e4)


# Of a source in a frame and with a clock of its own, which the log may lack
INDOORS: tuple[Kind, ...] = ("aisle", "loop")


MISTAKES: Mapping[str, Mistake] = MappingProxyType({
    "clock-offset": Mistake(
        (Argument("clock_offset_s", "SECONDS", SECONDS, -5.0, 5.0),),
        0.25,
        "Position stamps are late by this (negative: early).",
        "NIS hardly shows it; the clock offset to add is minus this, and innovations correlate "
        "with the acceleration.",
    ),
    "clock-drift": Mistake(
        (Argument("clock_drift_ppm", "PPM", PPM, -20_000.0, 20_000.0),),
        2000.0,
        "The clock of the positions runs fast by this many parts per million.",
        "The clock offset grows through the flight: the two halves give different offsets.",
        kinds=INDOORS,
    ),
    "clock-jump": Mistake(
        (Argument("clock_jump_s", "SECONDS", SECONDS, 0.0, 5.0),),
        0.25,
        "Until TIMESYNC converges at 50 s, stamps are times of arrival, late by this.",
        "timestamp equals timestamp_sample for 50 s and not after; analyse the rest (--start 50).",
        kinds=INDOORS,
    ),
    "nlos": Mistake(
        (
            Argument("nlos_percent", "PERCENT", PERCENT, 0.0, 50.0),
            Argument("nlos_size_m", "SIZE", METRES, 0.0, 100.0),
        ),
        5.0,
        "This share of the positions is off by about SIZE (2 m), in bursts: no line of sight.",
        "Innovations outside the gate while the bulk fits: remove outliers, leave SIGMA_Z.",
    ),
    "dropout": Mistake(
        (Argument("dropout_s", "SECONDS", SECONDS, 0.0, 600.0), _at("dropout_at_s")),
        8.0,
        "The position source is silent that long, from AT seconds on (the middle).",
        "A gap of the source: σ_p grows until the next update.",
    ),
    "imu-dropout": Mistake(
        (Argument("imu_dropout_s", "SECONDS", SECONDS, 0.0, 600.0), _at("imu_dropout_at_s")),
        2.0,
        "The IMU is missing that long, from AT seconds on (the middle).",
        "A gap of the IMU: the filter must raise Q there or it diverges.",
    ),
    "decimate": Mistake(
        (Argument("decimate_hz", "HZ", HERTZ, 0.1, 100.0),),
        2.0,
        "The position source is thinned to this rate.",
        "Below 5 Hz EKF2 would not fuse it; σ grows longer between updates.",
    ),
    "r-scale": Mistake(
        (Argument("r_scale", "FACTOR", NUMBER, 1e-4, 1e4),),
        0.1,
        "The reported variance and EKF2's noise² for the source are this factor times the truth.",
        "The data ask for the true SIGMA_Z, not for the reported one: below 1 trusts the source "
        "too much.",
    ),
    "yaw": Mistake(
        (Argument("yaw_deg", "DEG", DEGREES, -180.0, 180.0),),
        20.0,
        "The position frame is turned against north, clockwise.",
        "Innovations grow at every start and stop; the track's heading is off by this.",
        kinds=INDOORS,
    ),
    "scale": Mistake(
        (Argument("scale_percent", "PERCENT", PERCENT, -50.0, 50.0),),
        5.0,
        "Distances of the position source are too long: anchors surveyed wrongly.",
        "NIS hardly shows it; a tape measure or the truth does.",
        kinds=INDOORS,
    ),
    "jump": Mistake(
        (Argument("jump_m", "METRES", METRES, -100.0, 100.0), _at("jump_at_s")),
        1.0,
        "Positions jump by this along the first leg at AT (two thirds) and stay: a false match.",
        "One burst of innovations of the same sign; around a loop a closure error that is no "
        "drift.",
    ),
    "smoothed": Mistake(
        (Argument("smoothed_s", "SECONDS", SECONDS, 0.0, 10.0),),
        0.5,
        "The positioning system low-pass filters its positions with this time constant.",
        "Innovations are correlated, and positions look late by this without a clock error.",
    ),
    "slow-error": Mistake(
        (
            Argument("slow_error_m", "METRES", METRES, 0.0, 100.0),
            Argument("slow_error_s", "TIME", SECONDS, 0.1, 1e4),
        ),
        0.5,
        "A further error of the positions changes slowly, over about TIME (30 s): multipath.",
        "Innovations hardly show it, and both filters claim less than they err: R describes "
        "independent errors only.",
    ),
    "heading": Mistake(
        (Argument("heading_deg", "DEG", DEGREES, -180.0, 180.0), _at("heading_at_s")),
        20.0,
        "EKF2's heading is too large by this, from AT on (the start): a disturbed compass.",
        "Innovations grow at every start, stop and corner; the positions are turned against the "
        "attitude.",
    ),
    "accel-bias": Mistake(
        (Argument("accel_bias_m_s2", "M/S2", ACCELERATION, -5.0, 5.0),),
        0.5,
        "The accelerometer's forward axis reads too much by this.",
        "Innovations have a mean along the nose: calibrate the accelerometer.",
    ),
    "vibration": Mistake(
        (Argument("vibration_m_s2", "M/S2", ACCELERATION, 0.0, 20.0),),
        1.5,
        "The accelerometer is this much noisier (mean over 0.1 s): propellers out of balance.",
        "The data ask for a larger SIGMA_A.",
    ),
    "imu-rate": Mistake(
        (Argument("imu_rate_hz", "HZ", HERTZ, 1.0, 1000.0),),
        20.0,
        "The IMU is logged at this rate only, without averaging.",
        "Logging rate too low: motion between samples is lost, noise is folded in.",
    ),
    "no-motion": Mistake(
        (),
        0.0,
        "The vehicle hovers where it took off.",
        "Nothing about velocity, heading and clock can be identified.",
        switch="no_motion",
    ),
    "open-end": Mistake(
        (Argument("open_end_m", "METRES", METRES, 0.0, 100.0),),
        3.0,
        "The loop ends this far before its start (loop only).",
        "A false loop closure: forcing the end onto the start bends the whole path.",
        kinds=("loop",),
    ),
    "no-vvo": Mistake(
        (),
        0.0,
        "vehicle_visual_odometry is not logged, as with SDLOG_PROFILE 1.",
        "The position source is not in the log, and what EKF2 kept of it stands in, thinned: set "
        "SDLOG_PROFILE to 129.",
        switch="no_vvo",
        kinds=INDOORS,
    ),
    "ekf2-noise": Mistake(
        (Argument("ekf2_noise_m", "METRES", METRES, 0.01, 100.0),),
        0.02,
        "EKF2_EVP_NOISE (outdoors EKF2_GPS_P_NOISE) is this.",
        "Below the source's noise EKF2's NIS is far above 1 and it rejects good samples; above it "
        "NIS is far below 1.",
        of_ekf2=True,
    ),
    "ekf2-delay": Mistake(
        (Argument("ekf2_delay_s", "SECONDS", SECONDS, 0.0, 0.3),),
        0.175,
        "EKF2_EV_DELAY is this, while the stamps are right (outdoors EKF2_GPS_DELAY, where fixes "
        "are 110 ms old).",
        "EKF2 takes positions for older than they are, so that its track runs ahead of the truth; "
        "set EKF2_EV_DELAY to 0 (EKF2_GPS_DELAY to 110).",
        of_ekf2=True,
    ),
    "ekf2-gate": Mistake(
        (Argument("ekf2_gate", "SD", NUMBER, 1.0, 1000.0),),
        1.0,
        "EKF2_EVP_GATE (EKF2_GPS_P_GATE) is this: samples further off than so many √S are "
        "rejected.",
        "EKF2 rejects good samples, loses its track and resets to a sample now and then.",
        of_ekf2=True,
    ),
    "ekf2-off": Mistake(
        (),
        0.0,
        "EKF2_EV_CTRL (EKF2_GPS_CTRL) is 0.",
        "EKF2 never fuses the positions and does not know where it is; set EKF2_EV_CTRL to 1 "
        "(EKF2_GPS_CTRL to 5).",
        switch="ekf2_off",
        of_ekf2=True,
    ),
})  # fmt: skip


def parse(texts: Iterable[str]) -> Mistakes:
    """Parse mistakes as typed.

    >>> parse(["clock-offset=80ms", "nlos=5%,3m"]).clock_offset_s
    0.08

    Parameters
    ----------
    texts : iterable of str
        ``NAME``, ``NAME=VALUE`` or ``NAME=VALUE,VALUE``; of one that stands twice the last counts.

    Raises
    ------
    SettingsError
        Unknown name, or a value that is not a number, has an unknown unit or is out of range.
    """
    fields: dict[str, float | bool] = {}
    for text in texts:
        name, equals, values = text.strip().partition("=")
        if name not in MISTAKES:
            raise SettingsError(
                f"--mistake {text}: not a known mistake",
                f"{did_you_mean(name, MISTAKES)}Choose from {', '.join(MISTAKES)}.",
            )
        mistake = MISTAKES[name]
        given = values.split(",") if equals else []
        if len(given) > len(mistake.arguments):
            raise SettingsError(f"--mistake {text}: give {name}{mistake.usage}.")
        if mistake.switch:
            fields[mistake.switch] = True
        elif not given:
            fields[mistake.arguments[0].field] = mistake.default
        for argument, value in zip(mistake.arguments, given, strict=False):
            fields[argument.field] = _number(text, name, argument, value)
    return Mistakes(**fields)  # type: ignore[arg-type]


def _number(text: str, name: str, argument: Argument, value: str) -> float:
    match = _VALUE.fullmatch(value.strip())
    units = [unit for unit in argument.units if unit]
    if match is None or (match[2] or "") not in argument.units:
        wanted = f" in {', '.join(units)}" if units else ""
        raise SettingsError(
            f"--mistake {text}: {value!r} is not a number{wanted}; "
            f"give {name}{MISTAKES[name].usage}."
        )
    number = float(match[1]) * argument.units[match[2] or ""]
    if not (math.isfinite(number) and argument.low <= number <= argument.high):
        unit = f" {units[0]}" if units else ""
        raise SettingsError(
            f"--mistake {text}: {argument.metavar} {number:g} is out of range: "
            f"give {argument.low:g} to {argument.high:g}{unit}."
        )
    return number


def made(mistakes: Mistakes) -> tuple[str, ...]:
    """Names of the mistakes that these are."""
    clean = Mistakes()
    return tuple(
        name
        for name, mistake in MISTAKES.items()
        if any(
            getattr(mistakes, key) != getattr(clean, key)
            for key in ([a.field for a in mistake.arguments[:1]] or [mistake.switch])
        )
    )


def as_typed(name: str, mistakes: Mistakes) -> str:
    """One mistake as :func:`parse` takes it, with its values.

    >>> as_typed("nlos", parse(["nlos=5"]))
    'nlos=5%,2m'
    """
    values = []
    for argument in MISTAKES[name].arguments:
        value = getattr(mistakes, argument.field)
        unit = next((unit for unit in argument.units if unit), "")
        values += [] if value is None else [f"{value:g}{unit}"]
    return f"{name}={','.join(values)}" if values else name
