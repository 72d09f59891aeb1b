"""Check of the convention of a position source: axes, length unit, clock and orientation."""
