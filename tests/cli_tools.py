"""Run px4fuse commands in tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from px4fuse.cli import cli, main
from px4fuse.errors import Px4FuseError


def run(*arguments: object) -> Result:
    """Run a command as in a pipe, so that no line is wrapped."""
    return CliRunner(env={"COLUMNS": None}).invoke(cli, [str(argument) for argument in arguments])


def run_checked(*arguments: object, code: int = 0) -> Result:
    """Run a command and check its exit code."""
    result = run(*arguments)
    assert result.exit_code == code, (arguments, result.output, result.exception)
    return result


def error_line(*arguments: object) -> str:
    """Run a command that fails, check that its error is one line, and return the error."""
    result = run(*arguments)
    assert isinstance(result.exception, Px4FuseError), (arguments, result.output)
    assert result.stdout == ""
    assert "\n" not in str(result.exception)
    return str(result.exception)


def run_main(monkeypatch, capsys, *arguments: str | Path) -> tuple[int, str, str]:
    """Run the entry point; return exit code, standard output and standard error."""
    monkeypatch.setattr(sys, "argv", ["px4fuse", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    out, err = capsys.readouterr()
    return int(stopped.value.code or 0), out, err


def contents(folder: Path) -> dict[str, bytes]:
    """Return the content of each file in a folder by its name."""
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
