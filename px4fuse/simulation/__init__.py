"""Simulated flights with ground truth and injected faults, as PX4 ULog or in memory.

``scenario`` and ``faults`` import no large library, so that ``px4fuse simulate --help`` is fast.
"""
