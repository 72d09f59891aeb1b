"""From what was handed in to one row per student: which attempt counts, and what it is worth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Literal

from px4fuse.assignment.sheet import Sheet
from px4fuse.grading.class_table import item_points, settled_report
from px4fuse.grading.lateness import LateRule, in_zone_of
from px4fuse.grading.model import Entry, Graded, Override, Submission
from px4fuse.grading.overrides import TOTAL, Overrides, matched
from px4fuse.grading.platforms import ExportOrigin
from px4fuse.grading.roster import Person, Register
from px4fuse.results.reading import one_line

Attempt = Literal["latest", "best", "first"]
SHOWN = "%Y-%m-%d %H:%M"


@dataclass(frozen=True)
class Term:
    """The rules of a class.

    Attributes
    ----------
    attempt : {"latest", "best", "first"}
        Which one counts of several.
    due : datetime or None
        With a time zone.
    times : mapping
        Index of a person in the register to when Moodle says that the work was handed in.
    include_pending : bool
        Whether points that wait for the instructor are entered as they are proposed.
    """

    attempt: Attempt = "latest"
    due: datetime | None = None
    late: LateRule | None = None
    times: Mapping[int, datetime] | None = None
    include_pending: bool = False


@dataclass(frozen=True)
class Course:
    """What is known of a class besides what it handed in.

    Attributes
    ----------
    roster : tuple of Person or None
        Without one the students of the answer key, else those of the worksheets.
    worksheets : tuple of Sheet
        Tables of learning platforms, to be filled in.
    column : str
        Of the worksheets, for the grade; "" where there is only one.
    term : Term
        Which attempt counts, and what being late costs.
    anonymous : bool
        Whether the class page shows pseudonyms.
    """

    roster: tuple[Person, ...] | None = None
    worksheets: tuple[Sheet, ...] = ()
    column: str = ""
    term: Term = field(default_factory=Term)
    anonymous: bool = False


@dataclass(frozen=True)
class _Try:
    """One attempt: the file, when it came, and what that costs."""

    graded: Graded
    origin: ExportOrigin
    time: datetime | None
    packed: datetime | None
    late_s: float | None
    deduction: float
    remarks: tuple[str, ...]

    @property
    def read(self) -> bool:
        return bool(self.graded.version)

    @property
    def worth(self) -> float:
        """For the best of several: what counts, pending ones last."""
        points = self.graded.counted
        return -1.0 if points is None else max(points - self.deduction, 0.0)

    @property
    def order(self) -> tuple[float, float, float, str]:
        """By time, of one submission the better file later."""
        times = (0.0 if one is None else one.timestamp() for one in (self.time, self.packed))
        return (*times, self.worth, self.graded.submission)  # type: ignore[return-value]


def class_entries(
    graded: Sequence[Graded],
    submissions: Sequence[Submission],
    origins: Sequence[ExportOrigin],
    register: Register | None,
    term: Term,
    overrides: Overrides,
) -> tuple[tuple[Entry, ...], tuple[str, ...]]:
    """Lay out a class: everyone in the register, then what belongs to nobody in it.

    A file belongs to whom the platform says; where it says nothing that the register knows, to
    whom the report names, by id, then by name. Without a register every student that the reports
    or the platform name has a row.

    Parameters
    ----------
    graded, submissions, origins : sequences
        Of every file, in one order.

    Returns
    -------
    entries : tuple of Entry
    notes : tuple of str
        On overrides that fit nobody.
    """
    everyone = register or Register(_named(graded, origins))
    owners: dict[int, list[int]] = defaultdict(list)
    nobody: list[int] = []
    for index, (one, origin) in enumerate(zip(graded, origins, strict=True)):
        place = everyone.by_platform(origin)
        if place is None:
            place = everyone.by_report(one.student_id, one.student)
        (nobody if place is None else owners[place]).append(index)

    def tries(members: Sequence[int], place: int | None = None) -> list[_Try]:
        return [
            _try(graded[at], submissions[at], origins[at], term, place, everyone) for at in members
        ]

    made = [
        _entry(person, tries(owners[place], place), term)
        for place, person in enumerate(everyone.people)
    ]
    note = "Not in the roster." if register else "Neither the report nor the platform names anyone."
    for index in nobody:
        one = graded[index]
        person = Person(one.student_id, one_line(one.student or origins[index].name, 200))
        entry = _entry(person, tries([index]), term)
        made.append(replace(entry, remarks=(note, *entry.remarks)))
    titles = [tuple(item_points(one.counting)) if one.counting else () for one in made]
    said, notes = matched(overrides, made, titles)
    most = max((one.of for one in graded), default=0.0)
    settled = (
        _settled(one, words, most, term.include_pending)
        for one, words in zip(made, said, strict=True)
    )
    return tuple(settled), notes


def _named(graded: Sequence[Graded], origins: Sequence[ExportOrigin]) -> list[Person]:
    """Without a roster: everyone whom a platform, else a report, names; each once."""
    register = Register([])
    for one, origin in zip(graded, origins, strict=True):
        if origin.platform and (origin.number or origin.login):
            if register.by_platform(origin) is not None:
                continue
            numbers = {origin.platform: origin.number} if origin.number else {}
            same = register.by_report(one.student_id, "")
            # two students may not hand in under one id: the second is known by the platform alone
            student_id = origin.student_id or ("" if same is not None else one.student_id)
            register.people.append(
                Person(
                    student_id or origin.login or origin.number,
                    one_line(one.student if student_id else origin.name, 200) or origin.name,
                    origin.email,
                    origin.login,
                    numbers,
                )
            )
        elif one.student_id and register.by_report(one.student_id, "") is None:
            register.people.append(Person(one.student_id, one_line(one.student, 200)))
    return register.people


def _try(
    graded: Graded,
    submission: Submission,
    origin: ExportOrigin,
    term: Term,
    place: int | None,
    register: Register,
) -> _Try:
    said = origin.time or (term.times or {}).get(-1 if place is None else place)
    time = None if said is None else in_zone_of(said, term.due)
    packed = None if submission.time is None else in_zone_of(submission.time, term.due)
    late_s = None
    remarks = []
    if term.due is not None and time is not None:
        # not their difference: in one zone Python takes the clock's, also over a change of it
        late_s = max(time.timestamp() - term.due.timestamp(), 0.0)
    elif origin.late:
        remarks.append(
            f"{origin.platform.capitalize()} marks it as late and does not say by how much: nothing"
            " was taken off; say in overrides.csv what is."
        )
    elif term.late and term.due and packed and packed.timestamp() > term.due.timestamp():
        remarks.append(
            f"The zip file dates it {packed.strftime(SHOWN)}, after the due time; that may be when "
            "it was downloaded, so nothing was taken off."
        )
    claimed = register.by_report(graded.student_id, "") if origin.platform else None
    if claimed is not None and place is not None and claimed != place:
        other = register.people[claimed]
        remarks.append(
            f"The report gives the id of {other.student_id} ({other.name or 'no name'}), but "
            f"{origin.platform.capitalize()} says who handed it in."
        )
    deduction = term.late.deduction(late_s, graded.of) if term.late and late_s else 0.0
    return _Try(graded, origin, time, packed, late_s, deduction, tuple(remarks))


def _entry(person: Person, tries: Sequence[_Try], term: Term) -> Entry:
    if not tries:
        return Entry(person.name, person.student_id, None, email=person.email)
    ordered = sorted(tries, key=lambda one: one.order)
    # what is not a report counts only where there is nothing else
    able = [one for one in ordered if one.read] or ordered
    # several files of one submission: the best
    of_first = [one for one in able if one.order[:2] == able[0].order[:2]]
    chosen = {
        "latest": able[-1],
        "first": of_first[-1],
        "best": max(able, key=lambda one: (one.worth, one.order)),
    }[term.attempt]
    remarks = list(chosen.remarks)
    beside = sum(one is not chosen and one.order[:2] == chosen.order[:2] != (0.0, 0.0)
                 for one in able)  # fmt: skip
    if beside:
        remarks.append(f"{beside + 1} reports came at the same time; the best of them counts.")
    if able is not ordered and ordered[-1] is not chosen and not ordered[-1].read:
        remarks.append(
            f"{one_line(ordered[-1].graded.submission, 80)} cannot be read as a report, so that "
            "another file counts."
        )
    return Entry(
        person.name or one_line(chosen.graded.student or chosen.origin.name, 200),
        person.student_id,
        chosen.graded,
        tuple(one.graded for one in ordered if one is not chosen),
        "" if chosen.time is None else chosen.time.strftime(SHOWN),
        chosen.late_s,
        chosen.deduction,
        email=person.email,
        remarks=tuple(remarks),
    )


def _settled(
    entry: Entry, said: Mapping[str, Override], most: float, include_pending: bool
) -> Entry:
    """With the instructor's word, and the total that follows."""
    comment = "\n".join(
        said[name].comment for name in ("", TOTAL) if name in said and said[name].comment
    )
    entry = replace(entry, overrides={title: one for title, one in said.items() if title})
    settled = settled_report(entry)
    total = None
    if TOTAL in said and said[TOTAL].points is not None:
        total = said[TOTAL].points
    elif settled is not None and (settled.counted is not None or include_pending):
        total = round(max(settled.points - entry.deduction, 0.0), 2)
    return replace(entry, comment=comment, total=total, of=settled.of if settled else most)
