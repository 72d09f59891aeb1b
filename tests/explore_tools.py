"""Helpers for tests of the explore page in a browser."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from browser import Browser

import px4fuse.diagnose
from px4fuse.analysis import Analysis
from px4fuse.request import ComparisonRequest


@pytest.fixture(scope="session")
def explored(sample_log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Analysis]:
    """Explore page and analysis of the sample flight."""
    from px4fuse.explore.page import (
        make_analysis_page,
    )  # imported here, because Bokeh is slow to import

    request = ComparisonRequest(log=str(sample_log))
    # looked up at run time, because a fixture replaces it
    analysis = px4fuse.diagnose.diagnose(request)
    file = tmp_path_factory.mktemp("explore") / "sample.html"
    file.write_bytes(make_analysis_page(analysis).encode())
    return file, analysis


@pytest.fixture
def page(browser: Browser, explored: tuple[Path, Analysis]) -> Iterator[Browser]:
    yield show(browser, explored[0])
    assert browser.complaints() == []
    assert browser.requests() <= {"file", "data", "blob"}


def show(browser: Browser, file: Path, width: int = 1400) -> Browser:
    browser.open(file, width=width)
    ready = "document.querySelector('#span').textContent !== ''"
    end = time.monotonic() + 30.0
    while not browser.ask(ready):
        assert time.monotonic() < end, browser.complaints()
        time.sleep(0.05)
    return browser


def axe() -> str:
    """Return the script of axe-core, an accessibility checker."""
    return files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8") + ";1"


def serious(browser: Browser) -> list[Any]:
    """Return the serious and critical violations that axe-core reports for the page."""
    violations = ask(
        browser, "axe.run().then((r) => r.violations.map((v) => [v.impact, v.id, v.nodes[0].html]))"
    )
    return [one for one in violations if one[0] in ("serious", "critical")]


def open_view(browser: Browser, name: str) -> None:
    """Open a view of the page."""
    ask(browser, f"Explore.then((e) => {{ e.open({json.dumps(name)}); }})")
    settle(browser)


def settle(browser: Browser) -> None:
    """Wait until the page is drawn, including the redraw after a drag."""
    ask(
        browser,
        "new Promise((r) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)),"
        "200))",
    )


def ask(browser: Browser, script: str) -> Any:
    """Run a script that returns a promise, and return its result."""
    return browser.ask_later(script)


def mouse(page: Browser, places: list[tuple[float, float]]) -> None:
    """Drag the mouse along positions (pixels)."""
    kinds = ["mousePressed", *["mouseMoved"] * (len(places) - 1), "mouseReleased"]
    for kind, (x, y) in zip(kinds, [*places, places[-1]], strict=True):
        page.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1,
            clickCount=1,
        )  # fmt: skip
    settle(page)


def box(page: Browser, name: str) -> tuple[float, float, float, float]:
    """Scroll to an element and return x, y, width and height (pixels)."""
    x, y, width, height = page.ask(
        f"(() => {{ const node = document.getElementById({json.dumps(name)});"
        "node.scrollIntoView({block: 'center'}); const box = node.getBoundingClientRect();"
        "return [box.x, box.y, box.width, box.height]; })()"
    )
    return x, y, width, height
