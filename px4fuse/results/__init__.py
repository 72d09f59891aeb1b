"""Results: the JSON contract, its schema, and how results are written and read."""
