"""Tools to test web pages: an HTML parser, and headless Chromium."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# Locations of browsers that are not on PATH
PLACES = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)


class Elements(HTMLParser):
    """All elements and attributes of a page, from an HTML parser."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attributes)))


def content(text: str) -> Any:
    """Return the JSON data that a page with a table contains for its script."""
    (found,) = re.findall(r'<script type="application/json" id="content">(.*?)</script>', text)
    return json.loads(found)


class Browser:
    """Headless Chromium, controlled by its DevTools protocol over two pipes."""

    def __init__(self, program: str, profile: Path) -> None:
        its_input, self._out = os.pipe()
        self._in, its_output = os.pipe()
        # Chromium reads file descriptor 3 and writes 4
        wire = (
            "import os, sys; os.dup2(int(sys.argv[1]), 100); os.dup2(int(sys.argv[2]), 101);"
            "os.dup2(100, 3); os.dup2(101, 4); os.execv(sys.argv[3], sys.argv[3:])"
        )
        self._process = subprocess.Popen(
            [
                sys.executable, "-c", wire, str(its_input), str(its_output), program,
                "--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu",
                "--no-first-run", "--disable-background-networking", "--disable-component-update",
                "--disable-sync", "--disable-dev-shm-usage", "--hide-scrollbars",
                # block all requests
                "--proxy-server=127.0.0.1:9", "--host-resolver-rules=MAP * ~NOTFOUND",
                f"--user-data-dir={profile}", "about:blank",
            ],
            pass_fds=(its_input, its_output),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        os.close(its_input)
        os.close(its_output)
        self._buffer = b""
        self._count = 0
        self._session = ""
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        with contextlib.suppress(OSError, AssertionError):
            self._session = ""
            self.call("Browser.close")
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, **parameters: Any) -> Any:
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        content = json.dumps(message).encode() + b"\0"
        while content:
            content = content[os.write(self._out, content) :]
        while (answer := self._next()).get("id") != self._count:
            self.events.append(answer)
        assert "error" not in answer, f"{method}: {answer['error']}"
        return answer["result"]

    def _next(self, patience_s: float = 60.0) -> dict[str, Any]:
        end = time.monotonic() + patience_s
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            content = os.read(self._in, 1 << 20)
            assert content, "the browser has ended"
            self._buffer += content
        line, self._buffer = self._buffer.split(b"\0", 1)
        return dict(json.loads(line))

    def open(self, path: Path, *, scripts: bool = True, width: int = 1400) -> None:
        self.call("Emulation.setScriptExecutionDisabled", value=not scripts)
        self._measure(width, 900)
        self.events.clear()
        self.call("Page.navigate", url=path.as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        """Set the window size and wait for the new layout; on a small screen it comes late."""
        self._measure(width, height, scale)
        self.ask_later("new Promise((done) => requestAnimationFrame(() => setTimeout(done)))")

    def _measure(self, width: int, height: int, scale: float = 1.0) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height,
            deviceScaleFactor=scale, mobile=width < 600,
        )  # fmt: skip

    def ask(self, script: str) -> Any:
        """Evaluate a JavaScript expression and return its value."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def ask_later(self, script: str) -> Any:
        """Evaluate an expression that returns a promise, and return its result."""
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def click(self, selector: str) -> None:
        """Click at the position of an element, so that a covered or hidden one fails."""
        x, y = self.ask(
            f"(() => {{ const node = document.querySelector({json.dumps(selector)});"
            "node.scrollIntoView({block: 'center'}); const box = node.getClientRects()[0];"
            "return [box.x + Math.min(box.width / 2, 40), box.y + box.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            words = {"text": text} if text and kind == "keyDown" else {}
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key,
                windowsVirtualKeyCode={"Enter": 13, "Tab": 9, "Escape": 27}.get(key, ord(key[0])),
                **words,
            )  # fmt: skip

    def write(self, text: str) -> None:
        self.call("Input.insertText", text=text)

    def choose(self, selector: str, value: str) -> None:
        """Choose an option of a select element."""
        self.ask(
            f"(() => {{ const select = document.querySelector({json.dumps(selector)});"
            f"select.value = {json.dumps(value)};"
            "select.dispatchEvent(new Event('change')); })()"
        )

    def names(self) -> list[str]:
        """Return the names in the rows of the table."""
        return list(
            self.ask(
                "[...document.querySelectorAll('.list > tbody > tr:not(.more) .name')]"
                ".map((name) => name.textContent)"
            )
        )

    def complaints(self) -> list[Any]:
        """Return script errors, console messages and violations of the security policy."""
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        self.ask("1")  # pending events arrive before the answer
        return [event["params"] for event in self.events if event["method"] in kinds]

    def requests(self) -> set[str]:
        """Return the URL schemes of all requests of the page."""
        self.ask("1")
        return {
            event["params"]["request"]["url"].split(":")[0]
            for event in self.events
            if event["method"] == "Network.requestWillBeSent"
        }


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    program = next(
        (found for name in (*BROWSERS, *PLACES) if (found := shutil.which(name)) is not None), None
    )
    if program is None:
        pytest.skip("no Chromium or Chrome is installed: apt-get install chromium")
    if sys.platform == "win32":
        pytest.skip("the browser is driven over pipes, which Windows hands on differently")
    opened = Browser(program, tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()
