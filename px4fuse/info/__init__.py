"""Contents of a log, for the commands ``px4fuse info`` and ``px4fuse extract``."""
