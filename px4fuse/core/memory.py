"""Release of unused memory to the operating system."""

import ctypes
import sys


def release_free_memory() -> None:
    """Return freed memory, which the C library (glibc) keeps, to the operating system."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
