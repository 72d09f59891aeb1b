"""Diagnosis card: short summary of the faults and filter verdicts of one flight."""
