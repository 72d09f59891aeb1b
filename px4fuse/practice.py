"""Flights with hidden mistakes to practise on, as one page: look, prove it by a knob, choose, see.

For practice, not an exam: the answers are in the page, packed so that nobody reads them by chance.
"""

import base64
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.analysis import run
from px4fuse.explore.data import flight_data
from px4fuse.explore.packing import Packer
from px4fuse.explore.page import data_scripts, page_text
from px4fuse.findings import Finding, find
from px4fuse.findings.story import story
from px4fuse.record import Record, table
from px4fuse.request import ComparisonRequest
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

# Of two mistakes: that of the motion and one of single samples; a noise would hide another
BOTH_SEEN = ({"clock", "source"}, {"clock", "gate"}, {"frame", "source"}, {"frame", "gate"})
HARDEST = 3
MOST_SEED = 2**32 - 1
SIGMA_A_M_S2, SIGMA_Z_M = 0.10, 0.10
# Short of a minute, with two turns. A quiet IMU, which SIGMA_A fits: else its own errors would look
# like those of clock and frame
FLOWN: dict[str, Any] = {
    "passes": 3,
    "speed_m_s": 1.5,
    "sigma_a_m_s2": 0.05,
    "accel_bias_sigma_m_s2": 0.005,
    "gyro_bias_sigma_rad_s": 0.0002,
    "tilt_error_deg": 0.02,
    "yaw_error_deg": 0.2,
}
LENGTH_M = (8.0, 12.0)
# Of a mistake that has its moment, the finding that says when
MOMENTS = {"nlos": "source_outliers", "jump": "source_jumps", "dropout": "source_gap"}
NOISY_UWB = "noisy-uwb"  # not a mistake of the log: the filter's SIGMA_Z does not fit


class Trick(Record, frozen=True):
    """A mistake that may be hidden in a flight.

    Attributes
    ----------
    choice : str
        What it has to be called.
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`, or :data:`NOISY_UWB`.
    sizes : tuple of str
        As typed, for each level.
    view : str
        What of the page shows it.
    what : str
        What was done to the flight, with its size.
    tell_tale : str
        How it shows, and which knob proves it.
    either_sign : bool
    """

    choice: str
    mistake: str
    sizes: tuple[str, str, str]
    view: str
    what: str
    tell_tale: str
    either_sign: bool = False


class Tricks(Record, frozen=True):
    """What may be chosen, with what it stands for, and what may be hidden."""

    choices: dict[str, str]
    tricks: tuple[Trick, ...]


_TABLES = table(__file__, "practice.toml", Tricks)
CHOICES, TRICKS = _TABLES.choices, _TABLES.tricks


@dataclass(frozen=True)
class Round:
    """One flight of a set.

    Attributes
    ----------
    scenario : Scenario
    tricks : tuple of Trick
        None, one or two, of different choices.
    typed : tuple of str
        Their sizes, in the same order.
    """

    scenario: Scenario
    tricks: tuple[Trick, ...]
    typed: tuple[str, ...]

    @property
    def right(self) -> list[str]:
        """What has to be chosen."""
        return sorted({trick.choice for trick in self.tricks}) or ["nothing"]


def draw(seed: int, level: int = 1, count: int = 10) -> tuple[Round, ...]:
    """Draw the flights of a set: every choice in turn, in an order by chance.

    Parameters
    ----------
    seed : int
        The same seed, level and count give the same set.
    level : {1, 2, 3}
        1: one mistake, large; 2: smaller; 3: small, and two of them in every second flight.
    count : int
    """
    rng = np.random.default_rng([seed, level, count])
    names: list[str] = []
    while len(names) < count:
        names += [str(name) for name in rng.permutation(list(CHOICES))]
    return tuple(_round(rng, name, level) for name in names[:count])


def _round(rng: np.random.Generator, choice: str, level: int) -> Round:
    tricks = [one for one in TRICKS if one.choice == choice]
    tricks = [tricks[rng.integers(len(tricks))]] if tricks else []
    if level == HARDEST and tricks and rng.random() < 0.5:
        others = [one for one in TRICKS if {one.choice, choice} in BOTH_SEEN]
        tricks += [others[rng.integers(len(others))]] if others else []
    typed = []
    for trick in tricks:
        minus = "-" if trick.either_sign and rng.random() < 0.5 else ""
        typed.append(f"{minus}{trick.sizes[level - 1]}")
    noisy = next(
        (float(t) for one, t in zip(tricks, typed, strict=True) if one.mistake == NOISY_UWB),
        SIGMA_Z_M,
    )
    scenario = Scenario(
        **FLOWN,
        length_m=round(float(rng.uniform(*LENGTH_M)), 1),
        heading_deg=round(float(rng.uniform(0.0, 359.0)), 0),
        sigma_uwb_m=noisy,
        seed=int(rng.integers(MOST_SEED)),
    )
    return Round(scenario, tuple(tricks), tuple(typed))


def practice_text(
    seed: int,
    level: int = 1,
    count: int = 10,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> str:
    """Simulate a set of flights and lay out the page that asks about them.

    Parameters
    ----------
    seed, level, count : int
        See :func:`draw`.
    progress : callable
        Told what is being done, how many flights are done, and of how many.

    Returns
    -------
    str
        One page that needs no network; write it as UTF-8.
    """
    rounds, scripts = draw(seed, level, count), []
    data: dict[str, Any] = {}
    for number, one in enumerate(rounds):
        progress(f"flight {number + 1}", number, count)
        data, script = _flown(one, number)
        scripts.append(script)
    return page_text(
        "\n".join(scripts),
        data,
        command="practice",
        heading="What is wrong with this flight?",
        title=f"seed {seed}, level {level}",
        rounds=count,
        choices=CHOICES,
    )


def _flown(one: Round, number: int) -> tuple[dict[str, Any], str]:
    """One flight's data without what gives it away, and its elements with the packed answer."""
    mistakes = [
        f"{trick.mistake}={size}"
        for trick, size in zip(one.tricks, one.typed, strict=True)
        if trick.mistake != NOISY_UWB
    ]
    simulation = flights.simulate(one.scenario, parse(mistakes))
    flight = flights.to_flight(simulation, f"flight {number + 1}")
    request = ComparisonRequest(log=flight.log.name, sigma_a_m_s2=SIGMA_A_M_S2, sigma_z_m=SIGMA_Z_M)
    analysis = run(request, flight=flight)
    findings, packer = find(analysis), Packer()
    data = flight_data(analysis, packer)
    key = {
        "right": one.right,
        "made": [
            _made(trick, size, findings) for trick, size in zip(one.tricks, one.typed, strict=True)
        ],
        "story": list(story(analysis, findings)),
        "findings": data["findings"],
    }
    data |= {"story": [], "findings": []}
    packed = base64.b64encode(zlib.compress(json.dumps(key).encode())).decode()
    scripts = data_scripts(data, analysis, packer, f"-{number}")
    return data, f'{scripts}\n<script type="text/plain" id="key-{number}">{packed}</script>'


def _made(trick: Trick, size: str, findings: tuple[Finding, ...]) -> dict[str, Any]:
    """What was done to the flight, in words, and where and when it shows."""
    what = trick.what.format(size=size)
    moments = [one.spans_s[0] for one in findings if one.id == MOMENTS.get(trick.mistake)]
    return {
        "choice": trick.choice,
        "what": what,
        "tell": trick.tell_tale,
        "view": trick.view,
        "span": list(moments[0]) if moments else None,
    }
