"""Many logs: one table with a row per log and axis."""
