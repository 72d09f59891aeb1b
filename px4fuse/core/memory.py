"""Release of unused memory to the operating system."""

import ctypes
import sys


def release_free_memory() -> None:
    """Return freed memory to the operating system (only on Linux with glibc)."""
    if sys.platform == "linux" and hasattr(c_library := ctypes.CDLL(None), "malloc_trim"):
        c_library.malloc_trim(0)
