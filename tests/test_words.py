"""The sentences of a room's ``words.toml`` against the facts that the room's code gives them."""

import ast
import re
import tomllib
from pathlib import Path
from string import Formatter

import pytest

import px4fuse

ROOMS = [path.parent for path in Path(px4fuse.__file__).parent.glob("*/words.toml")
         if "sentences(" in (path.parent / "__init__.py").read_text("utf-8")]  # fmt: skip


def needed(text: str) -> set[str]:
    """Names of the facts of a sentence, without their fields."""
    return {re.split(r"[.\[]", name)[0] for _, name, *_ in Formatter().parse(text) if name}


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
def test_every_sentence_is_said_with_its_facts_and_no_others(room: Path) -> None:
    texts = tomllib.loads((room / "words.toml").read_text("utf-8"))
    trees = [ast.parse(path.read_text("utf-8")) for path in room.glob("*.py")]
    said = [
        node
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "say"
    ]
    assert {ast.literal_eval(call.args[0]) for call in said} == texts.keys()
    for call in said:
        facts = {word.arg for word in call.keywords}
        assert facts == needed(texts[ast.literal_eval(call.args[0])]), ast.unparse(call)


def test_there_are_such_rooms() -> None:
    assert "report" in {room.name for room in ROOMS}
