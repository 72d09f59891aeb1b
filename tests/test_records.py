"""Records are facts: nothing is changed in one once it is made."""

from __future__ import annotations

import ast
import dataclasses
import string
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import msgspec
import pytest

import px4fuse

# What gathers while something is read, written or replayed, and Gradescope's own files
FILLED = {"Packer", "_Fusion", "_Metadata"}


def classes() -> Iterator[type]:
    """Every record type of the package."""
    for module in walk_packages(px4fuse.__path__, "px4fuse."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and value.__module__ == module.name:
                yield value


RECORDS = [one for one in classes() if dataclasses.is_dataclass(one)]
STRUCTS = [one for one in classes() if issubclass(one, msgspec.Struct)]


def test_records_are_frozen() -> None:
    assert len(RECORDS) > 50
    assert len(STRUCTS) > 50
    thawed = {one.__name__ for one in RECORDS if not one.__dataclass_params__.frozen}  # type: ignore[attr-defined]
    thawed |= {one.__name__ for one in STRUCTS if not one.__struct_config__.frozen}
    assert thawed == FILLED


def test_a_frozen_record_refuses() -> None:
    flight = px4fuse.Settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        flight.sigma_a_m_s2 = 1.0  # type: ignore[misc]


def test_what_is_lacking_has_words_for_all_that_is_told() -> None:
    """Every row of ``lacking.toml`` is used, and whoever uses one tells what its braces ask for."""
    used: dict[str, set[frozenset[str | None]]] = {}
    for file in Path(px4fuse.__file__).parent.rglob("*.py"):
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "lacking":
                (name,) = call.args
                assert isinstance(name, ast.Constant)
                used.setdefault(name.value, set()).add(frozenset(k.arg for k in call.keywords))
    rows = tomllib.loads(Path(px4fuse.__file__).with_name("lacking.toml").read_text("utf-8"))
    asked = {
        name: {
            frozenset(
                field
                for text in row.values()
                for _, field, _, _ in string.Formatter().parse(text)
                if field
            )
        }
        for name, row in rows.items()
    }
    assert used == asked
