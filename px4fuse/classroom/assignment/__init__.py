"""Assignments: a simulated flight with injected faults for each student, and the answer key."""
