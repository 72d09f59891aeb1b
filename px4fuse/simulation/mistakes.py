"""The mistakes that a simulated flight can have, as a table of data.

Values are typed with their unit (``0.08``, ``80ms``, ``5%``, ``8s,40s``) or left out, which gives a
clear case.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from px4fuse.errors import SettingsError, did_you_mean
from px4fuse.simulation.scenario import KINDS, Kind, number, quantities
from px4fuse.units import NAMES, in_unit


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

    clock_offset_s: float = number(0.0, -5.0, 5.0, "s", "SECONDS")
    clock_drift_ppm: float = number(0.0, -20_000.0, 20_000.0, "ppm", "PPM")
    clock_jump_s: float = number(0.0, 0.0, 5.0, "s", "SECONDS")
    nlos_percent: float = number(0.0, 0.0, 50.0, "%", "PERCENT")
    nlos_size_m: float = number(2.0, 0.0, 100.0, "m", "SIZE")
    dropout_s: float = number(0.0, 0.0, 600.0, "s", "SECONDS")
    dropout_at_s: float | None = number(None, 0.0, 1e4, "s", "AT")
    imu_dropout_s: float = number(0.0, 0.0, 600.0, "s", "SECONDS")
    imu_dropout_at_s: float | None = number(None, 0.0, 1e4, "s", "AT")
    decimate_hz: float = number(0.0, 0.1, 100.0, "Hz", "HZ")
    r_scale: float = number(1.0, 1e-4, 1e4, "", "FACTOR")
    yaw_deg: float = number(0.0, -180.0, 180.0, "°", "DEG")
    scale_percent: float = number(0.0, -50.0, 50.0, "%", "PERCENT")
    jump_m: float = number(0.0, -100.0, 100.0, "m", "METRES")
    jump_at_s: float | None = number(None, 0.0, 1e4, "s", "AT")
    smoothed_s: float = number(0.0, 0.0, 10.0, "s", "SECONDS")
    slow_error_m: float = number(0.0, 0.0, 100.0, "m", "METRES")
    slow_error_s: float = number(30.0, 0.1, 1e4, "s", "TIME")
    heading_deg: float = number(0.0, -180.0, 180.0, "°", "DEG")
    heading_at_s: float | None = number(None, 0.0, 1e4, "s", "AT")
    mag_gauss: float = number(0.0, -1.0, 1.0, "gauss", "GAUSS")
    mag_at_s: float | None = number(None, 0.0, 1e4, "s", "AT")
    accel_bias_m_s2: float = number(0.0, -5.0, 5.0, "m/s²", "M/S2")
    vibration_m_s2: float = number(0.0, 0.0, 20.0, "m/s²", "M/S2")
    imu_rate_hz: float = number(0.0, 1.0, 1000.0, "Hz", "HZ")
    no_motion: bool = False
    open_end_m: float = number(0.0, 0.0, 100.0, "m", "METRES")
    no_vvo: bool = False
    ekf2_noise_m: float = number(0.0, 0.01, 100.0, "m", "METRES")
    ekf2_delay_s: float | None = number(None, 0.0, 0.3, "s", "SECONDS")
    ekf2_gate: float = number(5.0, 1.0, 1000.0, "", "SD")
    ekf2_off: bool = False


QUANTITIES = quantities(Mistakes)
# How a unit is written by who types a mistake
_ASCII = {"°": "deg", "m/s²": "m/s2"}


@dataclass(frozen=True)
class Mistake:
    """One row of the table.

    Attributes
    ----------
    fields : tuple of str
        Of :class:`Mistakes`: the first makes it, the others may be left out.
    usual : float or True
        Size where none is given; True of a switch.
    help : str
        What is wrong with the log, for instructors.
    finding : str
        What a student should find.
    kinds : tuple of str
        The kinds of flight that it applies to.
    of_ekf2 : bool
        Whether it is in EKF2's own parameters.
    """

    fields: tuple[str, ...]
    usual: float | Literal[True]
    help: str
    finding: str
    kinds: tuple[Kind, ...] = KINDS
    of_ekf2: bool = False

    @property
    def sizes(self) -> tuple[str, ...]:
        """Its fields that are numbers."""
        return () if self.usual is True else self.fields

    @property
    def usage(self) -> str:
        """What may follow its name, as in ``=PERCENT[,SIZE]``."""
        first, *rest = [f"={QUANTITIES[name].typed}" for name in self.sizes] or [""]
        return first + "".join(f"[,{name[1:]}]" for name in rest)


# Of a source in a frame and with a clock of its own, which the log may lack
INDOORS: tuple[Kind, ...] = ("aisle", "loop")


MISTAKES: Mapping[str, Mistake] = MappingProxyType({
    "clock-offset": Mistake(
        ("clock_offset_s",), 0.25,
        "Position stamps are late by this (negative: early).",
        "NIS hardly shows it; the clock offset to add is minus this, and innovations correlate "
        "with the acceleration.",
    ),
    "clock-drift": Mistake(
        ("clock_drift_ppm",), 2000.0,
        "The clock of the positions runs fast by this many parts per million.",
        "The clock offset grows through the flight: the two halves give different offsets.",
        kinds=INDOORS,
    ),
    "clock-jump": Mistake(
        ("clock_jump_s",), 0.25,
        "Until TIMESYNC converges at 50 s, stamps are times of arrival, late by this.",
        "timestamp equals timestamp_sample for 50 s and not after; analyse the rest (--start 50).",
        kinds=INDOORS,
    ),
    "nlos": Mistake(
        ("nlos_percent", "nlos_size_m"), 5.0,
        "This share of the positions is off by about SIZE (2 m), in bursts: no line of sight.",
        "Innovations outside the gate while the bulk fits: remove outliers, leave SIGMA_Z.",
    ),
    "dropout": Mistake(
        ("dropout_s", "dropout_at_s"), 8.0,
        "The position source is silent that long, from AT seconds on (the middle).",
        "A gap of the source: σ_p grows until the next update.",
    ),
    "imu-dropout": Mistake(
        ("imu_dropout_s", "imu_dropout_at_s"), 2.0,
        "The IMU is missing that long, from AT seconds on (the middle).",
        "A gap of the IMU: the filter must raise Q there or it diverges.",
    ),
    "decimate": Mistake(
        ("decimate_hz",), 2.0,
        "The position source is thinned to this rate.",
        "Below 5 Hz EKF2 would not fuse it; σ grows longer between updates.",
    ),
    "r-scale": Mistake(
        ("r_scale",), 0.1,
        "The reported variance and EKF2's noise² for the source are this factor times the truth.",
        "The data ask for the true SIGMA_Z, not for the reported one: below 1 trusts the source "
        "too much.",
    ),
    "yaw": Mistake(
        ("yaw_deg",), 20.0,
        "The position frame is turned against north, clockwise.",
        "Innovations grow at every start and stop; the track's heading is off by this.",
        kinds=INDOORS,
    ),
    "scale": Mistake(
        ("scale_percent",), 5.0,
        "Distances of the position source are too long: anchors surveyed wrongly.",
        "NIS hardly shows it; a tape measure or the truth does.",
        kinds=INDOORS,
    ),
    "jump": Mistake(
        ("jump_m", "jump_at_s"), 1.0,
        "Positions jump by this along the first leg at AT (two thirds) and stay: a false match.",
        "One burst of innovations of the same sign; around a loop a closure error that is no "
        "drift.",
    ),
    "smoothed": Mistake(
        ("smoothed_s",), 0.5,
        "The positioning system low-pass filters its positions with this time constant.",
        "Innovations are correlated, and positions look late by this without a clock error.",
    ),
    "slow-error": Mistake(
        ("slow_error_m", "slow_error_s"), 0.5,
        "A further error of the positions changes slowly, over about TIME (30 s): multipath.",
        "Innovations hardly show it, and both filters claim less than they err: R describes "
        "independent errors only.",
    ),
    "heading": Mistake(
        ("heading_deg", "heading_at_s"), 20.0,
        "EKF2's heading is too large by this, from AT on (the start): a disturbed compass, and "
        "outdoors an EKF2 that takes the heading from it as it is (EKF2_MAG_TYPE 1).",
        "Innovations grow at every start, stop and corner; the positions are turned against the "
        "attitude.",
    ),
    "mag": Mistake(
        ("mag_gauss", "mag_at_s"), 0.2,
        "A current beside the magnetometer adds this to its right axis from AT on (the middle).",
        "The magnetometer's innovations change then, and EKF2's heading with them; away from "
        "cables, or calibrate it with the motors running.",
        kinds=("outdoor",),
    ),
    "accel-bias": Mistake(
        ("accel_bias_m_s2",), 0.5,
        "The accelerometer's forward axis reads too much by this.",
        "Innovations have a mean along the nose: calibrate the accelerometer.",
    ),
    "vibration": Mistake(
        ("vibration_m_s2",), 1.5,
        "The accelerometer is this much noisier (mean over 0.1 s): propellers out of balance.",
        "The data ask for a larger SIGMA_A.",
    ),
    "imu-rate": Mistake(
        ("imu_rate_hz",), 20.0,
        "The IMU is logged at this rate only, without averaging.",
        "Logging rate too low: motion between samples is lost, noise is folded in.",
    ),
    "no-motion": Mistake(
        ("no_motion",), True,
        "The vehicle hovers where it took off.",
        "Nothing about velocity, heading and clock can be identified.",
    ),
    "open-end": Mistake(
        ("open_end_m",), 3.0,
        "The loop ends this far before its start (loop only).",
        "A false loop closure: forcing the end onto the start bends the whole path.",
        kinds=("loop",),
    ),
    "no-vvo": Mistake(
        ("no_vvo",), True,
        "vehicle_visual_odometry is not logged, as with SDLOG_PROFILE 1.",
        "The position source is not in the log, and what EKF2 kept of it stands in, thinned: set "
        "SDLOG_PROFILE to 129.",
        kinds=INDOORS,
    ),
    "ekf2-noise": Mistake(
        ("ekf2_noise_m",), 0.02,
        "EKF2_EVP_NOISE is this (outdoors EKF2_GPS_P_NOISE, which matters above 0.4 m).",
        "Below the source's noise EKF2's NIS is far above 1 and it rejects good samples; above it "
        "NIS is far below 1.",
        of_ekf2=True,
    ),
    "ekf2-delay": Mistake(
        ("ekf2_delay_s",), 0.175,
        "EKF2_EV_DELAY is this, while the stamps are right (outdoors EKF2_GPS_DELAY, where fixes "
        "are 110 ms old).",
        "EKF2 takes positions for older than they are, so that its track runs ahead of the truth; "
        "set EKF2_EV_DELAY to 0 (EKF2_GPS_DELAY to 110).",
        of_ekf2=True,
    ),
    "ekf2-gate": Mistake(
        ("ekf2_gate",), 1.0,
        "EKF2_EVP_GATE (EKF2_GPS_P_GATE) is this: samples further off than so many √S are "
        "rejected.",
        "EKF2 rejects good samples, loses its track and resets to a sample now and then.",
        of_ekf2=True,
    ),
    "ekf2-off": Mistake(
        ("ekf2_off",), True,
        "EKF2_EV_CTRL (EKF2_GPS_CTRL) is 0.",
        "EKF2 never fuses the positions and does not know where it is; set EKF2_EV_CTRL to 1 "
        "(EKF2_GPS_CTRL to 5).",
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
    changed: dict[str, float] = {}
    for text in texts:
        name, equals, values = text.strip().partition("=")
        if name not in MISTAKES:
            raise SettingsError(
                f"--mistake {text}: not a known mistake",
                f"{did_you_mean(name, MISTAKES)}Choose from {', '.join(MISTAKES)}.",
            )
        mistake = MISTAKES[name]
        given = values.split(",") if equals else []
        if len(given) > len(mistake.sizes):
            raise SettingsError(f"--mistake {text}: give {name}{mistake.usage}.")
        changed[mistake.fields[0]] = mistake.usual
        for field, value in zip(mistake.sizes, given, strict=False):
            taken, size = QUANTITIES[field], in_unit(value, QUANTITIES[field].unit)
            if size is None:
                wanted = f"{NAMES[taken.unit]}, as in {name}{mistake.usage}"
                raise SettingsError(f"--mistake {text}: {value!r}: give {wanted}.")
            taken.check(size, f"--mistake {text}: {taken.typed}")
            changed[field] = size
    return Mistakes(**changed)  # type: ignore[arg-type]


def made(mistakes: Mistakes) -> tuple[str, ...]:
    """Names of the mistakes that these are."""
    clean = Mistakes()
    return tuple(
        name
        for name, mistake in MISTAKES.items()
        if getattr(mistakes, mistake.fields[0]) != getattr(clean, mistake.fields[0])
    )


def as_typed(name: str, mistakes: Mistakes) -> str:
    """One mistake as :func:`parse` takes it, with its values.

    >>> as_typed("nlos", parse(["nlos=5"]))
    'nlos=5%,2m'
    """
    given = ((getattr(mistakes, one), QUANTITIES[one].unit) for one in MISTAKES[name].sizes)
    values = [f"{value:g}{_ASCII.get(unit, unit)}" for value, unit in given if value is not None]
    return f"{name}={','.join(values)}" if values else name
