"""Points of guessed answer forms on assigned flights.

``python tests/studies/form_guesses.py`` draws assignments like ``simulate --assignment`` and prints
the mean share of the points of random forms, of "none" everywhere, of the best constant form (the
most frequent fault with the most frequent answers), and of correct forms. ``--students`` sets the
number of flights.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from statistics import fmean

import numpy as np
from msgspec.structs import replace

from px4fuse.classroom.assignment.assignment import simulate_assigned_flight
from px4fuse.classroom.assignment.figures import FIGURE_ANSWERS_BY_FAULT, QUESTIONS
from px4fuse.classroom.assignment.key import CorrectFormAnswers, InjectedFault
from px4fuse.classroom.assignment.roster import Person
from px4fuse.classroom.grading.form_points import (
    compute_form_points,
    find_accepted_corrections,
    find_panels_showing_fault,
)
from px4fuse.results.answer_form import (
    CHOICE_LETTERS,
    EKF2_BEHAVIOURS,
    FAULT_KINDS,
    NOT_AVAILABLE,
    REPORT_PANELS,
    UNITS_BY_CORRECTION,
    VERDICTS,
    Answers,
    NamedFault,
)

SECRET = b"form guesses"
SHA256 = "0" * 64
GUESSES = 20


def truth(number: int) -> CorrectFormAnswers:
    """Return the correct answers for the flight of one student of a mixed class."""
    student = Person(f"s{number}")
    _, answer = simulate_assigned_flight(SECRET, student, "mixed")
    assert answer.form is not None
    return answer.form


def guess_choices(rng: np.random.Generator, one: CorrectFormAnswers) -> tuple[str, ...]:
    """Guess the fault of each figure, and give the answers to all questions for this fault."""
    letters, count = [], len(QUESTIONS)
    for first in range(0, len(one.choices), count):
        guess = rng.choice(one.choices[first][0].options)
        fault = next(each for each in FIGURE_ANSWERS_BY_FAULT.values() if each["fault"] == guess)
        for (choice, _), field in zip(one.choices[first : first + count], QUESTIONS, strict=True):
            letters.append(CHOICE_LETTERS[choice.options.index(fault[field])])
    return tuple(letters)


def at_random(rng: np.random.Generator, one: CorrectFormAnswers) -> Answers:
    """Return a form with random valid answers."""
    named = [name for name in FAULT_KINDS if name != "none"]
    kinds = rng.choice(named, int(rng.integers(1, 4)), replace=False)
    claims = tuple(
        NamedFault(
            str(kind), float(rng.lognormal(-1.0, 1.5)), when="whole flight",
            parameter=str(rng.choice(list(UNITS_BY_CORRECTION))),
            value=float(rng.lognormal(-1.0, 1.5)),
            panel=str(rng.choice(REPORT_PANELS)),
        )
        for kind in kinds
    )  # fmt: skip
    return Answers(
        log_sha256=SHA256,
        mistakes=(NamedFault("none"),) if rng.random() < 1.0 / 3.0 else claims,
        verdict_kf=str(rng.choice(VERDICTS)),  # type: ignore[arg-type]
        verdict_ekf2=str(rng.choice(VERDICTS)),  # type: ignore[arg-type]
        ekf2_did=(str(rng.choice(EKF2_BEHAVIOURS)),),
        quantities=tuple(rng.normal(0.0, 0.3, 3).tolist()),
        choices=tuple(rng.choice(CHOICE_LETTERS, len(one.choices)).tolist()),
    )


def constants(truths: Sequence[CorrectFormAnswers], kind: str) -> Iterator[Answers]:
    """Yield constant forms: one fault of several sizes, and the most frequent other answers."""

    def common(values: list[str]) -> str:
        return Counter(values).most_common(1)[0][0]

    blank = Answers(
        log_sha256=SHA256,
        mistakes=(NamedFault("none"),),
        verdict_kf=common([one.kf.verdict for one in truths]),  # type: ignore[arg-type]
        verdict_ekf2=common([one.ekf2.verdict for one in truths]),  # type: ignore[arg-type]
        ekf2_did=(common([said for one in truths for said in one.ekf2_did]),),
        choices=tuple(
            common([one.choices[index][1] for one in truths])
            for index in range(len(truths[0].choices))
        ),
    )
    if kind == "none":
        yield blank
        return
    of_kind = [wrong for one in truths for wrong in one.mistakes if wrong.kind == kind]
    sizes = [wrong.size for wrong in of_kind if wrong.size is not None] or [0.0]
    begins = [wrong.from_s for wrong in of_kind if wrong.from_s is not None] or [0.0]
    for size in np.quantile(sizes, np.arange(0.05, 1.0, 0.1)):
        cure = find_accepted_corrections(InjectedFault(kind, size, size, size), truths[0])[0][0]
        for from_s in (None, float(np.median(begins))):
            claim = NamedFault(
                kind, float(size), when="whole flight" if from_s is None else "", from_s=from_s,
                parameter=cure, panel=find_panels_showing_fault(kind)[0],
            )  # fmt: skip
            yield replace(blank, mistakes=(claim,))


def right(one: CorrectFormAnswers) -> Answers:
    """Return the correct form."""
    claims = []
    for wrong in one.mistakes:
        parameter, (low, high), _ = find_accepted_corrections(wrong, one)[0]
        value = 1.1 * low if np.isinf(high) else 0.5 * (low + high)
        value = None if np.isinf(low) else value
        whole = wrong.from_s is None and wrong.until_s is None
        claims.append(
            NamedFault(
                wrong.kind, wrong.size, when="whole flight" if whole else "", parameter=parameter,
                from_s=wrong.from_s, until_s=wrong.until_s, value=value,
                panel=find_panels_showing_fault(wrong.kind)[0],
            )
        )  # fmt: skip
    return Answers(
        log_sha256=SHA256,
        mistakes=tuple(claims) or (NamedFault("none"),),
        verdict_kf=one.kf.verdict,  # type: ignore[arg-type]
        verdict_ekf2=one.ekf2.verdict or NOT_AVAILABLE,  # type: ignore[arg-type]
        ekf2_did=one.ekf2_did,
        quantities=one.quantities,
        choices=tuple(letter for _, letter in one.choices),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--students", type=int, default=300)
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        truths = list(pool.map(truth, range(given.students), chunksize=5))
    rng = np.random.default_rng(1)
    none = Answers(log_sha256=SHA256, mistakes=(NamedFault("none"),))
    loops = [one for one in truths if one.sigma_z_m < 0.05]
    aisles = [one for one in truths if one.sigma_z_m >= 0.05]
    print(f"{len(aisles)} aisles, {len(loops)} loops")
    for name, group in (("all", truths), ("aisles", aisles), ("loops", loops)):
        kinds = {wrong.kind for one in group for wrong in one.mistakes} | {"none"}
        best = {kind: max(fmean(compute_form_points(form, one).fraction for one in group)
                          for form in constants(group, kind))
                for kind in kinds}  # fmt: skip
        kind = max(best, key=lambda each: best[each])
        for what, form, times in (
            ("right", right, 1), ("random", lambda one: at_random(rng, one), GUESSES),
            ("none", lambda _: none, 1),
        ):  # fmt: skip
            shares = [
                compute_form_points(form(one), one).fraction for one in group for _ in range(times)
            ]
            print(f"{name:7} {what:7} {fmean(shares):.3f}")
        print(f"{name:7} best constant {best[kind]:.3f} ({kind})")


if __name__ == "__main__":
    main()
