"""Report page on provenance: versions, files, parameters and methods of an analysis."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.flight.model import Flight, PositionTrack, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.request import replace_argument_names
from px4fuse.results.contract import LoopResults

from . import clock
from .cover import ALL_FINDINGS_TITLE, FlightResults
from .page import Page
from .phrases import describe_alignment, format_clock_map, write_findings

LABEL_WIDTH = 168.0  # points


def draw_pages(analysis: Analysis | AidingSourceAnalysis, results: FlightResults) -> Iterator[Page]:
    """Draw the pages on detected faults and on provenance."""
    page = Page(ALL_FINDINGS_TITLE)
    write_findings(page, results.findings)
    if not results.findings:
        page.write("None.")
    yield page
    flight = analysis.flight
    if isinstance(analysis, Analysis):
        page, source = Page("Appendix: provenance"), analysis.source
        clock_texts = map(format_clock_map, flight.clocks)
        _write_section(
            page, "Offset and drift of clocks relative to the autopilot's boot clock", clock_texts
        )
        if offset_text := clock.summarise_offset(analysis, results.findings):
            _write_section(page, f"Time offset between {source.name} and the IMU", [offset_text])
        if source.alignment is not None:
            alignment_texts = describe_alignment(source.alignment).items()
            _write_section(page, f"Alignment of {source.name}", alignment_texts)
        _write_section(page, "Automatic choices", analysis.notes or ["none"])
        _write_missing_data(page, analysis.missing)
        _write_methods(page, "methods.md")
    else:
        page, source = Page("Provenance"), None
        _write_section(page, "Automatic choices", flight.log.notes or ["none"])
        _write_missing_data(page, (analysis.missing_data, *flight.missing))
    _write_versions(page, results)
    section = Page()
    _write_section(section, "Log", _describe_log(flight, source))
    page.add_columns(section)  # keeps the section on one page
    yield page


def _describe_log(flight: Flight, source: PositionTrack | None) -> Iterator[tuple[str, str]]:
    """Yield pairs (label, text) on firmware, positions, parameters and input files of a log."""
    log = flight.log
    yield "firmware", f"{log.firmware}, git {log.firmware_hash}"
    yield "time zero", f"{log.boot_time_s:.6f} s after boot (first sample)"
    if source is not None:
        yield (
            "position source",
            f"{source.name} ({source.origin.kind}, {source.origin.route}) from "
            f"{', '.join(source.topics)}; clock: {source.clock}",
        )
    other_source_texts = (
        f"{track.name} ({track.compute_rate_hz():.1f} Hz)"
        for track in flight.positions
        if track is not source
    )
    yield "other positions", ", ".join(other_source_texts) or "none"
    parameters = (f"{name} {value:g}" for name, value in log.parameters.items())
    yield "parameters", ", ".join(parameters) or "none"
    for file in flight.inputs:
        yield file.role, f"{file.name}, {file.bytes} bytes, SHA-256 {file.sha256}"
    yield "file", f"{log.name}, {log.bytes} bytes, {log.format}, SHA-256 {log.sha256}"


def _write_missing_data(page: Page, unavailable_parts: Iterable[Unavailable]) -> None:
    """Write the reason and the remedy for each missing part of the data."""
    missing_data_texts = [
        (part.source or part.what, f"{part.reason}. {replace_argument_names(part.remedy)}")
        for part in unavailable_parts
    ]
    _write_section(page, "Missing data", missing_data_texts or ["none"])


def draw_loop_provenance(loop: Loop, results: LoopResults) -> Iterator[Page]:
    """Draw the provenance page of a loop analysis."""
    page, odometry = Page("Provenance"), loop.odometry.trajectory
    file_descriptions = [
        (
            "track" if track is odometry else "reference",
            f"{track.name}, {track.size_bytes} bytes, SHA-256 {track.sha256}. "
            f"{' '.join(track.notes)}",
        )
        for track in (odometry, *loop.references)
    ]
    _write_section(page, "Automatic choices", loop.notes or ["none"])
    _write_methods(page, "methods_loop.md")
    _write_versions(page, results)
    _write_section(page, "Files", file_descriptions)
    yield page


def _write_versions(page: Page, results: FlightResults | LoopResults) -> None:
    """Write the command, and the versions of px4fuse, Python and libraries."""
    provenance = results.provenance
    libraries = (f"{name} {version}" for name, version in provenance.libraries.items())
    text_by_label = {
        "command": provenance.command,
        "px4fuse": f"{provenance.px4fuse} on Python {provenance.python}",
        "libraries": ", ".join(libraries),
        "results": "attached to this PDF as results.json",
    }
    _write_section(page, "Made with", text_by_label.items())


def _write_section(page: Page, title: str, texts: Iterable[str | tuple[str, str]]) -> None:
    """Write texts, or labels with texts, below a title."""
    texts = list(texts)
    if texts:
        page.write_heading(title)
    for text in texts:
        if isinstance(text, str):
            page.write(text)
        else:
            page.write_labelled_text(*text, label_width=LABEL_WIDTH)


def _write_methods(page: Page, name: str) -> None:
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    _write_section(page, "Methods", text.split("\n\n"))
