"""Replay of PX4's EKF2 from a log, with the logged or with other parameters."""
