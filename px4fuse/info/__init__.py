"""Contents of a log: list for ``px4fuse info``, and tables for ``px4fuse extract``."""
