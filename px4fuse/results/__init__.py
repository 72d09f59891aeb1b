"""Results of the commands: types, JSON Schema, writing and reading."""
