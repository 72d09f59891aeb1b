"""Fixtures that every test file shares, and how Hypothesis chooses its examples.

The suite tries the same examples every time. A search with new random examples, as before each
release::

    python -m pytest --hypothesis-profile=random

Keep what it finds as an ``@example`` of the test.
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from browser import browser  # noqa: F401 - a fixture
from hypothesis import HealthCheck, settings

from px4fuse.flight import Flight
from px4fuse.readers import read_log

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_LOGS = REPOSITORY.parent / "shared" / "logs"

# A shell's background jobs ignore Ctrl-C, and so would all that the tests start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No limit on time: a slow machine must not fail
settings.register_profile(
    "steady",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=True,
    database=None,
)
settings.register_profile(
    "random", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("steady")


@pytest.fixture(scope="session")
def sample_log() -> Path:
    """The sample flight that ships with the project."""
    return REPOSITORY / "sample_logs" / "aisle_uwb.ulg"


@pytest.fixture(scope="session")
def sample_flight(sample_log: Path) -> Flight:
    """The sample flight, read once; tests must not change it."""
    return read_log(sample_log)


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """The folder of further flight logs, which are not part of the project."""
    if not SHARED_LOGS.is_dir():
        pytest.skip("the further flight logs (../shared/logs) are not beside the repository")
    return SHARED_LOGS
