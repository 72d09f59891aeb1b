"""Many logs: one table with a row per log and axis; and the differences between two."""

# For one log, by default
TIMEOUT_S = 600.0
