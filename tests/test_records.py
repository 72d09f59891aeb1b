"""All record types of the package are immutable."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from importlib import import_module
from pkgutil import walk_packages

import msgspec
import pytest

import px4fuse
from px4fuse.results.contract import schema

# Mutable buffers, which are filled while reading, writing or replaying
BUFFERS = {
    "ArrayEncoder", "Recording", "Topics",
    "_PdfComparison", "_BatchState",
}  # fmt: skip


def classes() -> Iterator[type]:
    """Yield every class of the package."""
    for module in walk_packages(px4fuse.__path__, "px4fuse."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and value.__module__ == module.name:
                yield value


RECORDS = [kind for kind in classes() if dataclasses.is_dataclass(kind)]
STRUCTS = [kind for kind in classes() if issubclass(kind, msgspec.Struct)]


def test_all_dataclasses_and_structs_are_immutable() -> None:
    assert len(RECORDS) > 50
    assert len(STRUCTS) > 50
    mutable = {kind.__name__ for kind in RECORDS if not kind.__dataclass_params__.frozen}  # type: ignore[attr-defined]
    mutable |= {kind.__name__ for kind in STRUCTS if not kind.__struct_config__.frozen}
    assert mutable == BUFFERS


def test_assignment_to_a_settings_field_raises_error() -> None:
    flight = px4fuse.Settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        flight.sigma_a_m_s2 = 1.0  # type: ignore[misc]


def test_json_results_contain_fields_that_have_default_values() -> None:
    """msgspec omits a default only if it is the same object, which differs between processes."""
    written_names = set(schema()["$defs"]) - {"AnalysisDescription"}  # its duration_s is never 0
    unreliable = {
        f"{kind.__name__}.{field.name}"
        for kind in STRUCTS
        if kind.__name__ in written_names and kind.__struct_config__.omit_defaults
        for field in msgspec.structs.fields(kind)
        if field.default and isinstance(field.default, float | str | tuple)
    }
    assert unreliable == set()
