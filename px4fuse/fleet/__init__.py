"""Many logs, and what changed between two."""
