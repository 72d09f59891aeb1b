"""Errors that px4fuse raises.

::

    Px4FuseError
    ├── LogError           the file cannot be read, or is not a flight log
    ├── MissingDataError   the log does not contain the required data
    ├── TrajectoryError    a trajectory or pose graph cannot be read or used
    ├── SettingsError      a setting is not valid
    ├── ResultsError       a file contains no results that this px4fuse version can read
    └── OutputError        a result cannot be written

The text is one line: the error, the file or setting, and advice. On the command line, Python
arguments in backticks (`sigma_z_m`) are replaced by options (--sigma-z); the exit code is 2.
"""

from collections.abc import Iterable
from pathlib import PurePath


def suggest_name(
    name: str, known_names: Iterable[str], folder: PurePath | None = None, cutoff: float = 0.7
) -> str:
    """Return "Did you mean X? " with the most similar known name X (in ``folder``), or "".

    >>> suggest_name("EKF2_EVP_NOIS", ["EKF2_EVP_GATE", "EKF2_EVP_NOISE"]), suggest_name("x", ["y"])
    ('Did you mean EKF2_EVP_NOISE? ', '')
    """
    import difflib  # noqa: PLC0415 - needed for errors only

    similar_names = difflib.get_close_matches(name, list(known_names), n=1, cutoff=cutoff)
    return f"Did you mean {PurePath(folder or '', similar_names[0])}? " if similar_names else ""


def to_one_line(text: str) -> str:
    r"""Replace line feeds and control characters, which file names may contain.

    >>> to_one_line("a\nb\x1b[2J")
    'a b?[2J'
    """
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class Px4FuseError(Exception):
    """Base class of all errors of px4fuse, with a text on one line.

    Parameters
    ----------
    reason : str
        Error, with the file or setting that causes it.
    remedy : str
        Advice to the user; "" if ``reason`` already contains it.
    """

    def __init__(self, reason: str, remedy: str = "") -> None:
        text, self.remedy = to_one_line(reason), to_one_line(remedy)
        self.reason = text.removesuffix(".")
        super().__init__(f"{self.reason}. {self.remedy}" if remedy else text)


class LogError(Px4FuseError):
    """The file cannot be read, or is not a flight log."""

    id = "log_unreadable"


class MissingDataError(Px4FuseError):
    """The log does not contain the required data."""

    id = "data_missing"


class TrajectoryError(Px4FuseError):
    """A trajectory or pose graph cannot be read or used."""


class SettingsError(Px4FuseError):
    """A setting is not valid, for example out of range."""


class ResultsError(Px4FuseError):
    """A file contains no results that this px4fuse version can read."""


class OutputError(Px4FuseError):
    """A result cannot be written."""
