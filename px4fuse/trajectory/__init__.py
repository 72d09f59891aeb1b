"""Trajectories in three dimensions: pose graphs, time offsets, and errors against a reference."""
