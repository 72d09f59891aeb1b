"""A page of explore in a browser, and its engine on settings of Python's."""

from __future__ import annotations

import json
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

from browser import Browser

from px4fuse.analysis import Analysis
from px4fuse.explore.page import html_text
from px4fuse.findings import find
from px4fuse.findings.model import Finding
from px4fuse.request import ComparisonRequest


def open_page(
    browser: Browser, file: Path, flights: list[tuple[Analysis, ComparisonRequest]], at: str = ""
) -> Browser:
    told: list[tuple[Analysis, tuple[Finding, ...], ComparisonRequest]] = [
        (analysis, find(analysis), request) for analysis, request in flights
    ]
    file.write_bytes(html_text(told).encode())
    return show(browser, file, at)


def show(browser: Browser, file: Path, at: str = "", width: int = 1400) -> Browser:
    browser.open(file, width=width)
    if at:
        browser.ask(f"location.hash = {json.dumps(at)}")
    ready = "document.querySelector('#tables table') !== null"
    end = time.monotonic() + 30.0
    while not browser.ask(ready):
        assert time.monotonic() < end, browser.complaints()
        time.sleep(0.05)
    return browser


def axe() -> str:
    """axe-core, to be run in a page."""
    return files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8") + ";1"


def serious(browser: Browser) -> list[Any]:
    """What axe-core, which is in the page, finds that shuts somebody out."""
    found = ask(
        browser,
        "axe.run().then((r) => r.violations.map((v) => [v.impact, v.id, v.nodes[0].html]))",
    )
    return [one for one in found if one[0] in ("serious", "critical")]


def open_view(browser: Browser, name: str) -> None:
    """Show a tab of the page."""
    ask(browser, f"Explore.then((e) => {{ e.open({json.dumps(name)}); }})")
    settle(browser)


def settle(browser: Browser) -> None:
    """Until what is under way is drawn, what follows the end of a drag too."""
    ask(
        browser,
        "new Promise((r) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)),"
        "200))",
    )


def ask(browser: Browser, script: str) -> Any:
    """What a script with ``await`` gives."""
    answer = browser.call(
        "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
    )
    assert "exceptionDetails" not in answer, answer
    return answer["result"].get("value")
