"""The page as one file: Bokeh, the flight's data, the engine and what moves them."""

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from bokeh.resources import Resources

from px4fuse.analysis import Analysis
from px4fuse.explore.data import flight_data, ranges
from px4fuse.explore.figures import FIGURES, document_json
from px4fuse.explore.packing import Packer
from px4fuse.webpage.safe import cleaned, inert_json, part, policy_hash, template

# Longer text from a log is cut
MAX_CHARACTERS = 2000
SCRIPTS = ("dom", "story", "step", "times", "tour")
HERE = "px4fuse.explore"


def html_text(analysis: Analysis) -> str:
    """Lay out the page.

    Parameters
    ----------
    analysis : Analysis
        Made from a request.

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
        heading="Turn the knobs and watch",
        title=data["log"],
    )


def data_scripts(data: dict[str, Any], analysis: Analysis, packer: Packer, suffix: str = "") -> str:
    """Return the elements with the data of one flight; none of them is run.

    Parameters
    ----------
    data : dict
        From :func:`px4fuse.explore.data.flight_data`.
    analysis : Analysis
    packer : Packer
        That the data were made with.
    suffix : str
        Of the elements' ids, where a page has several such sets.
    """
    document, places = document_json(data, analysis.tuning)
    content = {"flight": data, "ranges": ranges(), "packed": packer.specs, "places": places}
    return "\n".join(
        f'<script type="{kind}" id="{name}{suffix}">{text}</script>'
        for name, kind, text in (
            ("content", "application/json", inert_json(cleaned(content, MAX_CHARACTERS))),
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
    rounds: int = 0,
    choices: Mapping[str, str] = {},
) -> str:
    """The page around data that :func:`data_scripts` made.

    Parameters
    ----------
    scripts : str
    data : dict
        A flight of the page; all have ground truth, or none has.
    command, heading, title : str
    rounds : int
        How many flights are asked about.
    choices : mapping of str to str
        What may be answered, by name in words; none where nothing is asked.
    """
    practice = "practice" if choices else "no_practice"
    code = {
        # BokehJS itself, without widgets, tables and formulas; what follows it only sets a log
        # level, and says so on the console
        "bokeh": Resources(mode="inline", components=["bokeh"]).js_raw[0],
        "engine": part("engine.js", HERE),
        "script": "".join(part(f"{name}.js", HERE) for name in (*SCRIPTS, practice, "page")),
    }
    return template("explore/page.html").render(
        {f"{name}_hash": policy_hash(text) for name, text in code.items()},
        **code,
        style=part("base.css") + part("page.css", HERE),
        command=command,
        heading=heading,
        title=title,
        made_with=f"px4fuse {version('px4fuse')}",
        data=scripts,
        rounds=rounds,
        choices=choices,
        panels=FIGURES.panels.items(),
        has_truth=any(isinstance(axis["truth"], dict) for axis in data["axes"]),
    )
