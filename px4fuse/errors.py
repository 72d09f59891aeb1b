"""Errors that px4fuse raises.

::

    Px4FuseError
    ├── LogError           the log cannot be read, or is not one
    ├── MissingDataError   the log can be read, but the required data are not in it
    ├── TrajectoryError    a trajectory or pose graph cannot be read or used
    ├── SettingsError      a setting is outside its documented range
    ├── ResultsError       a file contains no results of px4fuse that this version reads
    └── OutputError        a result cannot be written

The text is one line: the error, the file or setting, and advice. The command line replaces Python
arguments in backticks (`sigma_z_m`) by options (--sigma-z), and ends with exit code 2.
"""

from collections.abc import Iterable


def suggest_name(name: str, known_names: Iterable[str]) -> str:
    """Return "Did you mean X? " with the most similar known name X.

    Return an empty string if there is no similar name.

    >>> suggest_name("EKF2_EVP_NOIS", ["EKF2_EVP_GATE", "EKF2_EVP_NOISE"]), suggest_name("x", ["y"])
    ('Did you mean EKF2_EVP_NOISE? ', '')
    """
    import difflib  # noqa: PLC0415 - needed for errors only

    similar = difflib.get_close_matches(name, list(known_names), n=1, cutoff=0.7)
    return f"Did you mean {similar[0]}? " if similar else ""


def to_one_line(text: str) -> str:
    r"""Replace characters that would break or change the line on which the text is printed.

    File names may contain line feeds and escape sequences of a terminal.

    >>> to_one_line("a\nb\x1b[2J")
    'a b?[2J'
    """
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class Px4FuseError(Exception):
    """Base class of all errors of px4fuse, with a text on one line.

    Parameters
    ----------
    reason : str
        The error, with the file or setting that causes it.
    remedy : str
        Advice to the user, one or more sentences; empty if the reason contains it.
    """

    def __init__(self, reason: str, remedy: str = "") -> None:
        text, self.remedy = to_one_line(reason), to_one_line(remedy)
        self.reason = text.removesuffix(".")
        super().__init__(f"{self.reason}. {self.remedy}" if remedy else text)


class LogError(Px4FuseError):
    """The log cannot be read, or is not a flight log."""

    id = "log_unreadable"


class MissingDataError(Px4FuseError):
    """The log was read, but the required data are not in it."""

    id = "data_missing"


class TrajectoryError(Px4FuseError):
    """A trajectory or pose graph cannot be read, or the required data are not in it."""


class SettingsError(Px4FuseError):
    """A setting is outside its documented range."""


class ResultsError(Px4FuseError):
    """A file contains no results of px4fuse, or none that this version reads."""


class OutputError(Px4FuseError):
    """A result cannot be written."""
