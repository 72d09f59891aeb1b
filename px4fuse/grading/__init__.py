"""Grading of a class: verification and points of the reports that students hand in.

Handed-in files are not trusted: reading is bounded in time and memory, nothing in them is executed,
and their paths, formulas and markup have no effect on the file system, tables or pages.
"""
