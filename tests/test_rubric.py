"""Default rubric, and errors of edited rubrics."""

import tomllib

import pytest

from px4fuse.classroom.grading.rubric import (
    AnyRubricItem,
    parse_rubric,
    read_default_rubric_text,
    read_rubric,
)
from px4fuse.errors import SettingsError

ITEM = '[[item]]\ntitle = "T"\npoints = 5\n'
NOTES = ITEM + 'check = "verified"\n'
NUMBER = ITEM + 'check = "number"\npath = "a.b"\n'


def test_default_rubric_contains_each_check_and_its_parameters():
    text = read_default_rubric_text()
    used = {item["check"] for item in tomllib.loads(text)["item"]}
    checks = AnyRubricItem.__args__
    assert used == {check.__struct_config__.tag for check in checks}
    for check in checks:
        for name in check.__struct_encode_fields__:
            assert name in text, name


@pytest.mark.parametrize("kind", ["compare", "loop"])
def test_default_rubric_has_60_points_or_180_with_answer_key(kind):
    items = [one for one in read_rubric(None).items if {one.report, one.command} <= {"any", kind}]
    assert {one.points for one in items if one.needs_answer_key} == {100.0, 20.0}
    assert [one.is_scored_by_instructor for one in items if one.needs_answer_key] == [False, True]
    assert sum(one.points for one in items) == 60 + 120


def test_read_copy_of_default_rubric_gives_equal_rubric(tmp_path):
    path = tmp_path / "rubric.toml"
    path.write_bytes(b"\xef\xbb\xbf" + read_default_rubric_text().replace("\n", "\r\n").encode())
    assert read_rubric(path) == read_rubric(None)


def test_rubric_without_parameters_has_default_values():
    (item,) = parse_rubric(ITEM + 'check = "clock"\n', "x").items
    assert (item.margin_s, item.report) == (0.03, "any")
    (item,) = parse_rubric(NUMBER + "at_most = 1\n", "x").items
    assert isinstance(item.at_most, float)


DEEP = "a = " + "[" * 100_000
BAD = {
    "not toml": ("[[item", "Expected"),
    "deep": (DEEP, "recursion"),
    "integer of ten thousand digits": (NOTES.replace("5", "9" * 10_000), "Exceeds the limit"),
    "empty": ("", "missing required field `item`"),
    "items are one table": ('[item]\ntitle = "x"', "Expected `array`"),
    "unknown key": ("colour = 1\n" + NOTES, "unknown field `colour`"),
    "unknown check": (ITEM + 'check = "beauty"', "Invalid value 'beauty'"),
    "no check": (ITEM, "Object missing required field `check`"),
    "empty title": (NOTES.replace('"T"', '" "'), "at item 1, field title"),
    "title of two lines": (NOTES.replace('"T"', '"a\\nb"'), "at item 1, field title"),
    "negative points": (
        NOTES.replace("5", "-5"),
        "Expected `float` >= 0.0 - at item 1, field points",
    ),
    "unknown parameter": (NOTES + "min_letters = 3", "unknown field `min_letters` - at item 1"),
    "invalid value in item 3": (
        NOTES + NOTES.replace("T", "U") + NUMBER + "at_most = 'x'",
        "at item 3, field at_most",
    ),
    "a check of an earlier rubric": (ITEM + 'check = "sections"', "Invalid value 'sections'"),
    "number without bound": (NUMBER, "give at_least, at_most or both"),
    "bounds exchanged": (NUMBER + "at_least = 2\nat_most = 1", "at_least <= at_most"),
    "zero_at below at_most": (NUMBER + "at_most = 2\nzero_at = 1", "zero_at must be outside"),
    "zero_at above at_least": (NUMBER + "at_least = 0\nzero_at = 1", "zero_at must be outside"),
    "a parameter of an earlier rubric": (ITEM + 'check = "consistent"\naxes = []', "field `axes`"),
    "titles equal except for case": (
        NOTES + NOTES.replace("T", "t"),
        "the item title 't' is not unique or is reserved",
    ),
    "title of the sum": (
        NOTES.replace("T", "Total"),
        "the item title 'Total' is not unique or is reserved",
    ),
    "duplicate title": (NOTES + NOTES, "the item title 'T' is not unique"),
    "too many": (NOTES * 101, "length <= 100"),
    "invalid others_log": ('others_log = "maybe"\n' + NOTES, "`$.others_log`"),
    "too large": ("#" * 1_000_001, "more than the limit"),
    "no text": (b"\xff\xfe\x00", "not a text file in UTF-8"),
}


@pytest.mark.parametrize(("text", "said"), BAD.values(), ids=BAD.keys())
def test_invalid_rubric_raises_one_line_error_with_file_name(tmp_path, text, said):
    path = tmp_path / "mine.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SettingsError) as error:
        read_rubric(path)
    message = str(error.value)
    assert said in message
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 500


def test_read_rubric_from_folder_or_missing_file_is_rejected(tmp_path):
    for path, said in ((tmp_path, "is a folder"), (tmp_path / "none.toml", "cannot be read")):
        with pytest.raises(SettingsError, match=said):
            read_rubric(path)
