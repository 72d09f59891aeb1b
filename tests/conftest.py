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
from typing import Any

import one_thread  # noqa: F401 - first
import pytest
from browser import browser  # noqa: F401 - a fixture
from ekf2_tools import opened
from exchange import replace
from explore_tools import explored, page  # noqa: F401 - fixtures
from hypothesis import HealthCheck, settings
from pypdf import PdfWriter
from ulog_tools import Log

from px4fuse import analysis, api
from px4fuse.assignment import truth
from px4fuse.comparison import comparison
from px4fuse.ekf2.model import Model, open_model
from px4fuse.filter.fast_replay import quick_replay
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop import tracks
from px4fuse.readers import read_log
from px4fuse.report import pdf
from px4fuse.request import ComparisonRequest

REPOSITORY = Path(__file__).resolve().parents[1]
SAMPLES = REPOSITORY / "sample_logs"
LOG = SAMPLES / "aisle_uwb.ulg"
REPORT = REPOSITORY / "reports" / "example" / "aisle_uwb.pdf"
SHARED = REPOSITORY.parent / "shared"

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

    The processes of the tests, which are begun after this, keep what they compile, as there are a
    hundred; not those of a study, which changes the code.
    """
    gc.disable()
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
    return LOG


@pytest.fixture(scope="session")
def sample_flight(sample_log: Path) -> Flight:
    """The sample flight, read once; tests must not change it."""
    return read_log(sample_log)


@pytest.fixture(scope="session")
def model(sample_flight: Flight) -> Model:
    """The sample's model of EKF2; what it has replayed it keeps."""
    return opened(sample_flight)


@pytest.fixture(scope="session")
def sample(sample_log: Path) -> analysis.Analysis:
    """The sample flight, analysed once; tests must not change it."""
    return _run_once(ComparisonRequest(log=str(sample_log)))


def shared(name: str) -> Path:
    """A folder of what is not part of the project."""
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"the further files ../shared/{name} are not beside the repository")
    return folder


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """Further flight logs."""
    return shared("logs")


@pytest.fixture(scope="session")
def model_of() -> Callable[[Path], Model | Unavailable]:
    """EKF2's model of a log; the last ones of a process are kept."""
    return lru_cache(8)(lambda path: open_model(read_log(path)))


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Flight]:
    """Write a made log or recording and read it as a flight."""

    def write_and_read(made: Any, *, stamped: bool = True, system: int | None = None) -> Flight:
        if isinstance(made, Log):
            return read_log(made.write(tmp_path / "made.ulg"))
        recorder = getattr(made, "record", lambda: made)()
        path = tmp_path / "made.tlog"
        path.write_bytes(recorder.tlog() if stamped else recorder.raw())
        return read_log(path, system=system)

    return write_and_read


def page_of(*drawn: Any) -> bytes:
    """An empty page with results attached: the text that is last of what is drawn."""
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment(pdf.RESULTS_NAME, drawn[-1].encode())
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

    def from_memory(found: object, results: object, text: str) -> bytes:
        if text not in _drawn:
            _drawn[text] = render(found, results, text)
            if len(_drawn) > MOST_ANALYSES:
                del _drawn[next(iter(_drawn))]
        return _drawn[text]

    monkeypatch.setattr(pdf, "render", from_memory)


# Of the unchanged program: they are there before any test patches them
_run, _read = analysis.run, analysis.read_flight
_kept: dict[tuple[str | bytes, ...] | None, Any] = {}


def _known(request: ComparisonRequest, what: str) -> tuple[str | bytes, ...] | None:
    """What it is kept under: where the files lie is no part of it, verification has links."""
    position = request.position
    paths = [request.log, request.mavlink, None if position is None else position.path]
    files = [Path(path) for path in paths if path is not None]
    if any(not file.is_file() for file in files):
        return None
    named = replace(
        request,
        log=Path(request.log).name,
        mavlink=request.mavlink and Path(request.mavlink).name,
        position=position and replace(position, path=Path(position.path).name),
    )
    return (what, repr(named), *(sha256(file.read_bytes()).digest() for file in files))


def _known_flight(request: ComparisonRequest) -> tuple[str | bytes, ...] | None:
    names = ("log", "mavlink", "system", "position", "clock_offset_s")
    return _known(ComparisonRequest(**{name: getattr(request, name) for name in names}), "flight")


def _once(known: tuple[str | bytes, ...] | None, make: Callable[[], Any]) -> Any:
    if known is None:
        return make()
    # the last one used stands last
    _kept[known] = _kept.pop(known) if known in _kept else make()
    if len(_kept) > 2 * MOST_ANALYSES:
        del _kept[next(iter(_kept))]
    return _kept[known]


def _read_once(
    request: ComparisonRequest, progress: analysis.Progress = analysis.ignore_progress
) -> Flight:
    return _once(_known_flight(request), lambda: _read(request, progress))


def _log_once(path: str | Path, *, system: int | None = None) -> Flight:
    return _read_once(ComparisonRequest(log=str(path), system=system))


def _run_once(
    request: ComparisonRequest,
    progress: analysis.Progress = analysis.ignore_progress,
    flight: Flight | None = None,
) -> analysis.Analysis:
    if flight is not None and flight is not _kept.get(_known_flight(request)):
        return _run(request, progress, flight)
    return _once(_known(request, "analysis"), lambda: _run(request, progress, flight))


@pytest.fixture(scope="module")
def analysed_once() -> Iterator[None]:
    """The same request on the same files is read and analysed once; where nothing is patched."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "read_flight", _read_once)
        patch.setattr(tracks, "read_log", _log_once)
        for place in (analysis, api):
            patch.setattr(place, "run", _run_once)
        yield


@pytest.fixture
def quick_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Our filter to 1e-9 in less time, see test_likelihood.py; for tests of what surrounds it."""
    for module in (comparison, truth):
        monkeypatch.setattr(module, "replay", quick_replay)
