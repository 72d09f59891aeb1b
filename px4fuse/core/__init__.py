"""Utilities for all packages: result records, file access, text formatting, worker processes."""
