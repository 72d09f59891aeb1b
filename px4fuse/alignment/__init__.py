"""Joining of two recordings of one flight, and alignment of a position file with a flight."""
