"""Two-state Kalman filter (KF), its consistency tests, and estimates of its noises."""
