"""How the documentation is built: ``python -m sphinx -W docs docs/_build``, without a network.

What can be read out of the program is made at build: the findings' pages, the commands' help, the
picture of the rooms.
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
MADE = Path(__file__).parent / "made"
sys.path.insert(0, str(Path(__file__).parent))

import findings_pages  # noqa: E402

from px4fuse.cli import COMMANDS, cli  # noqa: E402

project = "px4fuse"
author = copyright = "The px4fuse authors"  # noqa: A001 - as Sphinx calls it
release = metadata.version("px4fuse")
extensions = [
    "myst_parser",  # Markdown
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",  # numpydoc's sections
]
exclude_patterns = ["_build"]
html_theme = "furo"
smartquotes = False  # two dashes begin an option
html_title = f"px4fuse {release}"
myst_heading_anchors = 3
autodoc_typehints = "none"  # the docstrings say them, with units
autodoc_member_order = "bysource"
napoleon_use_rtype = False


def rooms() -> Figure:
    """The package's rooms from its layers in ``pyproject.toml``, what is imported below."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    figure = Figure(figsize=(7.0, 0.34 * len(layers)))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, 1.0), ylim=(len(layers), 0.0))
    axes.axis("off")
    for row, layer in enumerate(layers):
        names = layer.split(" | ")
        for place, name in enumerate(names):
            left, width = 0.08 + 0.9 * place / len(names), 0.9 / len(names) - 0.01
            axes.add_patch(_box(left, row + 0.08, width, 0.84))
            axes.text(left + width / 2.0, row + 0.5, name, ha="center", va="center", size=9)
    axes.annotate("", (0.03, len(layers) - 0.3), (0.03, 0.3), arrowprops={"arrowstyle": "->"})
    axes.text(0.012, len(layers) / 2.0, "imports", rotation=90, ha="center", va="center", size=8)
    return figure


def _box(left: float, top: float, width: float, height: float) -> FancyBboxPatch:
    return FancyBboxPatch(
        (left, top), width, height, boxstyle="round,pad=0,rounding_size=0.02", fc="#eef3f8",
        ec="#5b7fa6", lw=0.8,
    )  # fmt: skip


def commands() -> str:
    """What each command says of itself with ``--help``."""
    parts = ["# Every option\n"]
    for name in COMMANDS:
        context = click.Context(cli, info_name="px4fuse")
        command = cli.get_command(context, name)
        assert command is not None
        with click.Context(command, parent=context, info_name=name, max_content_width=88) as here:
            parts.append(f"## {name}\n\n```text\n{command.get_help(here)}\n```\n")
    return "\n".join(parts)


MADE.mkdir(exist_ok=True)
rooms().savefig(MADE / "rooms.svg")
(MADE / "options.md").write_text(commands(), encoding="utf-8")
findings_pages.write(MADE / "findings")
