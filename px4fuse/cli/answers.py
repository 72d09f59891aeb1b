"""Command ``px4fuse answers``: writes a form with questions about a flight for a student."""

import hashlib
from pathlib import Path

import click

from .options import log_argument, output_option
from .outputs import write_new_file


@click.command()
@log_argument
@output_option("FILE.toml", "Answer form to write (TOML).  [default: LOG.answers.toml beside LOG]")
def answers(log: Path, output: Path | None) -> None:
    """Write an empty form for a student's diagnosis of a flight.

    The form contains questions on injected faults, the behaviour of EKF2, and three numbers.
    Complete the form and give it to px4fuse compare --answers.
    """
    from px4fuse.core.reading import read_log_bytes
    from px4fuse.results.answer_form import form_name, format_answer_form

    form_path = output or log.with_name(form_name(log.name))
    sha256 = hashlib.sha256(read_log_bytes(log)).hexdigest()
    write_new_file(form_path, format_answer_form(log.name, sha256).encode())
