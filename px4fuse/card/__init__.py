"""Diagnosis card: one-page summary of the faults and the filter consistency of a flight."""
