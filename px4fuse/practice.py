"""Practice page: simulated flights with hidden mistakes that the student identifies.

It is not an exam: the page contains the answers, compressed so they are not read by accident.
"""

import base64
import json
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec import structs

from px4fuse.analysis import run
from px4fuse.card.build import build_card
from px4fuse.card.model import Card
from px4fuse.card.numbers import format_metres, format_ratio
from px4fuse.explore.data import flight_data
from px4fuse.explore.packing import Packer
from px4fuse.explore.page import data_scripts, page_text
from px4fuse.findings import Finding, find
from px4fuse.record import Record, table
from px4fuse.report.card_html import card_html
from px4fuse.request import ComparisonRequest
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

# Groups of mistakes that one flight can combine: one affects the whole motion, the other single
# samples. A wrong noise would hide another mistake, so it is not combined
COMBINABLE_GROUPS = ({"clock", "source"}, {"clock", "gate"}, {"frame", "source"}, {"frame", "gate"})
MAX_LEVEL = 3
MAX_SEED = 2**32 - 1
SIGMA_A_M_S2, SIGMA_Z_M = 0.10, 0.10
# A flight of less than a minute with two turns. The IMU errors are small, because large errors
# would resemble a time offset or a misaligned frame
SCENARIO_VALUES: dict[str, Any] = {
    "passes": 3,
    "speed_m_s": 1.5,
    "sigma_a_m_s2": 0.05,
    "accel_bias_sigma_m_s2": 0.005,
    "gyro_bias_sigma_rad_s": 0.0002,
    "tilt_error_deg": 0.02,
    "yaw_error_deg": 0.2,
}
LENGTH_M = (8.0, 12.0)  # m; range of the length of a pass
# Finding that contains the time span of a mistake
FINDING_WITH_TIME = {
    "nlos": "source_outliers",
    "jump": "source_position_jump",
    "dropout": "source_gap",
}
NO_MISTAKE = "No mistake: about 5 % of the innovations are outside ±2√S, and they are white."
NOISY_UWB = "noisy-uwb"  # the log is correct, but SIGMA_Z of KF is too small


class HiddenMistake(Record, frozen=True):
    """Mistake of a practice flight.

    Attributes
    ----------
    choice : str
        Correct answer, a key of :data:`CHOICES`.
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`, or :data:`NOISY_UWB`.
    sizes : tuple of str
        Size for each level, as on the command line.
    view : str
        View of the page that shows the mistake.
    fault : str
        Name of the mistake.
    size_text : str
        Text of its size; {0} and {1} are the parts of the size.
    symptom : str
        Effect on the plots, and the setting that confirms the mistake.
    either_sign : bool
        The size may also be negative.
    """

    choice: str
    mistake: str
    sizes: tuple[str, str, str]
    view: str
    fault: str
    size_text: str
    symptom: str
    either_sign: bool = False


class MistakeTable(Record, frozen=True):
    """Tables of ``practice.toml``: answers with their texts, and mistakes."""

    choices: dict[str, str]
    mistakes: tuple[HiddenMistake, ...]


_TABLES = table(__file__, "practice.toml", MistakeTable)
CHOICES, HIDDEN_MISTAKES = _TABLES.choices, _TABLES.mistakes


@dataclass(frozen=True)
class PracticeFlight:
    """Flight of a practice set.

    Attributes
    ----------
    scenario : Scenario
    mistakes : tuple of HiddenMistake
        Zero to two, with different choices.
    sizes : tuple of str
        Sizes of the mistakes, as on the command line.
    """

    scenario: Scenario
    mistakes: tuple[HiddenMistake, ...]
    sizes: tuple[str, ...]

    @property
    def correct_answers(self) -> list[str]:
        """Correct answers, sorted."""
        return sorted({mistake.choice for mistake in self.mistakes}) or ["nothing"]


def draw(seed: int, level: int = 1, count: int = 10) -> tuple[PracticeFlight, ...]:
    """Draw a random set of flights in which all choices occur equally often.

    Parameters
    ----------
    seed : int
        Seed, level and count determine the set.
    level : {1, 2, 3}
        1: one large mistake; 2: smaller; 3: small, two mistakes in some of the flights.
    count : int
    """
    rng = np.random.default_rng([seed, level, count])
    names: list[str] = []
    while len(names) < count:
        names += [str(name) for name in rng.permutation(list(CHOICES))]
    return tuple(_draw_flight(rng, name, level) for name in names[:count])


def _draw_flight(rng: np.random.Generator, choice: str, level: int) -> PracticeFlight:
    mistakes = [mistake for mistake in HIDDEN_MISTAKES if mistake.choice == choice]
    mistakes = [mistakes[rng.integers(len(mistakes))]] if mistakes else []
    if level == MAX_LEVEL and mistakes and rng.random() < 0.5:
        second_mistakes = [
            mistake for mistake in HIDDEN_MISTAKES if {mistake.choice, choice} in COMBINABLE_GROUPS
        ]
        mistakes += [second_mistakes[rng.integers(len(second_mistakes))]] if second_mistakes else []
    sizes = []
    for mistake in mistakes:
        sign = "-" if mistake.either_sign and rng.random() < 0.5 else ""
        sizes.append(f"{sign}{mistake.sizes[level - 1]}")
    noise_m = next(
        (
            float(s)
            for mistake, s in zip(mistakes, sizes, strict=True)
            if mistake.mistake == NOISY_UWB
        ),
        SIGMA_Z_M,
    )
    scenario = Scenario(
        **SCENARIO_VALUES,
        length_m=round(float(rng.uniform(*LENGTH_M)), 1),
        heading_deg=round(float(rng.uniform(0.0, 359.0)), 0),
        sigma_uwb_m=noise_m,
        seed=int(rng.integers(MAX_SEED)),
    )
    return PracticeFlight(scenario, tuple(mistakes), tuple(sizes))


def practice_text(
    seed: int,
    level: int = 1,
    count: int = 10,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> str:
    """Simulate a set of flights and make the practice page.

    Parameters
    ----------
    seed, level, count : int
        See :func:`draw`.
    progress : callable
        Called with a text, the number of finished flights and their total.

    Returns
    -------
    str
        HTML page that loads nothing from a network; write it as UTF-8.
    """
    practice_flights, scripts = draw(seed, level, count), []
    data: dict[str, Any] = {}
    for number, practice_flight in enumerate(practice_flights):
        progress(f"flight {number + 1}", number, count)
        data, script = _flight_data(practice_flight, number)
        scripts.append(script)
    return page_text(
        "\n".join(scripts),
        data,
        command="practice",
        title="simulated flights with known faults",
        about=f"seed {seed}, level {level}",
        flight_count=count,
        choices=CHOICES,
    )


def _flight_data(practice_flight: PracticeFlight, number: int) -> tuple[dict[str, Any], str]:
    """Return the data of a flight, and its elements with the compressed answer."""
    mistakes = [
        f"{mistake.mistake}={size}"
        for mistake, size in zip(practice_flight.mistakes, practice_flight.sizes, strict=True)
        if mistake.mistake != NOISY_UWB
    ]
    simulation = flights.simulate(practice_flight.scenario, parse(mistakes))
    flight = flights.to_flight(simulation, f"flight {number + 1}")
    request = ComparisonRequest(log=flight.log.name, sigma_a_m_s2=SIGMA_A_M_S2, sigma_z_m=SIGMA_Z_M)
    analysis = run(request, flight=flight)
    findings, packer = find(analysis), Packer()
    data, card = flight_data(analysis, packer), build_card(analysis, findings, request)
    described = [
        _describe_mistake(mistake, size, findings)
        for mistake, size in zip(practice_flight.mistakes, practice_flight.sizes, strict=True)
    ]
    key = {
        "right": practice_flight.correct_answers,
        "mistakes": described,
        "rerun": _rerun_sentence(card) if described else NO_MISTAKE,
        "card": card_html(_name_mistakes(card, described), has_apply=True),
    }
    compressed_key = base64.b64encode(zlib.compress(json.dumps(key).encode())).decode()
    scripts = data_scripts(data, analysis, packer, f"-{number}")
    return data, f'{scripts}\n<script type="text/plain" id="key-{number}">{compressed_key}</script>'


def _describe_mistake(
    mistake: HiddenMistake, size: str, findings: tuple[Finding, ...]
) -> dict[str, Any]:
    """Return fault, size, time, symptom and view of a mistake for the page, in words."""
    finding_id = FINDING_WITH_TIME.get(mistake.mistake)
    spans = [span for one in findings if one.id == finding_id for span in one.spans_s]
    time = f"{spans[0][0]:.1f} to {spans[-1][1]:.1f} s" if spans else "whole flight"
    return {
        "fault": mistake.fault,
        "size": mistake.size_text.format(*size_in_words(size)),
        "time": time,
        "symptom": mistake.symptom,
        "view": mistake.view,
        "span": list(spans[0]) if spans else None,
    }


def size_in_words(size: str) -> list[str]:
    """Split a size of the command line into its parts, with a blank before each unit.

    >>> size_in_words("5%,2m"), size_in_words("-400ms"), size_in_words("0.3")
    (['5 %', '2 m'], ['-400 ms'], ['0.3'])
    """
    return [re.sub(r"(?<=\d)(?=[^\d.])", " ", part).replace("deg", "°") for part in size.split(",")]


def _rerun_sentence(card: Card) -> str:
    """Return the re-run that improves most, in one sentence."""
    reruns = [
        rerun for cause in card.causes for rerun in cause.reruns if rerun.improves != "nothing"
    ]
    if not reruns:
        return "No re-run with one change corrects this flight."
    best = reruns[0]
    changes = [
        f"{name} {format_value(pair[0])} → {format_value(pair[1])}{unit}"
        for name, pair, format_value, unit in (
            ("position RMSE", best.position_rmse_m, format_metres, " m"),
            ("innovation ÷ √S", best.source_ratio, format_ratio, ""),
        )
        if pair is not None
    ]
    return f"Re-run, {best.label}: {', '.join(changes)}."


def _name_mistakes(card: Card, described: Sequence[Mapping[str, Any]]) -> Card:
    """Replace the headline of a card that found no cause on a flight with a mistake."""
    if card.causes or not described:
        return card
    fault = "; ".join(f"{one['fault']}: {one['size']}" for one in described)
    return structs.replace(
        card,
        severity="warning",
        headline=fault[0].upper() + fault[1:],
        do_this=("None of the automatic checks finds this mistake. Compare the plots.",),
    )
