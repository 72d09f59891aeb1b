"""Verification of a report (PDF): repeat its analysis on the log, and compare numbers and pages.

Verification confirms that the numbers follow from the log. It does not confirm the author.

The settings in the PDF may be forged. They are decoded strictly, and cannot name an output file.
Input files are found by SHA-256, never by name.
"""

import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from px4fuse.core.text import clean_text, join_first_names, shorten_to_line
from px4fuse.errors import Px4FuseError, SettingsError
from px4fuse.results.contract import (
    ComparisonResults,
    LoopResults,
    ReportedResults,
    to_json,
    to_json_dict,
)
from px4fuse.results.model import LIBRARIES, Provenance

from .model import Mismatch, PageStatus, Verification, VerificationStatus
from .pages import TextComparison, compare_pages

ASK_AUTHOR_REMEDY = (
    "Ask the author how the report was made, and for its log and all other input files."
)
INVALID_COMMAND_REASON = "the command in the report is not a command of px4fuse"
# Minimum KF prediction interval DT (s); the analysis with smaller values would take too long
MIN_REPEATABLE_DT_S = 0.01
ORIGINAL_PDF_REMEDY = "Ask the author of the report for the PDF that px4fuse wrote."
VERIFICATION_SCOPE_NOTE = (
    "Verification confirms that the numbers result from the log. It does not confirm who "
    "wrote the report."
)
NO_LOG_REASON = "no log was given, so the analysis could not be repeated"
# Relative tolerance of numbers; results of four types of processors differ by at most 3e-8
RESULT_RELATIVE_TOLERANCE = 1e-6
# Absolute tolerance of numbers, for the comparison of a report with a new analysis
RESULT_ABSOLUTE_TOLERANCE = 1e-9
# Relative tolerance of maximum-likelihood estimates, whose cost function is flat at its minimum
ESTIMATE_RELATIVE_TOLERANCE = 1e-3
# Absolute tolerance of maximum-likelihood estimates
ESTIMATE_ABSOLUTE_TOLERANCE = 1e-5
# Fields of the results that contain maximum-likelihood estimates, or depend on them
ESTIMATE_FIELDS = (
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
# Field of the results with the number of iterations of a solver
ITERATIONS_FIELD = "iterations"
# Maximum difference in the number of solver iterations: another processor may stop earlier
MAX_SOLVER_ITERATION_DIFFERENCE = 2
# Fields of the results that are not compared, because they describe the computer
MACHINE_DEPENDENT_FIELDS = ("provenance.python", "provenance.libraries")
MAX_LISTED_DIFFERENCES = 20
MAX_LISTED_PAGE_DIFFERENCES = 5
MAX_TEXT_LENGTH = 120
# Factors by which a result is multiplied before it is printed (per cent; mm or ms)
RESULT_TO_PRINTED_UNIT_FACTORS = (1.0, 100.0, 1000.0)
# Maximum number of lines of a student's notes in a report; a page has 60 lines
MAX_NOTES_LINES = 5_000
_NUMBER_PATTERN = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")

# Logs and other input files
PathBySha256 = Mapping[str, Path]
# Results of the new analysis, and a function that draws the PDF of these results
RecomputedReport = tuple[ReportedResults, Callable[[], bytes]]
# Function that links an input file into a temporary folder and returns the path of the link;
# arguments: file name, SHA-256, label for messages
_LinkInputFile = Callable[[str, str | None, str], str]


class NotRepeatableError(Exception):
    """Reason why an analysis cannot be repeated, with remedy and missing file."""


def log_sha256(results: ReportedResults) -> str:
    return results.track.sha256 if isinstance(results, LoopResults) else results.log.sha256


def recompute_report(
    results: ReportedResults, path_by_sha256: PathBySha256
) -> RecomputedReport | Verification:
    """Repeat the analysis of a submitted report with the settings in its ``results``.

    Return a verification with the status "cannot verify" if the analysis fails.
    """
    try:
        if tuple(results.provenance.libraries) != LIBRARIES:
            raise NotRepeatableError("the results do not list the library versions of px4fuse")
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            link_input_file = partial(_link_input_file, path_by_sha256, Path(folder))
            if isinstance(results, LoopResults):
                analysis, new_results = _repeat_loop_analysis(results, link_input_file)
            else:
                analysis, new_results = _repeat_comparison(results, link_input_file)
        return new_results, partial(_draw_report, analysis, new_results, results.provenance)
    except SettingsError as error:  # px4fuse cannot have made a report with invalid settings
        return make_unverifiable_result(f"{INVALID_COMMAND_REASON}: {error}")
    except NotRepeatableError as error:
        return make_unverifiable_result(*error.args)
    except Px4FuseError as error:
        return make_unverifiable_result(str(error))
    except Exception as error:  # noqa: BLE001 - forged settings may fail anywhere
        reason = f"the analysis with the settings in the report failed ({type(error).__name__})"
        return make_unverifiable_result(reason)


def _link_input_file(
    path_by_sha256: PathBySha256, folder: Path, name: str, sha256: str | None, file_label: str
) -> str:
    """Link the file with this SHA-256 into a temporary folder, and return the path of the link.

    The link keeps the file name, which the report prints.
    """
    path = None if sha256 is None else path_by_sha256.get(sha256)
    if path is None:
        missing_file_name = shorten_to_line(name, 80) or "the file"
        reason = f"none of the given files has the SHA-256 of {file_label}"
        raise NotRepeatableError(
            reason, f"Add {missing_file_name} to the --logs folder.", missing_file_name
        )
    if name != Path(name).name or name == ".." or "\\" in name or not name.isprintable():
        raise NotRepeatableError(
            f"{INVALID_COMMAND_REASON}: a file name contains a folder or unprintable characters"
        )
    # a separate folder for each link, because file names may be equal
    target = Path(tempfile.mkdtemp(dir=folder), name)
    try:
        target.symlink_to(path.resolve())
    except OSError:  # symbolic links need administrator rights on Windows
        shutil.copyfile(path, target)
    return str(target)


def split_track(source: str) -> tuple[str, str]:
    """Split ``LOG:vio`` into the file ``LOG`` and the track ``:vio`` ("" without a track)."""
    from px4fuse.loop.tracks import TRACK_NAMES  # noqa: PLC0415

    file_name, separator, track = source.rpartition(":")
    return (file_name, f":{track}") if separator and track in TRACK_NAMES else (source, "")


def _repeat_comparison(
    submitted_results: ComparisonResults, link_input_file: _LinkInputFile
) -> tuple[object, ReportedResults]:
    """Repeat the analysis of a report of ``px4fuse compare``.

    The analysis reads the linked files, which ``link_input_file`` finds by their hash. The results
    contain the paths of the report.
    """
    from px4fuse.diagnose import diagnose  # noqa: PLC0415
    from px4fuse.results.build import make_comparison_results  # noqa: PLC0415

    recorded_request = submitted_results.request
    if recorded_request.dt_s < MIN_REPEATABLE_DT_S:
        raise NotRepeatableError(
            f"the KF prediction interval DT is below {MIN_REPEATABLE_DT_S:g} s, so the analysis "
            "would take too long"
        )
    hash_by_role = {file.role: file.sha256 for file in submitted_results.log.joined}
    request = replace(
        recorded_request,
        log=link_input_file(recorded_request.log, submitted_results.log.sha256, "the log"),
    )
    if (position := recorded_request.position) is not None:
        link_path = link_input_file(position.path, hash_by_role.get("position"), "--position")
        request = replace(request, position=replace(position, path=link_path))
    analysis = diagnose(request)
    return analysis, make_comparison_results(recorded_request, analysis, submitted_results.student)


def _repeat_loop_analysis(
    submitted_results: LoopResults, link_input_file: _LinkInputFile
) -> tuple[object, ReportedResults]:
    """Repeat the analysis of a report of ``px4fuse loop``; see :func:`_repeat_comparison`."""
    from px4fuse.diagnose import analyse_loop_closure  # noqa: PLC0415
    from px4fuse.results.build import make_loop_results  # noqa: PLC0415

    recorded_request = submitted_results.request
    path, track = split_track(recorded_request.source)
    link_path = link_input_file(path, submitted_results.track.sha256, "the log")
    request = replace(recorded_request, source=link_path + track)
    if recorded_request.reference is not None:
        path, track = split_track(recorded_request.reference)
        # The reference given by the user is the last, after ground truth in the log
        sha256 = submitted_results.references[-1].sha256 if submitted_results.references else None
        request = replace(request, reference=link_input_file(path, sha256, "--reference") + track)
    analysis = analyse_loop_closure(request)
    return analysis, make_loop_results(recorded_request, analysis, submitted_results.student)


def _draw_report(
    analysis: object, results: ReportedResults, submitted_provenance: Provenance
) -> bytes:
    """Draw the report, but print the library versions of the submitted report.

    Other library versions on this computer are thus no difference of the pages.
    """
    from px4fuse.report.pdf import render_pdf  # noqa: PLC0415

    new_provenance = replace(submitted_provenance, command=results.provenance.command)
    return render_pdf(analysis, replace(results, provenance=new_provenance), to_json(results))


# ------------------------------------------------------------------ the verdict


def verify(results: ReportedResults, pdf: bytes, path_by_sha256: PathBySha256) -> Verification:
    """Verify a report: repeat its analysis, draw it again, and compare numbers and pages.

    Parameters
    ----------
    results : ComparisonResults or LoopResults
        Results attached to the report.
    pdf : bytes
        Content of the report file.
    path_by_sha256 : mapping of str to Path
        Logs and other input files by SHA-256.
    """
    report_version, installed_version = results.provenance.px4fuse, metadata.version("px4fuse")
    if report_version != installed_version:
        reason = (
            f"the report was made with px4fuse {report_version}; the installed version is "
            f"{installed_version}"
        )
        return make_unverifiable_result(reason, f"Verify the report with px4fuse {report_version}.")
    log_name = (
        split_track(results.track.name)[0] if isinstance(results, LoopResults) else results.log.name
    )
    log_file_name = shorten_to_line(log_name, 80) or "the log"
    if not path_by_sha256:
        return make_unverifiable_result(
            NO_LOG_REASON, f"Add {log_file_name} to the --logs folder.", log_file_name
        )
    sha256 = log_sha256(results)
    if sha256 not in path_by_sha256:
        reason = f"the given files do not contain the log (SHA-256 {sha256 or 'none'})"
        remedy = f"If you have the log, add {log_file_name} to the --logs folder."
        return Verification("other log", (reason,), False, remedy=remedy, missing=log_file_name)
    if results.student.notes.count("\n") > MAX_NOTES_LINES:
        reason = f"the student's notes have more than {MAX_NOTES_LINES} lines"
        return make_unverifiable_result(reason)
    recomputed_report = recompute_report(results, path_by_sha256)
    if isinstance(recomputed_report, Verification):
        return recomputed_report
    return _compare_with_new_report(results, pdf, *recomputed_report)


def make_unverifiable_result(
    reason: str, remedy: str = ASK_AUTHOR_REMEDY, missing_input: str = ""
) -> Verification:
    """Return the status "cannot verify" with its reason."""
    reasons = (shorten_to_line(reason, 400),)
    return Verification("cannot verify", reasons, False, remedy=remedy, missing=missing_input)


def _compare_with_new_report(
    submitted_results: ReportedResults,
    pdf: bytes,
    new_results: ReportedResults,
    draw_report: Callable[[], bytes],
) -> Verification:
    """Compare a submitted report with the report of the repeated analysis."""
    redrawn_pdf = draw_report()
    if redrawn_pdf == pdf:
        return Verification(
            "verified",
            ("a new run on the log gives an identical PDF", VERIFICATION_SCOPE_NOTE),
            True,
            page_status="same",
            redrawn_pdf=redrawn_pdf,
        )
    mismatches, is_same_number, value_count = compare_results(
        to_json_dict(submitted_results), to_json_dict(new_results)
    )
    values_reason = (
        f"all {value_count} values agree with a new run on the log (within "
        f"{RESULT_RELATIVE_TOLERANCE:g}, estimates within {ESTIMATE_RELATIVE_TOLERANCE:g})"
    )
    if mismatches:
        paths_text = join_first_names([mismatch.path for mismatch in mismatches], 3)
        values_reason = (
            f"{len(mismatches)} of {value_count} values differ from a new run on the log: "
            f"{paths_text}"
        )
    page_differences = compare_pages(
        pdf, redrawn_pdf, partial(is_same_text_up_to_rounding, is_same_number=is_same_number)
    )
    page_reasons = [each.sentence for each in page_differences[:MAX_LISTED_PAGE_DIFFERENCES]]
    if (unlisted_count := len(page_differences) - MAX_LISTED_PAGE_DIFFERENCES) > 0:
        page_reasons.append(f"{unlisted_count} further differences are not listed")
    page_status: PageStatus = "differ" if page_differences else "same"
    remedy, library_reasons = "", []
    # other library versions or another PDF program may change pages without a forgery
    submitted_libraries = submitted_results.provenance.libraries.items()
    other_libraries = submitted_libraries - new_results.provenance.libraries.items()
    if page_differences and other_libraries:
        page_status = "not compared"
        versions_text = shorten_to_line(", ".join(map(" ".join, sorted(other_libraries))), 300)
        library_reasons.append(
            f"the report was made with {versions_text}; this computer has other versions, so "
            "pages may look different"
        )
        remedy = f"Verify the report with {versions_text}."
    if any(difference.is_structural for difference in page_differences):
        page_status, remedy = "not compared", ORIGINAL_PDF_REMEDY
    # the decisive reason is first: some tables show only one reason
    status: VerificationStatus = "verified"
    reasons = [values_reason, *page_reasons, VERIFICATION_SCOPE_NOTE]
    if mismatches:
        status = "numbers differ"
        reasons = [values_reason, *page_reasons, *library_reasons]
    elif page_status == "not compared":
        status = "cannot verify"
        reasons = [*page_reasons, values_reason, *library_reasons]
    return Verification(
        status,
        tuple(reasons),
        True,
        mismatches[:MAX_LISTED_DIFFERENCES],
        page_status,
        page_differences,
        redrawn_pdf,
        remedy,
    )


def is_same_number_up_to_rounding(
    agreeing_pairs: Iterable[tuple[float, float]], submitted_number: str, redrawn_number: str
) -> bool:
    """Return True if two printed numbers can be rounded values of the same result.

    ``agreeing_pairs`` contains results that agree within the tolerances: the value in the submitted
    report, and the value in the new analysis. The printed numbers must be the rounded values of one
    of these pairs.
    """
    decimals = _count_decimals(submitted_number)
    printed_pair = float(submitted_number), float(redrawn_number)
    return decimals == _count_decimals(redrawn_number) and any(
        printed_pair == (round(abs(a) * scale, decimals), round(abs(b) * scale, decimals))
        for scale in RESULT_TO_PRINTED_UNIT_FACTORS
        for a, b in agreeing_pairs
    )


def compare_results(
    recorded_results: Mapping[str, Any], new_results: Mapping[str, Any]
) -> tuple[tuple[Mismatch, ...], TextComparison, int]:
    """Compare all values in the results of a report with the results of a new analysis.

    Returns
    -------
    mismatches : tuple of Mismatch
        Values that differ by more than the tolerances.
    is_same_number : callable
        Function of two printed numbers. It returns True if they are the rounded recorded value and
        the rounded new value of the same result.
    value_count : int
        Number of compared values.
    """
    command = str(new_results["provenance"]["command"])
    # with estimated settings, all numbers depend on maximum-likelihood estimates
    has_estimated_settings = not {"auto", "--position"}.isdisjoint(command.split())
    recorded_values, new_values = dict(flatten(recorded_results)), dict(flatten(new_results))
    # value in the report and value in the new analysis; one of them may lack a value
    value_pair_by_path = {
        path: (recorded_values.get(path, _ABSENT), new_values.get(path, _ABSENT))
        for path in {**new_values, **recorded_values}
        if not path.startswith(MACHINE_DEPENDENT_FIELDS)
    }
    mismatched_paths, non_number_paths, unequal_numbers = [], [], []
    for path, (recorded_value, new_value) in value_pair_by_path.items():
        if not is_number(recorded_value) or not is_number(new_value):
            non_number_paths.append(path)
            continue
        is_estimated = has_estimated_settings or path.startswith(ESTIMATE_FIELDS)
        # collect the numbers that agree within the tolerance, but are not equal: the texts below
        # may contain them with different digits
        if not _is_within_tolerance(path, recorded_value, new_value, is_estimated):
            mismatched_paths.append(path)
        elif recorded_value != new_value:
            unequal_numbers.append((float(recorded_value), float(new_value)))
    # Compare texts after numbers. A text may contain a number that is within the tolerance, but
    # rounded to other digits: for example 0.15 for a result of 0.1549999, and 0.16 for 0.1550001
    is_same_number = partial(is_same_number_up_to_rounding, unequal_numbers)
    mismatched_paths += [
        path
        for path in non_number_paths
        if not _is_equal_after_rounding(*value_pair_by_path[path], is_same_number)
    ]
    mismatches = (
        Mismatch(
            shorten_to_line(path, MAX_TEXT_LENGTH), *map(_format_value, value_pair_by_path[path])
        )
        for path in mismatched_paths
    )
    return tuple(mismatches), is_same_number, len(value_pair_by_path)


# Mark of a value that is missing in one of two results
_ABSENT = object()


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of each element of nested mappings and lists.

    >>> [*flatten({"a": {"b.c": [1, 2]}})]
    [('a.b.c.0', 1), ('a.b.c.1', 2)]
    """
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if not isinstance(value, Mapping):
        yield path, value
        return
    for key, element in value.items():
        yield from flatten(element, f"{path}.{key}" if path else f"{key}")


def is_number(value: object) -> bool:
    """Return True for int and float, but not for bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_within_tolerance(
    path: str, submitted_number: float, new_number: float, is_estimated: bool
) -> bool:
    """Return True if a number in a report agrees with that of the repeated analysis."""
    tolerance = 0.0
    if isinstance(new_number, int):  # counts must be equal, except the iterations of a solver
        if path.endswith(ITERATIONS_FIELD):
            tolerance = MAX_SOLVER_ITERATION_DIFFERENCE
    elif is_estimated:
        tolerance = ESTIMATE_RELATIVE_TOLERANCE * abs(new_number) + ESTIMATE_ABSOLUTE_TOLERANCE
    else:
        tolerance = RESULT_RELATIVE_TOLERANCE * abs(new_number) + RESULT_ABSOLUTE_TOLERANCE
    return abs(submitted_number - new_number) <= tolerance


def _is_equal_after_rounding(
    submitted_value: Any, new_value: Any, is_same_number: TextComparison
) -> bool:
    if isinstance(submitted_value, str) and isinstance(new_value, str):
        return is_same_text_up_to_rounding(submitted_value, clean_text(new_value), is_same_number)
    return type(submitted_value) is type(new_value) and bool(submitted_value == new_value)


def is_same_text_up_to_rounding(
    first_text: str, second_text: str, is_same_number: TextComparison
) -> bool:
    """Return True if texts are equal except for numbers, which ``is_same_number`` compares.

    >>> is_same_text_up_to_rounding("0.15 m", "0.16 m", lambda one, other: True)
    True
    >>> is_same_text_up_to_rounding("0.15 m", "0.15 s", lambda one, other: True)
    False
    """
    if first_text == second_text:
        return True
    # re.split with a group returns texts at even indices, and numbers at odd indices
    first_text_parts, second_text_parts = map(_NUMBER_PATTERN.split, (first_text, second_text))
    number_pairs = zip(first_text_parts[1::2], second_text_parts[1::2], strict=False)
    return first_text_parts[::2] == second_text_parts[::2] and all(
        a == b or is_same_number(a, b) for a, b in number_pairs
    )


def _count_decimals(number: str) -> int:
    """Count the decimal places of a printed number.

    >>> _count_decimals("0.15"), _count_decimals("3"), _count_decimals("1.2e-3")
    (2, 0, 4)
    """
    mantissa, _, exponent = number.partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)


def _format_value(value: Any) -> str:
    return "absent" if value is _ABSENT else shorten_to_line(str(value), MAX_TEXT_LENGTH)
