"""``px4fuse answers``: the form about a flight, to fill in."""

import hashlib
from pathlib import Path

import click

from px4fuse.cli.inputs import InputPath, options
from px4fuse.cli.outputs import write_new


@click.command()
@click.argument("log", type=InputPath())
@options("answers")
def answers(log: Path, output: Path | None) -> None:
    """Write the form about a flight: what is wrong with it, what EKF2 did, three numbers.

    Fill it in and give it to px4fuse compare --answers.
    """
    from px4fuse.answers import form_name, form_text
    from px4fuse.reading import read_log_bytes

    target = output or log.with_name(form_name(log.name))
    sha256 = hashlib.sha256(read_log_bytes(log)).hexdigest()
    write_new(target, form_text(log.name, sha256).encode())
