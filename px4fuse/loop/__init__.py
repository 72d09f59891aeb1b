"""A flight's odometry as a loop: part, closure, correction."""
