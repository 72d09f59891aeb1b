"""Points of answer forms that are copied from the outputs of px4fuse, on assigned flights.

``python tests/studies/copy_strategies.py --students 40`` simulates the assignments of a mixed class
and prints the mean points (of 100) of each strategy:

- ideal: the right answers
- report before: the findings of the unmarked log, as if px4fuse did not withhold them
- outputs: mechanical rules on parameters, rates, gaps and rejections, and the numbers of KF
- package: all functions of the package, which ignore the mark, and the numbers of KF
- random, and the best constant form of :mod:`form_guesses`

These strategies guess the fault of each figure, and give the answers of figures.toml for it.
``--students 300`` needs 20 minutes of processor time.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np
import pandas as pd
from form_guesses import at_random, constants, guess_choices, right
from msgspec.structs import replace

from px4fuse.analysis import Analysis
from px4fuse.classroom.assignment.assignment import simulate_assigned_flight
from px4fuse.classroom.assignment.key import (
    CorrectFormAnswers,
    CorrectVerdict,
    InjectedFault,
    _find_ekf2_behaviours,
    compute_numeric_answer,
)
from px4fuse.classroom.assignment.roster import Person
from px4fuse.classroom.grading.form_points import compute_form_points
from px4fuse.diagnose import analyse_loop_closure, diagnose
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.loop.model import Loop
from px4fuse.readers.ulog_topics import shows_diagnosis_of_assignments
from px4fuse.request import ComparisonRequest, Landing, LoopRequest
from px4fuse.results.answer_form import Answers, select_questions
from px4fuse.simulation.sensors import TIMESYNC_CONVERGENCE_TIME_S

SECRET = b"copy strategies"
# Faults that assignments contain, by the id of their finding
KIND_BY_FINDING = {
    "source_time_offset": "clock-offset", "source_timestamps_are_arrival_times": "clock-jump",
    "source_frame_misaligned": "yaw", "source_outliers": "nlos", "source_gap": "dropout",
    "imu_rate_too_low": "imu-rate", "ekf2_noise_too_small": "ekf2-noise",
    "ekf2_gate_too_small": "ekf2-gate", "ekf2_ev_delay_wrong": "ekf2-delay",
    "ekf2_not_fusing": "ekf2-off", "false_loop_closure": "open-end",
}  # fmt: skip


def sizes(analysis: Analysis) -> dict[str, InjectedFault]:
    """Return each fault with the size and times that the outputs state, if they state a size."""
    parameters, found = analysis.flight.log.parameters, {}
    assert isinstance(analysis.flight.imu, pd.DataFrame)
    rate_hz = float(1.0 / np.median(np.diff(analysis.flight.imu.index)))
    innovations = analysis.main.ekf2_tracks.innovations
    rejected = 0.0
    if isinstance(innovations, pd.DataFrame):
        rejected = float((innovations["rejected"] > 0).mean())
    values: dict[str, float | None] = {
        "ekf2-delay": 1e-3 * parameters.get("EKF2_EV_DELAY", 0.0),
        "ekf2-noise": parameters.get("EKF2_EVP_NOISE"),
        "ekf2-gate": parameters.get("EKF2_EVP_GATE"),
        "ekf2-off": None, "clock-jump": None, "imu-rate": rate_hz, "nlos": 100.0 * rejected,
    }  # fmt: skip
    if isinstance(analysis.time_offset, SourceTimeOffset):
        values["clock-offset"] = -analysis.time_offset.offset_s
        values["clock-jump"] = -analysis.time_offset.parts[0].offset_s
    if isinstance(analysis.heading, HeadingError):
        values["yaw"] = math.remainder(analysis.heading.misalignment_deg, 360.0)
    tuning = analysis.tuning.get(HORIZONTAL)
    if isinstance(tuning, AxisTuning):
        values["nlos"] = 100.0 * len(tuning.outlier_time_s) / tuning.count
    if isinstance(analysis.loop, Loop):
        values["open-end"] = analysis.loop.closure_error_m
    for kind, size in values.items():
        reach = 0.0 if size is None else 0.15 * abs(size)
        low, high = (None, None) if size is None else (size - reach, size + reach)
        until_s = TIMESYNC_CONVERGENCE_TIME_S if kind == "clock-jump" else None
        from_s = analysis.segment.end_s if kind == "open-end" else None
        found[kind] = InjectedFault(kind, size, low, high, from_s, until_s)
    if analysis.events.gaps:
        start_s, end_s = max(analysis.events.gaps, key=lambda gap: gap[1] - gap[0])
        length_s = end_s - start_s
        found["dropout"] = InjectedFault(
            "dropout", length_s, 0.85 * length_s, 1.15 * length_s, start_s, end_s
        )
    return found


def copied(analysis: Analysis, kinds: list[str], log_sha256: str) -> CorrectFormAnswers:
    """Return the answers that follow from the outputs, for these faults."""
    known = sizes(analysis)
    mistakes = tuple(known[kind] for kind in kinds if kind in known)
    filters = analysis.main.filters
    kf = CorrectVerdict(getattr(filters["kf"], "verdict", ""))
    ekf2 = CorrectVerdict(getattr(filters["ekf2"], "verdict", ""))
    tuning = analysis.tuning.get(HORIZONTAL)
    sigma_z_m = (tuning.sigma_z.value if isinstance(tuning, AxisTuning) else None) or 0.1
    behaviour = _find_ekf2_behaviours(analysis, mistakes, sigma_z_m)
    numbers = tuple(
        compute_numeric_answer(analysis.main, question) for question in select_questions(log_sha256)
    )
    return CorrectFormAnswers(mistakes, sigma_z_m, kf, ekf2, *behaviour, numbers)


def rule_kinds(analysis: Analysis, loop: Loop | None) -> list[str]:
    """Name faults by mechanical rules on the outputs for a marked log."""
    found, parameters = sizes(analysis), analysis.flight.log.parameters
    rules = {
        "ekf2-delay": parameters.get("EKF2_EV_DELAY", 0.0) > 0.0,
        "ekf2-off": parameters.get("EKF2_EV_CTRL", 1) == 0,
        "ekf2-gate": parameters.get("EKF2_EVP_GATE", 5.0) < 4.0,
        "ekf2-noise": parameters.get("EKF2_EVP_NOISE", 0.1) < 0.045,
        "imu-rate": (found["imu-rate"].size or 0.0) < 100.0,
        "nlos": 0.3 < (found["nlos"].size or 0.0) < 5.0,
        "dropout": "dropout" in found,
        "open-end": loop is not None and any(not closure.accepted for closure in loop.closures),
    }
    return [kind for kind, applies in rules.items() if applies][:2]


def forms_of(number: int) -> tuple[CorrectFormAnswers, dict[str, Answers]]:
    """Return the right answers for one student, and the form of each copying strategy."""
    content, answer = simulate_assigned_flight(SECRET, Person(f"s{number}"), "mixed")
    assert answer.form is not None
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, answer.file)
        log.write_bytes(content)
        loop = None
        if answer.scenario["kind"] == "loop":
            loop = analyse_loop_closure(LoopRequest(source=str(log), landed_at=Landing(0.0, 0.0)))
        token = shows_diagnosis_of_assignments.set(True)
        full = diagnose(ComparisonRequest(log=str(log)))
        shows_diagnosis_of_assignments.reset(token)
    named = [
        KIND_BY_FINDING[finding.id]
        for finding in full.findings
        if finding.id in KIND_BY_FINDING and finding.caused_by is None
    ]
    copies = {
        "report before": copied(full, named, answer.sha256),
        "outputs": copied(full, rule_kinds(full, loop), answer.sha256),
        "package": copied(full, named, answer.sha256),
    }
    forms = {name: right(one) for name, one in copies.items()}
    forms["report before"] = replace(forms["report before"], quantities=())
    return answer.form, forms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--students", type=int, default=40)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    with ProcessPoolExecutor(given.processes) as pool:
        made = list(pool.map(forms_of, range(given.students)))
    rng = np.random.default_rng(1)
    truths = [truth for truth, _ in made]

    def mean_points(form: Callable[[int], Answers]) -> float:
        return 100.0 * fmean(
            compute_form_points(form(n), one).fraction for n, one in enumerate(truths)
        )

    print(f"{len(truths)} flights, mean points of 100")
    print(f"{'ideal':14} {mean_points(lambda n: right(truths[n])):5.1f}")
    for name in made[0][1]:
        guess = partial(
            lambda name, n: replace(made[n][1][name], choices=guess_choices(rng, truths[n])), name
        )
        print(f"{name:14} {fmean(mean_points(guess) for _ in range(20)):5.1f}")
    random_means = (mean_points(lambda n: at_random(rng, truths[n])) for _ in range(20))
    print(f"{'random':14} {fmean(random_means):5.1f}")
    kinds = {mistake.kind for one in truths for mistake in one.mistakes} | {"none"}
    best = max(
        mean_points(partial(lambda form, _: form, form))
        for kind in kinds
        for form in constants(truths, kind)
    )
    print(f"{'constant':14} {best:5.1f}")


if __name__ == "__main__":
    main()
