"""Two recordings of one flight made one, and a position file placed into a flight."""
