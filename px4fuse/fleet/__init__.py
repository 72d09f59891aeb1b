"""Many logs in one table (``batch``), and differences between two (``diff``)."""

# s; default time limit for one log
TIMEOUT_S = 600.0
