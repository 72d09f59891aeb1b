"""Tables of sentences against the facts that the code gives them."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from string import Formatter

import pytest

import px4fuse

PACKAGE = Path(px4fuse.__file__).parent
ROOMS = [path.parent for path in PACKAGE.glob("*/words.toml")
         if "sentences(" in (path.parent / "__init__.py").read_text("utf-8")]  # fmt: skip


def needed(*texts: str) -> set[str]:
    """Names of the facts of sentences, without their fields."""
    names = [name for text in texts for _, name, *_ in Formatter().parse(text) if name]
    return {re.split(r"[.\[]", name)[0] for name in names}


def calls(folder: Path, function: str) -> Iterator[tuple[str, set[str | None]]]:
    """The name and the facts of every call of a function (a pattern) in a folder's modules."""
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and re.fullmatch(function, ast.unparse(node.func)):
                yield ast.literal_eval(node.args[0]), {word.arg for word in node.keywords}


TABLES = [*((room / "words.toml", "say") for room in ROOMS),
          (PACKAGE / "refusals.toml", r"(\w+Error|error_type)\.of"),
          (PACKAGE / "lacking.toml", "missing_data")]  # fmt: skip


@pytest.mark.parametrize(("table", "function"), TABLES, ids=lambda given: Path(given).name)
def test_every_sentence_is_said_with_its_facts_and_no_others(table: Path, function: str) -> None:
    rows = tomllib.loads(table.read_text("utf-8"))
    said = list(calls(table.parent, function))
    assert {name for name, _ in said} == rows.keys()
    for name, facts in said:
        row = rows[name]
        texts = row.values() if isinstance(row, dict) else [row] if isinstance(row, str) else row
        assert facts == needed(*texts), name


def test_there_are_such_rooms() -> None:
    assert {"report", "comparison"} <= {room.name for room in ROOMS}
