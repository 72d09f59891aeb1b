"""A guard against what does not end; not a measure of speed."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

# What is guarded takes a second at most; no machine is a hundred times slower
LIMIT_S = 120.0


class TookTooLongError(Exception):
    """The work did not end."""


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    """Interrupt what does not end, where the system can."""

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
