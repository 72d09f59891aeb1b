"""Alignment of a position file with a flight."""
