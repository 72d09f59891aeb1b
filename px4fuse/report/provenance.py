"""Provenance page: versions, files, parameters and methods needed to repeat the analysis."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from px4fuse.analysis import AidsOnlyAnalysis, Analysis
from px4fuse.flight.model import Flight, PositionTrack, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.report import clock, fonts
from px4fuse.report.cover import ALL_FINDINGS
from px4fuse.report.page import Page
from px4fuse.report.phrases import describe_alignment, format_clock_map, write_findings
from px4fuse.report.style import MUTED_COLOUR
from px4fuse.request import with_options
from px4fuse.results.contract import AidsResults, ComparisonResults, LoopResults

LABEL_WIDTH = 168.0  # width (points) of the labels


def draw(analysis: Analysis, results: ComparisonResults) -> Iterator[Page]:
    """Draw the provenance of a comparison."""
    flight, source = analysis.flight, analysis.source
    alignment = source.alignment
    yield _findings_page(results)
    page = Page("Appendix: provenance")
    clocks = map(format_clock_map, flight.clocks)
    _write_section(page, "Clocks, mapped to the autopilot's boot clock", plain_texts=clocks)
    _write_section(
        page,
        f"Time offset between {source.name} and the IMU",
        plain_texts=[clock.summarise_offset(analysis, results.findings)],
    )
    if alignment is not None:
        _write_section(page, f"Alignment of {source.name}", describe_alignment(alignment).items())
    _write_section(page, "Automatic choices", plain_texts=analysis.notes or ["none"])
    _write_missing(page, analysis.missing)
    _write_methods(page, "methods.md")
    _write_versions(page, results)
    _write_log(page, flight, source)
    yield page


def draw_aids(analysis: AidsOnlyAnalysis, results: AidsResults) -> Iterator[Page]:
    """Draw the provenance of a flight without a position source."""
    yield _findings_page(results)
    flight, page = analysis.flight, Page("Provenance")
    _write_section(page, "Automatic choices", plain_texts=flight.log.notes or ["none"])
    _write_missing(page, (analysis.missing_data, *flight.missing))
    _write_versions(page, results)
    _write_log(page, flight)
    yield page


def _findings_page(results: ComparisonResults | AidsResults) -> Page:
    page = Page(ALL_FINDINGS)
    write_findings(page, results.findings)
    return page


def _write_log(page: Page, flight: Flight, source: PositionTrack | None = None) -> None:
    log, facts_by_label = flight.log, dict[str, str]()
    other_positions = (
        f"{track.name} ({track.rate_hz:.1f} Hz)"
        for track in flight.positions
        if track is not source
    )
    if source is not None:
        facts_by_label["position source"] = (
            f"{source.name} ({source.origin.kind}, {source.origin.path}) from "
            f"{', '.join(source.topics)}; clock: {source.clock}"
        )
    parameters = (f"{name} {value:g}" for name, value in log.parameters.items())
    facts_by_label = {
        "firmware": f"{log.firmware}, git {log.firmware_hash}",
        "time zero": f"{log.boot_time_s:.6f} s after boot (first data sample)",
        **facts_by_label,
        "other positions": ", ".join(other_positions) or "none",
        "parameters": ", ".join(parameters) or "none",
        **{
            file.role: f"{file.name}, {file.bytes} bytes, SHA-256 {file.sha256}"
            for file in flight.inputs
        },
        "file": f"{log.name}, {log.bytes} bytes, {log.format}",
        "SHA-256": log.sha256,
    }
    section = Page()
    _write_section(section, "Log", facts_by_label.items())
    page.add_columns(section)  # Typst does not split a column between pages


def _write_missing(page: Page, unavailable_parts: Iterable[Unavailable]) -> None:
    missing = [
        (
            missing_data.source or missing_data.what,
            f"{missing_data.reason}. {with_options(missing_data.remedy)}",
        )
        for missing_data in unavailable_parts
    ]
    _write_section(page, "Missing data", missing, [] if missing else ["none"])


def draw_loop(loop: Loop, results: LoopResults) -> Iterator[Page]:
    """Draw the provenance of ``px4fuse loop``."""
    page = Page("Provenance")
    tracks = [
        ("track", loop.odometry.trajectory),
        *(("reference", reference) for reference in loop.references),
    ]
    file_facts = [
        (
            label,
            f"{track.name}, {track.size_bytes} bytes, SHA-256 {track.sha256}. "
            f"{' '.join(track.notes)}",
        )
        for label, track in tracks
    ]
    _write_section(page, "Automatic choices", plain_texts=loop.notes or ["none"])
    _write_methods(page, "methods_loop.md")
    _write_versions(page, results)
    _write_section(page, "Files", file_facts)
    yield page


def _write_versions(page: Page, results: ComparisonResults | AidsResults | LoopResults) -> None:
    student, versions = results.student, results.provenance
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


def _write_section(
    page: Page,
    title: str,
    labelled_texts: Iterable[tuple[str, str]] = (),
    plain_texts: Iterable[str] = (),
) -> None:
    labelled_texts, plain_texts = list(labelled_texts), list(plain_texts)
    if labelled_texts or plain_texts:
        page.heading(title)
    for label, text in labelled_texts:
        page.write_labelled(
            label,
            text,
            width=LABEL_WIDTH,
            above=-1.0,
            colour=MUTED_COLOUR,
            bold=False,
        )
    for text in plain_texts:
        page.write(text)


def _write_methods(page: Page, name: str) -> None:
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    _write_section(page, "Methods", plain_texts=text.split("\n\n"))
