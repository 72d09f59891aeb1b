"""Whether the numbers of a report are what its log gives, and the report drawn again from them.

The attached results are taken for what they claim: the recorded command is run again on the log,
found by its SHA-256, and what comes out is compared with what was handed in. This proves that the
numbers belong to the log. It does not prove who wrote them: whoever has the log can make the same
report with another name on it.

The report is drawn again from what the log gives, and the handed-in PDF is compared with it part
by part (:mod:`px4fuse.verification.pages`). No number rests on the handed-in pages.

The recorded request is a stranger's. It is decoded strictly, and the analysis knows the range of
every value; files are found by their SHA-256 among those that were given, never by name; and
nothing in it names an output.
"""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from px4fuse.errors import Px4FuseError, SettingsError
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_json, to_plain
from px4fuse.results.model import LIBRARIES, Provenance
from px4fuse.results.reading import cleaned, one_line
from px4fuse.verification.model import Mismatch, PageStatus, Status, Verdict
from px4fuse.verification.pages import WordsAlike, compare_pages

ADD = "Add {} to --logs."
ASK = "Ask how the report was made, and for the log and all files that it was made from."
NOT_OURS = "the recorded request is not one that px4fuse can have made"
# A flight of ten minutes has 60,000 steps of it, which take half a minute
MIN_DT_S = 0.01
ORIGINAL = "Ask for the PDF as px4fuse wrote it."
LIMIT = "A verified report proves that its numbers belong to the log, not who wrote them."
NO_LOG = "no log was given, so that no number could be computed again"
# Between processors: sums over a flight differ in the last few of 16 digits, differences of such
# sums in the last 8. Four kernels of OpenBLAS differ by 3e-8 at most (six flights). This is a
# tolerance, not a number of digits: two nearly equal numbers may be rounded to other last digits
RELATIVE, ABSOLUTE = 1e-6, 1e-9
# Minima are flat: where the likelihood or a cost differs in its 12th digit, the place of its
# minimum does in its 6th, and the ends of an interval found from it in the 4th. No page prints
# more than three digits of these.
ESTIMATE_RELATIVE, ESTIMATE_ABSOLUTE = 1e-3, 1e-5
ESTIMATES = (
    "tuning",
    "clock",
    "ekf2_replay",
    "why",
    "findings",
    "loop.closures",
    "loop.corrections",
    "source.alignment",
    "settings.clock_offset_s",
)
# How often a solver went round
ITERATIONS, MORE_ITERATIONS = "iterations", 2
# What tells the machine that a report was made on, and no number of it
MACHINE = ("provenance.python", "provenance.libraries")
SHOWN = 20
SHOWN_PAGES = 5
SHOWN_TEXT = 120
# Sizes by which a report multiplies numbers to print them: 1, per cent, thousandths
PRINTED_SCALES = (1.0, 100.0, 1000.0)
# Of notes that are drawn again; a page holds about 60
MAX_NOTES_LINES = 5_000
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")

# What the analysis gives now: results as a report attaches them, and what draws the report, with
# the student and the versions that were recorded
Recomputed = tuple[Reported, Callable[[], bytes]]
_Place = Callable[[str, str | None, str], str]


class _RefusedError(Exception):
    """Why an analysis is not run again, with the arguments of :func:`unknown`."""


def log_sha256(results: Reported) -> str:
    """SHA-256 of the log that a report is about."""
    return results.track.sha256 if isinstance(results, LoopResults) else results.log.sha256


def log_name(results: Reported) -> str:
    """Name of the log that a report is about, as the report gives it."""
    loop = isinstance(results, LoopResults)
    return split_part(results.track.name)[0] if loop else results.log.name  # type: ignore[union-attr]


def recompute(results: Reported, logs: Mapping[str, Path]) -> Recomputed | Verdict:
    """Repeat the analysis from what a report recorded.

    Parameters
    ----------
    results : ComparisonResults or LoopResults
        What is attached to the report.
    logs : mapping of str to Path
        Files by their SHA-256.

    Returns
    -------
    Recomputed or Verdict
        "cannot verify" where the command is not px4fuse's, a file is missing, or the analysis
        fails.
    """
    try:
        if tuple(results.provenance.libraries) != LIBRARIES:
            raise _RefusedError("the results do not say which libraries they were made with", ASK)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            place = partial(_place, logs, Path(folder))
            if isinstance(results, LoopResults):
                found, made = _looped(results, place)
            else:
                found, made = _compared(results, place)
        return made, partial(_drawn, found, made, results.provenance)
    except SettingsError as error:  # no run with these settings can have made a report
        return unknown(f"{NOT_OURS}: {error}", ASK)
    except _RefusedError as error:
        return unknown(*error.args)
    except Px4FuseError as error:
        return unknown(str(error), ASK)
    except Exception as error:  # noqa: BLE001 - settings made to fail may fail anywhere
        return unknown(f"the analysis cannot be repeated ({type(error).__name__})", ASK)


def _place(logs: Mapping[str, Path], within: Path, name: str, sha256: str | None, what: str) -> str:
    """A file with this content where the analysis finds it, under the recorded name.

    Names are printed in the report. They are those of links in a folder of this run alone, and
    only where they are plain names.
    """
    path = None if sha256 is None else logs.get(sha256)
    if path is None:
        missing = one_line(name, 80) or "its file"
        asked = f"none of the files given has the SHA-256 of {what}"
        raise _RefusedError(asked, ADD.format(missing), missing)
    if name != Path(name).name or name == ".." or "\\" in name or not name.isprintable():
        raise _RefusedError(f"{NOT_OURS}: a file name in it is not a plain name", ASK)
    # each in a folder of its own: two may have one name
    target = Path(tempfile.mkdtemp(dir=within), name)
    try:
        target.symlink_to(path.resolve())
    except OSError:  # on Windows for administrators only
        shutil.copyfile(path, target)
    return str(target)


def split_part(source: str) -> tuple[str, str]:
    """File and part of ``LOG:vio``, without a look at any file."""
    from px4fuse.loop.tracks import PARTS  # noqa: PLC0415

    name, colon, tail = source.rpartition(":")
    return (name, f":{tail}") if colon and tail in PARTS else (source, "")


def _compared(handed_in: ComparisonResults, place: _Place) -> tuple[object, Reported]:
    from px4fuse.analysis import run  # noqa: PLC0415
    from px4fuse.results.build import results  # noqa: PLC0415

    recorded = handed_in.request
    if recorded.dt_s < MIN_DT_S:
        raise _RefusedError(f"DT is below {MIN_DT_S:g} s, which takes too long to repeat", ASK)
    joined = {file.role: file.sha256 for file in handed_in.log.joined}
    request = replace(recorded, log=place(recorded.log, handed_in.log.sha256, "the log"))
    if (mavlink := recorded.mavlink) is not None:
        request = replace(request, mavlink=place(mavlink, joined.get("mavlink"), "--mavlink"))
    if (position := recorded.position) is not None:
        placed = place(position.path, joined.get("position"), "--position")
        request = replace(request, position=replace(position, path=placed))
    found = run(request)
    return found, results(recorded, found, handed_in.student)


def _looped(handed_in: LoopResults, place: _Place) -> tuple[object, Reported]:
    from px4fuse.analysis import run_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results  # noqa: PLC0415

    recorded = handed_in.request
    path, part = split_part(recorded.source)
    request = replace(recorded, source=place(path, handed_in.track.sha256, "the log") + part)
    if recorded.reference is not None:
        path, part = split_part(recorded.reference)
        sha256 = handed_in.references[-1].sha256 if handed_in.references else None
        request = replace(request, reference=place(path, sha256, "--reference") + part)
    found = run_loop(request)
    return found, loop_results(recorded, found, handed_in.student)


def _drawn(found: object, results: Reported, versions: Provenance) -> bytes:
    """Draw the report with the versions that were recorded."""
    from px4fuse.report.pdf import render  # noqa: PLC0415

    made = replace(versions, command=results.provenance.command)
    return render(found, replace(results, provenance=made), to_json(results))


# ------------------------------------------------------------------ the verdict


def verify(
    results: Reported,
    pdf: bytes,
    logs: Mapping[str, Path],
    *,
    recompute: Callable[[Reported, Mapping[str, Path]], Recomputed | Verdict] = recompute,
) -> Verdict:
    """Say whether a report's numbers are what its log gives, and draw it again.

    Parameters
    ----------
    logs : mapping of str to Path
        Logs and other recordings by their SHA-256.
    recompute : callable
        Repeats the analysis.

    Returns
    -------
    Verdict
        "verified" where the log gives every number; without a log never. It proves that the
        numbers belong to the log, not who wrote them. ``redrawn`` is the report to read, and
        ``pages`` names those of the PDF that look otherwise.
    """
    theirs, ours = results.provenance.px4fuse, metadata.version("px4fuse")
    if theirs != ours:
        named = one_line(theirs, 40)
        why = f"made with px4fuse {named}, this is {ours}"
        return unknown(why, f"Run it with px4fuse {named}.")
    name = one_line(log_name(results), 80) or "its log"
    if not logs:
        return unknown(NO_LOG, ADD.format(name), name)
    sha256 = log_sha256(results)
    if sha256 not in logs:
        asked = one_line(sha256, 64) or "none"
        reason = f"none of the {len(logs)} files given is the log, whose SHA-256 is {asked}"
        remedy = f"If it is a log of yours, a{ADD.format(name)[1:]}"
        return Verdict("other log", (reason,), False, remedy=remedy, missing=name)
    if results.student.notes.count("\n") > MAX_NOTES_LINES:
        reason = f"its notes have more than {MAX_NOTES_LINES} lines, which is no report"
        return unknown(reason, ASK)
    again = recompute(results, logs)
    return again if isinstance(again, Verdict) else _with_log(results, pdf, *again)


def unknown(reason: str, remedy: str = "", missing: str = "") -> Verdict:
    """Nothing can be said, for this reason; with what helps, and the name of a file that would."""
    reasons = (one_line(reason, 400),)
    return Verdict("cannot verify", reasons, False, remedy=remedy, missing=missing)


def _with_log(theirs: Reported, pdf: bytes, ours: Reported, draw: Callable[[], bytes]) -> Verdict:
    redrawn = draw()
    if redrawn == pdf:
        reason = "the log gives the same file again, byte for byte"
        return Verdict("verified", (reason, LIMIT), True, page_status="same", redrawn=redrawn)
    wrong, alike, compared = compare_results(to_plain(theirs), to_plain(ours))
    first = ", ".join(one.path for one in wrong[:3]) + ", …" * (len(wrong) > 3)
    reasons = [
        f"{len(wrong)} of {compared} values are not what the log gives: {first}"
        if wrong
        else f"the log gives all {compared} values again (within {RELATIVE:g}, estimates "
        f"within {ESTIMATE_RELATIVE:g})"
    ]
    others = _other_libraries(theirs.provenance, ours.provenance)
    words_alike = partial(same_words, alike=alike)
    pages = compare_pages(pdf, redrawn, words_alike, same_libraries=not others)
    foreign = any(one.structural for one in pages)
    page_status: PageStatus = "same"
    if pages:
        page_status = "not compared" if foreign else "differ"
    status: Status = "numbers differ" if wrong else "cannot verify" if foreign else "verified"
    said = [one.said for one in pages[:SHOWN_PAGES]]
    said += [f"{len(pages) - SHOWN_PAGES} more differences"] * (len(pages) > SHOWN_PAGES)
    # the first reason is the one that a class table shows
    reasons = [*said, *reasons] if status == "cannot verify" else [*reasons, *said]
    reasons += [f"made with {others}: of figures only place and texts were compared"] * bool(others)
    reasons += [LIMIT] * (status == "verified")
    remedy = ORIGINAL if foreign else ""
    return Verdict(status, tuple(reasons), True, wrong[:SHOWN], page_status, pages, redrawn, remedy)


def _other_libraries(theirs: Provenance, ours: Provenance) -> str:
    """List the libraries of which the report was made with other versions than those here."""
    others = (
        f"{name} {theirs.libraries.get(name)} (here {version})"
        for name, version in ours.libraries.items()
        if theirs.libraries.get(name) != version
    )
    return one_line(", ".join(others), 300)


@dataclass(frozen=True)
class Rounding:
    """Compare two printed numbers: a recorded number and its recomputed twin, each rounded.

    Attributes
    ----------
    pairs : tuple of tuple of float
        Recorded and recomputed numbers that are equal within the tolerances.
    """

    pairs: tuple[tuple[float, float], ...]

    def __call__(self, one: str, other: str) -> bool:
        """Return True if one pair gives both numbers."""
        decimals, printed = _decimals(one), (float(one), float(other))
        return decimals == _decimals(other) and any(
            printed == (round(abs(a) * scale, decimals), round(abs(b) * scale, decimals))
            for scale in PRINTED_SCALES
            for a, b in self.pairs
        )


def compare_results(
    recorded: Mapping[str, Any], recomputed: Mapping[str, Any]
) -> tuple[tuple[Mismatch, ...], Rounding, int]:
    """Compare every value of two results, of which the first is a stranger's.

    Returns
    -------
    differences : tuple of Mismatch
        What is beyond the tolerances.
    alike : Rounding
    compared : int
        How many values.
    """
    command = str(recomputed["provenance"]["command"])
    # everything rests on an offset or placement that was estimated
    everywhere = not {"auto", "--position"}.isdisjoint(command.split())
    handed_in, made = dict(flattened(recorded)), dict(flattened(recomputed))
    pairs = {
        path: (handed_in.get(path, _ABSENT), made.get(path, _ABSENT))
        for path in {**made, **handed_in}
        if not path.startswith(MACHINE)
    }
    near = {
        path: _near(path, *pair, everywhere or path.startswith(ESTIMATES))
        for path, pair in pairs.items()
        if all(map(is_number, pair))
    }
    twins = (pairs[path] for path, is_near in near.items() if is_near)
    alike = Rounding(tuple((float(a), float(b)) for a, b in twins if a != b))
    wrong = [path for path, is_near in near.items() if not is_near]
    wrong += [path for path in pairs if path not in near and not _same(*pairs[path], alike)]
    found = (Mismatch(one_line(path, SHOWN_TEXT), *map(_shown, pairs[path])) for path in wrong)
    return tuple(found), alike, len(pairs)


# Stands where there is nothing
_ABSENT = object()


def flattened(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of what is no mapping and no list, keys joined by dots.

    >>> [*flattened({"a": {"b.c": [1, 2]}})]
    [('a.b.c.0', 1), ('a.b.c.1', 2)]
    """
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if not isinstance(value, Mapping):
        yield path, value
        return
    for key, part in value.items():
        yield from flattened(part, f"{path}.{key}" if path else f"{key}")


def is_number(value: object) -> bool:
    """Whether a value is a number, and not a flag."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _near(path: str, theirs: float, ours: float, wide: bool) -> bool:
    if isinstance(ours, int):
        return abs(theirs - ours) <= (MORE_ITERATIONS if path.endswith(ITERATIONS) else 0)
    relative, absolute = (ESTIMATE_RELATIVE, ESTIMATE_ABSOLUTE) if wide else (RELATIVE, ABSOLUTE)
    return abs(theirs - ours) <= relative * abs(ours) + absolute


def _same(theirs: Any, ours: Any, rounded: WordsAlike) -> bool:
    """Whether two values that are not both numbers are the same."""
    if isinstance(theirs, str) and isinstance(ours, str):
        return same_words(theirs, cleaned(ours), rounded)
    return type(theirs) is type(ours) and bool(theirs == ours)


def same_words(one: str, other: str, alike: WordsAlike) -> bool:
    """Whether two texts are the same but for the rounding of their numbers.

    >>> same_words("0.15 m", "0.16 m", lambda one, other: True)
    True
    >>> same_words("0.15 m", "0.15 s", lambda one, other: True)
    False
    """
    if one == other:
        return True
    # every second part is a number
    parts, others = _NUMBER.split(one), _NUMBER.split(other)
    numbers = zip(parts[1::2], others[1::2], strict=False)
    return parts[::2] == others[::2] and all(a == b or alike(a, b) for a, b in numbers)


def _decimals(number: str) -> int:
    """Decimals of a printed number.

    >>> _decimals("0.15"), _decimals("3"), _decimals("1.2e-3")
    (2, 0, 4)
    """
    mantissa, _, exponent = number.partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def _shown(value: Any) -> str:
    """A value on one line."""
    return "absent" if value is _ABSENT else one_line(str(value), SHOWN_TEXT)
