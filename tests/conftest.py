"""Fixtures that every test file shares, and how Hypothesis chooses its examples.

The suite tries the same examples every time. A search with new random examples, as before each
release::

    python -m pytest --hypothesis-profile=random

Keep what it finds as an ``@example`` of the test.
"""

from __future__ import annotations

import gc
import io
import os
import signal
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import pytest
from browser import browser  # noqa: F401 - a fixture
from hypothesis import HealthCheck, settings
from msgspec.structs import replace
from pypdf import PdfWriter

from px4fuse import analysis
from px4fuse.flight import Flight
from px4fuse.readers import read_log
from px4fuse.report import pdf
from px4fuse.request import ComparisonRequest
from px4fuse.threads import ONE_THREAD

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


# Objects made since garbage was last looked for; a report that is drawn makes a hundred thousand
MANY_OBJECTS = 200_000


def pytest_configure() -> None:
    """Look for garbage between tests only, as collecting them makes none.

    The processes of the tests, which are begun after this, do linear algebra as commands do.
    """
    gc.disable()
    os.environ.update(ONE_THREAD)


def pytest_collection_finish() -> None:
    """Leave what was imported and collected out of every search for garbage."""
    gc.collect()
    gc.freeze()


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Forget what a file's functions have cached once its tests are done: analyses are large.

    Commands turn the search for garbage off for their process, which is that of all tests here.
    """
    gc.disable()  # `px4fuse batch` turns it on
    if gc.get_count()[0] > MANY_OBJECTS:
        gc.collect()
    module = getattr(item, "module", None)
    if module is not None and getattr(nextitem, "module", None) is not module:
        for value in vars(module).values():
            if getattr(value, "__module__", None) == module.__name__:
                getattr(value, "cache_clear", lambda: None)()


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


def page_of(_: object, text: str) -> bytes:
    """An empty page with results attached."""
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment(pdf.RESULTS_NAME, text.encode())
    out = io.BytesIO()
    writer.write(out)
    return out.getvalue()


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages take most of the time; for tests that look at none of them."""
    monkeypatch.setattr(pdf, "render", page_of)


@pytest.fixture
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same results are drawn once; for tests of what follows."""
    render, drawn = pdf.render, dict[str, bytes]()

    def from_memory(document: pdf.Report, text: str) -> bytes:
        if text not in drawn:
            drawn[text] = render(document, text)
        return drawn[text]

    monkeypatch.setattr(pdf, "render", from_memory)


# Of the unchanged program: it is there before any test patches it
_analysed = lru_cache(maxsize=2)(analysis.run)


@pytest.fixture
def analysed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An analysis of a sample log that was made before serves again; for tests of what follows."""

    def run(
        request: ComparisonRequest, progress: Callable[[str], None] = lambda _: None
    ) -> analysis.Analysis:
        del progress
        log = Path(request.log).resolve()  # verification reads it by a link
        assert log.is_relative_to(REPOSITORY), "another log may change"
        assert log.name == Path(request.log).name
        assert request.mavlink is request.position is None
        return _analysed(replace(request, log=str(log)))

    monkeypatch.setattr(analysis, "run", run)
