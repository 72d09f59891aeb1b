"""Fixtures of all test files, and the settings of Hypothesis.

Each run uses the same examples. Search with new random examples, for example before a release::

    python -m pytest --hypothesis-profile=random

Add each failing example as ``@example`` to its test.
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

from px4fuse import api, diagnose
from px4fuse.analysis import Analysis
from px4fuse.comparison.estimates import Progress, ignore_progress
from px4fuse.ekf2.model import Ekf2Model, prepare_ekf2_model
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.loop import tracks
from px4fuse.readers import read_log
from px4fuse.report import pdf
from px4fuse.request import ComparisonRequest

REPOSITORY = Path(__file__).resolve().parents[1]
SAMPLES = REPOSITORY / "sample_logs"
LOG = SAMPLES / "aisle_uwb.ulg"
REPORT = REPOSITORY / "reports" / "example" / "aisle_uwb.pdf"
REPORT_PAGES = 6
SHARED = REPOSITORY.parent / "shared"

# Background jobs of a shell ignore SIGINT, and processes started by tests would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No limit on time: a slow machine must not fail
settings.register_profile(
    "steady",
    max_examples=50,  # the same in each run
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=True,
    database=None,
)
settings.register_profile(
    "random", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("steady")


# Number of new objects before the next garbage collection; drawing a report makes 100,000
MANY_OBJECTS = 500_000


# Files whose tests the command of the README leaves out, by marker (pyproject.toml explains each).
# ``.ci/run`` runs them afterwards; ``python -m pytest FILE`` runs all tests of a file.
MARKED_FILES = {
    "process": "attacks bad_logs batch cli environment terminal workers writing",
    "browser": "class_page explore explore_engine explore_screen fleet_page practice",
    "oracle": "mavlink mavlink_frames pose_graph",
    "docs": "documentation",
    "slow": (
        "answers assignment detector_rates flown form_points fuzz gnss grade hypotheses outdoor "
        "remedies source_noise vision"
    ),
}
LEFT_OUT = f"not ({' or '.join((*MARKED_FILES, 'reallogs'))})"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of each file in ``MARKED_FILES``."""
    markers = {
        f"test_{name}.py": mark for mark, names in MARKED_FILES.items() for name in names.split()
    }
    for item in items:
        if marker := markers.get(item.path.name):
            item.add_marker(marker)


def pytest_configure(config: pytest.Config) -> None:
    """Leave out marked tests in a run without arguments; collect garbage between tests only.

    Test processes may write bytecode, which saves the compilation in each; processes of a study
    may not, because the study changes the code.
    """
    if config.args_source is config.ArgsSource.TESTPATHS and not config.option.markexpr:
        config.option.markexpr = LEFT_OUT
    gc.disable()
    if config.getoption("numprocesses", None):
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_finish() -> None:
    """Exclude imported modules and collected tests from garbage collection."""
    gc.collect()
    gc.freeze()


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Clear the caches of a test file after its last test, because analyses are large.

    Commands change the garbage collection of their process, which is that of the tests here.
    """
    gc.disable()  # `px4fuse batch` enables it
    if gc.get_count()[0] > MANY_OBJECTS:
        gc.collect()
    module = getattr(item, "module", None)
    if module is not None and getattr(nextitem, "module", None) is not module:
        for value in vars(module).values():
            if getattr(value, "__module__", None) == module.__name__:
                getattr(value, "cache_clear", lambda: None)()


@pytest.fixture(scope="session")
def sample_log() -> Path:
    """Log of the sample flight that is included in the project."""
    return LOG


@pytest.fixture(scope="session")
def sample_flight(sample_log: Path) -> Flight:
    """The sample flight, read once; tests must not change it."""
    return read_log(sample_log)


@pytest.fixture(scope="session")
def model(sample_flight: Flight) -> Ekf2Model:
    """EKF2 model of the sample flight; it caches its replays."""
    return opened(sample_flight)


@pytest.fixture(scope="session")
def sample(sample_log: Path) -> Analysis:
    """The sample flight, analysed once; tests must not change it."""
    return _diagnose_cached(ComparisonRequest(log=str(sample_log)))


def shared(name: str) -> Path:
    """Return a folder of ``../shared``; skip the test if it does not exist."""
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"the further files ../shared/{name} are not beside the repository")
    return folder


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    """Folder of flight logs that are not part of the repository (``../shared/logs``)."""
    return shared("logs")


@pytest.fixture(scope="session")
def model_of() -> Callable[[Path], Ekf2Model | Unavailable]:
    """Function that returns the EKF2 model of a log; the last 8 are cached."""
    return lru_cache(8)(lambda path: prepare_ekf2_model(read_log(path)))


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Flight]:
    """Write a generated log or recording to a file, and read it as a flight."""

    def write_and_read(made: Any, *, stamped: bool = True, system: int | None = None) -> Flight:
        if isinstance(made, Log):
            return read_log(made.write(tmp_path / "made.ulg"))
        recorder = getattr(made, "record", lambda: made)()
        path = tmp_path / "made.tlog"
        path.write_bytes(recorder.tlog() if stamped else recorder.raw())
        return read_log(path, system=system)

    return write_and_read


def blank_page(*drawn: Any) -> bytes:
    """Return an empty PDF page with results (the last argument) attached."""
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    writer.add_attachment(pdf.RESULTS_NAME, drawn[-1].encode())
    out = io.BytesIO()
    writer.write(out)
    return out.getvalue()


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pages of reports by an empty one, for tests that do not examine them."""
    monkeypatch.setattr(pdf, "render_pdf", blank_page)


# Size of each cache
MOST_ANALYSES = 16
_page_cache: dict[str, bytes] = {}


@pytest.fixture
def cached_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the pages of equal results once per process."""
    render_pdf = pdf.render_pdf

    def from_memory(found: object, results: object, text: str) -> bytes:
        if text not in _page_cache:
            _page_cache[text] = render_pdf(found, results, text)
            if len(_page_cache) > MOST_ANALYSES:
                del _page_cache[next(iter(_page_cache))]
        return _page_cache[text]

    monkeypatch.setattr(pdf, "render_pdf", from_memory)


# The original functions, saved before a test replaces them
_diagnose, _read = diagnose.diagnose, diagnose.read_flight
_cache: dict[tuple[str | bytes, ...] | None, Any] = {}


def _cache_key(request: ComparisonRequest, what: str) -> tuple[str | bytes, ...] | None:
    """Return the cache key: names and contents of the files, without their folders."""
    position = request.position
    paths = [request.log, None if position is None else position.path]
    files = [Path(path) for path in paths if path is not None]
    if any(not file.is_file() for file in files):
        return None
    named = replace(
        request,
        log=Path(request.log).name,
        position=position and replace(position, path=Path(position.path).name),
    )
    return (what, repr(named), *(sha256(file.read_bytes()).digest() for file in files))


def _flight_key(request: ComparisonRequest) -> tuple[str | bytes, ...] | None:
    names = ("log", "system", "position", "clock_offset_s")
    return _cache_key(
        ComparisonRequest(**{name: getattr(request, name) for name in names}), "flight"
    )


def _cached(known: tuple[str | bytes, ...] | None, make: Callable[[], Any]) -> Any:
    if known is None:
        return make()
    # the most recently used entry is last
    _cache[known] = _cache.pop(known) if known in _cache else make()
    if len(_cache) > 2 * MOST_ANALYSES:
        del _cache[next(iter(_cache))]
    return _cache[known]


def _read_cached(request: ComparisonRequest, progress: Progress = ignore_progress) -> Flight:
    return _cached(_flight_key(request), lambda: _read(request, progress))


def _read_log_cached(path: str | Path, *, system: int | None = None) -> Flight:
    return _read_cached(ComparisonRequest(log=str(path), system=system))


def _diagnose_cached(
    request: ComparisonRequest,
    progress: Progress = ignore_progress,
    flight: Flight | None = None,
) -> Analysis:
    if flight is not None and flight is not _cache.get(_flight_key(request)):
        return _diagnose(request, progress, flight)
    return _cached(_cache_key(request, "analysis"), lambda: _diagnose(request, progress, flight))


@pytest.fixture(scope="module")
def cached_analyses() -> Iterator[None]:
    """Analyse equal requests on equal files only once per test file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnose, "read_flight", _read_cached)
        patch.setattr(tracks, "read_log", _read_log_cached)
        for place in (diagnose, api):
            patch.setattr(place, "diagnose", _diagnose_cached)
        yield
