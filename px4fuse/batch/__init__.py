"""Comparison of many logs (``px4fuse batch``), and of two logs (``px4fuse diff``)."""

# Default maximum time (s) for the analysis of one log
LOG_ANALYSIS_TIMEOUT_S = 600.0
