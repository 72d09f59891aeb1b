"""The mistakes that a simulated flight can have; ``mistakes.toml`` has a row for each.

Values are typed with their unit (``0.08``, ``80ms``, ``5%``, ``8s,40s``) or left out, which gives a
clear case.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from px4fuse.errors import SettingsError, suggest_name
from px4fuse.record import table
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
    usual: float | bool
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


MISTAKES: Mapping[str, Mistake] = table(__file__, "mistakes.toml", dict[str, Mistake])


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
    value_by_field: dict[str, float] = {}
    for text in texts:
        name, equals, values = text.strip().partition("=")
        if name not in MISTAKES:
            raise SettingsError(
                f"--mistake {text}: not a known mistake",
                f"{suggest_name(name, MISTAKES)}Choose from {', '.join(MISTAKES)}.",
            )
        mistake = MISTAKES[name]
        typed_values = values.split(",") if equals else []
        if len(typed_values) > len(mistake.sizes):
            raise SettingsError(f"--mistake {text}: give {name}{mistake.usage}.")
        value_by_field[mistake.fields[0]] = mistake.usual
        for field, value in zip(mistake.sizes, typed_values, strict=False):
            bounds, size = QUANTITIES[field], in_unit(value, QUANTITIES[field].unit)
            if size is None:
                wanted = f"{NAMES[bounds.unit]}, as in {name}{mistake.usage}"
                raise SettingsError(f"--mistake {text}: {value!r}: give {wanted}.")
            bounds.check(size, f"--mistake {text}: {bounds.typed}")
            value_by_field[field] = size
    return Mistakes(**value_by_field)  # type: ignore[arg-type]


def active_mistakes(mistakes: Mistakes) -> tuple[str, ...]:
    """Names of the mistakes that these are."""
    clean = Mistakes()
    return tuple(
        name
        for name, mistake in MISTAKES.items()
        if getattr(mistakes, mistake.fields[0]) != getattr(clean, mistake.fields[0])
    )


def format_mistake(name: str, mistakes: Mistakes) -> str:
    """One mistake as :func:`parse` takes it, with its values.

    >>> format_mistake("nlos", parse(["nlos=5"]))
    'nlos=5%,2m'
    """
    sizes_with_units = (
        (getattr(mistakes, one), QUANTITIES[one].unit) for one in MISTAKES[name].sizes
    )
    values = [
        f"{value:g}{_ASCII.get(unit, unit)}"
        for value, unit in sizes_with_units
        if value is not None
    ]
    return f"{name}={','.join(values)}" if values else name
