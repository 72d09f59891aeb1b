"""What a report is made of: the comparison, its findings, and who it is for."""

from __future__ import annotations

from dataclasses import dataclass

from px4fuse.comparison import Comparison
from px4fuse.findings import Finding


@dataclass(frozen=True)
class Student:
    """Whose report it is; every part may be empty.

    Attributes
    ----------
    name, id : str
    notes : str
        The student's own words, Markdown.
    """

    name: str = ""
    id: str = ""
    notes: str = ""


@dataclass(frozen=True)
class Document:
    """One report.

    Attributes
    ----------
    comparison : Comparison
    findings : tuple of Finding
        Most severe first.
    student : Student
    command : str
        The command line that makes it again, without folders.
    """

    comparison: Comparison
    findings: tuple[Finding, ...]
    student: Student
    command: str
