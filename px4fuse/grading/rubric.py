"""The rubric: what a report is worth, as an instructor writes it down.

A TOML file of items, each with a title, points, the name of a check and its parameters. What a
check does and which parameters it has is in :data:`px4fuse.grading.scoring.CHECKS`.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NoReturn, cast

from px4fuse.errors import SettingsError
from px4fuse.grading.model import Applies, Doubtful, Rubric, RubricItem, RubricParameter
from px4fuse.grading.scoring import CHECKS
from px4fuse.reading import read_text

DEFAULT = "rubric.toml"
MAX_RUBRIC_BYTES = 1_000_000
MAX_ITEMS = 100
MAX_POINTS = 1000.0
MAX_TEXT = 200
MAX_LIST = 100
HELP = "px4fuse grade --write-rubric FILE.toml writes one that explains itself"

APPLIES: tuple[Applies, ...] = ("any", "compare", "loop")
# What becomes of points that nobody can vouch for
DOUBTFUL = {
    "unverified": RubricParameter("text", "pending", choices=("pending", "zero")),
    "others_log": RubricParameter("text", "pending", choices=("pending", "zero", "count")),
    "pages": RubricParameter("text", "count", choices=("count", "pending", "zero")),
}

ITEM_KEYS = ("title", "points", "check", "report")
RUBRIC_KEYS = ("title", *DOUBTFUL, "min_words", "common_words", "item")


def rubric_text() -> str:
    """The default rubric, comments and all, for an instructor to copy and edit."""
    return files("px4fuse.grading").joinpath(DEFAULT).read_text(encoding="utf-8")


def read_rubric(path: Path | None) -> Rubric:
    """Read and check a rubric.

    Parameters
    ----------
    path : Path or None
        None is the default one.

    Raises
    ------
    SettingsError
        It cannot be read, or something in it is not what it should be: the text says which item.
    """
    if path is None:
        return parse_rubric(rubric_text(), DEFAULT)
    return parse_rubric(read_text(path, SettingsError, MAX_RUBRIC_BYTES, name=str(path)), str(path))


def parse_rubric(text: str, where: str) -> Rubric:
    """Check the text of a rubric; ``where`` names it in errors."""
    try:
        given = tomllib.loads(text.replace("\r\n", "\n"))
    # an integer of a million digits is a ValueError of another kind
    except (ValueError, RecursionError) as error:
        why = str(error).splitlines()[0] if isinstance(error, tomllib.TOMLDecodeError) else ""
        raise SettingsError(
            f"{where}: not TOML{f' ({why[:MAX_TEXT]})' if why else ''}; {HELP}."
        ) from error
    for name in given:
        if name not in RUBRIC_KEYS:
            _refuse(where, f"unknown key {name!r}; it may have {', '.join(RUBRIC_KEYS)}")
    items = given.get("item")
    if not isinstance(items, list) or not items:
        _refuse(where, f"no items; give at least one [[item]], {HELP}")
    if len(items) > MAX_ITEMS:
        _refuse(where, f"{len(items)} items; give at most {MAX_ITEMS}")
    read = tuple(_item(where, number, item) for number, item in enumerate(items, start=1))
    titles: dict[tuple[str, str], int] = {}
    for number, item in enumerate(read, start=1):
        other = titles.setdefault((item.title, item.report), number)
        if other != number:
            _refuse(where, f"items {other} and {number} have the same title; give each its own")
    fates = {
        name: cast(Doubtful, _value(where, name, given, one)) for name, one in DOUBTFUL.items()
    }
    return Rubric(
        title=_value(where, "title", given, RubricParameter("text", "")),
        items=read,
        min_words=_value(where, "min_words", given, RubricParameter("whole", 100, 0, 100_000)),
        common_words=_value(where, "common_words", given, RubricParameter("texts", ())),
        **fates,
    )


def _item(where: str, number: int, given: object) -> RubricItem:
    if not isinstance(given, dict):
        _refuse(where, f"item {number} is not a table; begin it with [[item]]")
    title = _value(
        f"{where}: item {number}", "title", given, RubricParameter("text", required=True)
    )
    here = f"{where}: item {number} ({title!r})"
    if not title.strip():
        _refuse(f"{where}: item {number}", "the title is empty; give it one")
    points = _value(
        here, "points", given, RubricParameter("number", None, 0.0, MAX_POINTS, required=True)
    )
    check = _value(
        here, "check", given, RubricParameter("text", choices=tuple(CHECKS), required=True)
    )
    known = CHECKS[check].parameters
    for name in given:
        if name not in ITEM_KEYS and name not in known:
            _refuse(
                here,
                f"unknown key {name!r}; the check {check!r} may have {', '.join(known)}",
            )
    parameters = {name: _value(here, name, given, one) for name, one in known.items()}
    if check == "number":
        _check_bounds(here, parameters)
    if check == "sections" and not parameters["results"] and not parameters["pages"]:
        _refuse(here, "nothing is required; give results = [...] or pages = [...]")
    applies = _value(here, "report", given, RubricParameter("text", "any", choices=APPLIES))
    return RubricItem(title, points, check, cast(Applies, applies), parameters)


def _check_bounds(here: str, given: Mapping[str, Any]) -> None:
    low, high, zero = given["at_least"], given["at_most"], given["zero_at"]
    if low is None and high is None:
        _refuse(here, "no bound; give at_least, at_most or both")
    if low is not None and high is not None and low > high:
        _refuse(here, "at_least is above at_most; exchange them")
    if zero is None:
        return
    if low is not None and high is not None:
        _refuse(here, "zero_at goes with one bound; give at_least or at_most alone")
    if (high is not None and zero <= high) or (low is not None and zero >= low):
        _refuse(here, "zero_at is on the good side of the bound; put it beyond")


def _value(here: str, name: str, given: Mapping[str, Any], parameter: RubricParameter) -> Any:
    """One value, checked; a whole number counts as a number and one text as a list of it."""
    if name not in given:
        if parameter.required:
            _refuse(here, f"no {name!r}; give {_wanted(parameter)}")
        return parameter.default
    value, kind = given[name], parameter.kind
    good = False
    if kind in ("number", "whole"):
        types = int if kind == "whole" else int | float
        good = isinstance(value, types) and not isinstance(value, bool)
        # false for NaN too, and exact for integers that no float can hold
        good = good and parameter.low <= value <= parameter.high
        value = float(value) if good and kind == "number" else value
        good = good and math.isfinite(value)
    elif kind == "flag":
        good = isinstance(value, bool)
    elif kind == "text":
        good = _is_text(value, parameter)
    else:
        value = (value,) if isinstance(value, str) else value
        good = isinstance(value, list | tuple) and len(value) <= MAX_LIST
        good = good and all(_is_text(one, parameter) and one.strip() for one in value)
        good = good and (bool(value) or not parameter.required)
        value = tuple(value) if good else value
    if not good:
        simple = isinstance(value, str | float) or (isinstance(value, int) and abs(value) < 1e15)
        shown = repr(value) if simple else "what it is"
        shown = shown if len(shown) <= 40 else shown[:39] + "…"
        _refuse(here, f"{name} cannot be {shown}; give {_wanted(parameter)}")
    return value


def _is_text(value: object, parameter: RubricParameter) -> bool:
    if not isinstance(value, str) or len(value) > MAX_TEXT or not value.isprintable():
        return False
    return not parameter.choices or value in parameter.choices


def _wanted(parameter: RubricParameter) -> str:
    """What may be given, in words."""
    limits = f" from {parameter.low:g} to {parameter.high:g}" if parameter.high < 1e12 else ""
    choices = ", ".join(parameter.choices)
    return {
        "number": f"a number{limits}",
        "whole": f"a whole number{limits}",
        "flag": "true or false",
        "text": f"one of {choices}" if choices else f"a text of at most {MAX_TEXT} characters",
        "texts": f"a list of {choices}" if choices else 'a list of texts, ["...", "..."]',
    }[parameter.kind]


def _refuse(here: str, why: str) -> NoReturn:
    raise SettingsError(f"{here}: {why}.")
