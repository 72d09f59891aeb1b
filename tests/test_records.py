"""Records are facts: nothing is changed in one once it is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from importlib import import_module
from pkgutil import walk_packages

import msgspec
import pytest

import px4fuse

# Buffers that are filled while something is read, written, replayed or compared
FILLED = {"Packer", "_Fusion", "_Walk"}


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


def test_records_of_package_are_frozen() -> None:
    assert len(RECORDS) > 50
    assert len(STRUCTS) > 50
    thawed = {one.__name__ for one in RECORDS if not one.__dataclass_params__.frozen}  # type: ignore[attr-defined]
    thawed |= {one.__name__ for one in STRUCTS if not one.__struct_config__.frozen}
    assert thawed == FILLED


def test_settings_assignment_raises() -> None:
    flight = px4fuse.Settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        flight.sigma_a_m_s2 = 1.0  # type: ignore[misc]
