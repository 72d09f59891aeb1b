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

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from px4fuse.grading.model import Submission

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
_BLACKBOARD_TIME = "%Y-%m-%d-%H-%M-%S"
_MAX_METADATA = 20_000_000


@dataclass(frozen=True)
class ExportOrigin:
    """What a platform says of a file that was handed in.

    Attributes
    ----------
    platform : str
        One of :data:`PLATFORMS`; "" where the name is of no platform.
    number : str
        The platform's own: Moodle's participant, Canvas's and ILIAS's user, Gradescope's
        submission. Never the university's.
    name, login, student_id, email : str
        Of the student; "" where the platform does not say.
    time : datetime or None
        Without a time zone where the platform leaves it out.
    late : bool
        Whether the platform marks it so.
    """

    platform: str = ""
    number: str = ""
    name: str = ""
    login: str = ""
    student_id: str = ""
    email: str = ""
    time: datetime | None = None
    late: bool = False


def origin_of(name: str, platforms: Iterable[str] = tuple(PLATFORMS)) -> ExportOrigin:
    """Who handed a file in, by its path in the export.

    >>> origin_of("Doe Jane_4711_assignsubmission_file_/report.pdf").name
    'Doe Jane'
    >>> origin_of("doejane_LATE_12345_67890_report-1.pdf").number
    '12345'
    >>> origin_of("Lab 3_jdoe_attempt_2026-11-20-12-34-56_report.pdf").time
    datetime.datetime(2026, 11, 20, 12, 34, 56)
    >>> origin_of("Lab_jdoe_attempt_2026-11-20-12-34-56_x_attempt_2026-11-19-01-02-03.pdf").login
    'jdoe'
    >>> origin_of("report.pdf") == ExportOrigin()
    True
    """
    parts = name.split("/")
    for index in range(len(parts)):
        tail = "/".join(parts[index:])
        for platform in platforms:
            match = PLATFORMS[platform].match(tail)
            found = match and _origin(platform, match.groupdict())
            if found:
                return found
    return ExportOrigin()


def origins_of(
    found: Sequence[Submission], people: Mapping[str, ExportOrigin]
) -> list[ExportOrigin]:
    """Who handed in each file, and by which platform.

    An export is of one platform: that of most of its files. What a student called a file, in the
    way of another platform, says nothing.
    """
    first = [origin_of(one.name) for one in found]
    exports = [one.file if one.entry else Path(one.name).parts[0] for one in found]
    counted: dict[object, Counter[str]] = defaultdict(Counter)
    for export, origin in zip(exports, first, strict=True):
        counted[export][origin.platform] += bool(origin.platform)
    made = []
    for one, export in zip(found, exports, strict=True):
        platform, count = counted[export].most_common(1)[0]
        origin = origin_of(one.name, (platform,)) if count else ExportOrigin()
        if origin.platform in ("gradescope", ""):
            # PDF assignments are exported as 123456.pdf
            stem = one.name.rpartition("/")[2].casefold().removesuffix(".pdf")
            origin = people.get(origin.number or stem, origin)
        made.append(origin)
    return made


def _origin(platform: str, said: Mapping[str, str | None]) -> ExportOrigin | None:
    time = None
    if stamp := said.get("time"):
        try:
            time = datetime.strptime(stamp, _BLACKBOARD_TIME)
        except ValueError:  # a 99th month: a student's own name
            return None
    whole = said.get("name") or " ".join(filter(None, (said.get("first"), said.get("last"))))
    return ExportOrigin(
        platform,
        said.get("number") or "",
        whole,
        said.get("login") or "",
        time=time,
        late=bool(said.get("late")),
    )


def gradescope_metadata(text: str) -> dict[str, ExportOrigin]:
    r"""People and times of Gradescope's ``submission_metadata.yml``, by number of submission.

    Read line by line, the few that are needed: outputs of autograders are in it as well, deeper.
    Of a group the first member is named.

    >>> text = "submission_7:\n  :submitters:\n  - :name: Ada\n    :sid: '12'\n"
    >>> gradescope_metadata(text)["7"].student_id
    '12'
    """
    found: dict[str, ExportOrigin] = {}
    number, block = "", ""
    for line in text[:_MAX_METADATA].splitlines():
        if top := re.match(r"(?:submission_)?(\d+)(?:\.pdf)?:\s*$", line):
            number, block = top[1], ""
            found[number] = ExportOrigin("gradescope", number)
        elif line[:1].strip():
            number = ""
        elif number and (key := re.match(r"  :(\w+):\s*(.*)$", line)):
            block = key[1]
            if block == "created_at":
                found[number] = replace(found[number], time=_iso(_unquoted(key[2])))
        elif number and block == "submitters":
            field = re.match(r"  (?:- |  ):(name|sid|email):\s*(.*)$", line)
            if field:
                said = _unquoted(field[2])
                known = found[number]
                found[number] = replace(
                    known,
                    name=known.name or said * (field[1] == "name"),
                    student_id=known.student_id or said * (field[1] == "sid"),
                    email=known.email or said * (field[1] == "email"),
                )
    return found


def _unquoted(value: str) -> str:
    value = value.strip()
    quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "'\""
    return value[1:-1] if quoted else value


def _iso(value: str) -> datetime | None:
    """A time as YAML and JSON of Gradescope have it, with its zone.

    >>> _iso("2026-11-20 12:34:56.123456000 Z").isoformat()
    '2026-11-20T12:34:56.123456+00:00'
    """
    plain = re.sub(r"(\.\d{6})\d*", r"\1", value.strip()).replace(" Z", "+00:00")
    plain = re.sub(r" (?=[+-]\d\d:?\d\d$)", "", plain)
    try:
        found = datetime.fromisoformat(plain)
    except ValueError:
        return None
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def seen(origins: Iterable[ExportOrigin]) -> tuple[str, ...]:
    """Platforms that files came from, in the order of :data:`PLATFORMS`."""
    there = {one.platform for one in origins}
    return tuple(name for name in PLATFORMS if name in there)
