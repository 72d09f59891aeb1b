"""Diagnosis card: summary of a report for cover, terminal, web page and batch table.

:mod:`px4fuse.card.model` has the records, :func:`px4fuse.card.build.build_card` makes them from an
analysis and its findings. All texts are made there; renderers only print them.
"""
