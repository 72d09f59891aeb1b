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
from px4fuse.results.reading import clean_text, one_line
from px4fuse.verification.model import Mismatch, PageStatus, Status, Verdict
from px4fuse.verification.pages import WordsAlike, compare_pages

ADD_LOGS_ADVICE = "Add {} to --logs."
ASK_ADVICE = "Ask how the report was made, and for the log and all files that it was made from."
FOREIGN_REQUEST = "the recorded request is not one that px4fuse can have made"
# A flight of ten minutes has 60,000 steps of it, which take half a minute
MIN_DT_S = 0.01
ORIGINAL = "Ask for the PDF as px4fuse wrote it."
LIMIT = "A verified report proves that its numbers belong to the log, not who wrote them."
NO_LOG = "no log was given, so that no number could be computed again"
# Between processors: sums over a flight differ in the last few of 16 digits, differences of such
# sums in the last 8. Four kernels of OpenBLAS differ by 3e-8 at most (six flights). This is a
# tolerance, not a number of digits: two nearly equal numbers may be rounded to other last digits
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-6, 1e-9
# Minima are flat: where the likelihood or a cost differs in its 12th digit, the place of its
# minimum does in its 6th, and the ends of an interval found from it in the 4th. No page prints
# more than three digits of these.
ESTIMATE_RELATIVE_TOLERANCE, ESTIMATE_ABSOLUTE_TOLERANCE = 1e-3, 1e-5
ESTIMATE_PATHS = (
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
ITERATIONS, MAX_MORE_ITERATIONS = "iterations", 2
# What tells the machine that a report was made on, and no number of it
MACHINE_PATHS = ("provenance.python", "provenance.libraries")
MAX_DIFFERENCES = 20
SHOWN_PAGES = 5
MAX_TEXT_LENGTH = 120
# Sizes by which a report multiplies numbers to print them: 1, per cent, thousandths
PRINTED_SCALES = (1.0, 100.0, 1000.0)
# Of notes that are drawn again; a page holds about 60
MAX_NOTES_LINES = 5_000
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")

# What the analysis gives now: results as a report attaches them, and what draws the report, with
# the student and the versions that were recorded
Recomputed = tuple[Reported, Callable[[], bytes]]
_LinkFile = Callable[[str, str | None, str], str]


class NotRepeatableError(Exception):
    """Why an analysis is not run again, with the arguments of :func:`cannot_verify`."""


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
            raise NotRepeatableError(
                "the results do not say which libraries they were made with", ASK_ADVICE
            )
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            link_file = partial(_link_file, logs, Path(folder))
            if isinstance(results, LoopResults):
                analysis_result, new_results = _repeat_loop(results, link_file)
            else:
                analysis_result, new_results = _repeat_comparison(results, link_file)
        return new_results, partial(_draw_report, analysis_result, new_results, results.provenance)
    except SettingsError as error:  # no run with these settings can have made a report
        return cannot_verify(f"{FOREIGN_REQUEST}: {error}", ASK_ADVICE)
    except NotRepeatableError as error:
        return cannot_verify(*error.args)
    except Px4FuseError as error:
        return cannot_verify(str(error), ASK_ADVICE)
    except Exception as error:  # noqa: BLE001 - settings made to fail may fail anywhere
        return cannot_verify(
            f"the analysis cannot be repeated ({type(error).__name__})", ASK_ADVICE
        )


def _link_file(
    logs: Mapping[str, Path], within: Path, name: str, sha256: str | None, role: str
) -> str:
    """A file with this content where the analysis finds it, under the recorded name.

    Names are printed in the report. They are those of links in a folder of this run alone, and
    only where they are plain names.
    """
    path = None if sha256 is None else logs.get(sha256)
    if path is None:
        missing = one_line(name, 80) or "its file"
        problem = f"none of the files given has the SHA-256 of {role}"
        raise NotRepeatableError(problem, ADD_LOGS_ADVICE.format(missing), missing)
    if name != Path(name).name or name == ".." or "\\" in name or not name.isprintable():
        raise NotRepeatableError(
            f"{FOREIGN_REQUEST}: a file name in it is not a plain name", ASK_ADVICE
        )
    # each in a folder of its own: two may have one name
    target = Path(tempfile.mkdtemp(dir=within), name)
    try:
        target.symlink_to(path.resolve())
    except OSError:  # on Windows for administrators only
        shutil.copyfile(path, target)
    return str(target)


def split_part(source: str) -> tuple[str, str]:
    """File and part of ``LOG:vio``, without a look at any file."""
    from px4fuse.loop.tracks import FLIGHT_PARTS  # noqa: PLC0415

    name, colon, tail = source.rpartition(":")
    return (name, f":{tail}") if colon and tail in FLIGHT_PARTS else (source, "")


def _repeat_comparison(
    handed_in: ComparisonResults, link_file: _LinkFile
) -> tuple[object, Reported]:
    from px4fuse.analysis import run  # noqa: PLC0415
    from px4fuse.results.build import results  # noqa: PLC0415

    recorded = handed_in.request
    if recorded.dt_s < MIN_DT_S:
        raise NotRepeatableError(
            f"DT is below {MIN_DT_S:g} s, which takes too long to repeat", ASK_ADVICE
        )
    joined = {file.role: file.sha256 for file in handed_in.log.joined}
    request = replace(recorded, log=link_file(recorded.log, handed_in.log.sha256, "the log"))
    if (mavlink := recorded.mavlink) is not None:
        request = replace(request, mavlink=link_file(mavlink, joined.get("mavlink"), "--mavlink"))
    if (position := recorded.position) is not None:
        placed = link_file(position.path, joined.get("position"), "--position")
        request = replace(request, position=replace(position, path=placed))
    analysis_result = run(request)
    return analysis_result, results(recorded, analysis_result, handed_in.student)


def _repeat_loop(handed_in: LoopResults, link_file: _LinkFile) -> tuple[object, Reported]:
    from px4fuse.analysis import run_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results  # noqa: PLC0415

    recorded = handed_in.request
    path, part = split_part(recorded.source)
    request = replace(recorded, source=link_file(path, handed_in.track.sha256, "the log") + part)
    if recorded.reference is not None:
        path, part = split_part(recorded.reference)
        sha256 = handed_in.references[-1].sha256 if handed_in.references else None
        request = replace(request, reference=link_file(path, sha256, "--reference") + part)
    loop_result = run_loop(request)
    return loop_result, loop_results(recorded, loop_result, handed_in.student)


def _draw_report(subject: object, results: Reported, versions: Provenance) -> bytes:
    """Draw the report with the versions that were recorded."""
    from px4fuse.report.pdf import render  # noqa: PLC0415

    new_provenance = replace(versions, command=results.provenance.command)
    return render(subject, replace(results, provenance=new_provenance), to_json(results))


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
    report_version, own_version = results.provenance.px4fuse, metadata.version("px4fuse")
    if report_version != own_version:
        shown_version = one_line(report_version, 40)
        why = f"made with px4fuse {shown_version}, this is {own_version}"
        return cannot_verify(why, f"Run it with px4fuse {shown_version}.")
    name = one_line(log_name(results), 80) or "its log"
    if not logs:
        return cannot_verify(NO_LOG, ADD_LOGS_ADVICE.format(name), name)
    sha256 = log_sha256(results)
    if sha256 not in logs:
        expected_hash = one_line(sha256, 64) or "none"
        reason = f"none of the {len(logs)} files given is the log, whose SHA-256 is {expected_hash}"
        remedy = f"If it is a log of yours, a{ADD_LOGS_ADVICE.format(name)[1:]}"
        return Verdict("other log", (reason,), False, remedy=remedy, missing=name)
    if results.student.notes.count("\n") > MAX_NOTES_LINES:
        reason = f"its notes have more than {MAX_NOTES_LINES} lines, which is no report"
        return cannot_verify(reason, ASK_ADVICE)
    again = recompute(results, logs)
    return again if isinstance(again, Verdict) else _verify_with_log(results, pdf, *again)


def cannot_verify(reason: str, remedy: str = "", missing: str = "") -> Verdict:
    """Nothing can be said, for this reason; with what helps, and the name of a file that would."""
    reasons = (one_line(reason, 400),)
    return Verdict("cannot verify", reasons, False, remedy=remedy, missing=missing)


def _verify_with_log(
    submitted: Reported, pdf: bytes, recomputed: Reported, draw: Callable[[], bytes]
) -> Verdict:
    redrawn = draw()
    if redrawn == pdf:
        reason = "the log gives the same file again, byte for byte"
        return Verdict("verified", (reason, LIMIT), True, page_status="same", redrawn=redrawn)
    mismatches, numbers_alike, compared = compare_results(to_plain(submitted), to_plain(recomputed))
    first = ", ".join(one.path for one in mismatches[:3]) + ", …" * (len(mismatches) > 3)
    reasons = [
        f"{len(mismatches)} of {compared} values are not what the log gives: {first}"
        if mismatches
        else f"the log gives all {compared} values again (within {RELATIVE_TOLERANCE:g}, estimates "
        f"within {ESTIMATE_RELATIVE_TOLERANCE:g})"
    ]
    others = _other_libraries(submitted.provenance, recomputed.provenance)
    words_alike = partial(same_words, numbers_alike=numbers_alike)
    pages = compare_pages(pdf, redrawn, words_alike, same_libraries=not others)
    foreign = any(one.structural for one in pages)
    page_status: PageStatus = "same"
    if pages:
        page_status = "not compared" if foreign else "differ"
    status: Status = "numbers differ" if mismatches else "cannot verify" if foreign else "verified"
    sentences = [one.sentence for one in pages[:SHOWN_PAGES]]
    sentences += [f"{len(pages) - SHOWN_PAGES} more differences"] * (len(pages) > SHOWN_PAGES)
    # the first reason is the one that a class table shows
    reasons = [*sentences, *reasons] if status == "cannot verify" else [*reasons, *sentences]
    reasons += [f"made with {others}: of figures only place and texts were compared"] * bool(others)
    reasons += [LIMIT] * (status == "verified")
    remedy = ORIGINAL if foreign else ""
    return Verdict(
        status,
        tuple(reasons),
        True,
        mismatches[:MAX_DIFFERENCES],
        page_status,
        pages,
        redrawn,
        remedy,
    )


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
    numbers_alike : Rounding
    compared : int
        How many values.
    """
    command = str(recomputed["provenance"]["command"])
    # everything rests on an offset or placement that was estimated
    everywhere = not {"auto", "--position"}.isdisjoint(command.split())
    handed_in, new_values = dict(flatten(recorded)), dict(flatten(recomputed))
    pairs = {
        path: (handed_in.get(path, _ABSENT), new_values.get(path, _ABSENT))
        for path in {**new_values, **handed_in}
        if not path.startswith(MACHINE_PATHS)
    }
    is_near_by_path = {
        path: _is_near(path, *pair, everywhere or path.startswith(ESTIMATE_PATHS))
        for path, pair in pairs.items()
        if all(map(is_number, pair))
    }
    twins = (pairs[path] for path, is_near in is_near_by_path.items() if is_near)
    numbers_alike = Rounding(tuple((float(a), float(b)) for a, b in twins if a != b))
    wrong_paths = [path for path, is_near in is_near_by_path.items() if not is_near]
    wrong_paths += [
        path
        for path in pairs
        if path not in is_near_by_path and not _is_same(*pairs[path], numbers_alike)
    ]
    mismatches = (
        Mismatch(one_line(path, MAX_TEXT_LENGTH), *map(_format_value, pairs[path]))
        for path in wrong_paths
    )
    return tuple(mismatches), numbers_alike, len(pairs)


# Stands where there is nothing
_ABSENT = object()


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of what is no mapping and no list, keys joined by dots.

    >>> [*flatten({"a": {"b.c": [1, 2]}})]
    [('a.b.c.0', 1), ('a.b.c.1', 2)]
    """
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if not isinstance(value, Mapping):
        yield path, value
        return
    for key, part in value.items():
        yield from flatten(part, f"{path}.{key}" if path else f"{key}")


def is_number(value: object) -> bool:
    """Whether a value is a number, and not a flag."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_near(path: str, submitted: float, recomputed: float, wide: bool) -> bool:
    if isinstance(recomputed, int):
        return abs(submitted - recomputed) <= (
            MAX_MORE_ITERATIONS if path.endswith(ITERATIONS) else 0
        )
    relative, absolute = (
        (ESTIMATE_RELATIVE_TOLERANCE, ESTIMATE_ABSOLUTE_TOLERANCE)
        if wide
        else (RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE)
    )
    return abs(submitted - recomputed) <= relative * abs(recomputed) + absolute


def _is_same(submitted: Any, recomputed: Any, rounded: WordsAlike) -> bool:
    """Whether two values that are not both numbers are the same."""
    if isinstance(submitted, str) and isinstance(recomputed, str):
        return same_words(submitted, clean_text(recomputed), rounded)
    return type(submitted) is type(recomputed) and bool(submitted == recomputed)


def same_words(one: str, other: str, numbers_alike: WordsAlike) -> bool:
    """Whether two texts are the same but for the rounding of their numbers.

    >>> same_words("0.15 m", "0.16 m", lambda one, other: True)
    True
    >>> same_words("0.15 m", "0.15 s", lambda one, other: True)
    False
    """
    if one == other:
        return True
    # every second part is a number
    pieces, other_pieces = _NUMBER.split(one), _NUMBER.split(other)
    numbers = zip(pieces[1::2], other_pieces[1::2], strict=False)
    return pieces[::2] == other_pieces[::2] and all(
        a == b or numbers_alike(a, b) for a, b in numbers
    )


def _decimals(number: str) -> int:
    """Decimals of a printed number.

    >>> _decimals("0.15"), _decimals("3"), _decimals("1.2e-3")
    (2, 0, 4)
    """
    mantissa, _, exponent = number.partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def _format_value(value: Any) -> str:
    """A value on one line."""
    return "absent" if value is _ABSENT else one_line(str(value), MAX_TEXT_LENGTH)
