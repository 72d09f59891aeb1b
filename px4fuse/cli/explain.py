"""Command ``px4fuse explain``: prints the meaning, an example and the error rates of a finding."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from px4fuse.cli.outputs import write_and_print
from px4fuse.errors import SettingsError, suggest_name

if TYPE_CHECKING:
    from px4fuse.report.page import Page


@click.command()
@click.argument("finding", required=False)
def explain(finding: str | None) -> None:
    """Explain a finding: meaning, example, action, false alarms.

    FINDING is an id that px4fuse compare prints, such as source_outliers. Without FINDING, the
    ids of all findings are listed.
    """
    write_and_print({}, _list_page() if finding is None else _finding_page(finding))


def _list_page() -> Page:
    from px4fuse.findings.model import CATALOGUE, GROUPS
    from px4fuse.report.page import Page

    page = Page()
    for group in GROUPS:
        page.heading(group[0].upper() + group[1:])
        rows = [(name, entry.title) for name, entry in CATALOGUE.items() if entry.group == group]
        page.table(("id", "finding"), rows)
    return page


def _finding_page(finding_id: str) -> Page:
    from px4fuse.findings.cause_grouping import CONSEQUENCES, effect_ids
    from px4fuse.findings.model import CATALOGUE, load_examples
    from px4fuse.report.page import Page

    name = finding_id.lower().replace("-", "_")
    if name not in CATALOGUE:
        raise SettingsError(
            f"{finding_id!r} is not a finding",
            f"{suggest_name(name, CATALOGUE)}For a list of findings, run px4fuse explain.",
        )
    entry, example = CATALOGUE[name], load_examples()[name]
    causes = [cause for cause in CONSEQUENCES if name in effect_ids(cause)]
    page = Page()
    page.write(f"{entry.title}  [{name}]", bold=True)
    page.write_labelled("Meaning", entry.meaning)
    if example.message:
        page.write_labelled("Example", example.message)
        page.write_labelled("Action", example.remedy)
    for label, names in {"Causes": causes, "Effects": effect_ids(name)}.items():
        if names:
            page.write_labelled(label, ", ".join(names))
    rates = ["False alarms and detection are not measured for this finding."]
    if example.clean_flights:
        rate_texts = [f"{name}: {100.0 * rate:.0f} %" for name, rate in example.detection.items()]
        rates = [
            f"False alarms occurred on {example.false_alarms} of {example.clean_flights} simulated "
            "flights without an injected fault.",
            "Fraction of simulated flights on which the injected fault is detected: "
            f"{'; '.join(rate_texts)}.",
        ]
    page.write_labelled("Rates", *rates)
    return page
