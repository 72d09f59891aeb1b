"""File formats by content (``formats.toml``): position streams, and formats that are not read."""

from pathlib import Path
from typing import Any

from px4fuse.core.reading import display_name
from px4fuse.core.record import read_toml
from px4fuse.errors import Px4FuseError

_FORMATS = read_toml(__file__, dict[str, list[dict[str, Any]]])
# Formats of streams with positions: name, pattern of a row and pattern of the ranges
STREAM_FORMATS = _FORMATS["streams"]


def refuse_foreign_format(path: Path, head: bytes, error_type: type[Px4FuseError]) -> None:
    """Raise an error with the name of the format if px4fuse does not read it."""
    name = display_name(path)
    for foreign_format in _FORMATS["foreign"]:
        if any(head.startswith(start.encode("latin-1")) for start in foreign_format["starts"]):
            remedy = foreign_format["remedy"].format(name=name)
            raise error_type(f"{name}: the file is {foreign_format['name']}", remedy)
