"""The page as one file: Bokeh, the flight's data, the engine and what moves them."""

from __future__ import annotations

from importlib.metadata import version
from importlib.resources import files
from string import Template
from typing import Any

from bokeh.resources import Resources

from px4fuse.analysis import Analysis
from px4fuse.explore.data import flight_data, ranges
from px4fuse.explore.figures import document_json
from px4fuse.explore.packing import Packer
from px4fuse.findings.model import Finding
from px4fuse.request import ComparisonRequest
from px4fuse.webpage.safe import clean, escaped, inert_json, policy_hash
from px4fuse.webpage.safe import part as shared

# Longer text from a log is cut
MAX_CHARACTERS = 2000
Explored = tuple[Analysis, tuple[Finding, ...], ComparisonRequest]


def html_text(flights: list[Explored]) -> str:
    """Lay out the page.

    Parameters
    ----------
    flights : list of (Analysis, tuple of Finding, ComparisonRequest)
        One, or two to be shown side by side.

    Returns
    -------
    str
        Write it as UTF-8.
    """
    packer = Packer()
    data = [flight_data(*flight, packer, beside=len(flights) > 1) for flight in flights]
    document, places = document_json(data, [analysis.tuning for analysis, _, _ in flights])
    content = {
        "flights": data,
        "ranges": ranges(),
        "packed": packer.specs,
        "places": places,
    }
    scripts = {
        "bokeh": _bokeh(),
        "engine": _file("engine.js"),
        "script": _file("grid.js") + _file("times.js") + _file("page.js"),
    }
    names = " and ".join(one["log"] for one in data)
    return Template(_file("page.html")).substitute(
        {f"{name}_hash": policy_hash(text) for name, text in scripts.items()},
        **scripts,
        style=shared("base.css") + _file("page.css"),
        title=escaped(names),
        made_with=escaped(f"px4fuse {version('px4fuse')}"),
        content=inert_json(_plain(content)),
        document=inert_json(document),
        arrays=packer.text(),
        plots="\n".join(_panels(number, one) for number, one in enumerate(data)),
        count=len(data),
    )


def _file(name: str) -> str:
    return files("px4fuse.explore").joinpath(name).read_text(encoding="utf-8")


def _bokeh() -> str:
    """BokehJS itself; widgets, tables and formulas stay out."""
    # what follows it only sets a log level, and says so on the console
    return Resources(mode="inline", components=["bokeh"]).js_raw[0]


def _plain(value: Any) -> Any:
    """Numbers of numpy as Python's, and every text without what a page cannot hold."""
    if isinstance(value, dict):
        return {clean(str(name), MAX_CHARACTERS): _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, str):
        return clean(value, MAX_CHARACTERS)
    return value.item() if hasattr(value, "item") else value


PANELS = (
    ("strip", "What happened"),
    ("position", "Position"),
    ("velocity", "Velocity"),
    ("error", "Error of position against the truth"),
    ("innovation", "Innovations with ±2√S (the farthest may lie beyond the axis)"),
    ("sigma_p", "Standard deviation of position: grows on predict, shrinks on update"),
    ("sigma_v", "Standard deviation of velocity"),
    ("nis", "Running mean of NIS: 1 is right, the band holds 95 %"),
    ("gain", "Gain K: position solid, velocity dotted"),
)


def _panels(number: int, data: dict[str, Any]) -> str:
    """Places of the plots of one flight."""
    truth = any(isinstance(axis["truth"], dict) for axis in data["axes"])
    shown = [
        f'<figure class="plot"><figcaption>{title}</figcaption>'
        f'<div id="{name}-{number}"></div></figure>'
        for name, title in PANELS
        if name != "error" or truth
    ]
    head = f'<h2 dir="auto">{escaped(data["log"])}</h2>'
    return f'<section class="flight">{head}{"".join(shown)}</section>'
