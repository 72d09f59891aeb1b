"""Our filter against EKF2 and ground truth."""
