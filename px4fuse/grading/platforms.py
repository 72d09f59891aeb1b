"""Who handed a file in and when, as far as learning platforms say it in the names of their exports.

A student chooses the name of the file and what is in a zip file, and nothing outside of it: what
the platform wrote stands first in a path, and the first match is taken.

Sources of the names:

- Moodle: ``mod/assign/feedback/file/importziplib.php`` of its repository, which reads the names
  back: ``{full name}_{participant}_assignsubmission_{plugin}_``, since 4.1 without the last ``_``.
- Canvas: "How do I download all student submissions for an assignment?", Instructor Guide:
  ``{surnamefirst}[_LATE]_{user}_{submission}_{file}``.
- Blackboard Learn: "Download assignments", Instructor Help:
  ``{assignment}_{user name}_attempt_{year-month-day-hour-minute-second}_{file}``.
- Gradescope: "Exporting submissions", Help Center: ``submission_{number}``, and beside them
  ``submission_metadata.yml`` with names, ids (``:sid:``) and times.
- ILIAS: multi-feedback of ``components/ILIAS/Exercise`` in its repository:
  ``{last}_{first}_{login}_{user}/``, where a late file's name begins with "Late Submission - " if
  the instructor's language is English; in others only ``--due`` tells.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from px4fuse.assignment.roster import Person

METADATA = "submission_metadata.yml"
# By platform: how its exports name files
PLATFORMS = {
    "moodle": re.compile(
        r"(?P<name>[^/]+?)_(?P<number>\d+)_assignsubmission_[a-z]+(?P<rest>_?(?:/|$)|_[^/]*$)"
    ),
    "canvas": re.compile(
        r"(?P<name>[^\W\d_][^/_]*)(?P<late>_LATE)?_(?P<number>\d+)_\d+_[^/]+(?:/|$)"
    ),
    "blackboard": re.compile(
        r"[^/]*?_(?P<login>[^/_]+)_attempt_(?P<time>\d{4}-\d\d-\d\d-\d\d-\d\d-\d\d)(?:_[^/]*|\.[^/.]+)$"
    ),
    "gradescope": re.compile(r"submission_(?P<number>\d+)(?:/|\.pdf$)"),
    # a login has a letter, and a number is not a year: "flight_lab_reports_2026/" is a folder
    "ilias": re.compile(
        r"(?P<last>[^\W\d_][^/_]*)_(?P<first>[^\W\d_][^/_]*)_(?P<login>[^/]*[^\W\d_][^/]*)"
        r"_(?P<number>(?!(?:19|20)\d\d/)\d+)/(?P<late>Late Submission - )?"
    ),
}
# What a platform writes into a name once, and nobody else by chance
_PARTS = re.compile(r"_attempt_\d{4}-|_\d+_assignsubmission_")
TIME_IN_NAMES = "%Y-%m-%d-%H-%M-%S"
_SUBMISSION = re.compile(r"^(?:submission_)?(\d+)(?:\.pdf)?:\s*\n((?:[ -].*\n?)*)", re.MULTILINE)
_SUBMITTERS = re.compile(r"^  :submitters:\s*\n((?:  - .*\n?|    .*\n?)*)", re.MULTILINE)


UNKNOWN = Person("")


@dataclass(frozen=True)
class ExportOrigin:
    """What a platform says of a file that was handed in.

    Attributes
    ----------
    platform : str
        One of :data:`PLATFORMS`; "" where the name is of no platform.
    person : Person
        The student, as far as the platform says; its number is the platform's own (Moodle's
        participant, Canvas's and ILIAS's user, Gradescope's submission), never the university's.
    time : datetime or None
        Without a time zone where the platform leaves it out.
    late : bool
        Whether the platform marks it so.
    imitated : bool
        Whether a student's own part of the name looks like a platform's.
    """

    platform: str = ""
    person: Person = UNKNOWN
    time: datetime | None = None
    late: bool = False
    imitated: bool = False


NOBODY = ExportOrigin()


def origin_of(name: str, platforms: Iterable[str] = tuple(PLATFORMS)) -> ExportOrigin:
    """Who handed a file in, by its path in the export.

    >>> origin_of("Doe Jane_4711_assignsubmission_file_/report.pdf").person.name
    'Doe Jane'
    >>> origin_of("doejane_LATE_12345_67890_report-1.pdf").person.numbers
    {'canvas': '12345'}
    >>> origin_of("Lab 3_jdoe_attempt_2026-11-20-12-34-56_report.pdf").time
    datetime.datetime(2026, 11, 20, 12, 34, 56)
    >>> origin_of("report.pdf") == ExportOrigin()
    True
    """
    parts = name.split("/")
    for index in range(len(parts)):
        tail = "/".join(parts[index:])
        for platform in platforms:
            match = PLATFORMS[platform].match(tail)
            if match is None:
                continue
            said = {key: value or "" for key, value in match.groupdict().items()}
            stamp = said.get("time", "")
            try:
                time = datetime.strptime(stamp, TIME_IN_NAMES) if stamp else None
            except ValueError:  # a 99th month: a student's own name
                continue
            whole = said.get("name") or f"{said.get('first', '')} {said.get('last', '')}".strip()
            numbers = {platform: said["number"]} if "number" in said else {}
            person = Person("", whole, "", said.get("login", ""), numbers)
            imitated = len(_PARTS.findall(name)) > (platform in ("moodle", "blackboard"))
            return ExportOrigin(platform, person, time, bool(said.get("late")), imitated)
    return NOBODY


def gradescope_metadata(text: str) -> dict[str, ExportOrigin]:
    r"""People and times of Gradescope's ``submission_metadata.yml``, by number of submission.

    Only what stands where Gradescope writes it: outputs of autograders are in it as well, deeper.
    Of a group the first member is named.

    >>> text = "submission_7:\n  :submitters:\n  - :name: Ada\n    :sid: '12'\n"
    >>> gradescope_metadata(text)["7"].person.student_id
    '12'
    """
    found = {}
    for number, block in _SUBMISSION.findall(text.replace("\r\n", "\n")):
        people = _SUBMITTERS.search(block)
        name, student_id, email = (
            _value(people[1] if people else "", rf"  (?:- |  ):{key}")
            for key in ("name", "sid", "email")
        )
        person = Person(student_id, name, email, "", {"gradescope": number})
        found[number] = ExportOrigin("gradescope", person, _time(_value(block, "  :created_at")))
    return found


def _value(block: str, key: str) -> str:
    """The first value of a key, without quotes."""
    match = re.search(rf"^{key}: *(['\"]?)(.*)\1 *$", block, re.MULTILINE)
    return match[2] if match else ""


def _time(value: str) -> datetime | None:
    """A time as YAML of Gradescope has it, with its zone.

    >>> _time("2026-11-20 12:34:56.123456000 Z").isoformat()
    '2026-11-20T12:34:56.123456+00:00'
    """
    try:
        found = datetime.fromisoformat(re.sub(r" (?=Z|[+-]\d)", "", value))
    except ValueError:
        return None
    return found if found.tzinfo else found.replace(tzinfo=UTC)
