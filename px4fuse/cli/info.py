"""``px4fuse info``: what is in a log, and what can be done with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.inputs import InputPath, comparison_request, json_option, recording_options
from px4fuse.cli.outputs import check_targets, finish, progress, result_files
from px4fuse.plain import few_words
from px4fuse.record import Unavailable

if TYPE_CHECKING:
    from px4fuse.inspect.inventory import Inventory, Source
    from px4fuse.report.page import Cell, Page
    from px4fuse.request import ComparisonRequest

SOURCES_HEAD = ("", "source", "samples", "Hz", "gaps", "span (s)")


def _versions(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if not wanted:
        return
    import platform

    from px4fuse.results.model import provenance

    made = provenance("")
    libraries = ", ".join(f"{name} {version}" for name, version in made.libraries.items())
    click.echo(f"px4fuse {made.px4fuse}, Python {made.python}, {platform.platform()}")
    click.echo(libraries)
    context.exit()


@click.command()
@click.argument("log", type=InputPath())
@click.option(
    "--versions",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_versions,
    help="Print versions, system and libraries, for a bug report, and exit.",
)
@json_option
@recording_options
def info(log: Path, json_path: Path | None, **given: Any) -> None:
    """Say what is in a log, what px4fuse can do with it, and what to log next time."""
    from px4fuse.analysis import read_flight
    from px4fuse.inspect.inventory import take_inventory, to_plain

    request = comparison_request(log, given)
    check_targets([json_path])
    with progress(json_path) as step:
        flight = read_flight(request, step)
        step("looking at what is in it")
        inventory = take_inventory(flight)
    contents = result_files(to_plain(inventory), json_path)
    finish(contents, _page(inventory, request))


def _page(inventory: Inventory, request: ComparisonRequest) -> Page:
    from px4fuse.report.page import Page
    from px4fuse.report.style import GOOD, SEVERITY_COLOURS
    from px4fuse.request import command_line

    page = Page()
    page.write(inventory.flight.log.name, bold=True)
    for label, text in _facts(inventory):
        page.labelled(label, text)
    if inventory.flight.log.senders:
        page.table(("sender", "what it is", "messages", "lost"), _senders(inventory), right=(2, 3))
    page.table(SOURCES_HEAD, list(_sources(inventory)), right=(2, 3, 4, 5))
    looks = {True: ("yes", GOOD), False: ("no", SEVERITY_COLOURS["warning"])}
    rows = [(looks[can.possible], can.name, can.reason) for can in inventory.abilities]
    page.table(("", "", "What px4fuse can do with it"), rows)
    if next(ability.possible for ability in inventory.abilities if ability.name == "compare"):
        command = command_line(request, "compare", typed=True)
        page.add("command", text=command, label="Compare")
    lists = {
        "Next": [f"{one.remedy} ({'; '.join(one.improves)})" for one in inventory.advice],
        "Clocks": _clocks(inventory),
        "Not used": [
            f"{one.name}, {one.count} messages: {one.reason}" for one in inventory.flight.unused
        ],
        "Notes": inventory.notes,
    }
    for label, texts in lists.items():
        if texts:
            page.labelled(label, *texts)
    return page


def _facts(inventory: Inventory) -> list[tuple[str, str]]:
    log = inventory.flight.log
    size = f"{log.bytes / 1e6:.1f} MB" if log.bytes >= 1e5 else f"{log.bytes} bytes"
    version = log.firmware if log.firmware != "unknown" else f"{log.autopilot}, version unknown"
    git = "" if log.firmware_hash == "unknown" else f" (git {log.firmware_hash[:8]})"
    hardware = "hardware unknown" if log.hardware == "unknown" else log.hardware
    facts = [
        ("Log", f"{log.format}, {size}, SHA-256 {log.sha256[:12]}"),
        ("Vehicle", f"{version}{git}, {hardware}"),
        ("Data", f"{_duration(log.duration_s)}, {_start(inventory)}"),
        ("Flying", _flying(inventory)),
    ]
    if log.dropouts:
        lost_s = sum(dropout.duration_s for dropout in log.dropouts)
        longest_s = max(dropout.duration_s for dropout in log.dropouts)
        count = len(log.dropouts)
        words = f"{count} of the logger, {lost_s:.2f} s in all, the longest {longest_s:.2f} s"
        facts.append(("Dropouts", words))
    facts += [
        (file.role.capitalize(), f"{file.name}, SHA-256 {file.sha256[:12]}")
        for file in inventory.flight.inputs
    ]
    return facts


def _duration(seconds: float) -> str:
    return f"{seconds:.{1 if seconds >= 1 else 3}f} s" if seconds else "a single moment"


def _start(inventory: Inventory) -> str:
    if inventory.start_utc is None:
        return f"from {inventory.flight.log.boot_time_s:.1f} s after boot (no UTC in the log)"
    return f"from {inventory.start_utc[:19].replace('T', ' ')} UTC"


def _flying(inventory: Inventory) -> str:
    airborne = inventory.flight.airborne
    if isinstance(airborne, Unavailable):
        return "unknown, no land detector"
    if not airborne:
        return "never, by the land detector"
    spans = [f"{start:.1f} s to {end:.1f} s" for start, end in airborne]
    return few_words(spans, 3)


def _senders(inventory: Inventory) -> list[tuple[str, ...]]:
    return [
        (
            f"{sender.system}/{sender.component}",
            sender.description + (" (this flight)" if sender.chosen else ""),
            f"{sender.messages}",
            "unknown" if sender.lost_share is None else f"{sender.lost_share:.1%}",
        )
        for sender in inventory.flight.log.senders
    ]


def _sources(inventory: Inventory) -> Iterator[tuple[Cell, ...]]:
    from px4fuse.report.style import MUTED

    previous = ""
    for source in inventory.sources:
        part = source.part if source.part != previous else ""
        previous = source.part
        if source.unavailable:
            yield part, ("none", MUTED), "", "", "", ""  # why not stands below
            continue
        yield (
            f"{part:9}->" if source.chosen else part,
            source.name,
            "" if source.samples is None else f"{source.samples}",
            "" if source.rate_hz is None else _short(source.rate_hz),
            _gaps(source),
            _span(source),
        )


def _gaps(source: Source) -> str:
    if source.gaps is None:
        return ""
    if not source.gaps.count:
        return "0"
    return f"{source.gaps.count} ({_short(source.gaps.longest_s)} s)"


def _short(value: float) -> str:
    """Two digits or more, four characters as a rule."""
    return f"{value:.{2 if value < 1 else 1 if value < 10 else 0}f}"


def _span(source: Source) -> str:
    if source.start_s is None or source.end_s is None:
        return ""
    digits = 1 if source.end_s < 10 else 0
    # adding zero makes of -0 a 0
    start, end = (round(time, digits) + 0.0 for time in (source.start_s, source.end_s))
    return f"{start:.{digits}f}..{end:.{digits}f}"


def _clocks(inventory: Inventory) -> list[str]:
    from px4fuse.report.words import clock_words

    on: dict[str, dict[str, None]] = {}
    for source in inventory.sources:
        if source.clock:
            name = source.name if source.part == "position" else source.part
            on.setdefault(source.clock, {})[name] = None
    lines = [f"{clock}: {', '.join(parts)}" for clock, parts in on.items()]
    return lines + [clock_words(clock) for clock in inventory.flight.clocks]
