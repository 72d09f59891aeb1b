"""Report: PDF pages and terminal summary."""
