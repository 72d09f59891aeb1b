"""Assignments: a simulated flight with mistakes for each student, and the answer key."""
