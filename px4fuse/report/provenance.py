"""Provenance: where every number comes from, so that somebody else can make it again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from px4fuse.report import clock, fonts
from px4fuse.report.document import Document, LoopDocument
from px4fuse.report.page import Page
from px4fuse.report.style import MUTED
from px4fuse.report.words import alignment_words, clock_words
from px4fuse.results.parts import provenance

INDENT, SIZE = 140.0, 7.5
METHOD = (
    "State x = [position, velocity] per axis, F = [[1, dt], [0, 1]], B = [dt²/2, dt], H = [1, 0], "
    "R = SIGMA_Z², Q(dt) = SIGMA_A² · DT · [[dt³/4, dt²/2], [dt²/2, dt]]; predict on the DT grid "
    "and to each measurement's own time, update with filterpy. Input: specific force turned into "
    "NED by the slerped attitude, gravity removed, averaged over each step. Initial state: the "
    "first measurement at rest, σ_p 0.5 m, σ_v 1 m/s.",
    "NIS = ν²/S with a two-sided 95 % chi-square band (Bar-Shalom, Li and Kirubarajan 2001, "
    "section 5.4), assuming white innovations. EKF2's innovations have their sign turned, resets "
    "are treated as stated, and times are of measurement. EKF2 logs no covariance between north "
    "and east, so along the aisle none is added. Along one axis EKF2's σ just before an update is "
    "√(S - R), just after it √((S - R) R / S).",
    "EKF2 replayed: a model of EKF2 (15 error states, gate, time-outs, resets, output predictor), "
    "not PX4's code, started from estimator_states and fed with the log's IMU and vision; height "
    "and heading are EKF2's own. Why EKF2 differs: mean squares at EKF2's own sample times, from "
    "5 s after each start of the replay.",
)

LOOP_METHOD = (
    "Path length on key frames. Misclosure: last pose by odometry minus where the vehicle really "
    "ended. By distance: headings are turned back by the share of the heading misclosure that "
    "their distance gives (slerp), the steps with them, and what is left of the position's "
    "misclosure is spread in proportion to cumulative distance (compass rule, UAT 366 module 2, "
    "Example 2).",
    "Pose graph: nodes are key frames, r = Log(Z⁻¹ X_i⁻¹ X_j) on SE(3), cost ½ Σ rᵀ Ω r, "
    "Levenberg-Marquardt with analytic Jacobians (Grisetti et al. 2010). Odometry edges: variance "
    "in proportion to distance and time. Gate: d² = rᵀ (Σ_odometry + Σ_closure)⁻¹ r against "
    "chi-square, Σ_odometry from odometry alone. Robust: DCS (Agarwal et al. 2013), GNC with "
    "truncated least squares (Yang et al. 2020).",
    "ATE and RPE as in Sturm et al. 2012, the reference interpolated at the estimate's times; "
    "alignment by Umeyama 1991, or about the vertical where both know gravity (Zhang and "
    "Scaramuzza 2018); 95 % intervals by block bootstrap.",
)
# Labels and sentences below a heading
Sections = dict[str, list[tuple[str, str]]]


def draw(document: Document) -> Iterator[Page]:
    """Draw one page or more."""
    analysis, flight, source = document.analysis, document.analysis.flight, document.analysis.source
    log, placed = flight.log, document.analysis.source.alignment
    others = (f"{t.name} ({t.rate_hz:.1f} Hz)" for t in flight.positions if t is not source)
    parameters = ", ".join(f"{name} {value:g}" for name, value in log.parameters.items())
    missing = [(p.source or p.what, f"{p.reason}. {p.remedy}") for p in analysis.missing]
    yield from _layout(
        "Appendix: provenance",
        document,
        {
            "The log": [
                ("file", f"{log.name}, {log.bytes} bytes, {log.format}"),
                ("SHA-256", log.sha256),
                *(
                    (f.role, f"{f.name}, {f.bytes} bytes, SHA-256 {f.sha256}")
                    for f in flight.inputs
                ),
                ("firmware", f"{log.firmware}, git {log.firmware_hash}"),
                ("time zero", f"{log.boot_time_s:.6f} s after boot, the first sample of data"),
                (
                    "position source",
                    f"{source.name} ({source.origin.kind}, {source.origin.passage}) from "
                    f"{', '.join(source.topics)}; clock: {source.clock}",
                ),
                ("also in the log", ", ".join(others) or "no other position"),
                ("parameters", parameters or "none"),
            ],
            "Clocks, to the autopilot's boot clock": _plain(map(clock_words, flight.clocks)),
            f"Stamps of {source.name}, by the IMU": _plain([clock.line(document)]),
            f"Placement of {source.name}": [*alignment_words(placed).items()] if placed else [],
            "Choices made on the way": _plain(analysis.notes or ["none"]),
            "Looked for and not found": missing or _plain(["nothing is missing"]),
            "How the numbers are made": _plain(METHOD),
        },
    )


def draw_loop(document: LoopDocument) -> Iterator[Page]:
    """Draw one page or more about a loop alone."""
    loop = document.loop
    files = [("track", loop.odometry.trajectory)]
    files += [("reference", reference) for reference in loop.references]
    read = [
        (label, f"{track.name}, {track.size_bytes} bytes, SHA-256 {track.sha256}. "
         f"{' '.join(track.notes)}")
        for label, track in files
    ]  # fmt: skip
    yield from _layout(
        "Provenance",
        document,
        {
            "The files": read,
            "Choices made on the way": _plain(loop.notes or ["none"]),
            "How the numbers are made": _plain(LOOP_METHOD),
        },
    )


def _plain(texts: Iterable[str]) -> list[tuple[str, str]]:
    """Sentences without a label."""
    return [("", text) for text in texts]


def _layout(heading: str, document: Document | LoopDocument, sections: Sections) -> Iterator[Page]:
    """Write what the report was made with, and then all else, in small letters."""
    page, student = Page(heading), document.student
    made = provenance(document.command) if document.made is None else document.made
    made_with = [
        ("command", made.command),
        ("px4fuse", f"{made.px4fuse} on Python {made.python}"),
        ("libraries", ", ".join(f"{name} {of}" for name, of in made.libraries.items())),
        ("results", "attached inside this PDF as results.json"),
    ]
    if fonts.missing(student.name + student.id + student.notes):
        text = (
            f"{fonts.NO_GLYPH} stands for characters that no font on this machine has; "
            "results.json holds the text as given"
        )
        made_with.append(("fonts", text))
    for title, entries in {"Made with": made_with, **sections}.items():
        if entries:
            page.heading(title, 9.5, above=9.0)
        for label, text in entries:
            if label:
                page.labelled(label, text, size=SIZE, width=INDENT, above=-1.0, colour=MUTED,
                              bold=False)  # fmt: skip
            else:
                page.write(text, size=SIZE)
    yield page
