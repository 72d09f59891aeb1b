"""Assignments: individual simulated flights for a class, and the answer key."""
