"""``px4fuse compare``: the main job."""

import sys
from pathlib import Path
from typing import Any, Literal, get_args

import click

from px4fuse.cli import inputs, outputs
from px4fuse.request import settings_name
from px4fuse.writing import STANDARD_OUTPUT

Severity = Literal["error", "warning", "info"]
SEVERITIES = get_args(Severity)


@click.command()
@click.argument("log", type=inputs.InputPath())
@inputs.analysis_options
@inputs.person_options
@inputs.report_options(
    "The report.  [default: reports/LOG.pdf, settings that are not at their defaults in its name]"
)
@inputs.options("compare")
@inputs.open_option
def compare(
    log: Path,
    output: Path | None,
    json_path: Path | None,
    fail_on: Severity | None,
    checks: bool,
    **given: Any,
) -> None:
    """Compare a flight's EKF2 with a two-state Kalman filter over IMU and position.

    LOG is a PX4 ULog or a MAVLink recording (.tlog or raw stream). Writes a PDF report and its
    results as JSON, for example reports/LOG_sigma-z-0.05.pdf and .json.
    """
    from px4fuse.analysis import bad_verdicts, run_or_judge_aids
    from px4fuse.memory import give_back
    from px4fuse.report.terminal import summary
    from px4fuse.results.build import judged_results

    person = inputs.read_person(given)
    request = inputs.comparison_request(log, given)
    outputs.report_paths(output, json_path)  # before the work, not after it
    with outputs.progress(json_path) as step:
        found = run_or_judge_aids(request, step)
        results = judged_results(request, found, person)
        give_back()  # before anything of the report is imported
        if output is None and json_path != STANDARD_OUTPUT:
            output = outputs.default_report(log.stem, settings_name(request), results)
        contents = outputs.result_files(results, json_path, output, found, step)
    outputs.finish(contents, summary(found, results, output), request)
    bad = bad_verdicts(found) if checks else {}
    for name, verdict in bad.items():
        click.echo(f"{name}: {verdict}", err=True)
    if bad:
        sys.exit(1)
    if fail_on is not None:
        worst = SEVERITIES[: SEVERITIES.index(fail_on) + 1]
        if any(one.severity in worst and one.caused_by is None for one in results.findings):
            sys.exit(1)
