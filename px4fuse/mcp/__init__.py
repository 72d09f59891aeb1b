"""Model Context Protocol server (``px4fuse mcp``), with which assistants call px4fuse."""
