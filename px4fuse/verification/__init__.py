"""Verification of students' reports: comparison with a new run of the analysis on the log."""
