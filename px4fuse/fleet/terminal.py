"""What ``px4fuse batch`` says when it is done."""

from px4fuse.findings import named
from px4fuse.fleet.rows import BETWEEN_FINDINGS, FAILED
from px4fuse.fleet.run import Fleet
from px4fuse.plain import factor_words
from px4fuse.report.page import Page
from px4fuse.report.style import MUTED, SEVERITY_COLOURS

# Reasons why logs are not compared, findings and what is worse
SHOWN = 8
RED, YELLOW = SEVERITY_COLOURS["error"], SEVERITY_COLOURS["warning"]


def summary(fleet: Fleet) -> Page:
    """What could not be compared, both filters by axis, findings and what is worse."""
    page, logs = Page(), fleet.table.drop_duplicates("log")
    alone = logs[logs["axis"] == ""].groupby(["status", "reason", "remedy"], sort=False)["log"]
    causes = alone.agg(["count", "first"]).reset_index()
    most = causes.sort_values("count", ascending=False, kind="stable")
    for cause in most.head(SHOWN).to_dict("records"):
        one = "" if cause["count"] == 1 else f"{cause['count']} logs, one is "
        text = "{first}: {status}: {reason}. {remedy}".format_map(cause).rstrip()
        page.write(one + text, colour=RED if cause["status"] == FAILED else YELLOW)
    if len(most) > SHOWN:
        page.write(f"{len(most) - SHOWN} more reasons are in fleet.html.")
    heads = [f"{whose}\n{what}" for whose in ("ours", "EKF2") for what in ("logs", "factor")]
    lines = []
    for axis, rows in fleet.table[fleet.table["axis"] != ""].groupby("axis", sort=False):
        cells = []
        for factors in (rows["kf_factor"].dropna(), rows["ekf2_factor"].dropna()):
            cells += [f"{len(factors)}", factor_words(factors.median()) if len(factors) else "–"]
        lines.append((str(axis), *cells))
    if lines:
        page.table(("axis", *heads), lines, right=(1, 2, 3, 4))
        told = "factor: median of how many times √S is overstated (above 1)"
        page.write(told, colour=MUTED)
    found = logs["findings"].str.split(BETWEEN_FINDINGS).explode()
    for finding, count in found[found != ""].value_counts().head(SHOWN).items():
        page.write(f"{count} × {named(str(finding))}")
    worse = fleet.table[fleet.table["change"] != ""]
    for row in worse.head(SHOWN).itertuples():
        page.write(f"worse: {row.log} {row.axis}: {row.change}", colour=RED)
    if len(worse) > SHOWN:
        page.write(f"and {len(worse) - SHOWN} more in the column change")
    page.write(fleet.against)
    counts = logs["status"].value_counts()
    said = ", ".join(f"{count} {status}" for status, count in counts.items())
    again = " The same command tries those that failed again." if FAILED in counts else ""
    page.write(f"{len(logs)} logs: {said}; {fleet.reused} as before.{again}")
    return page
