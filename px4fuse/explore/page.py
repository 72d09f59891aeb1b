"""Explore page as one HTML file: Bokeh, data of the flight, KF in JavaScript, user interface."""

from collections.abc import Mapping
from importlib.metadata import version

from bokeh.resources import Resources

from px4fuse.analysis import Analysis
from px4fuse.explore.data import Data, flight_data, ranges
from px4fuse.explore.figures import FIGURES, document_json, has_reference
from px4fuse.explore.packing import Packer
from px4fuse.html.safe import clean_values, inert_json, load_template, policy_hash, read_asset
from px4fuse.report.card_html import axis_figures, card_html, card_of, card_style

# Maximum length (characters) of a text from a log; longer texts are shortened
MAX_LOG_TEXT_LENGTH = 2000
SCRIPT_NAMES = ("card", "step", "times")
PACKAGE = "px4fuse.explore"


def html_text(analysis: Analysis) -> str:
    """Make the page of an analysis.

    Parameters
    ----------
    analysis : Analysis
        Analysis of one flight, with the request.

    Returns
    -------
    str
        HTML page, to be written as UTF-8.
    """
    packer = Packer()
    data, card = flight_data(analysis, packer), card_of(analysis)
    identity = card.identity
    return page_text(
        data_scripts(data, analysis, packer),
        data,
        command="explore",
        title=data["log"],
        about=f"{identity.source}, {identity.firmware}, {identity.duration_s:.1f} s",
        card=card_html(card, has_apply=True),
        sha256=analysis.flight.log.sha256,
    )


def data_scripts(data: Data, analysis: Analysis, packer: Packer, suffix: str = "") -> str:
    """Return HTML elements with the data of one flight, which browsers neither execute nor show.

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
    document, places = document_json(data)
    content = {"flight": data, "ranges": ranges(), "packed": packer.specs, "places": places}
    figures = f'<template id="figures{suffix}">{axis_figures(analysis)}</template>\n'
    return figures + "\n".join(
        f'<script type="{kind}" id="{name}{suffix}">{text}</script>'
        for name, kind, text in (
            ("content", "application/json", inert_json(clean_values(content, MAX_LOG_TEXT_LENGTH))),
            ("document", "application/json", inert_json(document)),
            ("arrays", "text/plain", packer.text()),
        )
    )


def page_text(
    data_elements: str,
    data: Data,
    *,
    command: str,
    title: str,
    about: str = "",
    card: str = "",
    sha256: str = "",
    flight_count: int = 0,
    choices: Mapping[str, str] = {},
) -> str:
    """Make the HTML page with the data elements.

    Parameters
    ----------
    data_elements : str
        Script elements from :func:`data_scripts`.
    data : dict
        Data of any flight of the page: either all have ground truth or none has.
    command, title, about : str
        Command, file, and description of the flight in the header.
    card : str
        HTML of the diagnosis card; empty if the page shows it after an answer.
    sha256 : str
        SHA-256 of the log, in the head of the page.
    flight_count : int
        Number of flights in a practice set; 0 on other pages.
    choices : mapping of str to str
        Possible answers with their texts; empty for a page without questions.
    """
    practice = "practice" if choices else "no_practice"
    scripts_by_name = {
        # the core of BokehJS, without widgets, tables and formulas; the second script only sets
        # the log level
        "bokeh": Resources(mode="inline", components=["bokeh"]).js_raw[0],
        "engine": read_asset("engine.js", PACKAGE),
        "script": read_asset("dom.js")
        + "".join(read_asset(f"{name}.js", PACKAGE) for name in (*SCRIPT_NAMES, practice, "page")),
    }
    return load_template("explore/page.html").render(
        {f"{name}_hash": policy_hash(text) for name, text in scripts_by_name.items()},
        **scripts_by_name,
        style="".join(map(read_asset, ("colours.css", "base.css")))
        + card_style()
        + read_asset("page.css", PACKAGE),
        command=command,
        title=title,
        about=about,
        card=card,
        made_from=f"px4fuse {command} {sha256}".rstrip(),
        made_with=f"px4fuse {version('px4fuse')}",
        data=data_elements,
        flight_count=flight_count,
        choices=choices,
        views=FIGURES.views,
        has_reference=has_reference(data),
    )
