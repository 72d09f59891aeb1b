"""Loops of odometry: segment, loop closure, and correction of the path."""
