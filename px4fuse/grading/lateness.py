"""When something was due, and what handing it in late costs.

Points are taken off for every started day (or hour) after the due time: so many per cent of the
most points that there are to have, never more than the limit that the rule names, and never below
zero points.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from px4fuse.errors import SettingsError

_RULE = re.compile(
    r"(?P<rate>\d+(?:\.\d+)?)\s*%\s*/\s*(?P<unit>day|hour)"
    r"(?:\s+up to\s+(?P<most>\d+(?:\.\d+)?)\s*%)?"
)
# What is left of the minute or day that is named
_REST = {
    "%Y-%m-%d %H:%M:%S": timedelta(0),
    "%Y-%m-%d %H:%M": timedelta(seconds=59),
    "%Y-%m-%d": timedelta(hours=23, minutes=59, seconds=59),
}
# Moodle's strftimedaydatetime in English, with hours of twelve and of twenty-four
_MOODLE_FORMATS = ("%A, %d %B %Y, %I:%M %p", "%A, %d %B %Y, %H:%M")


@dataclass(frozen=True)
class LateRule:
    """What late hand-ins cost.

    Attributes
    ----------
    share : float
        Of the most points, for every started unit.
    most : float
        Share that is never exceeded.
    text : str
        As it was given.
    """

    share: float
    unit_s: float
    most: float
    text: str

    def deduction(self, late_s: float, of: float) -> float:
        """Points that are taken off.

        >>> late_rule("10%/day").deduction(86_401.0, 50.0)
        10.0
        >>> late_rule("10%/day up to 30%").deduction(1e9, 50.0)
        15.0
        """
        units = math.ceil(max(late_s, 0.0) / self.unit_s)
        return round(of * min(units * self.share, self.most), 2)


def late_rule(text: str) -> LateRule:
    """Read ``10%/day`` or ``10%/day up to 50%``.

    Raises
    ------
    SettingsError
        It is not such a rule.
    """
    match = _RULE.fullmatch(text.strip())
    if match is None or not 0.0 <= float(match["rate"]) <= 100.0:
        raise SettingsError(f"--late {text!r}: give a rule such as 10%/day or 10%/day up to 50%.")
    unit_s = {"day": 86_400.0, "hour": 3_600.0}[match["unit"]]
    most = min(float(match["most"] or 100.0) / 100.0, 1.0)
    return LateRule(float(match["rate"]) / 100.0, unit_s, most, text.strip())


def due_time(text: str) -> datetime:
    """Read a due time: ``2026-11-20 23:59``, with a zone ``+01:00`` or ``Europe/Berlin`` behind it.

    Without a zone it is that of this computer. A date alone means the end of that day, and a time
    without seconds the end of that minute.

    Raises
    ------
    SettingsError
        It is not such a time.
    """
    words = text.strip().replace("T", " ", 1).split()
    zone: tzinfo | None = None
    if len(words) > 1 and (words[-1][:1].isalpha() or words[-1][:1] in "+-"):
        zone = _zone(words.pop(), text)
    elif offset := re.search(r"(?<=:\d\d)(Z|[+-]\d\d:?\d\d)$", words[-1] if words else ""):
        words[-1] = words[-1].removesuffix(offset[0])
        zone = _zone(offset[0], text)
    for form, rest in _REST.items():
        try:
            found = datetime.strptime(" ".join(words), form)
        except ValueError:
            continue
        found += rest
        return found.replace(tzinfo=zone) if zone else found.astimezone()
    raise SettingsError(
        f"--due {text!r}: give a time such as '2026-11-20 23:59' or "
        "'2026-11-20 23:59 Europe/Berlin'."
    )


def _zone(name: str, text: str) -> tzinfo:
    if name == "Z":
        name = "+00:00"
    if name[0] in "+-":
        try:
            zone = datetime.strptime(name, "%z").tzinfo
        except ValueError:
            zone = None
        if zone is not None:
            return zone
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"--due {text!r}: there is no time zone {name!r}. Give one such as +01:00 or "
            "Europe/Berlin."
        ) from error


def in_zone_of(time: datetime, due: datetime | None) -> datetime:
    """A platform's time, which is in the zone of the due time where it says none."""
    if time.tzinfo is not None:
        return time
    return time.replace(tzinfo=due.tzinfo) if due is not None else time.astimezone()


def moodle_time(text: str) -> datetime | None:
    """When Moodle's worksheet says that something was handed in; None where it cannot be read.

    >>> moodle_time("Friday, 20 November 2026, 11:58 PM").isoformat()
    '2026-11-20T23:58:00'
    >>> moodle_time("-")
    """
    for form in _MOODLE_FORMATS:
        try:
            return datetime.strptime(text.strip(), form)
        except ValueError:
            continue
    return None
