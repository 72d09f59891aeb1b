"""Provenance: where every number comes from, so that somebody else can make it again."""

from __future__ import annotations

from collections.abc import Iterator

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
Section = tuple[str, list[tuple[str, str]]]


def draw(document: Document) -> Iterator[Page]:
    """Draw one page or more."""
    comparison = document.comparison
    flight, source = comparison.flight, comparison.source
    log = flight.log
    sections: list[Section] = [
        _made_with(document),
        (
            "The log",
            [
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
                    f"{', '.join(source.topics)}; "
                    f"clock: {source.clock}",
                ),
                (
                    "also in the log",
                    ", ".join(
                        f"{t.name} ({t.rate_hz:.1f} Hz)"
                        for t in flight.positions
                        if t is not source
                    )
                    or "no other position",
                ),
                (
                    "parameters",
                    ", ".join(f"{k} {v:g}" for k, v in log.parameters.items()) or "none",
                ),
            ],
        ),
        ("Clocks, to the autopilot's boot clock", [("", clock_words(c)) for c in flight.clocks]),
        (f"Stamps of {source.name}, by the IMU", [("", clock.line(document))]),
        (
            f"Placement of {source.name}",
            [] if source.alignment is None else alignment_words(source.alignment),
        ),
        ("Choices made on the way", [("", note) for note in comparison.notes] or [("", "none")]),
        (
            "Looked for and not found",
            [
                (part.source or part.what, f"{part.reason}. {part.remedy}")
                for part in comparison.missing
            ]
            or [("", "nothing is missing")],
        ),
        ("How the numbers are made", [("", text) for text in METHOD]),
    ]
    yield from _layout("Appendix: provenance", sections)


def draw_loop(document: LoopDocument) -> Iterator[Page]:
    """Draw one page or more about a loop alone."""
    loop = document.loop
    files = [("track", loop.odometry.trajectory)]
    files += [("reference", reference) for reference in loop.references]
    yield from _layout(
        "Provenance",
        [
            _made_with(document),
            (
                "The files",
                [
                    (
                        label,
                        f"{track.name}, {track.size_bytes} bytes, SHA-256 {track.sha256}. "
                        f"{' '.join(track.notes)}",
                    )
                    for label, track in files
                ],
            ),
            ("Choices made on the way", [("", note) for note in loop.notes] or [("", "none")]),
            ("How the numbers are made", [("", text) for text in LOOP_METHOD]),
        ],
    )


def _made_with(document: Document | LoopDocument) -> Section:
    made = provenance(document.command) if document.made is None else document.made
    return (
        "Made with",
        [
            ("command", made.command),
            ("px4fuse", f"{made.px4fuse} on Python {made.python}"),
            ("libraries", ", ".join(f"{k} {v}" for k, v in made.libraries.items())),
            ("results", "attached inside this PDF as results.json"),
            *_fonts(document),
        ],
    )


def _layout(heading: str, sections: list[Section]) -> Iterator[Page]:
    page = Page(heading)
    for title, entries in sections:
        if entries:
            page.heading(title, 9.5, above=9.0)
        for label, text in entries:
            if label:
                page.labelled(
                    label, text, size=SIZE, width=INDENT, above=-1.0, colour=MUTED, bold=False
                )
            else:
                page.write(text, size=SIZE, above=0.0)
    yield page


def _fonts(document: Document | LoopDocument) -> list[tuple[str, str]]:
    student = document.student
    if not fonts.missing(student.name + student.id + student.notes):
        return []
    text = (
        f"{fonts.NO_GLYPH} stands for characters that no font on this machine has; results.json "
        "holds the text as given"
    )
    return [("fonts", text)]
