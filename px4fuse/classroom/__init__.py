"""Assignments for a course, and grading of the submitted reports."""
