"""Trajectories: loop closure, pose graphs, and scores against a reference.

Position and orientation over time, in three dimensions; the two-state filter along one axis is in
:mod:`px4fuse.filter.kalman`.
"""
