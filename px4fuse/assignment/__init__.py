"""A flight per student, and its answer key."""
