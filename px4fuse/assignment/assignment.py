"""Individual simulated flights for a class, with an answer key for the instructor."""

import hashlib
import secrets
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from px4fuse.answer_form import form_name, form_text
from px4fuse.assignment.key import Answer, AnswerKey, key_text, read_key
from px4fuse.assignment.random_assignment import AssignedFlight, Kinds, draw
from px4fuse.assignment.roster import Person, normalise_text
from px4fuse.assignment.truth import form_truth
from px4fuse.errors import OutputError, SettingsError
from px4fuse.input_files import inputs_not_registered
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import parse
from px4fuse.text import to_json_types
from px4fuse.writing import write_all

# numbers of the simulation that the answer key contains
TRUTH = (
    "duration_s",
    "sigma_z_m",
    "sigma_a_m_s2",
    "reported_sigma_m",
    "clock_offset_to_add_s",
    "path_length_m",
    "closure_error_m",
)


def fly(
    secret: bytes, student: Person, kind: Kinds, count: int | None = None, truth: bool = True
) -> tuple[bytes, Answer]:
    """Simulate the flight of one student; return its log (ULog) and its answer."""
    assigned_flight = draw(secret, student.student_id, kind, count, truth)
    simulation = flights.simulate(assigned_flight.scenario, parse(assigned_flight.typed))
    log = flights.to_ulog(simulation)
    sha256 = hashlib.sha256(log).hexdigest()
    known = flights.answer(simulation)["truth"]
    return log, Answer(
        student_id=student.student_id,
        name=student.name,
        file=student.file,
        sha256=sha256,
        scenario=to_json_types(asdict(assigned_flight.scenario)),
        mistakes=assigned_flight.typed,
        truth={name: float(known[name]) for name in TRUTH},
        difficulty=assigned_flight.difficulty,
        form=form_truth(simulation, sha256),
    )


def key_path(folder: Path, key_option: Path | None) -> Path:
    """Return the path of the answer key, by default beside the students' folder.

    Raises
    ------
    OutputError
        The path is inside the students' folder.
    """
    resolved_folder = folder.resolve()
    path = key_option or resolved_folder.parent / f"{resolved_folder.name}_answers.json"
    if resolved_folder in (path.resolve(), *path.resolve().parents):
        raise OutputError(
            f"{path} is in the students' folder, so students could read the answer key. "
            "Choose another place with --answer."
        )
    return path


def assign(
    students: Sequence[Person],
    folder: Path,
    key_file: Path,
    secret: bytes | None,
    kind: Kinds,
    count: int | None = None,
    truth: bool = True,
    step: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[AnswerKey, int]:
    """Write log and form of each student into a folder, and the answer key.

    The key is written before log and form of a student, so that an interrupted run can continue.
    Existing files are never replaced: an existing log must be identical, and a key may only gain
    students.

    Parameters
    ----------
    secret : bytes or None
        None uses the secret of an existing key, or generates one.
    count : int, optional
        Number of mistakes per flight; drawn by default.
    truth : bool
        Logs of aisle flights contain the ground truth.
    step : callable
        Called after each flight with the number of finished flights and of all.

    Returns
    -------
    AnswerKey
    int
        Number of logs that were written; the others existed already.

    Raises
    ------
    SettingsError
        One flight cannot have this many mistakes.
    OutputError
        A file exists with other content, or cannot be written.
    """
    with inputs_not_registered():
        key = read_key(key_file) if key_file.exists() else AnswerKey(kind, ())
    answers = {normalise_text(answer.student_id): answer for answer in key.answers}
    _check_extends(
        key_file,
        key.kind == kind and answers.keys() <= {normalise_text(s.student_id) for s in students},
    )
    new_secret = key.secret
    if secret is None:
        new_secret = new_secret or secrets.token_urlsafe(24)
        secret = new_secret.encode()
    elif new_secret.encode() != secret:
        new_secret = ""
    written = 0
    for done, student in enumerate(students, start=1):
        log, answer = fly(secret, student, kind, count, truth)
        known = answers.setdefault(normalise_text(student.student_id), answer)
        _check_extends(key_file, known.sha256 == answer.sha256)
        form = form_text(student.file, answer.sha256).encode()
        contents = {folder / student.file: log, folder / form_name(student.file): form}
        new = {
            path: content for path, content in contents.items() if not _is_written(path, content)
        }
        key = AnswerKey(kind, tuple(answers.values()), new_secret)
        # the key first: an interrupted run needs its secret to continue
        write_all({key_file: key_text(key).encode()})
        key_file.chmod(0o600)  # readable only for the instructor
        write_all(new)
        written += folder / student.file in new
        step(done, len(students))
    return key, written


def preview(
    students: Sequence[Person],
    key_file: Path,
    secret: bytes | None,
    kind: Kinds,
    count: int | None = None,
) -> list[AssignedFlight]:
    """Draw the flights of :func:`assign` without simulating them or writing files.

    Raises
    ------
    SettingsError
        One flight cannot have this many mistakes, or there is no secret.
    OutputError
        The existing key was made by an earlier px4fuse.
    """
    if secret is None:
        before = read_key(key_file) if key_file.exists() else None
        if before is None or not before.secret:
            raise SettingsError(
                "--preview requires --secret-file or --secret. A generated secret is not "
                "stored, so the next run would draw other flights."
            )
        secret = before.secret.encode()
    return [draw(secret, student.student_id, kind, count) for student in students]


def _is_written(target: Path, log: bytes) -> bool:
    """Return True if the file exists with this content; OutputError if it differs."""
    if not target.exists() and not target.is_symlink():
        return False
    if target.is_file() and target.stat().st_size == len(log) and target.read_bytes() == log:
        return True
    raise OutputError(
        f"{target} already exists with other content. It was not "
        "overwritten. Use the same secret and options as before, or another folder "
        "(-o)."
    )


def _check_extends(key_file: Path, same: bool) -> None:
    """Raise OutputError if an existing answer key is not part of the new one."""
    if not same:
        raise OutputError(
            f"{key_file} is the answer key of other flights. It was not overwritten. Use "
            "the same secret, options and students as before (more students may be "
            "added), or another file (--answer)."
        )
