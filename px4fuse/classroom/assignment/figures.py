"""Multiple-choice questions about figures of simulated flights."""

from collections.abc import Iterable, Mapping
from io import BytesIO

import pandas as pd

from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison, Comparison, FilterName
from px4fuse.core.record import read_toml
from px4fuse.flight.model import Ekf2, Truth
from px4fuse.report import panels, style
from px4fuse.results.answer_form import CHOICE_LETTERS, Choice, ChoiceLetter
from px4fuse.simulation import flights
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.scenario import make_scenario

from .key import compare_simulation
from .random_assignment import DrawRandomNumber, draw_scenario_numbers

FIGURE_COUNT = 3
# Number of straight passes along the path in each simulated flight
STRAIGHT_PASS_COUNT = 4
# Plots of position errors: the background is grey while the velocity (m/s) in the positive
# direction of the path exceeds this value
MIN_SPEED_FOR_GREY_BACKGROUND_M_S = 0.2
# Questions about each figure; figures.toml contains the answers by these keys
QUESTIONS = {
    "fault": "injected fault of the flight",
    "evidence": "plots that show the fault, and plots that do not show the fault",
    "change": "smallest change of data or settings after which both KF and EKF2 are consistent",
    "prediction": "effect on KF and EKF2 if SIGMA_Z and EKF2_EVP_NOISE are multiplied by 3",
    "useless": "change of data or settings that does not correct the fault, and why not",
}


# For each kind of fault: right answers about a flight with this fault, by key of QUESTIONS.
# "mistake_option" is the value of ``px4fuse simulate --mistake`` that injects the fault
FIGURE_ANSWERS_BY_FAULT = read_toml(__file__, dict[str, dict[str, str]])


def _shuffle(names: Iterable[str], seed_prefix: str, draw_number: DrawRandomNumber) -> list[str]:
    """Sort names in random order; the same arguments always give the same order."""
    return sorted(names, key=lambda name: draw_number(f"{seed_prefix} {name}"))


def _select_fault_kinds(draw_number: DrawRandomNumber) -> dict[str, str]:
    """Select the injected fault of each figure at random; return the fault by figure title."""
    fault_kinds = _shuffle(FIGURE_ANSWERS_BY_FAULT, "figures", draw_number)[:FIGURE_COUNT]
    return {f"Figure {number}": kind for number, kind in enumerate(fault_kinds, start=1)}


def make_choice_questions(
    draw_number: DrawRandomNumber,
) -> tuple[tuple[Choice, ChoiceLetter], ...]:
    """Make the multiple-choice questions about a student's plots, each with its right letter.

    ``draw_number`` returns a random number in [0, 1) for a name. The number is always the same for
    the same student and name, so the questions of a student do not change.
    """
    choices = []
    for title, kind in _select_fault_kinds(draw_number).items():
        other_fault_kinds = _shuffle(
            FIGURE_ANSWERS_BY_FAULT.keys() - {kind}, f"{title} other", draw_number
        )
        fault_kinds = [kind, *other_fault_kinds[: len(CHOICE_LETTERS) - 1]]
        for key, question in QUESTIONS.items():
            shuffled_kinds = _shuffle(fault_kinds, f"{title} {key}", draw_number)
            options = tuple(FIGURE_ANSWERS_BY_FAULT[each][key] for each in shuffled_kinds)
            letter = CHOICE_LETTERS[shuffled_kinds.index(kind)]
            choices.append((Choice(f"{title}: {question}", options), letter))
    return tuple(choices)


def draw_figures(draw_number: DrawRandomNumber) -> bytes:
    """Simulate and plot the flights for a student's multiple-choice questions; return one PNG file.

    ``draw_number`` is as in :func:`make_choice_questions`.
    """
    return _plot_figures(
        {
            title: _simulate_flight(title, kind, draw_number)
            for title, kind in _select_fault_kinds(draw_number).items()
        }
    )


def _simulate_flight(title: str, kind: str, draw_number: DrawRandomNumber) -> Comparison:
    """Simulate and analyse the flight of a figure, with the injected fault ``kind``."""

    def draw_number_of_figure(name: str) -> float:
        return draw_number(f"{title} {name}")

    scenario = make_scenario(
        "aisle",
        passes=STRAIGHT_PASS_COUNT,
        # an integer: the random numbers are multiples of 2**-53
        seed=int(2**53 * draw_number_of_figure("seed")),
        **draw_scenario_numbers("aisle", draw_number_of_figure),
    )
    faults = parse_faults(FIGURE_ANSWERS_BY_FAULT[kind].get("mistake_option", "").split())
    return compare_simulation(flights.simulate(scenario, faults))


def _plot_figures(comparisons: Mapping[str, Comparison]) -> bytes:
    """Plot each flight in one row: innovations, position errors of KF and EKF2, and map."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - slow import

    png_buffer = BytesIO()
    with style.apply_report_style():
        figure = Figure(figsize=(17.0, 3.6 * len(comparisons)), layout="constrained")
        rows = figure.subplots(len(comparisons), len(FILTER_NAMES) + 2, squeeze=False)
        for (title, comparison), axes in zip(comparisons.items(), rows, strict=True):
            innovation_axes, *error_axes, map_axes = axes
            result = comparison.main.with_whole_flight_tracks()
            innovation_axes.set_title(f"{title}: innovations along the path and ±2√S (m)")
            panels.draw_innovations(innovation_axes, result)
            for axis, filter_name in zip(error_axes, FILTER_NAMES, strict=True):
                _draw_errors(axis, result, filter_name)
            for axis in axes[:-1]:
                axis.set_xlabel(style.TIME_LABEL)
            _draw_map(map_axes, comparison)
        figure.savefig(png_buffer, format="png", dpi=90, metadata={"Software": None})
    return png_buffer.getvalue()


def _draw_errors(axes: style.Axes, result: AxisComparison, filter_name: FilterName) -> None:
    """Plot the position error of a filter and ±2σ."""
    name, truth = FILTER_NAMES[filter_name], result.truth
    errors = compute_position_errors(result, filter_name)
    axes.set_title(f"{name}: error along the path and ±2σ (m)")
    assert isinstance(errors, pd.DataFrame)
    assert isinstance(truth, pd.DataFrame)
    colour = style.SIGMA_BAND_COLOURS[name]
    style.draw_sigma_band(axes, 0.0 * errors["error_m"], errors["sigma_m"], colour)
    style.draw_curve(axes, errors["error_m"], **style.TRACK_STYLES[name])
    axes.fill_between(
        truth.index,
        0.0,
        1.0,
        where=truth["velocity_m_s"] > MIN_SPEED_FOR_GREY_BACKGROUND_M_S,
        transform=axes.get_xaxis_transform(),
        color="0.9",
        zorder=0,
    )


def _draw_map(axes: style.Axes, comparison: Comparison) -> None:
    """Plot positions, EKF2 and ground truth in the horizontal plane."""
    axes.set_title("Map: positions (dots), EKF2 (line), ground truth (dotted line)")
    ekf2, truth = comparison.flight.ekf2, comparison.flight.truth
    assert isinstance(ekf2, Ekf2)
    assert isinstance(truth, Truth)
    dot_style = style.MEASUREMENT_STYLE | {"ms": 4.0}
    for track, line in (
        (comparison.source.samples, dot_style),
        (ekf2.state, style.TRACK_STYLES["EKF2"]),
        (truth.samples, style.TRACK_STYLES["ground truth"]),
    ):
        axes.plot(track["east_m"], track["north_m"], **line)
    style.set_map_axes(axes, "east", "north")
