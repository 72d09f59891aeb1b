"""Reports on flights, loop closures and trajectories as PDF, and summaries on the terminal."""
