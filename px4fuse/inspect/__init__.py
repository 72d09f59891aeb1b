"""Contents of a log: list for ``info`` and tables for ``extract``."""
