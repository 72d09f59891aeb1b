"""Damaged input for whatever reads files: the part of ``studies/fuzz.py`` that takes half a minute.

The same inputs every time. What a study of a million found is an example here for good.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz import TARGETS, Outcome, Target, attempt, tried

# By target, what once escaped
EXAMPLES: dict[str, list[bytes]] = {}


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: one.name)
def test_whatever_is_read_is_a_result_or_one_line(target: Target, tmp_path: Path) -> None:
    outcome = tried(target, target.in_suite, seed=1, folder=tmp_path)
    assert outcome.escaped == []
    # neither is all of it refused at the door, nor is nothing damaged
    assert min(outcome.read, outcome.refused) > 0 or target.name == "MAVLink"


@pytest.mark.parametrize(
    ("name", "content"),
    [(name, content) for name, contents in EXAMPLES.items() for content in contents],
)
def test_what_once_escaped(name: str, content: bytes, tmp_path: Path) -> None:
    target, outcome = next(one for one in TARGETS if one.name == name), Outcome()
    attempt(target, content, tmp_path / f"input{target.end}", outcome, name)
    assert outcome.escaped == []
