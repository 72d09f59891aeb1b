"""Right answers to the answer form about a simulated flight."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from px4fuse.comparison.comparison import compare, run_kf
from px4fuse.comparison.estimates import estimate_noises_and_clock
from px4fuse.comparison.model import AxisComparison, Comparison, FilterName, FilterSummary
from px4fuse.comparison.preparation import prepare
from px4fuse.core.record import Record, read_toml
from px4fuse.filter.kalman import replay
from px4fuse.filter.model import (
    COVARIANCE_COLUMNS,
    process_noise_unit,
    symmetric_matrix,
    transition,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.flight.model import Ekf2, Unavailable
from px4fuse.loop.analysis import analyse
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.request import SIGMA_Z_M, ComparisonRequest
from px4fuse.results.answer_form import (
    GATE_QUESTION_UPDATES,
    Choice,
    ChoiceName,
    FormQuestion,
    select_questions,
)
from px4fuse.simulation import flights
from px4fuse.simulation.faults import FAULT_TYPES as SIMULATED_MISTAKES
from px4fuse.simulation.sensors import TIMESYNC_CONVERGED_S

# Relative tolerance of the size of an injected fault in a right answer
SIZE_TOLERANCE = 0.15
# Tolerance (m) of the loop closure error in a right answer
CLOSURE_TOLERANCE_M = 0.3
# Minimum fraction of rejected positions for which the student must name rejections by EKF2
MIN_REJECTED_FRACTION = 0.005
# Minimum size (m) of a position reset of EKF2 that the student must name
MIN_RESET_M = 0.2
# Time (s) after the start of the flight in which position resets do not count: EKF2 resets to the
# first position
IGNORED_RESETS_S = 5.0
# Injected faults for which the form must ("required") or may ("allowed") name a behaviour of EKF2
BEHAVIOUR_RULES = read_toml(__file__, dict[str, dict[str, set[str]]], "did.toml")


class InjectedFault(Record):
    """Injected fault of a simulated flight, with the bounds of right answers.

    Attributes
    ----------
    size : float or None
        Size in the first unit of the fault in ``form.toml``.
    low, high : float or None
        Smallest and largest size that is a right answer.
    from_s, until_s : float or None
        Start and end (s since the first data); both None for the whole flight.
    """

    kind: str
    size: float | None = None
    low: float | None = None
    high: float | None = None
    from_s: float | None = None
    until_s: float | None = None


class VerdictTruth(Record):
    """Right consistency verdict on a filter, and the factor by which its reported σ is wrong.

    ``verdict`` is "" if the flight has too few data for a verdict.
    """

    verdict: str
    factor: float | None = None


class FormTruth(Record):
    """Right answers to the answer form about one flight.

    Attributes
    ----------
    sigma_z_m : float
        True noise of the position source (m, 1 σ).
    ekf2_did : tuple of str
        Behaviours of EKF2 that the student has to name.
    ekf2_did_also : tuple of str
        Behaviours of EKF2 that the student may name without losing points.
    quantities : tuple
        Answers to the questions of :func:`~px4fuse.results.answer_form.select_questions`; None if
        the flight is too short.
    choices : tuple
        Questions about the figures, each with the letter of the right answer.
    """

    mistakes: tuple[InjectedFault, ...]
    sigma_z_m: float
    kf: VerdictTruth
    ekf2: VerdictTruth
    ekf2_did: tuple[str, ...]
    ekf2_did_also: tuple[str, ...]
    quantities: tuple[float | tuple[float, ...] | None, ...]
    choices: tuple[tuple[Choice, ChoiceName], ...] = ()


def form_truth(simulation: flights.Simulation, log_sha256: str) -> FormTruth:
    """Compute the right answers from a simulation and its analysis with default settings."""
    answer = flights.make_answer_key(simulation)
    comparison = compare_simulation(simulation)
    mistakes = tuple(
        _injected_fault(name, values, answer["truth"], comparison)
        for name, values in answer["mistakes"].items()
    )
    sigma_z_m = answer["truth"]["sigma_z_m"]
    return FormTruth(
        mistakes,
        sigma_z_m,
        _verdict(comparison, "kf"),
        _verdict(comparison, "ekf2"),
        *_ekf2_behaviour(comparison, mistakes, sigma_z_m),
        tuple(
            right_numeric_answer(comparison.main, question)
            for question in select_questions(log_sha256)
        ),
    )


def compare_simulation(simulation: flights.Simulation) -> Comparison:
    """Analyse a simulated flight with the default settings of KF."""
    flight = flights.to_flight(simulation)
    prepared = prepare(
        flight,
        ComparisonRequest(log=flight.log.name, sigma_z_m=SIGMA_Z_M),
        as_sent=True,  # without corrections of frame and clock, as for the students' logs
    )
    return compare(prepared, run_kf(prepared))


def _injected_fault(
    name: str, values: Mapping[str, Any], truth: Mapping[str, Any], comparison: Comparison
) -> InjectedFault:
    sizes = SIMULATED_MISTAKES[name].size_fields
    if not sizes:
        return InjectedFault(name)
    size = values[sizes[0]]
    tolerance = SIZE_TOLERANCE * abs(size)
    if name == "open-end":  # the student measures the closure error, which contains odometry drift
        odometry = trajectory_of(comparison.flight, "vio")
        measured_m = analyse(LoopSource(odometry, comparison.flight)).closure_error_m
        size, tolerance = measured_m if isinstance(measured_m, float) else size, CLOSURE_TOLERANCE_M
    low, high = size - tolerance, size + tolerance
    if name == "clock-offset":  # all values in the 95 % interval of the estimate are right
        _, time_offset = estimate_noises_and_clock(comparison)
        if isinstance(time_offset, ClockOffset) and time_offset.is_determinable:
            low, high = min(low, -time_offset.interval_s[1]), max(high, -time_offset.interval_s[0])
    from_s = until_s = None
    match name:
        case "clock-jump":
            until_s = TIMESYNC_CONVERGED_S
        case "open-end":
            _, from_s = truth["airborne_s"]
        case "nlos" if truth["outlier_time_s"]:
            from_s, *_, until_s = truth["outlier_time_s"] * 2
        case "dropout" | "imu-dropout" | "jump" | "heading" | "mag":
            from_s = values[sizes[1]]
            until_s = from_s + abs(size) if name.endswith("dropout") else None
    return InjectedFault(name, size, low, high, from_s, until_s)


def _verdict(comparison: Comparison, filter_name: FilterName) -> VerdictTruth:
    filter_summary = comparison.main.filters[filter_name]
    if not isinstance(filter_summary, FilterSummary):
        return VerdictTruth("")
    is_consistent = filter_summary.verdict == "consistent"
    factor = None if is_consistent else filter_summary.sigma_error_factor
    return VerdictTruth(filter_summary.verdict, factor)


def _ekf2_behaviour(
    comparison: Comparison, mistakes: tuple[InjectedFault, ...], sigma_z_m: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the behaviours of EKF2 that the student must name, and those that are allowed."""
    size_by_kind = {mistake.kind: mistake.size or 0.0 for mistake in mistakes}
    required, allowed = (
        [
            behaviour
            for behaviour, kinds in BEHAVIOUR_RULES[rule].items()
            if kinds & size_by_kind.keys()
        ]
        for rule in ("required", "allowed")
    )
    if size_by_kind.get("ekf2-noise", 0.0) > sigma_z_m:
        required.append("weighted the positions too little")
    innovations = comparison.main.ekf2_innovations
    if not isinstance(innovations, Unavailable):
        has_bad_samples = "nlos" in size_by_kind or "jump" in size_by_kind
        if (innovations["rejected"] > 0).mean() > MIN_REJECTED_FRACTION:
            required.append("rejected outliers" if has_bad_samples else "rejected good samples")
    ekf2 = comparison.flight.ekf2
    min_reset_time_s = comparison.segment.start_s + IGNORED_RESETS_S
    for reset in ekf2.resets if isinstance(ekf2, Ekf2) else ():
        is_large = reset.quantity == "position" and math.hypot(*reset.delta[:2]) > MIN_RESET_M
        if is_large and reset.time_s > min_reset_time_s:
            required.append("dead-reckoned, then reset")
    if "never fused" in required:  # EKF2 cannot follow positions that it does not fuse
        required, allowed = ["never fused"], [*required, *allowed]
    if not required:
        required, allowed = ["normal"], ["followed the positions", *allowed]
    required = [*dict.fromkeys(required)]
    return tuple(required), tuple(each for each in dict.fromkeys(allowed) if each not in required)


def right_numeric_answer(
    axis_comparison: AxisComparison, question: FormQuestion
) -> float | tuple[float, ...] | None:
    """Compute the right answer to a question by a run of KF; None with too few measurements.

    For the kind "prediction", the answer is the position σ (m) after predictions in steps of DT
    without an update.
    """
    settings = Settings(question.sigma_a_m_s2, question.sigma_z_m)
    kf_replay = replay(axis_comparison.axis, settings)
    updates = kf_replay.updates.iloc[question.update - 1 :]
    if updates.empty:
        return None
    update_row, covariance = (
        updates.iloc[0],
        kf_replay.steps.loc[updates.index[0], COVARIANCE_COLUMNS],
    )
    nis = updates["innovation_m"] ** 2 / updates["innovation_variance_m2"]
    match question.kind:
        case "gate":
            is_outside = nis.iloc[: GATE_QUESTION_UPDATES + 1] > question.duration_or_gate**2
            outside_numbers = np.flatnonzero(is_outside) + question.update
            return tuple(outside_numbers.astype(float).tolist())
        case "prediction":
            p, f = symmetric_matrix(tuple(covariance)), transition(settings.dt_s)
            q = symmetric_matrix(process_noise_unit(settings.dt_s))
            q *= settings.sigma_a_m_s2**2 * settings.dt_s
            for _ in range(round(question.duration_or_gate / settings.dt_s)):
                p = f @ p @ f.T + q
            return math.sqrt(p[0, 0])
        case "nis":
            return float(nis.iloc[0])
        case "variance":
            return float(covariance.iloc[0])
    return float(update_row["gain_position" if question.kind == "gain" else "innovation_m"])
