"""Pose graphs in SE(2) and SE(3): optimisation, and tests of loop closures."""
