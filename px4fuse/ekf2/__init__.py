"""Model of PX4's EKF2, which replays a flight from a log."""
