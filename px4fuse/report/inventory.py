"""Terminal output of ``px4fuse info``: contents of a log and possible analyses."""

from collections.abc import Iterator

from px4fuse.core.text import format_count, join_first_names
from px4fuse.flight.model import Unavailable
from px4fuse.info.inventory import Inventory, LoggedData
from px4fuse.readers.px4_topics import RECONSTRUCTED_TRACK_NAME
from px4fuse.request import ComparisonRequest, command_line

from .page import Cell, Page
from .phrases import format_clock_map
from .style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS


def make_log_page(inventory: Inventory, request: ComparisonRequest) -> Page:
    """List the contents of a log and the possible analyses."""
    page = Page()
    page.write(inventory.flight.log.name, bold=True)
    page.write_labelled_texts(dict(_describe_log(inventory)))
    for option in inventory.abilities:
        label = "This log permits" if option.possible else "Not possible"
        colour = GOOD_COLOUR if option.possible else SEVERITY_COLOURS["warning"]
        page.write(f"{label}: {option.name} ({option.reason})", colour=colour)
    if inventory.abilities[0].possible:  # comparison of KF and EKF2
        command = command_line(request, "compare", for_shell=True)
        page.add("command", text=command, label="Run")
    for advice in inventory.advice:
        page.write_labelled_text("Action", f"{'; '.join(advice.improves)}: {advice.remedy}")
    for sender in inventory.flight.log.senders:
        lost_text = "unknown" if sender.lost_fraction is None else f"{sender.lost_fraction:.1%}"
        page.write_labelled_text(
            "Sender",
            f"{sender.system}/{sender.component}, {sender.description}"
            f"{' (this flight)' * sender.chosen}: {sender.messages} messages, lost: {lost_text}",
        )
    head = ("data", "topic", "samples", "rate", "gaps", "time in the log")
    page.add_table(head, [*_make_source_rows(inventory)], right_aligned_columns=(2, 3, 5))
    texts_by_label = {
        "Clocks": [*map(format_clock_map, inventory.flight.clocks)],
        "Not used": [
            f"{topic.name}, {topic.count} messages: {topic.reason}"
            for topic in inventory.flight.unused
        ],
        "Notes": inventory.notes,
    }
    for label, texts in texts_by_label.items():
        if texts:
            page.write_labelled_text(label, *texts)
    return page


def _describe_log(inventory: Inventory) -> Iterator[tuple[str, str]]:
    """Yield pairs (label, text) on log, vehicle, time span, airborne times and input files."""
    log, airborne_spans = inventory.flight.log, inventory.flight.airborne
    size_text = f"{log.bytes / 1e6:.1f} MB" if log.bytes >= 1e5 else f"{log.bytes} bytes"
    yield "Log", f"{log.format}, {size_text}, SHA-256 {log.sha256[:12]}"
    firmware_text = (
        log.firmware if log.firmware != "unknown" else f"{log.autopilot}, version unknown"
    )
    git_text = "" if log.firmware_hash == "unknown" else f" (git {log.firmware_hash[:8]})"
    hardware_text = "hardware unknown" if log.hardware == "unknown" else log.hardware
    yield "Vehicle", f"{firmware_text}{git_text}, {hardware_text}"
    start_text = f"{log.boot_time_s:.1f} s after boot (the log contains no UTC)"
    if inventory.start_utc is not None:
        start_text = f"at {inventory.start_utc[:19].replace('T', ' ')} UTC"
    duration_text = f"{log.duration_s:.{1 if log.duration_s >= 1.0 else 3}f} s"
    if not log.duration_s:
        duration_text = "all samples have the same timestamp"
    yield "Data", f"{duration_text}, the data start {start_text}"
    if isinstance(airborne_spans, Unavailable):
        airborne_text = "unknown (the log contains no land detector)"
    else:
        span_texts = [f"{start:.1f} s to {end:.1f} s" for start, end in airborne_spans]
        airborne_text = (
            join_first_names(span_texts, 3) or "the land detector never reported a flight"
        )
    yield "Airborne", airborne_text
    if log.dropouts:
        durations_s = [dropout.duration_s for dropout in log.dropouts]
        yield (
            "Dropouts",
            f"{len(durations_s)} logger dropouts of {sum(durations_s):.2f} s in total, at most "
            f"{max(durations_s):.2f} s",
        )
    for file in inventory.flight.inputs:
        yield file.role.capitalize(), f"{file.name}, SHA-256 {file.sha256[:12]}"


def _make_source_rows(inventory: Inventory) -> Iterator[tuple[Cell, ...]]:
    for source in inventory.sources:
        note = " (computed)" * (source.name == RECONSTRUCTED_TRACK_NAME)
        yield (
            f"{source.part} (used)" if source.chosen else source.part,
            ("none", MUTED_COLOUR) if source.unavailable else f"{source.name}{note}",
            "" if source.samples is None else f"{source.samples}",
            "" if source.rate_hz is None else f"{_format_for_narrow_column(source.rate_hz)} Hz",
            _format_gaps(source),
            _format_time_span(source),
        )


def _format_gaps(source: LoggedData) -> str:
    if source.gaps is None:
        return ""
    if not source.gaps.count:
        return "no gap"
    longest_gap_text = _format_for_narrow_column(source.gaps.longest_s)
    return f"{format_count(source.gaps.count, 'gap')} (up to {longest_gap_text} s)"


def _format_for_narrow_column(value: float) -> str:
    return f"{value:.{2 if value < 1 else 1 if value < 10 else 0}f}"


def _format_time_span(source: LoggedData) -> str:
    if source.start_s is None or source.end_s is None:
        return ""
    digits = 1 if source.end_s < 10 else 0
    return f"{source.start_s:z.{digits}f} to {source.end_s:z.{digits}f} s"
