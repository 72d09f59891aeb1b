"""Time limit for work that may not end; not a measurement of speed."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

# s; the limited work takes 1 s at most, and no computer is 100 times slower
LIMIT_S = 120.0


class TookTooLongError(Exception):
    """The work did not end."""


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    """Raise TookTooLongError after LIMIT_S, on systems with interval timers."""

    def stop(*_: Any) -> None:
        raise TookTooLongError(f"not done within {LIMIT_S:g} s")

    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
