"""Sphinx configuration: ``python -m sphinx -W docs docs/_build`` builds without a network.

The build also writes pages from the source code: one page per finding, the help of all commands,
and a figure of the package layers.
"""

from __future__ import annotations

import sys
import tomllib
from importlib import metadata
from pathlib import Path

import click
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[1]
GENERATED_FOLDER = Path(__file__).parent / "made"
sys.path.insert(0, str(Path(__file__).parent))

import findings_pages  # noqa: E402

from px4fuse.cli import COMMANDS, cli  # noqa: E402

project = "px4fuse"
author = copyright = "The px4fuse authors"  # noqa: A001 - name required by Sphinx
release = metadata.version("px4fuse")
extensions = [
    "myst_parser",  # Markdown
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",  # numpydoc sections of docstrings
]
exclude_patterns = ["_build"]
html_theme = "furo"
smartquotes = False  # keeps the two dashes of options
html_title = f"px4fuse {release}"
myst_heading_anchors = 3
autodoc_typehints = "none"  # docstrings contain the types, with units
autodoc_member_order = "bysource"
napoleon_use_rtype = False


def draw_layers() -> Figure:
    """Draw the package layers of the import-linter contract in ``pyproject.toml``."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    figure = Figure(figsize=(7.0, 0.34 * len(layers)))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(len(layers), 0.0))
    axes.axis("off")
    for row, layer in enumerate(layers):
        names = layer.split(" | ")
        for column, name in enumerate(names):
            left, width = 0.08 + 0.9 * column / len(names), 0.9 / len(names) - 0.01
            axes.add_patch(_make_rounded_box(left, row + 0.08, width, 0.84))
            axes.text(left + width / 2.0, row + 0.5, name, ha="center", va="center", size=9)
    axes.annotate("", (0.03, len(layers) - 0.3), (0.03, 0.3), arrowprops={"arrowstyle": "->"})
    axes.text(0.012, len(layers) / 2.0, "imports", rotation=90, ha="center", va="center", size=8)
    return figure


def _make_rounded_box(left: float, top: float, width: float, height: float) -> FancyBboxPatch:
    return FancyBboxPatch(
        (left, top), width, height, boxstyle="round,pad=0,rounding_size=0.02", fc="#eef3f8",
        ec="#5b7fa6", lw=0.8,
    )  # fmt: skip


def format_options() -> str:
    """Format the ``--help`` text of each command as one Markdown page."""
    sections = ["# All options\n"]
    for name in COMMANDS:
        parent = click.Context(cli, info_name="px4fuse")
        command = cli.get_command(parent, name)
        assert command is not None
        with click.Context(command, parent=parent, info_name=name, max_content_width=88) as context:
            help_text = command.get_help(context)
        sections.append(f"## {name}\n\n```text\n{help_text}\n```\n")
    return "\n".join(sections)


GENERATED_FOLDER.mkdir(exist_ok=True)
draw_layers().savefig(GENERATED_FOLDER / "layers.svg")
(GENERATED_FOLDER / "options.md").write_text(format_options(), encoding="utf-8")
findings_pages.write_finding_pages(GENERATED_FOLDER / "findings")
