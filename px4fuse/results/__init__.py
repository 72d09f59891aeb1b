"""The contract: what is written as JSON, its schema, and how it is read back."""
