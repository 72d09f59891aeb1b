"""Quiz page (``px4fuse practice``): simulated flights whose injected faults the user must find.

The page contains the right answers, compressed so that users do not read them by accident.
"""

import base64
import json
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import structs

from px4fuse.card.build import build_card
from px4fuse.card.model import DiagnosisCard
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.preparation import prepare_comparison_inputs
from px4fuse.core.record import Record, read_toml
from px4fuse.core.text import capitalise_first_letter
from px4fuse.diagnose import diagnose_comparison
from px4fuse.finding import Finding
from px4fuse.report.card_html import make_card_html
from px4fuse.request import ComparisonRequest
from px4fuse.simulation import flights
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.scenario import Scenario

from .data import ArrayEncoder, make_flight_data
from .page import make_data_elements, make_page_html

# Pairs of quiz answers: one flight may contain a fault of each answer, because neither fault hides
# the other
COMBINABLE_ANSWER_PAIRS = (
    {"clock", "source"},
    {"clock", "gate"},
    {"frame", "source"},
    {"frame", "gate"},
)
MAX_QUIZ_LEVEL = 3  # level of the most difficult flights
MAX_SEED = 2**32 - 1
SIGMA_A_M_S2, SIGMA_Z_M = 0.10, 0.10
# Settings of the simulated flights; IMU errors are small, because large errors resemble faults
SCENARIO_SETTINGS: dict[str, Any] = {
    "passes": 3,
    "speed_m_s": 1.5,
    "sigma_a_m_s2": 0.05,
    "accel_bias_sigma_m_s2": 0.005,
    "gyro_bias_sigma_rad_s": 0.0002,
    "tilt_error_deg": 0.02,
    "yaw_error_deg": 0.2,
}
# Range of the random length (m) of a pass along the straight path
AISLE_LENGTH_RANGE_M = (8.0, 12.0)
# Id of the finding that detects an injected fault, by name of the fault
FINDING_ID_BY_FAULT = {
    "nlos": "source_outliers",
    "jump": "source_position_jump",
    "dropout": "source_gap",
}
# Fault: SIGMA_Z of KF is smaller than the noise of the simulated positions
NOISY_UWB_FAULT = "noisy-uwb"


class QuizFault(Record):
    """Injected fault that the user has to find.

    Attributes
    ----------
    choice : str
        Name of the right answer.
    name : str
        Fault, as in ``px4fuse simulate --mistake NAME``, or :data:`NOISY_UWB_FAULT`.
    sizes : tuple of str
        Size at each level of difficulty, as in ``px4fuse simulate --mistake``.
    view : str
        Tab of the web page that shows the fault.
    """

    choice: str
    name: str
    sizes: tuple[str, str, str]
    description: str
    symptom: str
    size_text: str = "{0}"
    view: str = "errors"
    has_random_sign: bool = False


class QuizTable(Record):
    """Possible answers (name and text) and injected faults of the quiz (``practice.toml``)."""

    choices: dict[str, str]
    faults: tuple[QuizFault, ...]


_QUIZ = read_toml(__file__, QuizTable)
QUIZ_ANSWERS, QUIZ_FAULTS = _QUIZ.choices, _QUIZ.faults


@dataclass(frozen=True)
class QuizFlight:
    """Simulated flight of the quiz, with its injected faults and their sizes."""

    scenario: Scenario
    faults_and_sizes: tuple[tuple[QuizFault, str], ...]

    @property
    def correct_answers(self) -> list[str]:
        return sorted({fault.choice for fault, _ in self.faults_and_sizes}) or ["nothing"]


def choose_random_flights(seed: int, level: int, count: int) -> tuple[QuizFlight, ...]:
    """Choose the faults of all simulated flights at random; all answers are equally frequent.

    Parameters
    ----------
    seed : int
        Seed of the random numbers.
    level : {1, 2, 3}
        Difficulty: one large fault (1), one smaller fault (2), or up to two small faults (3).
    count : int
        Number of flights.
    """
    rng = np.random.default_rng([seed, level, count])
    right_answers: list[str] = []
    while len(right_answers) < count:
        right_answers += [str(name) for name in rng.permutation(list(QUIZ_ANSWERS))]
    return tuple(_draw_flight(rng, answer, level) for answer in right_answers[:count])


def _draw_flight(rng: np.random.Generator, right_answer: str, level: int) -> QuizFlight:
    """Choose a random flight of the quiz: its faults with their sizes, and its scenario."""

    def draw_one_fault(candidates: list[QuizFault]) -> list[QuizFault]:
        """Return a list with one random candidate; empty without candidates."""
        return [candidates[rng.integers(len(candidates))]] if candidates else []

    faults = draw_one_fault([fault for fault in QUIZ_FAULTS if fault.choice == right_answer])
    if level == MAX_QUIZ_LEVEL and faults and rng.random() < 0.5:
        faults += draw_one_fault(
            [
                fault
                for fault in QUIZ_FAULTS
                if {fault.choice, right_answer} in COMBINABLE_ANSWER_PAIRS
            ]
        )
    faults_and_sizes, sigma_uwb_m = [], SIGMA_Z_M
    for fault in faults:
        sign = "-" if fault.has_random_sign and rng.random() < 0.5 else ""
        size = f"{sign}{fault.sizes[level - 1]}"
        faults_and_sizes.append((fault, size))
        if fault.name == NOISY_UWB_FAULT:
            sigma_uwb_m = float(size)
    scenario = Scenario(
        **SCENARIO_SETTINGS,
        length_m=round(float(rng.uniform(*AISLE_LENGTH_RANGE_M)), 1),
        heading_deg=round(float(rng.uniform(0.0, 359.0)), 0),
        sigma_uwb_m=sigma_uwb_m,
        seed=int(rng.integers(MAX_SEED)),
    )
    return QuizFlight(scenario, tuple(faults_and_sizes))


def make_practice_page(
    seed: int, level: int, count: int, progress: Callable[[str, int, int], None]
) -> str:
    """Simulate and analyse ``count`` flights, and return the quiz page (HTML).

    ``progress`` is called with a text, the number of finished flights, and the number of flights.
    """
    flights_html = ""
    for flight_index, practice_flight in enumerate(choose_random_flights(seed, level, count)):
        progress(f"flight {flight_index + 1}", flight_index, count)
        data, flight_html = _simulate_flight_data(practice_flight, flight_index)
        flights_html += flight_html
    return make_page_html(
        data,  # plots and axes are equal for all flights: take those of the last
        data_scripts=flights_html,
        command="practice",
        title="simulated flights with known faults",
        about=f"seed {seed}, level {level}",
        flight_count=count,
        choices=QUIZ_ANSWERS,
    )


def _simulate_flight_data(
    practice_flight: QuizFlight, flight_index: int
) -> tuple[dict[str, Any], str]:
    """Return the data of a flight, and HTML elements with the data and the answers."""
    faults_and_sizes = practice_flight.faults_and_sizes
    # the scenario already contains the noise of a noisy UWB, so it is not injected as a fault
    fault_options = [
        f"{fault.name}={size}" for fault, size in faults_and_sizes if fault.name != NOISY_UWB_FAULT
    ]
    simulation = flights.simulate(practice_flight.scenario, parse_faults(fault_options))
    flight = flights.to_flight(simulation, f"flight {flight_index + 1}")
    request = ComparisonRequest(log=flight.log.name, sigma_a_m_s2=SIGMA_A_M_S2, sigma_z_m=SIGMA_Z_M)
    # do not correct axes and timestamps automatically: the correction would hide the injected fault
    prepared = prepare_comparison_inputs(flight, request, keep_positions_as_sent=True)
    # store the request in the analysis: the page shows it as a px4fuse command
    analysis = replace(diagnose_comparison(compare(prepared)), request=request)
    fault_descriptions = [_describe_fault(*pair, analysis.findings) for pair in faults_and_sizes]
    card = _with_fault_headline(build_card(analysis, request), fault_descriptions)
    answer_key = {
        "right": practice_flight.correct_answers,
        "mistakes": fault_descriptions,
        "card": make_card_html(card, has_apply_buttons=True),
    }
    compressed_key = base64.b64encode(zlib.compress(json.dumps(answer_key).encode())).decode()
    answer_key_html = f'<script type="text/plain" id="key-{flight_index}">{compressed_key}</script>'
    encoder = ArrayEncoder()
    data = make_flight_data(analysis, encoder)
    return data, make_data_elements(data, analysis, encoder, f"-{flight_index}") + answer_key_html


def _describe_fault(fault: QuizFault, size: str, findings: tuple[Finding, ...]) -> dict[str, Any]:
    """Describe a fault for the solution: name, size, time, symptom, and the plot that shows it."""
    finding_id = FINDING_ID_BY_FAULT.get(fault.name)
    spans = [span for finding in findings if finding.id == finding_id for span in finding.spans_s]
    time_text = f"{spans[0][0]:.1f} to {spans[-1][1]:.1f} s" if spans else "whole flight"
    return {
        "fault": fault.description,
        "size": fault.size_text.format(*split_fault_size(size)),
        "time": time_text,
        "symptom": fault.symptom,
        "view": fault.view,
    }


def split_fault_size(size: str) -> list[str]:
    """Split the size of an injected fault at commas, and separate numbers and units by blanks.

    >>> split_fault_size("5%,2m"), split_fault_size("-400ms"), split_fault_size("0.3")
    (['5 %', '2 m'], ['-400 ms'], ['0.3'])
    """
    return [re.sub(r"(?<=\d)(?=[^\d.])", " ", part).replace("deg", "°") for part in size.split(",")]


def _with_fault_headline(
    card: DiagnosisCard, fault_descriptions: Sequence[Mapping[str, Any]]
) -> DiagnosisCard:
    """Replace the headline of a diagnosis card by the injected faults, which were not detected."""
    if card.causes or not fault_descriptions:
        return card
    fault_text = "; ".join(f"{fault['fault']}: {fault['size']}" for fault in fault_descriptions)
    return structs.replace(
        card,
        severity="warning",
        headline=capitalise_first_letter(fault_text),
        do_this=("px4fuse does not detect this fault. Look for its effect in the plots.",),
    )
