"""SE(2), SE(3) and pose graphs: optimisation, and closures that may be false."""
