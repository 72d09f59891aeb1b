"""Joining of two recordings of a flight, and alignment of a position file with a flight."""
