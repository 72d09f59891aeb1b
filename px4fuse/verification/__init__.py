"""Whether a report is what its log gives."""
