"""Provenance page: versions, files, parameters and methods needed to repeat the analysis."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from px4fuse.analysis import AidsOnlyAnalysis, Analysis
from px4fuse.ekf2_parameters import EV_POS, GNSS_POS
from px4fuse.flight import Flight, PositionTrack, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.report import clock, fonts
from px4fuse.report.page import Page
from px4fuse.report.phrases import describe_alignment, format_clock_map
from px4fuse.report.style import MUTED_COLOUR
from px4fuse.request import with_options
from px4fuse.results.contract import AidsResults, ComparisonResults, LoopResults

INDENT, SIZE = 140.0, 7.5


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the provenance of a comparison."""
    flight, source = analysis.flight, analysis.source
    placement = source.alignment
    page = _start_page("Appendix: provenance", results)
    _write_log(page, flight, source)
    clocks = map(format_clock_map, flight.clocks)
    _write_section(page, "Clocks, mapped to the autopilot's boot clock", plain=clocks)
    _write_section(
        page,
        f"Time offset of {source.name} (against the IMU)",
        plain=[clock.summary_line(analysis, results.findings)],
    )
    if placement is not None:
        _write_section(page, f"Alignment of {source.name}", describe_alignment(placement).items())
    _write_section(page, "Automatic choices", plain=analysis.notes or ["none"])
    _write_missing(page, analysis.missing)
    _write_methods(page, "methods.md")
    yield page


def draw_aids(alone: AidsOnlyAnalysis, results: AidsResults) -> Iterator[Page]:
    """Draw the provenance of a flight without a position source."""
    flight, page = alone.flight, _start_page("Provenance", results)
    _write_log(page, flight)
    _write_section(page, "Automatic choices", plain=flight.log.notes or ["none"])
    _write_missing(page, (alone.missing_data, *flight.missing))
    yield page


def _write_log(page: Page, flight: Flight, source: PositionTrack | None = None) -> None:
    """Write log, position source and parameters, without those of position aids not used."""
    log, facts = flight.log, dict[str, str]()
    others = (f"{t.name} ({t.rate_hz:.1f} Hz)" for t in flight.positions if t is not source)
    other_parameters = set[str]()
    if source is not None:
        aid = source.origin.aid or EV_POS
        other_parameters = other_parameters.union(
            *(one.own_parameters for one in (EV_POS, GNSS_POS) if one != aid)
        )
        facts["position source"] = (
            f"{source.name} ({source.origin.kind}, {source.origin.path}) from "
            f"{', '.join(source.topics)}; clock: {source.clock}"
        )
    parameters = (
        f"{n} {value:g}" for n, value in log.parameters.items() if n not in other_parameters
    )
    facts = {
        "file": f"{log.name}, {log.bytes} bytes, {log.format}",
        "SHA-256": log.sha256,
        **{f.role: f"{f.name}, {f.bytes} bytes, SHA-256 {f.sha256}" for f in flight.inputs},
        "firmware": f"{log.firmware}, git {log.firmware_hash}",
        "time zero": f"{log.boot_time_s:.6f} s after boot (first data sample)",
        **facts,
        "other positions": ", ".join(others) or "none",
        "parameters": ", ".join(parameters) or "none",
    }
    _write_section(page, "Log", facts.items())


def _write_missing(page: Page, unavailable_parts: Iterable[Unavailable]) -> None:
    missing = [
        (part.source or part.what, f"{part.reason}. {with_options(part.remedy)}")
        for part in unavailable_parts
    ]
    none = [] if missing else ["none"]
    _write_section(page, "Missing data", missing, none)


def draw_loop(loop: Loop, results: LoopResults) -> Iterator[Page]:
    """Draw the provenance of ``px4fuse loop``."""
    page = _start_page("Provenance", results)
    tracks = [("track", loop.odometry.trajectory), *(("reference", r) for r in loop.references)]
    file_facts = [
        (
            label,
            f"{track.name}, {track.size_bytes} bytes, SHA-256 {track.sha256}. "
            f"{' '.join(track.notes)}",
        )
        for label, track in tracks
    ]
    _write_section(page, "Files", file_facts)
    _write_section(page, "Automatic choices", plain=loop.notes or ["none"])
    _write_methods(page, "methods_loop.md")
    yield page


def _start_page(title: str, results: ComparisonResults | AidsResults | LoopResults) -> Page:
    """Begin the page with command, versions and attached results."""
    page, student, versions = Page(title), results.student, results.provenance
    facts = {
        "command": versions.command,
        "px4fuse": f"{versions.px4fuse} on Python {versions.python}",
        "libraries": ", ".join(f"{name} {version}" for name, version in versions.libraries.items()),
        "results": "attached to this PDF as results.json",
    }
    if fonts.missing_characters(student.name + student.id + student.notes):
        facts["fonts"] = (
            f"{fonts.NO_GLYPH} replaces characters for which no font is installed on this "
            "computer; results.json contains the original text"
        )
    _write_section(page, "Made with", facts.items())
    return page


def _write_section(
    page: Page, title: str, labelled: Iterable[tuple[str, str]] = (), plain: Iterable[str] = ()
) -> None:
    """Write a heading with labelled and plain texts in small print; nothing without texts."""
    labelled, plain = list(labelled), list(plain)
    if labelled or plain:
        page.heading(title, 9.5, above=9.0)
    for label, text in labelled:
        page.labelled(
            label, text, size=SIZE, width=INDENT, above=-1.0, colour=MUTED_COLOUR, bold=False
        )
    for text in plain:
        page.write(text, size=SIZE)


def _write_methods(page: Page, name: str) -> None:
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    _write_section(page, "Methods", plain=text.split("\n\n"))
