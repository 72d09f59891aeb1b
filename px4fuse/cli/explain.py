"""Command ``px4fuse explain``: meaning, example, false alarms and detection of a finding."""

import click

from .outputs import write_and_print_results


@click.command()
@click.argument("finding", required=False)
def explain(finding: str | None) -> None:
    """Explain a finding: meaning, example, action, false alarms.

    FINDING is an id that px4fuse compare prints, such as source_outliers. Without FINDING, the
    ids of all findings are listed.
    """
    from px4fuse.report.explanation import make_finding_page, make_findings_list

    write_and_print_results(
        {}, make_findings_list() if finding is None else make_finding_page(finding)
    )
