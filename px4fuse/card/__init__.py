"""Diagnosis card: the same few facts on the cover, the terminal, the web page and the batch table.

:mod:`px4fuse.card.model` has the records, :func:`px4fuse.card.build.build_card` makes them from an
analysis and its findings. Renderers print the fields and choose no words.
"""
