"""Model Context Protocol server (``px4fuse mcp``), so that AI assistants can call px4fuse."""
