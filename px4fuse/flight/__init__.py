"""Records of a recorded flight: its sensors, position sources and EKF2's topics."""
