"""Answer key of an assignment: flight, injected faults and right answers of each student."""

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.estimates import estimate_noises_and_time_offset
from px4fuse.comparison.model import AxisComparison, Comparison, FilterName, FilterSummary
from px4fuse.comparison.preparation import prepare_comparison_inputs
from px4fuse.core.reading import read_text
from px4fuse.core.record import Record, Sha256, read_toml
from px4fuse.errors import SettingsError
from px4fuse.filter.kalman import run_kf
from px4fuse.filter.model import (
    COVARIANCE_COLUMNS,
    compute_unit_density_process_noise,
    make_symmetric_matrix,
    make_transition_matrix,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.model import Ekf2, Unavailable
from px4fuse.loop.analysis import analyse
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.request import SIGMA_Z_M, ComparisonRequest
from px4fuse.results.answer_form import (
    LATER_UPDATE_COUNT_IN_GATE_QUESTION,
    Choice,
    ChoiceLetter,
    FormQuestion,
    select_questions,
)
from px4fuse.simulation import flights
from px4fuse.simulation.faults import FAULT_TYPES, injected_fault_names
from px4fuse.simulation.sensors import TIMESYNC_CONVERGENCE_TIME_S

from .roster import MAX_STUDENTS, ClassList, Person, normalise_text

# Maximum relative error of the size of a fault in a student's answer
FAULT_SIZE_TOLERANCE_FRACTION = 0.15
# Maximum deviation (m) of a student's loop closure error from the right value
CLOSURE_ERROR_TOLERANCE_M = 0.3
# Minimum fraction of positions rejected by EKF2 for which the student must report rejections
MIN_REPORTED_REJECTION_FRACTION = 0.005
# Minimum size (m) of an EKF2 position reset that the student must report
MIN_POSITION_RESET_TO_REPORT_M = 0.2
# Time (s) after the start of the analysed flight in which position resets are ignored: EKF2 resets
# its position to the first position that it fuses
INITIAL_TIME_WITHOUT_RESETS_S = 5.0
# Behaviour of EKF2 that the answer form must name ("required") or may name ("allowed"), with the
# injected faults that cause it
EKF2_BEHAVIOUR_RULES = read_toml(__file__, dict[str, dict[str, str]], "did.toml")
# Maximum size (bytes) of an answer key: the key of 1000 students has 2 million bytes
MAX_KEY_BYTES = 20_000_000
ANSWER_KEY_NOTE = (
    "For the instructor only: this file lists the injected faults of every student's flight. Do "
    "not hand it out."
)


class InjectedFault(Record):
    """Injected fault of a simulated flight, with the accepted range of its size.

    Attributes
    ----------
    size : float or None
        True size, in the first unit of the fault in ``form.toml``.
    low, high : float or None
        Smallest and largest size that is accepted as a right answer.
    from_s, until_s : float or None
        Start and end (s since the first sample); both None for the whole flight.
    """

    kind: str
    size: float | None = None
    low: float | None = None
    high: float | None = None
    from_s: float | None = None
    until_s: float | None = None


class CorrectVerdict(Record):
    """Correct answer about the consistency of a filter.

    Attributes
    ----------
    verdict : str
        "consistent", "overconfident" or "underconfident"; "" with too few data.
    factor : float or None
        Factor by which the reported σ is too small or too large.
    """

    verdict: str
    factor: float | None = None


class CorrectFormAnswers(Record):
    """Correct answers to the questions about one simulated flight.

    Attributes
    ----------
    mistakes : tuple of InjectedFault
    sigma_z_m : float
        True noise of the position source (m, 1 σ).
    ekf2_did : tuple of str
        Behaviours of EKF2 that the student must report, for example "never fused".
    ekf2_did_also : tuple of str
        Further behaviours of EKF2 that the student may report without losing points.
    quantities : tuple
        Numeric answers; None if the flight is too short for a question.
    choices : tuple
        Multiple-choice questions about figures, each with the letter of the right answer.
    """

    mistakes: tuple[InjectedFault, ...]
    sigma_z_m: float
    kf: CorrectVerdict
    ekf2: CorrectVerdict
    ekf2_did: tuple[str, ...]
    ekf2_did_also: tuple[str, ...]
    quantities: tuple[float | tuple[float, ...] | None, ...]
    choices: tuple[tuple[Choice, ChoiceLetter], ...] = ()


class CorrectAnswers(
    msgspec.Struct, frozen=True, rename={"student_id": "id", "true_values": "truth"}
):
    """Simulated flight of one student, with its injected faults and the right answers.

    Attributes
    ----------
    file, sha256 : str
        File name and SHA-256 of the student's log.
    scenario : dict
        Fields of :class:`px4fuse.simulation.scenario.Scenario`.
    mistakes : tuple of str
        Injected faults, as values of ``px4fuse simulate --mistake``.
    true_values : dict
        Parameters of the simulation that the log does not contain, for example ``sigma_z_m``.
    difficulty : float or None
        Smallest size that px4fuse detects, divided by the size of the injected fault.
    """

    student_id: Annotated[str, Meta(pattern=r"\S")]
    name: Annotated[str, Meta(max_length=1000)]
    file: str
    sha256: Sha256
    scenario: dict[str, str | int | float | bool | None] = {}
    mistakes: Annotated[tuple[str, ...], Meta(max_length=20)] = ()
    true_values: dict[str, float] = {}
    difficulty: float | None = None
    form: CorrectFormAnswers | None = None


class _AnswerKeySchema(msgspec.Struct, frozen=True):
    name: Literal["px4fuse-assignment"] = "px4fuse-assignment"
    version: Literal[3] = 3


class AnswerKey(msgspec.Struct, frozen=True):
    """Right answers for all students of a class (JSON file of the instructor).

    ``kind`` is the flight: "aisle", "loop" or "mixed". ``secret`` is the seed of the random
    numbers.
    """

    kind: str
    answers: Annotated[tuple[CorrectAnswers, ...], Meta(min_length=1, max_length=MAX_STUDENTS)] = (
        msgspec.field(name="students")
    )
    secret: str = ""
    schema: _AnswerKeySchema = _AnswerKeySchema()
    note: str = ANSWER_KEY_NOTE

    def __repr__(self) -> str:  # an error message must not show the secret
        return f"AnswerKey({self.kind!r}, {len(self.answers)} students)"

    def find_right_answers_of_student(self, student_id: str) -> CorrectAnswers | None:
        """Return the right answers for a student; None for an unknown student."""
        class_list = ClassList(Person(answer.student_id) for answer in self.answers)
        student_index = class_list.find_student_index(Person(student_id))
        return None if student_index is None else self.answers[student_index]

    def find_answers_by_log_sha256(self, sha256: str) -> CorrectAnswers | None:
        return next((answer for answer in self.answers if answer.sha256 == sha256), None)


def format_answer_key(key: AnswerKey) -> str:
    return msgspec.json.format(msgspec.json.encode(key), indent=1).decode() + "\n"


def read_answer_key(path: Path) -> AnswerKey:
    """Read the answer key of an assignment.

    Raises
    ------
    SettingsError
        The file cannot be read, or was not written by ``px4fuse simulate --assignment``.
    """
    text = read_text(path, SettingsError, MAX_KEY_BYTES, name=str(path))
    try:
        key = msgspec.json.decode(text, type=AnswerKey)
        if len({normalise_text(answer.student_id) for answer in key.answers}) < len(key.answers):
            raise ValueError("two students have the same id")
    except (RecursionError, ValueError) as error:
        raise SettingsError(
            f"{path} is not an answer key, or is from another px4fuse version ({error}).",
            "Give the answer key that px4fuse simulate --assignment wrote.",
        ) from error
    return key


# ------------------------------------------------------------------ right answers


def compute_form_answers(simulation: flights.Simulation, log_sha256: str) -> CorrectFormAnswers:
    """Compute the right answers from the simulated flight and its analysis by px4fuse."""
    comparison = compare_simulation(simulation)
    faults = tuple(
        _make_injected_fault(name, simulation, comparison)
        for name in injected_fault_names(simulation.faults)
    )
    sigma_z_m = simulation.scenario.source_sigma_m
    return CorrectFormAnswers(
        faults,
        sigma_z_m,
        _determine_right_verdict(comparison, "kf"),
        _determine_right_verdict(comparison, "ekf2"),
        *_find_ekf2_behaviours(comparison, faults, sigma_z_m),
        tuple(
            compute_numeric_answer(comparison.main, question)
            for question in select_questions(log_sha256)
        ),
    )


def compare_simulation(simulation: flights.Simulation) -> Comparison:
    """Analyse a simulated flight with the default settings of KF."""
    flight = flights.to_flight(simulation)
    prepared_comparison = prepare_comparison_inputs(
        flight,
        ComparisonRequest(log=flight.log.name, sigma_z_m=SIGMA_Z_M),
        # do not correct frame and clock: the student has to find these faults
        keep_positions_as_sent=True,
    )
    return compare(prepared_comparison)


def _make_injected_fault(
    name: str, simulation: flights.Simulation, comparison: Comparison
) -> InjectedFault:
    """Return an injected fault with its size, the accepted range of sizes, and its time span."""
    value_field_names = FAULT_TYPES[name].value_field_names
    if not value_field_names:
        return InjectedFault(name)
    size = getattr(simulation.faults, value_field_names[0])
    start_s, end_s = _find_fault_time(name, size, simulation)
    tolerance = FAULT_SIZE_TOLERANCE_FRACTION * abs(size)
    if name == "open-end":
        # the student can only measure the closure error, which includes the odometry drift
        odometry = trajectory_of(comparison.flight, "vio")
        closure_error_m = analyse(LoopSource(odometry, comparison.flight)).closure_error_m
        size = closure_error_m if isinstance(closure_error_m, float) else size
        tolerance = CLOSURE_ERROR_TOLERANCE_M
    low, high = size - tolerance, size + tolerance
    if name == "clock-offset":
        # also accept the 95 % interval of px4fuse's estimate. The estimate is the correction of the
        # timestamps, so its sign is opposite to that of the injected time offset
        _, time_offset = estimate_noises_and_time_offset(comparison)
        if isinstance(time_offset, SourceTimeOffset) and time_offset.is_determinable:
            lowest_correction_s, highest_correction_s = time_offset.interval_s
            low, high = min(low, -highest_correction_s), max(high, -lowest_correction_s)
    return InjectedFault(name, size, low, high, start_s, end_s)


def _find_fault_time(
    name: str, size: float, simulation: flights.Simulation
) -> tuple[float | None, float | None]:
    """Return start and end of a fault; None for the start or the end of the flight."""
    if name == "clock-jump":
        return None, TIMESYNC_CONVERGENCE_TIME_S
    if name == "open-end":
        return simulation.motion.touch_down_s, None
    outlier_times_s = simulation.positions.outlier_times_s.tolist()
    if name == "nlos" and outlier_times_s:
        return outlier_times_s[0], outlier_times_s[-1]
    # fields of FaultSizes that end in _at_s are start times
    last_field_name = FAULT_TYPES[name].value_field_names[-1]
    if not last_field_name.endswith("_at_s"):
        return None, None
    start_s = getattr(simulation.faults, last_field_name)
    # the size of a dropout is its duration; other faults last until the end
    return start_s, start_s + size if name in ("dropout", "imu-dropout") else None


def _determine_right_verdict(comparison: Comparison, filter_name: FilterName) -> CorrectVerdict:
    """Return the right answer about the consistency of a filter, from its analysis by px4fuse."""
    filter_summary = comparison.main.filters[filter_name]
    if not isinstance(filter_summary, FilterSummary):
        return CorrectVerdict("")
    factor = None if filter_summary.verdict == "consistent" else filter_summary.sigma_error_factor
    return CorrectVerdict(filter_summary.verdict, factor)


def _find_ekf2_behaviours(
    comparison: Comparison, faults: tuple[InjectedFault, ...], sigma_z_m: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the behaviours of EKF2 that a student must report, and those a student may report."""
    size_by_kind = {fault.kind: fault.size or 0.0 for fault in faults}
    kinds = size_by_kind.keys()

    def list_behaviours(rule: str) -> list[str]:
        """Return the behaviours that the injected faults cause, by one table of did.toml."""
        return [
            behaviour
            for behaviour, rule_kinds in EKF2_BEHAVIOUR_RULES[rule].items()
            if not kinds.isdisjoint(rule_kinds.split())
        ]

    required, allowed = list_behaviours("required"), list_behaviours("allowed")
    if size_by_kind.get("ekf2-noise", 0.0) > sigma_z_m:
        required.append("weighted the positions too little")
    innovations = comparison.main.ekf2_tracks.innovations
    if (
        not isinstance(innovations, Unavailable)
        and (innovations["rejected"] > 0).mean() > MIN_REPORTED_REJECTION_FRACTION
    ):
        has_bad_samples = not kinds.isdisjoint({"nlos", "jump"})
        required.append("rejected outliers" if has_bad_samples else "rejected good samples")
    if _has_position_reset(comparison):
        required.append("dead-reckoned, then reset")
    if "never fused" in required:
        # EKF2 never fused the positions. Its other behaviours are consequences, so the student need
        # not report them
        required, allowed = ["never fused"], [*required, *allowed]
    elif not required:
        required, allowed = ["normal"], ["followed the positions", *allowed]
    # a behaviour may occur several times in ``allowed``: remove the duplicates
    further_behaviours = [each for each in dict.fromkeys(allowed) if each not in required]
    return tuple(required), tuple(further_behaviours)


def _has_position_reset(comparison: Comparison) -> bool:
    """Return True if EKF2 reset its position to a clearly different position in flight."""
    ekf2 = comparison.flight.ekf2
    earliest_counted_reset_time_s = comparison.segment.start_s + INITIAL_TIME_WITHOUT_RESETS_S
    return isinstance(ekf2, Ekf2) and any(
        reset.quantity == "position"
        and reset.time_s > earliest_counted_reset_time_s
        and math.hypot(*reset.delta[:2]) > MIN_POSITION_RESET_TO_REPORT_M
        for reset in ekf2.resets
    )


def compute_numeric_answer(
    axis_comparison: AxisComparison, question: FormQuestion
) -> float | tuple[float, ...] | None:
    """Run KF to compute the right answer to a question; None with too few measurements."""
    settings = Settings(question.sigma_a_m_s2, question.sigma_z_m)
    kf_run = run_kf(axis_comparison.axis, settings)
    # updates from the update that the question is about
    updates = kf_run.updates.iloc[question.update_number - 1 :]
    if updates.empty:
        return None
    nis = updates["innovation_m"] ** 2 / updates["innovation_variance_m2"]
    if question.kind == "gate":
        is_outside = (
            nis.iloc[: LATER_UPDATE_COUNT_IN_GATE_QUESTION + 1] > question.question_parameter**2
        )
        rejected_update_numbers = np.flatnonzero(is_outside) + question.update_number
        return tuple(rejected_update_numbers.astype(float).tolist())
    covariance = kf_run.steps.loc[updates.index[0], COVARIANCE_COLUMNS]
    if question.kind == "prediction":
        # propagate the covariance without updates: P = F P Fᵀ + Q
        p, f = make_symmetric_matrix(tuple(covariance)), make_transition_matrix(settings.dt_s)
        q = make_symmetric_matrix(compute_unit_density_process_noise(settings.dt_s))
        q *= settings.sigma_a_m_s2**2 * settings.dt_s
        for _ in range(round(question.question_parameter / settings.dt_s)):
            p = f @ p @ f.T + q
        return math.sqrt(p[0, 0])
    value_by_kind = {
        "gain": updates["gain_position"].iloc[0],
        "innovation": updates["innovation_m"].iloc[0],
        "nis": nis.iloc[0],
        "variance": covariance.iloc[0],
    }
    return float(value_by_kind[question.kind])
