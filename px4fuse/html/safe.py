"""Escaping of untrusted data, so that they cannot run scripts in a web page."""

import base64
import hashlib
import json
from functools import cache
from importlib.resources import files
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from px4fuse.core.text import clean_text, convert_nested

MAX_TEXT_LENGTH = 20_000


def clean_texts(value: Any, max_length: int = MAX_TEXT_LENGTH) -> Any:
    r"""Clean and shorten all texts in nested dicts and lists.

    >>> clean_texts(["a\x1bb", "abcdef", 1.0], 3)
    ['ab', 'abc…', 1.0]
    """

    def clean_element(element: Any) -> Any:
        if isinstance(element, str):
            return clean_text(element[:max_length]) + "…" * (len(element) > max_length)
        return element.item() if hasattr(element, "item") else element

    return convert_nested(value, clean_element)


def encode_safe_json(value: object) -> str:
    """Encode as JSON without <, > and &, so that it cannot contain HTML tags."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")


def compute_csp_hash(text: str) -> str:
    """Return the SHA-256 of a script or style for the Content-Security-Policy of a page."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def make_relative_url(path: str) -> str:
    r"""Convert a relative path to a URL; return "" for an absolute path.

    >>> make_relative_url("results/a b.json"), make_relative_url("javascript:alert(1)")
    ('results/a%20b.json', 'javascript%3Aalert%281%29')
    >>> make_relative_url("//example.org/x"), make_relative_url("C:\\x")
    ('', 'C%3A%5Cx')
    """
    if PurePosixPath(path).is_absolute():
        return ""
    return quote(path.encode("utf-8", "replace"))


@cache
def load_template(name: str) -> Template:
    """Load a Jinja template that cleans, shortens and escapes all inserted text."""
    environment = Environment(
        loader=PackageLoader("px4fuse", ""),
        autoescape=True,
        trim_blocks=True,
        finalize=lambda value: clean_texts(value) if type(value) is str else value,
        undefined=StrictUndefined,
    )
    return environment.get_template(name)


def read_asset(name: str, package: str = "px4fuse.html") -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")
