"""Verification: repeat the analysis of a report on its log, and compare numbers and pages.

The recorded command is run again on the log, which is found by its SHA-256, and the results are
compared with the attached ones. This confirms that the numbers follow from the log. It does not
confirm the author: each person with the log can make the same report under another name.

The report is drawn again from the new results, and the handed-in PDF is compared with it
(:mod:`px4fuse.verification.pages`). No number is read from the handed-in pages.

The recorded request is not trusted: it is decoded strictly, all values are checked for their
ranges, files are found by SHA-256 and never by name, and it cannot name an output file.
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
from px4fuse.results.contract import (
    ComparisonResults,
    LoopResults,
    ReportedResults,
    to_json,
    to_plain,
)
from px4fuse.results.model import LIBRARIES, Provenance
from px4fuse.results.reading import clean_text, one_line
from px4fuse.verification.model import Mismatch, PageStatus, Status, Verdict
from px4fuse.verification.pages import TextComparison, compare_pages

ADD_LOGS_ADVICE = "Add {} to --logs."
ASK_ADVICE = "Ask how the report was made, and for its log and all other input files."
FOREIGN_REQUEST_REASON = "the recorded command was not written by px4fuse"
# minimum DT (s) of a report: ten minutes of flight then have 60,000 steps, which take half a minute
MIN_DT_S = 0.01
ORIGINAL_PDF_ADVICE = "Ask for the PDF that px4fuse wrote."
LIMIT_NOTE = (
    "Verification confirms that the numbers follow from the log. It does not confirm the author."
)
NO_LOG_REASON = "no log was given, so the analysis could not be repeated"
# Tolerance for another processor. Sums over a flight differ in the last few of 16 digits, and
# differences of sums in the last 8. Four OpenBLAS kernels differ by at most 3e-8 (six flights)
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-6, 1e-9
# Tolerance of estimates at a minimum of a likelihood or cost. Minima are flat: if a likelihood or
# cost differs in its 12th digit, its minimum differs in the 6th, and the ends of its interval in
# the 4th digit. Pages print up to three digits
ESTIMATE_RELATIVE_TOLERANCE, ESTIMATE_ABSOLUTE_TOLERANCE = 1e-3, 1e-5
ESTIMATE_PATHS = (
    "tuning",
    "clock",
    "ekf2_replay",
    "difference_steps",
    "findings",
    "trials",
    "card.causes",
    "loop.closures",
    "loop.corrections",
    "source.alignment",
    "settings.clock_offset_s",
)
# field with the number of solver iterations, and accepted difference
ITERATIONS_FIELD, MAX_MORE_ITERATIONS = "iterations", 2
# fields that are not compared, because they describe the computer of the report
MACHINE_PATHS = ("provenance.python", "provenance.libraries")
MAX_DIFFERENCES = 20
MAX_LISTED_PAGES = 5
MAX_TEXT_LENGTH = 120
# factors between a result and the printed number: 1, per cent, thousandths
PRINTED_SCALES = (1.0, 100.0, 1000.0)
# maximum lines of a student's notes in a report that is drawn again; a page has about 60 lines
MAX_NOTES_LINES = 5_000
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")

# new results, and a function that draws the report with the recorded student and versions
Recomputed = tuple[ReportedResults, Callable[[], bytes]]
_LinkFile = Callable[[str, str | None, str], str]


class NotRepeatableError(Exception):
    """Reason why an analysis cannot be repeated: arguments of :func:`cannot_verify`."""


def log_sha256(results: ReportedResults) -> str:
    """Return the SHA-256 of the log of a report."""
    return results.track.sha256 if isinstance(results, LoopResults) else results.log.sha256


def log_name(results: ReportedResults) -> str:
    """Return the name of the log of a report, as recorded."""
    loop = isinstance(results, LoopResults)
    return split_track(results.track.name)[0] if loop else results.log.name  # type: ignore[union-attr]


def recompute(results: ReportedResults, logs: Mapping[str, Path]) -> Recomputed | Verdict:
    """Repeat the recorded analysis of a report.

    Parameters
    ----------
    results : ComparisonResults or LoopResults
        Attached results.
    logs : mapping of str to Path
        Files by SHA-256.

    Returns
    -------
    Recomputed or Verdict
        "cannot verify" if px4fuse cannot have written the command, a file is missing, or the
        analysis fails.
    """
    try:
        if tuple(results.provenance.libraries) != LIBRARIES:
            raise NotRepeatableError("the results do not list the library versions", ASK_ADVICE)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            link_file = partial(_link_file, logs, Path(folder))
            if isinstance(results, LoopResults):
                analysis_result, new_results = _repeat_loop(results, link_file)
            else:
                analysis_result, new_results = _repeat_comparison(results, link_file)
        return new_results, partial(_draw_report, analysis_result, new_results, results.provenance)
    except SettingsError as error:  # px4fuse rejects these settings, so it did not make the report
        return cannot_verify(f"{FOREIGN_REQUEST_REASON}: {error}", ASK_ADVICE)
    except NotRepeatableError as error:
        return cannot_verify(*error.args)
    except Px4FuseError as error:
        return cannot_verify(str(error), ASK_ADVICE)
    except Exception as error:  # noqa: BLE001 - forged settings may fail anywhere
        return cannot_verify(
            f"the analysis cannot be repeated ({type(error).__name__})", ASK_ADVICE
        )


def _link_file(
    logs: Mapping[str, Path], folder: Path, name: str, sha256: str | None, role: str
) -> str:
    """Link the file with this SHA-256 into a temporary folder, and return the path of the link.

    The link has the recorded name, because the report prints it. Names with folders are rejected.
    """
    path = None if sha256 is None else logs.get(sha256)
    if path is None:
        missing_name = one_line(name, 80) or "the file"
        reason = f"none of the given files has the SHA-256 of {role}"
        raise NotRepeatableError(reason, ADD_LOGS_ADVICE.format(missing_name), missing_name)
    if name != Path(name).name or name == ".." or "\\" in name or not name.isprintable():
        raise NotRepeatableError(
            f"{FOREIGN_REQUEST_REASON}: it contains a path instead of a file name", ASK_ADVICE
        )
    # in separate folders, because two files may have the same name
    target = Path(tempfile.mkdtemp(dir=folder), name)
    try:
        target.symlink_to(path.resolve())
    except OSError:  # symbolic links need administrator rights on Windows
        shutil.copyfile(path, target)
    return str(target)


def split_track(source: str) -> tuple[str, str]:
    """Split ``LOG:vio`` into file and track, without checking if the file exists."""
    from px4fuse.loop.tracks import TRACK_NAMES  # noqa: PLC0415

    name, colon, tail = source.rpartition(":")
    return (name, f":{tail}") if colon and tail in TRACK_NAMES else (source, "")


def _repeat_comparison(
    handed_in: ComparisonResults, link_file: _LinkFile
) -> tuple[object, ReportedResults]:
    from px4fuse.analysis import run  # noqa: PLC0415
    from px4fuse.results.build import results  # noqa: PLC0415

    recorded = handed_in.request
    if recorded.dt_s < MIN_DT_S:
        raise NotRepeatableError(
            f"DT is below {MIN_DT_S:g} s, so the analysis would take too long", ASK_ADVICE
        )
    hash_by_role = {file.role: file.sha256 for file in handed_in.log.joined}
    request = replace(recorded, log=link_file(recorded.log, handed_in.log.sha256, "the log"))
    if (mavlink := recorded.mavlink) is not None:
        request = replace(
            request, mavlink=link_file(mavlink, hash_by_role.get("mavlink"), "--mavlink")
        )
    if (position := recorded.position) is not None:
        linked_path = link_file(position.path, hash_by_role.get("position"), "--position")
        request = replace(request, position=replace(position, path=linked_path))
    analysis_result = run(request)
    return analysis_result, results(recorded, analysis_result, handed_in.student)


def _repeat_loop(handed_in: LoopResults, link_file: _LinkFile) -> tuple[object, ReportedResults]:
    from px4fuse.analysis import run_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results  # noqa: PLC0415

    recorded = handed_in.request
    path, track_part = split_track(recorded.source)
    request = replace(
        recorded, source=link_file(path, handed_in.track.sha256, "the log") + track_part
    )
    if recorded.reference is not None:
        path, track_part = split_track(recorded.reference)
        sha256 = handed_in.references[-1].sha256 if handed_in.references else None
        request = replace(request, reference=link_file(path, sha256, "--reference") + track_part)
    loop_result = run_loop(request)
    return loop_result, loop_results(recorded, loop_result, handed_in.student)


def _draw_report(subject: object, results: ReportedResults, versions: Provenance) -> bytes:
    """Draw the report with the versions that the submitted report states."""
    from px4fuse.report.pdf import render  # noqa: PLC0415

    new_provenance = replace(versions, command=results.provenance.command)
    return render(subject, replace(results, provenance=new_provenance), to_json(results))


# ------------------------------------------------------------------ the verdict


def verify(
    results: ReportedResults,
    pdf: bytes,
    logs: Mapping[str, Path],
    *,
    recompute: Callable[[ReportedResults, Mapping[str, Path]], Recomputed | Verdict] = recompute,
) -> Verdict:
    """Verify a report: repeat its analysis, compare numbers and pages, and draw it again.

    Parameters
    ----------
    logs : mapping of str to Path
        Logs and other recordings by SHA-256.
    recompute : callable
        Repeats the analysis.

    Returns
    -------
    Verdict
        "verified" only if the analysis was repeated on the log and all numbers agree. ``redrawn``
        is the report drawn again, ``pages`` lists pages that differ from it.
    """
    report_version, own_version = results.provenance.px4fuse, metadata.version("px4fuse")
    if report_version != own_version:
        shown_version = one_line(report_version, 40)
        reason = f"made with px4fuse {shown_version}; this is px4fuse {own_version}"
        return cannot_verify(reason, f"Verify it with px4fuse {shown_version}.")
    name = one_line(log_name(results), 80) or "the log"
    if not logs:
        return cannot_verify(NO_LOG_REASON, ADD_LOGS_ADVICE.format(name), name)
    sha256 = log_sha256(results)
    if sha256 not in logs:
        expected_hash = one_line(sha256, 64) or "none"
        reason = f"none of the {len(logs)} given files is the log (SHA-256 {expected_hash})"
        remedy = f"If the log is yours, a{ADD_LOGS_ADVICE.format(name)[1:]}"
        return Verdict("other log", (reason,), False, remedy=remedy, missing=name)
    if results.student.notes.count("\n") > MAX_NOTES_LINES:
        reason = f"the notes have more than {MAX_NOTES_LINES} lines"
        return cannot_verify(reason, ASK_ADVICE)
    recomputed = recompute(results, logs)
    return (
        recomputed
        if isinstance(recomputed, Verdict)
        else _verify_with_log(results, pdf, *recomputed)
    )


def cannot_verify(reason: str, remedy: str = "", missing: str = "") -> Verdict:
    """Return the verdict "cannot verify" with reason, remedy and name of a missing file."""
    reasons = (one_line(reason, 400),)
    return Verdict("cannot verify", reasons, False, remedy=remedy, missing=missing)


def _verify_with_log(
    submitted: ReportedResults, pdf: bytes, recomputed: ReportedResults, draw: Callable[[], bytes]
) -> Verdict:
    redrawn = draw()
    if redrawn == pdf:
        reason = "the new run on the log gives an identical file"
        return Verdict("verified", (reason, LIMIT_NOTE), True, page_status="same", redrawn=redrawn)
    mismatches, is_same_number, value_count = compare_results(
        to_plain(submitted), to_plain(recomputed)
    )
    first_paths = ", ".join(m.path for m in mismatches[:3]) + ", …" * (len(mismatches) > 3)
    reasons = [
        f"{len(mismatches)} of {value_count} values differ from a new run on the log: {first_paths}"
        if mismatches
        else f"all {value_count} values agree with a new run on the log (within "
        f"{RELATIVE_TOLERANCE:g}, estimates within {ESTIMATE_RELATIVE_TOLERANCE:g})"
    ]
    is_same_text = partial(is_same_text_rounded, is_same_number=is_same_number)
    pages = compare_pages(pdf, redrawn, is_same_text)
    is_foreign = any(difference.is_structural for difference in pages)
    here = recomputed.provenance.libraries.items()
    others = sorted({*submitted.provenance.libraries.items()} - {*here}) if pages else []
    not_comparable = is_foreign or bool(others)
    page_status: PageStatus = "same"
    if pages:
        page_status = "not compared" if not_comparable else "differ"
    status: Status = "verified"
    if mismatches or not_comparable:
        status = "numbers differ" if mismatches else "cannot verify"
    page_sentences = [difference.sentence for difference in pages[:MAX_LISTED_PAGES]]
    page_sentences += [f"further differences: {len(pages) - MAX_LISTED_PAGES}"] * (
        len(pages) > MAX_LISTED_PAGES
    )
    # the class table shows the first reason
    reasons = (
        [*page_sentences, *reasons] if status == "cannot verify" else [*reasons, *page_sentences]
    )
    remedy = ORIGINAL_PDF_ADVICE if is_foreign else ""
    if others:  # other libraries may draw differently
        versions = one_line(", ".join(map(" ".join, others)), 300)
        reasons.append(f"made with {versions}; here are other versions")
        remedy = remedy or f"Verify it with {versions}."
    reasons += [LIMIT_NOTE] * (status == "verified")
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


@dataclass(frozen=True)
class Rounding:
    """Comparison of numbers in texts: equal if both are roundings of the same result.

    Attributes
    ----------
    pairs : tuple of tuple of float
        Recorded and recomputed results that are equal within the tolerances.
    """

    pairs: tuple[tuple[float, float], ...]

    def __call__(self, one: str, other: str) -> bool:
        """Return True if the two results of a pair round to these two numbers."""
        decimals, printed = _decimals(one), (float(one), float(other))
        return decimals == _decimals(other) and any(
            printed == (round(abs(a) * scale, decimals), round(abs(b) * scale, decimals))
            for scale in PRINTED_SCALES
            for a, b in self.pairs
        )


def compare_results(
    recorded: Mapping[str, Any], recomputed: Mapping[str, Any]
) -> tuple[tuple[Mismatch, ...], Rounding, int]:
    """Compare all values of recorded and recomputed results.

    Returns
    -------
    differences : tuple of Mismatch
        Values that differ by more than the tolerances.
    is_same_number : Rounding
    compared : int
        Number of compared values.
    """
    command = str(recomputed["provenance"]["command"])
    # with these options all numbers depend on an estimated time offset or alignment
    is_estimate_everywhere = not {"auto", "--position"}.isdisjoint(command.split())
    recorded_values, new_values = dict(flatten(recorded)), dict(flatten(recomputed))
    pairs = {
        path: (recorded_values.get(path, _ABSENT), new_values.get(path, _ABSENT))
        for path in {**new_values, **recorded_values}
        if not path.startswith(MACHINE_PATHS)
    }
    is_near_by_path = {
        path: _is_near(path, *pair, is_estimate_everywhere or path.startswith(ESTIMATE_PATHS))
        for path, pair in pairs.items()
        if all(map(is_number, pair))
    }
    near_pairs = (pairs[path] for path, is_near in is_near_by_path.items() if is_near)
    is_same_number = Rounding(tuple((float(a), float(b)) for a, b in near_pairs if a != b))
    wrong_paths = [path for path, is_near in is_near_by_path.items() if not is_near]
    wrong_paths += [
        path
        for path in pairs
        if path not in is_near_by_path and not _is_same(*pairs[path], is_same_number)
    ]
    mismatches = (
        Mismatch(one_line(path, MAX_TEXT_LENGTH), *map(_format_value, pairs[path]))
        for path in wrong_paths
    )
    return tuple(mismatches), is_same_number, len(pairs)


# marker of a missing value
_ABSENT = object()


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield paths (keys joined by dots) and values of nested mappings and lists.

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
    """Return True for a number that is not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_near(path: str, submitted: float, recomputed: float, is_estimate: bool) -> bool:
    if isinstance(recomputed, int):
        return abs(submitted - recomputed) <= (
            MAX_MORE_ITERATIONS if path.endswith(ITERATIONS_FIELD) else 0
        )
    relative, absolute = (
        (ESTIMATE_RELATIVE_TOLERANCE, ESTIMATE_ABSOLUTE_TOLERANCE)
        if is_estimate
        else (RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE)
    )
    return abs(submitted - recomputed) <= relative * abs(recomputed) + absolute


def _is_same(submitted: Any, recomputed: Any, rounded: TextComparison) -> bool:
    """Return True if two values are equal, texts up to the rounding of their numbers."""
    if isinstance(submitted, str) and isinstance(recomputed, str):
        return is_same_text_rounded(submitted, clean_text(recomputed), rounded)
    return type(submitted) is type(recomputed) and bool(submitted == recomputed)


def is_same_text_rounded(one: str, other: str, is_same_number: TextComparison) -> bool:
    """Return True if two texts are equal up to the rounding of their numbers.

    >>> is_same_text_rounded("0.15 m", "0.16 m", lambda one, other: True)
    True
    >>> is_same_text_rounded("0.15 m", "0.15 s", lambda one, other: True)
    False
    """
    if one == other:
        return True
    # the pieces are alternately text and number
    pieces, other_pieces = _NUMBER.split(one), _NUMBER.split(other)
    numbers = zip(pieces[1::2], other_pieces[1::2], strict=False)
    return pieces[::2] == other_pieces[::2] and all(
        a == b or is_same_number(a, b) for a, b in numbers
    )


def _decimals(number: str) -> int:
    """Count the decimals of a printed number.

    >>> _decimals("0.15"), _decimals("3"), _decimals("1.2e-3")
    (2, 0, 4)
    """
    mantissa, _, exponent = number.partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def _format_value(value: Any) -> str:
    return "absent" if value is _ABSENT else one_line(str(value), MAX_TEXT_LENGTH)
