"""What is in a log, and the log as tables."""
