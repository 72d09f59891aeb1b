"""Loop closure error of an odometry path, and corrections of the path."""
