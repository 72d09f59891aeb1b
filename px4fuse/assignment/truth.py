"""Right answers of the answer form for a simulated flight."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from px4fuse.answer_form import GATE_UPDATES, FormQuestion, draw_questions
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.estimates import estimate_noises_and_clock
from px4fuse.comparison.model import AxisComparison, Comparison, FilterName, FilterSummary
from px4fuse.filter.kalman import replay
from px4fuse.filter.model import COVARIANCES, process_noise_unit, symmetric_matrix, transition
from px4fuse.filter.settings import Settings
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.loop.analysis import analyse
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.record import Record, table
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import MISTAKES as SIMULATED
from px4fuse.simulation.sensors import TIMESYNC_CONVERGED_S

# relative tolerance of the size of a mistake
SIZE_TOLERANCE = 0.15
# m; tolerance of a loop closure error
CLOSURE_TOLERANCE_M = 0.3
# minimum fraction of rejected samples that a right form must name
MIN_REJECTED_SHARE = 0.005
# minimum size (m) of a reset that a right form must name. Resets in the first seconds (s) of the
# segment are ignored, because EKF2 resets to its first position
MIN_RESET_M, EKF2_START_S = 0.2, 5.0
EKF2_BEHAVIOUR = table(__file__, "did.toml", dict[str, dict[str, set[str]]])


class TrueMistake(Record, frozen=True):
    """Mistake of a simulated flight, with the range of right answers.

    Attributes
    ----------
    size : float or None
        Size in the first unit of :data:`px4fuse.answer_form.MISTAKES`. Answers from ``low`` to
        ``high`` are right.
    from_s, until_s : float or None
        Time (s) since the first data; both None: the whole flight.
    """

    kind: str
    size: float | None = None
    low: float | None = None
    high: float | None = None
    from_s: float | None = None
    until_s: float | None = None


class VerdictTruth(Record, frozen=True):
    """Verdict on the reported σ of a filter ("": none), and the factor by which σ is wrong."""

    verdict: str
    factor: float | None = None


class FormTruth(Record, frozen=True):
    """Right answers of the answer form for one flight.

    Attributes
    ----------
    sigma_z_m : float
        True position noise of the source (1 σ).
    ekf2_did, ekf2_did_also : tuple of str
        Behaviour of EKF2 that the form must name, and further behaviour that it may name.
    quantities : tuple
        Answers to :func:`px4fuse.answer_form.draw_questions`; None if the flight is too short.
    """

    mistakes: tuple[TrueMistake, ...]
    sigma_z_m: float
    kf: VerdictTruth
    ekf2: VerdictTruth
    ekf2_did: tuple[str, ...]
    ekf2_did_also: tuple[str, ...]
    quantities: tuple[float | tuple[float, ...] | None, ...]


def form_truth(simulation: flights.Simulation, log_sha256: str) -> FormTruth:
    """Compute the right answers from the simulation and a comparison with default settings."""
    answer = flights.answer(simulation)
    comparison = compare(flights.to_flight(simulation), Settings())
    mistakes = tuple(
        _true_mistake(name, values, answer["truth"], comparison)
        for name, values in answer["mistakes"].items()
    )
    sigma_z_m = answer["truth"]["sigma_z_m"]
    return FormTruth(
        mistakes,
        sigma_z_m,
        _verdict(comparison, "kf"),
        _verdict(comparison, "ekf2"),
        *_ekf2_behaviour(comparison, mistakes, sigma_z_m),
        tuple(quantity_truth(comparison.main, question) for question in draw_questions(log_sha256)),
    )


def _true_mistake(
    name: str, values: Mapping[str, Any], truth: Mapping[str, Any], comparison: Comparison
) -> TrueMistake:
    sizes = SIMULATED[name].sizes
    if not sizes:
        return TrueMistake(name)
    size, tolerance = values[sizes[0]], SIZE_TOLERANCE * abs(values[sizes[0]])
    if name == "open-end":  # a student measures the closure error, which includes odometry drift
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
    return TrueMistake(name, size, low, high, from_s, until_s)


def _verdict(comparison: Comparison, filter_name: FilterName) -> VerdictTruth:
    filter_summary = comparison.main.filters[filter_name]
    if not isinstance(filter_summary, FilterSummary):
        return VerdictTruth("")
    is_consistent = filter_summary.verdict == "consistent"
    factor = None if is_consistent else filter_summary.sigma_error_factor
    return VerdictTruth(filter_summary.verdict, factor)


def _ekf2_behaviour(
    comparison: Comparison, mistakes: tuple[TrueMistake, ...], sigma_z_m: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the behaviour of EKF2 that the form must name, and that it may name in addition."""
    size_of = {mistake.kind: mistake.size or 0.0 for mistake in mistakes}
    required, allowed = (
        [behaviour for behaviour, kinds in EKF2_BEHAVIOUR[rule].items() if kinds & size_of.keys()]
        for rule in ("required", "allowed")
    )
    if size_of.get("ekf2-noise", 0.0) > sigma_z_m:
        required.append("weighted the positions too little")
    innovations = comparison.main.ekf2_innovations
    if not isinstance(innovations, Unavailable):
        has_bad_samples = "nlos" in size_of or "jump" in size_of
        if (innovations["rejected"] > 0).mean() > MIN_REJECTED_SHARE:
            required.append("rejected outliers" if has_bad_samples else "rejected good samples")
    ekf2 = comparison.flight.ekf2
    since_s = comparison.segment.start_s + EKF2_START_S
    for reset in ekf2.resets if isinstance(ekf2, Ekf2) else ():
        is_large = reset.quantity == "position" and math.hypot(*reset.delta[:2]) > MIN_RESET_M
        if is_large and reset.time_s > since_s:
            required.append("dead-reckoned, then reset")
    if not required:
        required, allowed = ["normal"], ["followed the positions", *allowed]
    return tuple(dict.fromkeys(required)), tuple(
        behaviour for behaviour in dict.fromkeys(allowed) if behaviour not in required
    )


def quantity_truth(
    result: AxisComparison, question: FormQuestion
) -> float | tuple[float, ...] | None:
    """Answer a question by a replay of KF with the settings of the question.

    None if the flight has too few measurements. The answer about a gap is the position σ after
    predictions with F and Q (steps of DT), without an update.
    """
    settings = Settings(question.sigma_a_m_s2, question.sigma_z_m)
    kf_replay = replay(result.axis, settings)
    updates = kf_replay.updates
    update_index = question.update - 1
    if update_index >= len(updates):
        return None
    row, covariance = (
        updates.iloc[update_index],
        kf_replay.steps.loc[updates.index[update_index], COVARIANCES],
    )
    match question.kind:
        case "gate":
            following_updates = updates.iloc[update_index : update_index + GATE_UPDATES + 1]
            nis = (
                following_updates["innovation_m"] ** 2 / following_updates["innovation_variance_m2"]
            )
            outside_numbers = np.flatnonzero(nis > question.extra**2) + question.update
            return tuple(outside_numbers.astype(float).tolist())
        case "silence":
            p, f = symmetric_matrix(tuple(covariance)), transition(settings.dt_s)
            q = (
                settings.sigma_a_m_s2**2
                * settings.dt_s
                * symmetric_matrix(process_noise_unit(settings.dt_s))
            )
            for _ in range(round(question.extra / settings.dt_s)):
                p = f @ p @ f.T + q
            return math.sqrt(p[0, 0])
        case "nis":
            return float(row["innovation_m"] ** 2 / row["innovation_variance_m2"])
        case "variance":
            return float(covariance.iloc[0])
    return float(row["gain_position" if question.kind == "gain" else "innovation_m"])
