"""Grading of a class: verification and points of the reports that students submit.

Submitted files may be malicious: reading is bounded in time and memory, no content is executed, and
paths, formulas and markup in them have no effect on the file system, tables or pages.
"""
