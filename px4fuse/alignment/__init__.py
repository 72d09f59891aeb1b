"""Two recordings of one flight made one, and a position file placed into a flight."""

from __future__ import annotations

from px4fuse.alignment.joining import join
from px4fuse.alignment.placement import place

__all__ = ["join", "place"]
