"""Reports and results as text that can be compared line by line with golden files."""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from msgspec import Struct, structs

from px4fuse.report.page import PageBlock

GOLDEN = Path(__file__).with_name("golden")
# Fields of the results that depend on computer, file or command
NOT_KEPT = ("schema", "request", "provenance", "log", "command", "report_sha256")
MANY = 12  # longer lists are summarised by their statistics


NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")
# Iteration counts and hashes, which depend on the rounding of the processor
LAST_DIGITS = re.compile(r"\b[0-9a-f]{64}\b|\b[0-9a-f]{12,32}…|(?<=iterations )\d+")


def assert_matches_golden(name: str, lines: list[str], paragraph: int | None = None) -> None:
    """Compare lines with a golden file; decimal numbers may differ by one in the last digit."""
    path, kept, found = GOLDEN / f"{name}.txt", [""], "\n".join(lines)
    if paragraph is not None:
        kept = path.read_text(encoding="utf-8").rstrip().split("\n\n")
    if os.environ.get("PX4FUSE_GOLDEN") == "write":
        at = paragraph or 0
        kept[at : at + 1] = [found]
        path.write_text("\n\n".join(kept) + "\n", encoding="utf-8")
    text = path.read_text(encoding="utf-8") if paragraph is None else [*kept, ""][paragraph]
    kept, found = text.splitlines(), f"{found}\n".splitlines()
    if len(kept) == len(found):
        pairs = zip(kept, found, strict=True)
        found = [one if is_alike(one, other) else other for one, other in pairs]
    different = difflib.unified_diff(kept, found, lineterm="", n=1)
    assert found == kept, "\n".join(list(different)[:40])


def is_alike(one: str, other: str) -> bool:
    """Return True if two lines agree within the rounding differences between processors.

    Tick lines always agree: the last digit of a width can change the number of ticks.
    """
    if one == other or (one.lstrip().startswith("x [") and other.lstrip().startswith("x [")):
        return True
    one, other = (LAST_DIGITS.sub("#", line) for line in (one, other))
    if NUMBER.sub("#", one) != NUMBER.sub("#", other):
        return False
    return all(
        abs(float(a) - float(b)) <= 1.01 * max(10.0 ** Decimal(each).as_tuple().exponent
                                               for each in (a, b))
        for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True)
    )  # fmt: skip


def rounded(text: str) -> str:
    """Round the decimal numbers of a text to four digits."""
    return re.sub(r"-?\d+\.\d+(?:e[-+]?\d+)?", lambda found: value(float(found[0])), text)


def written(path: Path) -> Iterator[str]:
    """Yield the values of a results file."""
    results = json.loads(path.read_text(encoding="utf-8"))
    yield from of_values({name: results[name] for name in results if name not in NOT_KEPT})


def value(part: Any, digits: int = 4) -> str:
    """Format a value with few digits, so that rounding differences do not appear."""
    if isinstance(part, bool) or part is None or isinstance(part, str):
        return str(part)
    if isinstance(part, float | int | np.floating | np.integer):
        return f"{0.0 if abs(part) < 1e-9 else part:.{digits}g}"
    if isinstance(part, Struct):
        part = structs.asdict(part)
    if isinstance(part, Mapping):
        return "{" + ", ".join(f"{name}: {value(each)}" for name, each in part.items()) + "}"
    if isinstance(part, Sequence | np.ndarray):
        if len(part) > MANY and all(isinstance(each, float | int) for each in part):
            return numbers(part)
        return "[" + ", ".join(value(each) for each in part) + "]"
    return type(part).__name__


def numbers(some: Any) -> str:
    """Summarise numbers: count, first, last, mean and standard deviation."""
    known = np.ma.filled(np.ma.asarray(some, dtype=float), np.nan).ravel()
    known = known[np.isfinite(known)]
    if not len(known):
        return "0"
    return f"{len(known)} {value([known[0], known[-1], known.mean(), known.std()])}"


def colour(given: Any) -> str:
    """Format colours as hexadecimal red, green, blue and opacity."""
    try:
        return str(to_hex(given, keep_alpha=True))
    except (TypeError, ValueError):
        return f"{len(given)} colours {numbers(given)}"


def of_artist(artist: Any) -> Iterator[str]:
    """Describe an artist in one line."""
    label = str(artist.get_label())
    name = f"{type(artist).__name__} {'' if label.startswith('_') else label!r}"
    looks = f"z {value(artist.get_zorder())} alpha {value(artist.get_alpha())}"
    match artist:
        case Line2D():
            edge = value(artist.get_markeredgewidth())
            marks = f"{artist.get_marker()} {value(artist.get_markersize())} {edge}"
            dashes = value(artist._unscaled_dash_pattern)
            width = f"{artist.get_linestyle()} {dashes} {value(artist.get_linewidth())}"
            x, y = (numbers(part) for part in artist.get_data())
            yield f"{name} {colour(artist.get_color())} {width} {marks} {looks}: {x}; {y}"
        case Text():
            if artist.get_text():
                place = value(artist.get_position())
                side = f"{artist.get_ha()} {artist.get_va()}"
                letters = f"{value(artist.get_size())} {colour(artist.get_color())}"
                letters += f" {artist.get_weight()} {value(artist.get_rotation())}"
                yield f"Text {artist.get_text()!r} at {place} {side} {letters}"
        case Collection():
            paths = [path.vertices for path in artist.get_paths()]
            shape = numbers(np.concatenate(paths)) if paths else "0"
            faces = colour(artist.get_facecolor())
            yield (
                f"{name} {faces} {numbers(artist.get_linewidth())} {looks}: "
                f"{numbers(artist.get_offsets())}; {shape}; {numbers(artist.get_array())}"
            )
        case Patch():
            corners = artist.get_path().transformed(artist.get_patch_transform()).vertices
            edge = f"{colour(artist.get_edgecolor())} {value(artist.get_linewidth())}"
            faces = f"{colour(artist.get_facecolor())} {edge} {artist.get_hatch() or ''}".rstrip()
            yield f"{name} {faces} {looks}: {numbers(corners)}"
        case Legend():
            names = [text.get_text() for text in artist.get_texts()]
            anchor = value(artist.get_bbox_to_anchor()._bbox.bounds)
            yield f"Legend {names} {anchor} {artist._loc} {value(artist.handlelength)}"


def ticks(axis: Axis) -> str:
    """Describe the visible ticks: positions, labels and number of minor ticks."""
    low, high = sorted(axis.get_view_interval())
    places = [float(place) for place in axis.get_majorticklocs() if low <= place <= high]
    labels = axis.get_major_formatter().format_ticks(places)
    small = sum(low <= place <= high for place in axis.get_minorticklocs())
    size = axis.get_tick_params().get("labelsize")
    return f"{value(places)} {[label for label in labels if label]} {small} {value(size)}"


def of_axes(axes: Axes) -> Iterator[str]:
    """Describe axes: position, limits, labels, ticks and artists."""
    spans = value([*axes.get_xlim(), *axes.get_ylim()])
    scales = f"{axes.get_xscale()} {axes.get_yscale()} {'' if axes.axison else 'bare'}"
    yield f"axes {value(axes.get_position().bounds)} spans {spans} {scales}".rstrip()
    labels = axes.get_title(), axes.get_xlabel(), axes.get_ylabel()
    yield f"  labels {labels} ticks {axes.xaxis.get_tick_params()['labelbottom']}"
    yield f"  x {ticks(axes.xaxis)} y {ticks(axes.yaxis)}"
    legend = axes.get_legend()
    drawn = [*axes.lines, *axes.collections, *axes.patches, *axes.texts]
    for artist in [*drawn, *([legend] if legend else [])]:
        yield from (f"  {line}" for line in of_artist(artist))


def of_figure(figure: Figure) -> Iterator[str]:
    """Describe a figure with its axes."""
    yield f"figure {value(figure.get_size_inches())}"
    for artist in [*figure.texts, *figure.lines, *figure.legends]:
        yield from of_artist(artist)
    for axes in figure.axes:
        yield from of_axes(axes)


def of_blocks(blocks: Sequence[PageBlock]) -> Iterator[str]:
    """Describe the blocks of pages, one line per block, table row and artist."""
    for block in blocks:
        inner = ("figure", "axes", "columns", "blocks", "rows")
        plain = {name: part for name, part in block.items() if name not in inner}
        yield value(plain)
        for row in block.get("rows", ()):
            yield f"  {value(row)}"
        if "figure" in block:
            yield from (f"  {line}" for line in of_figure(block["figure"]))
        for below in (*block.get("columns", ()), block.get("blocks", ())):
            yield from (f"  {line}" for line in of_blocks(below))


def of_values(part: Any, path: str = "") -> Iterator[str]:
    """Yield each value of nested data with its path."""
    if isinstance(part, Struct):
        part = structs.asdict(part)
    if isinstance(part, Mapping):
        for name, below in part.items():
            yield from of_values(below, f"{path}.{name}" if path else str(name))
    elif isinstance(part, list) and any(isinstance(each, dict | list) for each in part):
        for place, below in enumerate(part):
            yield from of_values(below, f"{path}.{place}")
    else:
        yield f"{path} {value(part)}"
