"""Run the command line (``python -m px4fuse``)."""

from .cli import main

if __name__ == "__main__":
    main()
