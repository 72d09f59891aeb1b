"""Terminal output of ``px4fuse explain``: detectable faults and their meaning."""

from px4fuse.core.text import capitalise_first_letter
from px4fuse.errors import SettingsError, suggest_name
from px4fuse.findings.model import (
    EFFECTS_BY_CAUSE,
    FINDING_CATALOGUE,
    FINDING_GROUPS,
    find_effect_ids,
    load_finding_examples,
)

from .page import Page


def make_findings_list() -> Page:
    """List all types of findings that px4fuse can report."""
    page = Page()
    for group in FINDING_GROUPS:
        page.write_heading(capitalise_first_letter(group))
        rows = [
            (name, finding.title)
            for name, finding in FINDING_CATALOGUE.items()
            if finding.group == group
        ]
        page.add_table(("id", "finding"), rows)
    return page


def make_finding_page(finding_id: str) -> Page:
    """Explain a detectable fault (finding): meaning, example, causes and effects.

    Raises
    ------
    SettingsError
        The id is unknown.
    """
    name = finding_id.lower().replace("-", "_")
    if name not in FINDING_CATALOGUE:
        raise SettingsError(
            f"unknown finding id {finding_id!r}",
            f"{suggest_name(name, FINDING_CATALOGUE)}For a list of findings, run px4fuse explain.",
        )
    finding, example = FINDING_CATALOGUE[name], load_finding_examples()[name]
    causes = [cause for cause in EFFECTS_BY_CAUSE if name in find_effect_ids(cause)]
    page = Page()
    page.write(f"{finding.title}  [{name}]", bold=True)
    page.write_labelled_text("Meaning", finding.meaning)
    if example.message:
        page.write_labelled_text("Example", example.message)
        page.write_labelled_text("Action", example.remedy)
    for label, text, finding_ids in (
        ("Causes", f"Findings that can cause {name}", causes),
        ("Effects", f"Findings that {name} can cause", find_effect_ids(name)),
    ):
        if finding_ids:
            page.write_labelled_text(label, f"{text}: {', '.join(finding_ids)}")
    rate_sentences = [
        "The rates of false alarms and of detection have not been measured for this finding."
    ]
    if example.fault_free_flight_count:
        detection_rate_texts = [
            f"{name}: {100.0 * rate:.0f} %"
            for name, rate in example.detection_rate_by_fault.items()
        ]
        rate_sentences = [
            f"False alarms: {example.false_alarm_count} of {example.fault_free_flight_count} "
            "simulated flights without an injected fault.",
            "Detected fraction of the simulated flights with the injected fault: "
            f"{'; '.join(detection_rate_texts)}.",
        ]
    page.write_labelled_text("Rates", *rate_sentences)
    return page
