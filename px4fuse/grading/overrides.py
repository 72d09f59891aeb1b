"""What the instructor says instead of the rules: a table that is read and never written over."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

from px4fuse.assignment.key import folded
from px4fuse.assignment.roster import Person, Register
from px4fuse.assignment.sheet import read_sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.class_table import decimal
from px4fuse.grading.model import Entry, Override
from px4fuse.results.reading import cleaned, one_line

NAME = "overrides.csv"
TITLES = ("id", "item", "points", "comment")
TEMPLATE = "\ufeff" + ",".join(TITLES) + "\r\n"
TOTAL = "total"
MOST = 1e6
MAX_COMMENT = 10_000

# Id as it was typed, to item as it was typed ("" for all of it), to what is said
Overrides = Mapping[str, Mapping[str, Override]]


def read_overrides(path: Path) -> Overrides:
    """Read ``overrides.csv``; nothing where it is not there.

    Its columns are id (as in class.csv, or the file's name), item (a title of the rubric, "total",
    or empty for a comment on all of it), points and comment.

    Raises
    ------
    SettingsError
        A column is missing, or a row says no number of points where it should.
    """
    if not path.exists():
        return {}
    sheet = read_sheet(path)
    missing = [title for title in TITLES if sheet.column((title,)) is None]
    if missing:
        raise SettingsError(
            f"{path}: no column {', '.join(missing)}", f"Its columns are {', '.join(TITLES)}."
        )
    found: dict[str, dict[str, Override]] = defaultdict(dict)
    for number, row in enumerate(sheet.rows, start=2):
        student, item, points, comment = (
            sheet.cell(row, (title,)).removeprefix("'") for title in TITLES
        )
        value = decimal(points)
        wrong = ""
        if item in found[student]:
            wrong = f"{one_line(student, 40)}, {one_line(item, 40) or 'all'} stands there twice"
        elif points and (value is None or not 0.0 <= value <= MOST or not item):
            given = one_line(points, 20)
            wrong = f"points {given!r}: give a number from 0 up, and an item or total"
        if wrong:
            raise SettingsError(f"{path}: row {number}: {wrong}.")
        found[student][item] = Override(value, cleaned(comment[:MAX_COMMENT]))
    return found


def matched(
    overrides: Overrides, entries: Sequence[Entry]
) -> tuple[list[dict[str, Override]], tuple[str, ...]]:
    """What is said of whom, and a sentence for every row that fits nobody, or no item.

    Returns
    -------
    said : list of dict
        For each entry, by the title of an item, "total", or "" for all of it.
    notes : tuple of str
    """
    said: list[dict[str, Override]] = [{} for _ in entries]
    whole = max((one.of for entry in entries for one in entry.files), default=MOST)
    files = (entry.counting.submission if entry.counting else "" for entry in entries)
    people = Register(
        Person(entry.student_id, login=file) for entry, file in zip(entries, files, strict=True)
    )
    notes = []
    for student, rows in overrides.items():
        # by the very id, the id but for leading zeros, or the file's name
        place = people.place(Person(student, login=student))
        if place is None:
            notes.append(f"{NAME}: nobody has the id {one_line(student, 40) or '(empty)'}.")
            continue
        one = entries[place].counting
        most = {item.title: item.of for item in one.items} if one else {}
        most |= {TOTAL: one.of if one else whole, "": MOST}
        titles = {folded(title): title for title in most}
        for item, override in rows.items():
            title, wrong = titles.get(folded(item)), ""
            if title is None:
                wrong = f"has no item {one_line(item, 60)!r}"
            elif title in said[place]:
                wrong = f"has {title or 'a comment on all'!r} from another row already"
            elif (override.points or 0.0) > most[title]:
                wrong = f"cannot have more than {most[title]:g} points of {one_line(title, 60)!r}"
            else:
                said[place][title] = override
            notes += [f"{NAME}: {one_line(student, 40)} {wrong}."] if wrong else []
    return said, tuple(notes)
