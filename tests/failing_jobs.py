"""Jobs for worker processes, most of which fail; imports nothing else of the tests."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from px4fuse.errors import LogError


class Unreadable:
    """Object that can be pickled but not unpickled."""

    def __reduce__(self) -> Any:
        return int, ("no number",)


def run_job(job: tuple[str, Any]) -> Any:
    """Perform the action that a job names."""
    what, value = job
    match what:
        case "square":
            return value * value
        case "blocks Ctrl-C":
            return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
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
