"""Jobs for workers, most of which go wrong; importable where nothing else of the tests is."""

from __future__ import annotations

import os
import time
from typing import Any

from px4fuse.errors import LogError


class Unreadable:
    """Pickles, and cannot be read back."""

    def __reduce__(self) -> Any:
        return int, ("no number",)


def act(job: tuple[str, Any]) -> Any:
    """What a job says."""
    what, value = job
    match what:
        case "square":
            return value * value
        case "exit":
            os._exit(value)
        case "hang":
            time.sleep(600)
        case "raise":
            raise ValueError(value)
        case "own error":
            raise LogError(value)
        case "hog":
            return len(bytearray(value))
        case "big":
            return bytes(value)
        case "local":
            return lambda: value
        case "unreadable":
            return Unreadable()
        case "process":
            return os.getpid()
        case "variable":
            return os.environ.get(value)
    return None
