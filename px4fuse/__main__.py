"""Run the command line (``python -m px4fuse``)."""

from px4fuse.cli import main

if __name__ == "__main__":
    main()
