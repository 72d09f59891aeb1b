"""Fixtures that every test file shares."""

from __future__ import annotations

from pathlib import Path

import pytest

from px4fuse.flight import Flight
from px4fuse.readers import read_log

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_LOGS = REPOSITORY.parent / "shared" / "logs"


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
