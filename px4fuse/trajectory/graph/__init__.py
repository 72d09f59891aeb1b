"""SE(2), SE(3) and pose graphs."""
