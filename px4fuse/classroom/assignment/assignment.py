"""Writing of an assignment: log and question form for each student, and the answer key."""

import hashlib
import secrets
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from px4fuse.core.input_files import protect_inputs
from px4fuse.core.text import to_json_types
from px4fuse.core.writing import write_output_files
from px4fuse.errors import OutputError
from px4fuse.results.answer_form import form_name, format_answer_form
from px4fuse.simulation import flights
from px4fuse.simulation.faults import parse_faults

from .figures import draw_figures, make_choice_questions
from .key import (
    AnswerKey,
    CorrectAnswers,
    compute_form_answers,
    format_answer_key,
    read_answer_key,
)
from .random_assignment import (
    DrawRandomNumber,
    FlightKind,
    assign_random_flight,
    derive_hmac_key,
    draw_uniform,
)
from .roster import Person, normalise_text


def simulate_assigned_flight(
    secret: bytes,
    student: Person,
    kind: FlightKind,
    fault_count: int | None = None,
    with_ground_truth: bool = True,
) -> tuple[bytes, CorrectAnswers]:
    """Simulate the flight of one student; return the log (ULog) and the right answers."""
    assigned_flight = assign_random_flight(
        secret, student.student_id, kind, fault_count, with_ground_truth
    )
    simulation = flights.simulate(
        assigned_flight.scenario, parse_faults(assigned_flight.mistake_options)
    )
    log = flights.to_ulog(simulation, is_assessed=True)
    sha256 = hashlib.sha256(log).hexdigest()
    true_values = flights.compute_true_values(simulation)
    right_form_answers = replace(
        compute_form_answers(simulation, sha256),
        choices=make_choice_questions(partial(draw_uniform, secret, student.student_id, kind)),
    )
    return log, CorrectAnswers(
        student_id=student.student_id,
        name=student.name,
        file=student.log_file_name,
        sha256=sha256,
        scenario=to_json_types(assigned_flight.scenario),
        mistakes=assigned_flight.mistake_options,
        # numbers only: the answer key has no lists, such as the times of the outliers
        true_values={
            name: value for name, value in true_values.items() if isinstance(value, float)
        },
        difficulty=assigned_flight.difficulty,
        form=right_form_answers,
    )


def answer_key_path(folder: Path, key_option: Path | None) -> Path:
    """Return the path of the answer key, by default next to the students' folder.

    Raises
    ------
    OutputError
        The path is inside the students' folder.
    """
    resolved_folder = folder.resolve()
    path = key_option or resolved_folder.parent / f"{resolved_folder.name}_answers.json"
    if path.resolve().is_relative_to(resolved_folder):
        raise OutputError(
            f"The answer key {path} would be in the students' folder. Choose another folder with "
            "--answer."
        )
    return path


def write_assignment(
    students: Sequence[Person],
    folder: Path,
    key_file: Path,
    secret: bytes | None,
    kind: FlightKind,
    fault_count: int | None = None,
    with_ground_truth: bool = True,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> tuple[AnswerKey, int]:
    """Write log, answer form and figures of each student to a folder, and the answer key.

    Existing files are not overwritten.

    Parameters
    ----------
    secret : bytes or None
        Seed of the random numbers; None for a random seed, which the answer key stores.
    fault_count : int, optional
        Number of injected faults of each flight; random by default.
    with_ground_truth : bool
        True to log the ground truth.

    Returns
    -------
    key : AnswerKey
        Right answers for all students.
    written_count : int
        Number of new logs.

    Raises
    ------
    SettingsError
        A flight cannot have ``fault_count`` injected faults.
    OutputError
        A file exists with other content, or cannot be written.
    """
    # add the students to an existing answer key
    key = AnswerKey(kind, ())
    if key_file.exists():
        with protect_inputs(is_active=False):
            key = read_answer_key(key_file)
    answers = {normalise_text(answer.student_id): answer for answer in key.answers}
    # an answer key without these students belongs to another class
    is_key_of_this_class = not answers or any(
        normalise_text(student.student_id) in answers for student in students
    )
    _require_answer_key_of_same_flights(key_file, key.kind == kind and is_key_of_this_class)
    if secret is None:
        # an existing answer key contains the secret of its flights
        stored_secret = key.secret or secrets.token_urlsafe(24)
        secret = derive_hmac_key(stored_secret)
    else:
        # a secret that the user gave is not written to a file
        stored_secret = key.secret if derive_hmac_key(key.secret) == secret else ""
    written_count = 0
    for finished_count, student in enumerate(students, start=1):
        log, answer = simulate_assigned_flight(
            secret, student, kind, fault_count, with_ground_truth
        )
        # if the answer key already contains the right answers for this student, keep them
        stored_answer = answers.setdefault(normalise_text(student.student_id), answer)
        _require_answer_key_of_same_flights(key_file, stored_answer.sha256 == answer.sha256)
        log_file = folder / student.log_file_name
        missing_content_by_path = _make_missing_files(
            log_file, log, stored_answer, partial(draw_uniform, secret, student.student_id, kind)
        )
        key = AnswerKey(kind, tuple(answers.values()), stored_secret)
        # store the secret before the log: a restart after an interruption needs the secret
        write_output_files({key_file: format_answer_key(key).encode()})
        key_file.chmod(0o600)  # only the instructor can read the answer key
        write_output_files(missing_content_by_path)
        written_count += log_file in missing_content_by_path
        progress(finished_count, len(students))
    return key, written_count


def _make_missing_files(
    log_file: Path, log: bytes, answer: CorrectAnswers, draw_number: DrawRandomNumber
) -> dict[Path, bytes]:
    """Return the contents of log, answer form and figures of a student, except existing files."""
    # the questions must be those of the answer key, also if an earlier version wrote the key
    choices = answer.form.choices if answer.form else ()
    empty_form = format_answer_form(
        log_file.name, answer.sha256, [choice for choice, _ in choices]
    ).encode()
    form_file = log_file.with_name(form_name(log_file.name))
    contents = {
        path: content
        for path, content in ((log_file, log), (form_file, empty_form))
        if not _exists_with_same_content(path, content)
    }
    # a figure is never compared: its bytes depend on the version of Matplotlib
    figures_file = log_file.with_suffix(".png")
    if not figures_file.exists():
        contents[figures_file] = draw_figures(draw_number)
    return contents


def _exists_with_same_content(path: Path, content: bytes) -> bool:
    """Return True if the file exists with this content.

    Raises
    ------
    OutputError
        The file exists with other content.
    """
    if not path.exists() and not path.is_symlink():
        return False
    if path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content:
        return True
    raise OutputError(
        f"{path} exists with other content and was not overwritten. Repeat the command that "
        "wrote the file with the same secret and options, or choose another folder (-o)."
    )


def _require_answer_key_of_same_flights(key_file: Path, has_same_flights: bool) -> None:
    """Raise an OutputError if the answer key is of other flights or of another class."""
    if not has_same_flights:
        raise OutputError(
            f"{key_file} is the answer key of other flights and was not overwritten. Choose "
            "another file with --answer. To add students to the key, repeat the command that "
            "wrote it, with the same secret and options, and all students."
        )
