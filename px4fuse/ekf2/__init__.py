"""EKF2 replayed from an ordinary log: the model, its agreement with the log, and what if."""
