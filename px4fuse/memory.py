"""Memory that is no longer used: what comes next would be put on top of it."""

import ctypes
import sys


def release_free_memory() -> None:
    """Give freed memory back to the system, where the C library keeps it for later (glibc).

    It lies in pieces between what is still used, too small for large arrays.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
