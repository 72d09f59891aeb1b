"""Loop analysis of odometry: segment of the loop, loop closures, and corrections of the path."""
