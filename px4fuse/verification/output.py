"""Output of ``px4fuse verify``: JSON and terminal."""

import hashlib
from dataclasses import asdict
from pathlib import Path

from px4fuse.core.text import shorten_to_line
from px4fuse.report.page import Page
from px4fuse.report.style import GOOD_COLOUR, SEVERITY_COLOURS

from .model import Verification
from .verification import VERIFICATION_SCOPE_NOTE

SCHEMA = {"name": "px4fuse-verification", "version": "3.0"}


def make_verification_output(pdf: bytes, verification: Verification) -> dict[str, object]:
    """Return the JSON output of ``px4fuse verify``."""
    values = asdict(verification)
    # the JSON output omits the fields that only px4fuse grade needs
    for name in ("redrawn_pdf", "remedy", "missing"):
        del values[name]
    return {
        "schema": SCHEMA,
        "report_sha256": hashlib.sha256(pdf).hexdigest(),
        "outcome": verification.outcome,
        **values,
        "limit": VERIFICATION_SCOPE_NOTE,
    }


def verification_page(name: str, verification: Verification, output: Path | None) -> Page:
    """Format the terminal output of ``px4fuse verify``."""
    page = Page()
    colour_by_outcome = {"verified": GOOD_COLOUR, "cannot verify": SEVERITY_COLOURS["warning"]}
    colour = colour_by_outcome.get(verification.outcome, SEVERITY_COLOURS["error"])
    page.write(f"{shorten_to_line(name, 200)}: {verification.outcome}", bold=True, colour=colour)
    sentences = [
        shorten_to_line(reason, 400)
        for reason in verification.reasons
        if reason != VERIFICATION_SCOPE_NOTE
    ]
    sentences += [
        f"{difference.path}: report {difference.recorded}, re-computed {difference.recomputed}"
        for difference in verification.differences
    ]
    for sentence in sentences:
        page.write(sentence, indent=12.0)
    if output is not None and not verification.redrawn_pdf:
        page.write(
            "px4fuse did not write the output file (-o), because it could not repeat the analysis."
        )
    elif output is None and verification.pages:
        page.write("Action: write the recomputed report with -o FILE.pdf, and read FILE.pdf.")
    page.write_muted_text(VERIFICATION_SCOPE_NOTE)
    return page
