"""Comparison of KF with EKF2 and with ground truth."""
