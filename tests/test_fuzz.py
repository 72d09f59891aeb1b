"""Damaged input for whatever reads files: the part of ``studies/fuzz.py`` that takes half a minute.

The same inputs every time. What a study finds beyond them belongs here as a test of its own.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz import COMMANDS, TARGETS, Target, tried


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: one.name)
def test_whatever_is_read_is_a_result_or_one_line(target: Target, tmp_path: Path) -> None:
    outcome = tried(target, target.in_suite, seed=1, folder=tmp_path)
    assert outcome.escaped == []
    # neither is all of it refused at the door, nor is nothing damaged
    assert min(outcome.read, outcome.refused) > 0 or target.name == "MAVLink"


@pytest.mark.usefixtures("analysed_once", "drawn_once")  # what is computed is not what is read
@pytest.mark.parametrize(
    "target", [one for one in COMMANDS if one.in_suite], ids=lambda one: one.name
)
def test_whole_commands_end_as_they_should(target: Target, tmp_path: Path) -> None:
    assert tried(target, target.in_suite, seed=1, folder=tmp_path).escaped == []
