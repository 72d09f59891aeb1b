"""Grading of a class: verification and points of the reports that students submit.

Submitted files may be malicious: reading is bounded in time and memory, and no content is executed.
"""
