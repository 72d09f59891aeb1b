"""The report: PDF pages, terminal summary, results JSON."""
