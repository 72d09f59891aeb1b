"""Whether the pages of a report say what its results say, without the log.

Without the log nothing can be drawn again. What can be done is to format the results as the report
does and to look for the words on the page where they belong: heads and feet, the cover's facts,
verdicts and findings, the loop's figures, and what the report was made with.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numpy as np

from px4fuse.comparison.comparison import AgainstTruth, FilterSummary
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.kalman import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight import Unavailable
from px4fuse.report import cover
from px4fuse.report.loop_words import loop_lines
from px4fuse.report.style import lacks_glyphs, printable, shorten
from px4fuse.report.words import settings_words

HEAD_SIZE, HEAD_WIDTH = 6.5, 330
COVER = "Two-state Kalman filter against EKF2"
CONTINUED = "Findings,continued"
LOOP = "LoopclosureApaththattrulyreturns"
PROVENANCE = "Provenance"
Part = TypeVar("Part", Consistency, FilterSummary, AgainstTruth)


@dataclass(frozen=True)
class Missing:
    """Words that the results determine and that do not stand on a page."""

    page: int
    words: str


def disagreements(results: Mapping[str, Any], pages: Sequence[str]) -> list[Missing]:
    """Everything that the results would print and the pages lack.

    Parameters
    ----------
    results : mapping
        Valid under the schema of px4fuse's current version.
    pages : sequence of str
        Text of each page.

    Raises
    ------
    KeyError, TypeError, ValueError, AttributeError, Px4FuseError
        The results are not of the form that px4fuse writes.
    """
    squeezed = ["".join(page.split()) for page in pages]
    found = []
    for place, words in (*_running(results, squeezed), *_body(results, squeezed)):
        wanted = "".join(printable(words).split())
        # a font that is not here, or letters that are joined or turned: extracted in another order
        if _plain(words) and wanted and not any(wanted in squeezed[index] for index in place):
            found.append(Missing(place[0] + 1 if place else 1, words))
    return found


def _plain(words: str) -> bool:
    turned = any(unicodedata.bidirectional(letter) in ("R", "AL", "NSM") for letter in words)
    return not turned and not lacks_glyphs(words)


Wanted = Iterator[tuple[list[int], str]]


def _running(results: Mapping[str, Any], pages: Sequence[str]) -> Wanted:
    """Head and foot of every page."""
    log = results["log"] if "log" in results else results["track"]
    head = shorten(
        printable(f"px4fuse · {log['name']} · SHA-256 {log['sha256'][:12]}"), HEAD_SIZE, HEAD_WIDTH
    )
    for index in range(len(pages)):
        yield [index], head
        yield [index], f"px4fuse {results['provenance']['px4fuse']} {index + 1} / {len(pages)}"


def _body(results: Mapping[str, Any], pages: Sequence[str]) -> Wanted:
    covers = [i for i, page in enumerate(pages) if i == 0 or CONTINUED in page]
    loops = [i for i, page in enumerate(pages) if LOOP in page][:1] or [0]
    sources = [i for i, page in enumerate(pages) if page.startswith(PROVENANCE)]
    sources = sources or [len(pages) - 1]
    if "axes" in results:
        yield [0], COVER
        yield from (([0], words) for words in _facts(results))
    else:
        yield [0], f"SHA-256 {results['track']['sha256']}"
    student = results["student"]
    who = ", ".join(part for part in (student["name"], student["id"]) if part)
    if who:
        yield [0], f"Student {who}"
    yield from ((covers, words) for words in _findings(results["findings"], pages, covers))
    if "unavailable" not in results["loop"]:
        yield from ((loops, f"{label} {words}") for label, words in _loop(results["loop"]))
    yield from ((sources, words) for words in _sources(results))


def _facts(results: Mapping[str, Any]) -> Iterator[str]:
    log, settings = results["log"], results["settings"]
    yield f"Log {log['name']}, {log['size_bytes'] / 1e6:.2f} MB, {log['duration_s']:.1f} s of data"
    yield f"SHA-256 {log['sha256']}"
    yield f"Vehicle {log['firmware']}, {log['hardware']}"
    source = results["position_source"]
    yield (
        f"Position {source['name']}: {source['description']}, {source['rate_hz']:.1f} Hz, "
        f"{source['frame']}; {source['reason']}"
    )
    yield (
        f"Segment {settings['start_s']:.2f} s to {settings['end_s']:.2f} s, "
        f"{settings['segment_reason']}"
    )
    # the offset of a position file is spent on placing it
    offset = 0.0 if "alignment" in source else settings["clock_offset_s"]
    chosen = Settings(
        settings["sigma_a_m_s2"], settings["sigma_z_m"], settings["dt_s"], settings["input"], offset
    )
    yield f"Our filter {settings_words(chosen)}"
    yield from (row for name, axis in results["axes"].items() for row in _verdicts(name, axis))


def _verdicts(name: str, axis: Mapping[str, Any]) -> Iterator[str]:
    """Rows of the verdict table."""
    truth = axis["truth"]
    yield " ".join((name, "ours", *cover._cells(_summary(axis["kf"]), _against(truth, "kf"))))
    if axis["ekf2"].keys() == {"unavailable"}:
        yield "EKF2 not available"
        return
    yield " ".join(("EKF2", *cover._cells(_summary(axis["ekf2"]), _against(truth, "ekf2"))))
    between = axis["difference"]
    if "unavailable" not in between:
        yield (f"ours - EKF2 {between['position_rmse_m']:.3f} {between['velocity_rmse_m_s']:.3f}")


def _summary(values: Mapping[str, Any]) -> FilterSummary:
    consistency: Consistency | Unavailable
    if "unavailable" in values:
        consistency = Unavailable(**values["unavailable"])
    else:
        consistency = _made(Consistency, values)
    return _made(FilterSummary, {**values, "consistency": consistency})


def _against(truth: Mapping[str, Any], which: str) -> AgainstTruth | Unavailable:
    if f"{which}_count" not in truth:
        return Unavailable("ground truth", "", "")
    names = [f.name for f in fields(AgainstTruth)]
    return _made(AgainstTruth, {name: truth.get(f"{which}_{name}") for name in names})


def _made(kind: type[Part], values: Mapping[str, Any]) -> Part:
    found: dict[str, Any] = {f.name: values.get(f.name) for f in fields(kind)}
    return kind(**found)


def _findings(
    findings: Sequence[Mapping[str, Any]], pages: Sequence[str], covers: Sequence[int]
) -> Iterator[str]:
    """Every finding; where they are all on one page, with nothing between or after them."""
    texts = [f"{f['severity']} {f['message']} {f['remedy']}" for f in findings]
    if "".join(COVER.split()) not in pages[0] or len(covers) > 1:
        yield from texts
        return
    if not texts:
        texts = ["None: no detector has anything to say about this flight."]
    after = "From above" if "Fromabove" in pages[0] else "px4fuse ·"
    yield " ".join(("Findings", *texts, after))


def _loop(loop: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The loop's figures, in the report's words."""
    axes, end = loop.get("closure_error_axes_m"), loop["known_end"]
    turned = loop["heading_error_deg"]
    like = SimpleNamespace(
        odometry=SimpleNamespace(trajectory=_Path(loop["track"], loop["kind"], loop["frame"],
                                                  loop["poses"])),
        segment=Segment(loop["start_s"], loop["end_s"], loop["part_reason"]),
        nodes=range(loop["key_frames"]),
        spacing_m=loop["key_frame_spacing_m"],
        path_length_m=loop["path_length_m"],
        closure_error_m=loop.get("closure_error_m"),
        misclosure_m=_gone("misclosure") if axes is None else np.array(list(axes.values())),
        misclosure_heading_deg=Unavailable(**turned["unavailable"])
        if isinstance(turned, Mapping)
        else turned,
        known_end=_gone("end") if "unavailable" in end else SimpleNamespace(source=end["source"]),
        closures=[SimpleNamespace(gate=SimpleNamespace(**closure)) for closure in loop["closures"]],
    )  # fmt: skip
    return loop_lines(cast(Any, like))


def _gone(what: str) -> Unavailable:
    return Unavailable(what, "", "")


@dataclass(frozen=True)
class _Path:
    """As much of a trajectory as is told of it."""

    name: str
    kind: str
    frame: str
    poses: int

    def __len__(self) -> int:
        return self.poses


def _sources(results: Mapping[str, Any]) -> Iterator[str]:
    """What stands on the page that says where everything comes from."""
    made = results["provenance"]
    yield f"command {made['command']}"
    yield f"px4fuse {made['px4fuse']} on Python {made['python']}"
    yield ", ".join(f"{name} {version}" for name, version in made["libraries"].items())
    yield from results["notes"] if "notes" in results else results["loop"]["notes"]
    if "log" not in results:
        for track in (results["track"], *results["references"]):
            yield f"{track['name']}, {track['size_bytes']} bytes, SHA-256 {track['sha256']}."
        return
    log = results["log"]
    yield f"file {log['name']}, {log['size_bytes']} bytes, {log['format']}"
    yield f"SHA-256 {log['sha256']}"
    for file in log["joined"]:
        yield f"{file['role']} {file['name']}, {file['size_bytes']} bytes, SHA-256 {file['sha256']}"
    yield f"firmware {log['firmware']}, git {log['firmware_hash']}"
    yield f"time zero {log['boot_time_s']:.6f} s after boot, the first sample of data"
    yield ", ".join(f"{name} {value:g}" for name, value in log["parameters"].items()) or "none"
    for part in results["missing"]:
        yield f"{part['reason']}. {part['remedy']}"
