"""Loop analysis: loop closure error of odometry, and correction of the path."""
