"""The page as one HTML file: Bokeh, the flight's data, the KF engine and the user interface."""

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from bokeh.resources import Resources

from px4fuse.analysis import Analysis
from px4fuse.explore.data import flight_data, ranges
from px4fuse.explore.figures import FIGURES, document_json
from px4fuse.explore.packing import Packer
from px4fuse.webpage.safe import clean_values, inert_json, part, policy_hash, template

MAX_CHARACTERS = 2000  # longer texts from a log are shortened
SCRIPTS = ("dom", "summary", "step", "times", "tour")
PACKAGE = "px4fuse.explore"


def html_text(analysis: Analysis) -> str:
    """Make the page of an analysis.

    Parameters
    ----------
    analysis : Analysis
        Must have a request.

    Returns
    -------
    str
        Write it as UTF-8.
    """
    packer = Packer()
    data = flight_data(analysis, packer)
    return page_text(
        data_scripts(data, analysis, packer),
        data,
        command="explore",
        heading="Interactive Kalman filter",
        title=data["log"],
        sha256=analysis.flight.log.sha256,
    )


def data_scripts(data: dict[str, Any], analysis: Analysis, packer: Packer, suffix: str = "") -> str:
    """Return the script elements with the data of one flight; none of them is executed.

    Parameters
    ----------
    data : dict
        From :func:`px4fuse.explore.data.flight_data`.
    analysis : Analysis
    packer : Packer
        Packer of the arrays in the data.
    suffix : str
        Suffix of the element ids, for pages with several flights.
    """
    document, places = document_json(data, analysis.tuning)
    content = {"flight": data, "ranges": ranges(), "packed": packer.specs, "places": places}
    return "\n".join(
        f'<script type="{kind}" id="{name}{suffix}">{text}</script>'
        for name, kind, text in (
            ("content", "application/json", inert_json(clean_values(content, MAX_CHARACTERS))),
            ("document", "application/json", inert_json(document)),
            ("arrays", "text/plain", packer.text()),
        )
    )


def page_text(
    scripts: str,
    data: dict[str, Any],
    *,
    command: str,
    heading: str,
    title: str,
    sha256: str = "",
    rounds: int = 0,
    choices: Mapping[str, str] = {},
) -> str:
    """Make the page around the data elements.

    Parameters
    ----------
    scripts : str
        Elements of :func:`data_scripts`.
    data : dict
        One flight of the page; either all flights have ground truth or none.
    command, heading, title : str
    sha256 : str
        SHA-256 of the log, in the head of the page.
    rounds : int
        Number of flights in a practice set.
    choices : mapping of str to str
        Possible answers with their texts; empty for a page without questions.
    """
    practice = "practice" if choices else "no_practice"
    code = {
        # BokehJS core without widgets, tables and formulas; the second script of Bokeh only sets
        # the log level and writes to the console
        "bokeh": Resources(mode="inline", components=["bokeh"]).js_raw[0],
        "engine": part("engine.js", PACKAGE),
        "script": "".join(part(f"{name}.js", PACKAGE) for name in (*SCRIPTS, practice, "page")),
    }
    return template("explore/page.html").render(
        {f"{name}_hash": policy_hash(text) for name, text in code.items()},
        **code,
        style=part("base.css") + part("page.css", PACKAGE),
        command=command,
        heading=heading,
        title=title,
        made_from=f"px4fuse {command} {sha256}".rstrip(),
        made_with=f"px4fuse {version('px4fuse')}",
        data=scripts,
        rounds=rounds,
        choices=choices,
        panels=FIGURES.panels.items(),
        has_truth=any(isinstance(axis["truth"], dict) for axis in data["axes"]),
    )
