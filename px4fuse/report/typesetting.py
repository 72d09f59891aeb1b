"""Typesetting of reports as PDF with Typst."""

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typst

from . import fonts
from .card_text import PLACE_TEXTS
from .style import FILTER_COLOURS

# PDF/A-3a for archives, PDF/UA-1 for screen readers
PDF_STANDARDS: list[Any] = ["a-3a", "ua-1"]
TEMPLATES = ("cover.typ", "report.typ")


def read_template() -> str:
    folder = Path(__file__).parent
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in TEMPLATES)


def compile_pdf(report: Mapping[str, Any]) -> bytes:
    """Typeset data as PDF with Typst, without access to files and packages."""
    font_names = fonts.find_font_names(json.dumps(report, ensure_ascii=False))
    data = {
        **report,
        "fonts": font_names,
        "filter_colours": FILTER_COLOURS,
        "place_texts": PLACE_TEXTS,
    }
    with TemporaryDirectory() as empty_folder:
        compiler = typst.Compiler(
            input=read_template().encode(),
            root=empty_folder,
            font_paths=typst.Fonts(
                include_system_fonts=False,
                include_embedded_fonts=False,
                font_paths=fonts.find_font_folders(font_names),
            ),
            package_path=empty_folder,
            package_cache_path=empty_folder,
            sys_inputs={"data": json.dumps(data)},
        )
        document = compiler.compile(format="pdf", pdf_standards=PDF_STANDARDS)
    assert isinstance(document, bytes)
    return document
