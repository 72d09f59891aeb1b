"""Damaged input for all file readers: the part of ``studies/fuzz.py`` that takes half a minute.

The inputs are the same in every run. Add a separate test for each fault that a study finds.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz import COMMANDS, TARGETS, Target, run_target


@pytest.mark.parametrize("target", TARGETS, ids=lambda one: one.name)
def test_file_readers_on_fuzzed_input_give_result_or_error(target: Target, tmp_path: Path) -> None:
    outcome = run_target(target, target.in_suite, seed=1, folder=tmp_path)
    assert outcome.faults == []
    # Some inputs must be read and some rejected, otherwise the damage is too strong or too weak
    assert min(outcome.read, outcome.rejected) > 0 or target.name == "MAVLink"


@pytest.mark.usefixtures(
    "cached_analyses", "cached_pages"
)  # analysis and drawing are not tested here
@pytest.mark.parametrize(
    "target", [one for one in COMMANDS if one.in_suite], ids=lambda one: one.name
)
def test_commands_on_fuzzed_input_end_without_exception(target: Target, tmp_path: Path) -> None:
    assert run_target(target, target.in_suite, seed=1, folder=tmp_path).faults == []
