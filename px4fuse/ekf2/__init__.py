"""EKF2 replay from a default log: model, agreement with the log, and other parameters (what-if)."""
