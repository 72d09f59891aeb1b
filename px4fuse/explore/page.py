"""Interactive web page (one HTML file) with the data of a flight, KF in JavaScript, and Bokeh."""

from collections.abc import Mapping
from importlib.metadata import version

from bokeh.resources import Resources

from px4fuse.analysis import Analysis
from px4fuse.html.safe import (
    clean_texts,
    compute_csp_hash,
    encode_safe_json,
    load_template,
    read_asset,
)
from px4fuse.report.card_html import (
    SIGMA_RATIO_AXIS,
    make_card_html,
    make_diagnosis_card,
    make_sigma_ratio_figures,
    read_card_css,
)

from .data import ArrayEncoder, PageData, make_flight_data
from .figures import TITLE_BY_TAB, make_document_json, select_plots

# Maximum length (characters) of a text from a log on the web page
MAX_LOG_TEXT_LENGTH = 2000
ASSET_PACKAGE = "px4fuse.explore"


def make_analysis_page(analysis: Analysis) -> str:
    """Make the interactive page with the analysis of one flight (HTML)."""
    encoder = ArrayEncoder()
    data, card = make_flight_data(analysis, encoder), make_diagnosis_card(analysis)
    description = card.identity
    return make_page_html(
        data,
        data_scripts=make_data_elements(data, analysis, encoder),
        command="explore",
        title=data["log"],
        about=f"{description.source}, {description.firmware}, {description.duration_s:.1f} s",
        card=make_card_html(card, has_apply_buttons=True),
        sha256=analysis.flight.log.sha256,
    )


def make_data_elements(
    data: PageData, analysis: Analysis, encoder: ArrayEncoder, suffix: str = ""
) -> str:
    """Return HTML elements with the data of one flight; ``suffix`` makes their ids unique."""
    bokeh_document, name_by_plot_id = make_document_json(data)
    content = {
        "flight": data,
        "ratio_axis": SIGMA_RATIO_AXIS,
        "places": name_by_plot_id,
    }
    text_by_name = {
        "content": encode_safe_json(clean_texts(content, MAX_LOG_TEXT_LENGTH)),
        "document": encode_safe_json(bokeh_document),
        "arrays": encoder.text(),
    }
    figures = f'<template id="figures{suffix}">{make_sigma_ratio_figures(analysis)}</template>'
    scripts = (
        f'<script type="text/plain" id="{name}{suffix}">{text}</script>'
        for name, text in text_by_name.items()
    )
    return "\n".join((figures, *scripts))


def make_page_html(
    data: PageData,
    *,
    command: str,
    sha256: str = "",
    choices: Mapping[str, str] = {},
    **fields: object,
) -> str:
    """Make the web page (HTML) of one flight, or of a quiz with several flights.

    Parameters
    ----------
    data : dict
        Data of one of the flights.
    command : str
        Command of px4fuse that makes the page.
    sha256 : str
        SHA-256 of the log.
    choices : mapping
        Answers of the quiz and their texts; empty without a quiz.
    fields
        Further fields of the template ``page.html``.
    """
    script_names = ("card", "step", "practice" if choices else "no_practice", "page")
    scripts_by_name = {
        # BokehJS without widgets, tables and formulas; js_raw[1] only sets the log level
        "bokeh": Resources(mode="inline", components=["bokeh"]).js_raw[0],
        "engine": read_asset("engine.js", ASSET_PACKAGE),
        "script": read_asset("dom.js")
        + "".join(read_asset(f"{name}.js", ASSET_PACKAGE) for name in script_names),
    }
    return load_template("explore/page.html").render(
        {f"{name}_hash": compute_csp_hash(text) for name, text in scripts_by_name.items()},
        **scripts_by_name,
        style="".join(map(read_asset, ("colours.css", "base.css")))
        + read_card_css()
        + read_asset("page.css", ASSET_PACKAGE),
        command=command,
        made_from=f"px4fuse {command} {sha256}".rstrip(),
        made_with=f"px4fuse {version('px4fuse')}",
        choices=choices,
        tabs=TITLE_BY_TAB,
        plots=select_plots(data),
        axis_names=[axis["name"] for axis in data["axes"]],
        **fields,
    )
