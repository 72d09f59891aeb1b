"""Report as PDF, and summary on the terminal."""
