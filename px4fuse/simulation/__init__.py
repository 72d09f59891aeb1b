"""Simulated flights with ground truth and injected faults, as PX4 ULog or in memory.

``scenario`` defines the flight and ``faults`` its injected faults. ``motion`` computes the true
motion, ``sensors`` the measurements, ``ekf2`` the EKF2 topics, and ``ulog_writer`` the file.
``flights`` combines them. ``scenario`` and ``faults`` import no large library, so that
``px4fuse simulate --help`` is fast.
"""
