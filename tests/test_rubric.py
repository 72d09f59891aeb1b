"""The rubric: the one that ships, and those that an instructor spoils."""

import tomllib

import pytest

from px4fuse.errors import SettingsError
from px4fuse.grading.rubric import parse_rubric, read_rubric, rubric_text
from px4fuse.grading.scoring import CHECKS, NEED_KEY

ITEM = '[[item]]\ntitle = "T"\npoints = 5\n'
NOTES = ITEM + 'check = "flight"\n'
NUMBER = ITEM + 'check = "number"\npath = "a.b"\n'


def test_default_uses_and_explains_every_check_and_parameter():
    text = rubric_text()
    used = {item["check"] for item in tomllib.loads(text)["item"]}
    assert used == set(CHECKS)
    for check in CHECKS.values():
        for name in check.parameters:
            assert f"{name} = " in text or name in text, name


@pytest.mark.parametrize("kind", ["compare", "loop"])
def test_items_of_the_default_add_up_to_65_and_120_with_a_key(kind):
    items = [one for one in read_rubric(None).items if one.report in ("any", kind)]
    with_key = {one.check: one.points for one in items if one.check in NEED_KEY}
    assert with_key == {"answers": 100.0, "text": 20.0}
    assert sum(one.points for one in items) == 65 + 120


def test_copy_of_the_default_is_the_default(tmp_path):
    path = tmp_path / "rubric.toml"
    path.write_bytes(b"\xef\xbb\xbf" + rubric_text().replace("\n", "\r\n").encode())
    assert read_rubric(path) == read_rubric(None)


def test_parameters_left_out_have_their_defaults():
    (item,) = parse_rubric(NOTES, "x").items
    assert item.parameters["min_measurements"] == 100
    assert item.report == "any"


def test_one_text_is_a_list_of_it_and_a_whole_number_a_number():
    (item,) = parse_rubric(NUMBER + "at_most = 1\n", "x").items
    assert item.parameters["path"] == ("a.b",)
    assert isinstance(item.parameters["at_most"], float)


DEEP = "a = " + "[" * 100_000
BAD = {
    "not toml": ("[[item", "not TOML"),
    "deep": (DEEP, "not TOML"),
    "integer of ten thousand digits": (NOTES.replace("5", "9" * 10_000), "not TOML"),
    "empty": ("", "no items"),
    "no items": ('title = "x"', "no items"),
    "items are one table": ('[item]\ntitle = "x"', "no items"),
    "item is a number": ("item = [1]", "item 1 is not a table"),
    "unknown key": ("colour = 1\n" + NOTES, "unknown key 'colour'"),
    "unknown check": (ITEM + 'check = "beauty"', "check cannot be 'beauty'"),
    "no check": (ITEM, "no 'check'"),
    "no title": ('[[item]]\npoints = 1\ncheck = "text"', "no 'title'"),
    "empty title": (NOTES.replace('"T"', '" "'), "title is empty"),
    "title of two lines": (NOTES.replace('"T"', '"a\\nb"'), "title cannot be"),
    "no points": ('[[item]]\ntitle = "T"\ncheck = "text"', "no 'points'"),
    "negative points": (NOTES.replace("5", "-5"), "points cannot be -5"),
    "points are text": (NOTES.replace("5", '"5"'), "points cannot be '5'"),
    "points are true": (NOTES.replace("5", "true"), "points cannot be True"),
    "points are nan": (NOTES.replace("5", "nan"), "points cannot be nan"),
    "points are a date": (NOTES.replace("5", "2026-01-01"), "points cannot be what it is"),
    "huge points": (NOTES.replace("5", "9" * 400), "points cannot be"),
    "unknown parameter": (NOTES + "min_letters = 3", "unknown key 'min_letters'"),
    "wrong type": (
        NOTES + "min_measurements = 1.5",
        "min_measurements cannot be 1.5; give a whole number",
    ),
    "unknown report": (NOTES + 'report = "tune"', "report cannot be 'tune'"),
    "unknown setting": (ITEM + 'check = "tuning"\nsettings = ["dt_s"]', "a list of sigma_z_m"),
    "number without bound": (NUMBER, "no bound"),
    "number without path": (ITEM + 'check = "number"\nat_most = 1', "no 'path'"),
    "bounds exchanged": (NUMBER + "at_least = 2\nat_most = 1", "exchange them"),
    "zero on the good side": (NUMBER + "at_most = 2\nzero_at = 1", "put it beyond"),
    "zero with two bounds": (NUMBER + "at_least = 0\nat_most = 2\nzero_at = 9", "one bound"),
    "nothing required": (ITEM + 'check = "sections"', "nothing is required"),
    "two alike": (NOTES + NOTES, "items 1 and 2 have the same title"),
    "too many": (NOTES * 101, "at most 100"),
    "words are text": ("common_words = [1]\n" + NOTES, "common_words cannot be"),
    "words asked for": ('min_words = "x"\n' + NOTES, "min_words cannot be 'x'"),
    "others' log": ('others_log = "maybe"\n' + NOTES, "others_log cannot be 'maybe'"),
    "pages": ('pages = "maybe"\n' + NOTES, "pages cannot be 'maybe'"),
    "unverified": ('unverified = "maybe"\n' + NOTES, "unverified cannot be 'maybe'"),
}


@pytest.mark.parametrize(("text", "said"), BAD.values(), ids=BAD.keys())
def test_spoilt_rubric_is_one_line_that_says_where(tmp_path, text, said):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError) as error:
        read_rubric(path)
    message = str(error.value)
    assert said in message
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 500


def test_files_that_are_no_rubric(tmp_path):
    for content, said in (
        (b"#" * 1_000_001, "more than the limit"),
        (b"\xff\xfe\x00", "not a text file"),
    ):
        path = tmp_path / "x.toml"
        path.write_bytes(content)
        with pytest.raises(SettingsError, match=said):
            read_rubric(path)
    for path, said in ((tmp_path, "is a folder"), (tmp_path / "none.toml", "cannot be read")):
        with pytest.raises(SettingsError, match=said):
            read_rubric(path)
