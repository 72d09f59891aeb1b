"""When something was due, and what handing it in late costs.

Points are taken off for every started day (or hour) after the due time: so many per cent of the
most points that there are to have, never more than the limit that the rule names, and never below
zero points.
"""

import math
import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from px4fuse.errors import SettingsError

_RULE = re.compile(
    r"(?P<rate>\d+(?:\.\d+)?)\s*%\s*/\s*(?P<unit>day|hour)"
    r"(?:\s+up to\s+(?P<most>\d+(?:\.\d+)?)\s*%)?"
)
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
    words = text.split()
    try:
        zone = ZoneInfo(words.pop()) if words and words[-1][0].isalpha() else None
        found = datetime.fromisoformat("T".join(words[:2]) + "".join(words[2:]))
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise SettingsError(
            f"--due {text!r}: give a time such as '2026-11-20 23:59', with or without a time zone "
            "('+01:00' or 'Europe/Berlin') behind it."
        ) from error
    clock = re.search(r"\d\d:\d\d(:\d\d)?", text)
    if clock is None:
        found = found.replace(hour=23, minute=59)
    if clock is None or clock[1] is None:
        found = found.replace(second=59)
    return found.replace(tzinfo=zone) if zone else found if found.tzinfo else found.astimezone()


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
        with suppress(ValueError):
            return datetime.strptime(text.strip(), form)
    return None
