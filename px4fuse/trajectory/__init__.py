"""Trajectories in 3D: pose graphs, time offsets, and errors against a reference."""
