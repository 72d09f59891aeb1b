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
from collections.abc import Callable, Iterator
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import pytest
from browser import browser  # noqa: F401 - a fixture
from exchange import replace
from explore_tools import explored, page  # noqa: F401 - fixtures
from hypothesis import HealthCheck, settings
from pypdf import PdfWriter

import px4fuse
from px4fuse import analysis
from px4fuse.ekf2.model import Model, open_model
from px4fuse.fleet import inputs
from px4fuse.flight import Flight, Unavailable
from px4fuse.notebook import commands
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
    max_examples=50,  # they are the same each time
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
MANY_OBJECTS = 500_000


def pytest_configure(config: pytest.Config) -> None:
    """Look for garbage between tests only, as collecting them makes none.

    The processes of the tests, which are begun after this, do linear algebra as commands do, and
    keep what they compile, as there are a hundred; not those of a study, which changes the code.
    """
    gc.disable()
    os.environ.update(ONE_THREAD)
    if config.getoption("numprocesses", None):
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


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


@pytest.fixture(scope="session")
def model_of() -> Callable[[Path], Model | Unavailable]:
    """EKF2's model of a log; the last ones of a process are kept."""
    return lru_cache(8)(lambda path: open_model(read_log(path)))


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


# The last ones of a process are kept
MOST_ANALYSES = 16
_drawn: dict[str, bytes] = {}


@pytest.fixture
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same results are drawn once; for tests of what follows."""
    render = pdf.render

    def from_memory(document: pdf.Report, text: str) -> bytes:
        if text not in _drawn:
            _drawn[text] = render(document, text)
            if len(_drawn) > MOST_ANALYSES:
                del _drawn[next(iter(_drawn))]
        return _drawn[text]

    monkeypatch.setattr(pdf, "render", from_memory)


# Of the unchanged program: it is there before any test patches it
_run = px4fuse.run
_analyses: dict[tuple[str | bytes, ...], analysis.Analysis] = {}


def _remembered(
    request: ComparisonRequest,
    progress: Callable[[str], None] = lambda _: None,
    flight: Flight | None = None,
) -> analysis.Analysis:
    position = request.position
    paths = [request.log, request.mavlink, None if position is None else position.path]
    files = [Path(path) for path in paths if path is not None]
    if flight is not None or any(not file.is_file() for file in files):
        return _run(request, progress, flight)
    # where they lie is not part of an analysis: verification reads them by links
    named = replace(
        request,
        log=Path(request.log).name,
        mavlink=request.mavlink and Path(request.mavlink).name,
        position=position and replace(position, path=Path(position.path).name),
    )
    known = (repr(named), *(sha256(file.read_bytes()).digest() for file in files))
    # the last one used stands last
    _analyses[known] = _analyses.pop(known) if known in _analyses else _run(request, progress)
    if len(_analyses) > MOST_ANALYSES:
        del _analyses[next(iter(_analyses))]
    return _analyses[known]


@pytest.fixture(scope="module")
def analysed_once() -> Iterator[None]:
    """The same request on the same files is analysed once; for tests that patch nothing of it."""
    with pytest.MonkeyPatch.context() as patch:
        for place in (analysis, commands):
            patch.setattr(place, "run", _remembered)
        patch.setattr(inputs, "run_or_judge_aids", _remembered)
        yield


@pytest.fixture
def analysed_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the analysis among others of what follows it."""
    monkeypatch.setattr(analysis, "run", _run)
