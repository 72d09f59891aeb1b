"""Many logs: one table with a row per log and axis; and what changed between two."""
