"""Model of PX4's EKF2 that replays a flight from a log, with logged or changed parameters."""
