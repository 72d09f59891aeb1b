"""Simulated flights with known truth and chosen mistakes, as PX4 ULog or in memory.

``scenario`` defines the flight, ``mistakes`` the errors. ``motion`` computes the true motion,
``sensors`` the measurements, ``ekf2`` the EKF2 topics, ``ulog_writer`` the file; ``flights``
combines them. Scenario and mistakes have no heavy imports, because the command line help uses them.
"""
