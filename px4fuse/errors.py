"""Everything that px4fuse raises on purpose.

::

    Px4FuseError
    ├── LogError           the log cannot be read, or is not one
    ├── MissingDataError   the log can be read but lacks what was asked for
    ├── TrajectoryError    a trajectory or pose graph cannot be read or used
    ├── SettingsError      a setting is outside its documented range
    ├── ResultsError       a file holds no results of px4fuse that this version reads
    └── OutputError        a result cannot be written

The text of each is one line for a person: what is wrong, where, and what to do. It names arguments
as Python does, in backticks (`sigma_z_m`); the command line puts its options in their place
(:func:`px4fuse.request.with_options`), prints it on standard error and ends with exit code 2.
"""

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Self


def suggest_name(name: str, known: Iterable[str]) -> str:
    """The known name that a mistyped one is nearest to, as a question; empty where none is near.

    >>> suggest_name("EKF2_EVP_NOIS", ["EKF2_EVP_GATE", "EKF2_EVP_NOISE"]), suggest_name("x", ["y"])
    ('Did you mean EKF2_EVP_NOISE? ', '')
    """
    import difflib  # noqa: PLC0415 - where something is wrong only

    near = difflib.get_close_matches(name, list(known), n=1)
    return f"Did you mean {near[0]}? " if near else ""


def to_one_line(text: str) -> str:
    r"""A text without what would break or rewrite the line on which it is printed.

    File names may hold line feeds and a terminal's escape sequences.

    >>> to_one_line("a\nb\x1b[2J")
    'a b?[2J'
    """
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


@cache
def _error_texts() -> Mapping[str, list[str]]:
    """Reason, and remedy where there is one, of every case."""
    import tomllib  # noqa: PLC0415 - where something is wrong only

    return tomllib.loads(Path(__file__).with_name("refusals.toml").read_text("utf-8"))


class Px4FuseError(Exception):
    """Base of all errors that px4fuse raises on purpose; all is put on one line.

    Parameters
    ----------
    reason : str
        What is wrong, and where.
    remedy : str
        What to do, a sentence; empty where the reason says it.
    """

    def __init__(self, reason: str, remedy: str = "") -> None:
        text, self.remedy = to_one_line(reason), to_one_line(remedy)
        self.reason = text.removesuffix(".")
        super().__init__(f"{self.reason}. {self.remedy}" if remedy else text)

    @classmethod
    def of(cls, case: str, /, **facts: object) -> Self:
        """The error of a case, in the words of ``refusals.toml``.

        >>> str(SettingsError.of("no_column", path="class.csv")).partition(". ")[0]
        'class.csv: no column tells who a student is'
        """
        return cls(*(text.format_map(facts) for text in _error_texts()[case]))


class LogError(Px4FuseError):
    """The log cannot be read, or is not a flight log."""


class MissingDataError(Px4FuseError):
    """The log was read, but what was asked for is not in it."""


class TrajectoryError(Px4FuseError):
    """A trajectory or pose graph cannot be read, or lacks what was asked for."""


class SettingsError(Px4FuseError):
    """A setting is outside its documented range."""


class ResultsError(Px4FuseError):
    """A file holds no results of px4fuse, or none that this version reads."""


class OutputError(Px4FuseError):
    """A result cannot be written."""
