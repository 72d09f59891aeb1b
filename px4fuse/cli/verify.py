"""Command ``px4fuse verify``: repeats the analysis of a report, and compares the numbers."""

import sys
from functools import partial
from pathlib import Path

import click

from px4fuse.core.reading import display_name, hash_files, read_bytes_limited
from px4fuse.errors import LogError

from .options import InputPath, json_option, max_size_option, open_option, output_option
from .outputs import (
    check_output_paths,
    make_result_files,
    progress,
    write_and_print_results,
)

# Maximum time (s) to repeat an analysis; a flight of 10 minutes takes about 60 s
ANALYSIS_TIMEOUT_S = 1800.0


@click.command()
@click.argument("report", type=InputPath(), metavar="REPORT.pdf")
@click.argument("logs", type=InputPath(), nargs=-1, metavar="[LOG ...]")
@max_size_option
@output_option("FILE.pdf", "Report to write, recomputed from the log (PDF).  [default: none]")
@json_option
@open_option
def verify(
    report: Path, logs: tuple[Path, ...], output: Path | None, json_path: Path | None
) -> None:
    """Verify that the numbers of REPORT.pdf follow from its log.

    LOG is the flight log and all other input files of the report, or folders with these files;
    px4fuse finds them by SHA-256. Repeats the analysis with the settings in the report, and lists
    numbers and pages that differ. Verifies the numbers, not the author. Without LOG nothing is
    verified.

    Exit code 0: verified; 1: differences, another log, or not verifiable; 2: invalid input.
    """
    from px4fuse.core.workers import JobFailure, run_one_with_limits
    from px4fuse.verification.output import make_verification_output, verification_page
    from px4fuse.verification.pdf_input import MAX_PDF_BYTES, read_report
    from px4fuse.verification.verification import verify as verify_report

    name = display_name(report)
    content = read_bytes_limited(
        report, LogError, MAX_PDF_BYTES, remedy_if_too_large="Give a PDF report that px4fuse wrote."
    )
    recorded_results = read_report(content, name)
    with progress(json_path) as show_progress:
        show_progress("computing the SHA-256 of the logs")
        file_by_sha256 = hash_files(logs)
        check_output_paths([json_path, output])
        if logs and not file_by_sha256:
            raise LogError(
                "The folders given as LOG contain no files. Give the flight log or its folder."
            )
        show_progress("repeating the analysis of the report")
        verification = run_one_with_limits(
            partial(verify_report, pdf=content, path_by_sha256=file_by_sha256),
            recorded_results,
            ANALYSIS_TIMEOUT_S,
        )
    if isinstance(verification, JobFailure):
        raise LogError(f"{name} cannot be verified: {verification.reason}")
    pdf_by_path = (
        {} if output is None or not verification.redrawn_pdf else {output: verification.redrawn_pdf}
    )
    contents = pdf_by_path | make_result_files(
        make_verification_output(content, verification), json_path
    )
    write_and_print_results(contents, verification_page(name, verification, output))
    sys.exit(0 if verification.outcome == "verified" else 1)
