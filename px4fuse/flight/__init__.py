"""Data classes for the content of a flight log: IMU, position sources, EKF2 and ground truth."""
