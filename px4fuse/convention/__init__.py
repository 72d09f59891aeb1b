"""Check of a position source's convention: axes, unit, clock and orientation."""
