"""Trajectories in three dimensions: pose graphs, time offsets, and scores against a reference.

The two-state filter KF along one axis is in :mod:`px4fuse.filter.kalman`.
"""
