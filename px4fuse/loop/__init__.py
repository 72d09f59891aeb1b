"""Loops of odometry: segment, loop closures, and corrections of the path."""
