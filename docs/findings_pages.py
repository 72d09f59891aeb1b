"""Write one Markdown page per finding: meaning, example, action, error rates and thresholds.

The examples are findings on simulated flights. ``px4fuse explain`` prints them from a file. Update
this file after a change of messages or rates:

    python docs/findings_pages.py --examples
"""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib import pyplot
from scipy.interpolate import CubicSpline

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "studies")]

from comparisons import compare  # noqa: E402
from exchange import replace  # noqa: E402
from flights import aisle_flight, unexplained, with_noises  # noqa: E402
from source_errors import coloured, held, laid_over, two_levels, white  # noqa: E402
from test_aids import aid_log, outage_free, steps  # noqa: E402
from test_convention import examples as convention_examples  # noqa: E402
from test_findings import FAULTS, TUNED_IDS  # noqa: E402
from test_loop import LAP_S, TRUE, GivenClosure, OdometryNoise, laps  # noqa: E402
from test_source_values import examples as value_examples  # noqa: E402

import px4fuse  # noqa: E402
from px4fuse.analysis import Analysis  # noqa: E402
from px4fuse.diagnose import diagnose_comparison  # noqa: E402
from px4fuse.ekf2.aids import evaluate_aids  # noqa: E402
from px4fuse.filter.frame_rotation import HeadingErrorInPart, combine_heading_parts  # noqa: E402
from px4fuse.filter.settings import Settings  # noqa: E402
from px4fuse.finding import Finding  # noqa: E402
from px4fuse.findings import find, find_aid_findings, find_loop_findings, source_frame  # noqa: E402
from px4fuse.findings.model import (  # noqa: E402
    EFFECTS_BY_CAUSE,
    FINDING_CATALOGUE,
    FINDING_GROUPS,
    FINDING_TITLES,
    find_effect_ids,
    load_finding_examples,
)
from px4fuse.flight.model import AidLog, Columns  # noqa: E402
from px4fuse.report.panels import INNOVATIONS_PANEL, POSITION_PANEL, POSITION_SIGMA_PANEL  # noqa: E402
from px4fuse.simulation.faults import parse_faults  # noqa: E402
from px4fuse.simulation.flights import simulate_flight  # noqa: E402
from px4fuse.simulation.scenario import Scenario  # noqa: E402

add_time_correlated_errors, add_two_noise_levels = (
    partial(coloured, tau_s=0.5, share=1.0),
    partial(two_levels, factor=3.0),
)
SIGMA_Z_BY_AXIS_M = (0.05, 0.2, 0.1)
FINDINGS_FOLDER = ROOT / "px4fuse" / "findings"
EXAMPLES_PATH = FINDINGS_FOLDER / "examples.json"
# Findings that no simulated flight shows; their examples in examples.json are of recorded flights
FINDING_IDS_WITH_RECORDED_EXAMPLE = {
    "ekf2_acceleration_bad",
    "ekf2_bias_at_limit",
    "ekf2_gps_delay_wrong",
    "ekf2_not_aligned",
    "gyroscope_bias",
    "imu_values_impossible",
    "parameter_changed",
    "source_coordinate_constant",
    "source_height_constant",
    "source_relocalises",
}
MAX_LABEL_LINE_LENGTH = 26  # maximum number of characters in a line of an axis label
# For each finding id: faults (option --mistake of px4fuse simulate) and KF settings that cause the
# finding
FAULTS_AND_SETTINGS_BY_FINDING_ID: Mapping[str, tuple[tuple[str, ...], Mapping[str, float]]] = {
    "accelerometer_bias": (("accel-bias",), {}),
    "ekf2_ev_delay_wrong": (("ekf2-delay=250ms",), {}),
    "ekf2_gate_too_small": (("ekf2-gate",), {}),
    "ekf2_noise_too_large": (("ekf2-noise=50cm",), {}),
    "ekf2_noise_too_small": (("ekf2-noise=5cm",), {}),
    "source_time_offset": (("clock-offset",), {}),
    "source_time_offset_changes": (("clock-drift=8000ppm",), {}),
    "source_timestamps_are_arrival_times": (("clock-jump",), {}),
    "source_outliers": (("nlos",), {}),
    "source_frame_misaligned": (("yaw",), {}),
    "source_scale_error": (("scale=15%",), {}),
    "source_position_jump": (("jump",), {}),
    "source_low_pass_filtered": (("smoothed",), {}),
    "source_downsampled": (("decimate=3Hz",), {}),
    "source_reported_variance_wrong": (("r-scale",), {}),
    "sigma_a_too_small": ((), {"sigma_a_m_s2": 0.03}),
    "sigma_a_too_large": ((), {"sigma_a_m_s2": 5.0}),
    "sigma_z_too_small": ((), {"sigma_z_m": 0.02}),
    "sigma_z_too_large": ((), {"sigma_z_m": 0.5}),
}


@dataclass(frozen=True)
class ExampleFlight:
    """Flight with a finding: finding, description of the flight, and its analysis for plots."""

    finding: Finding
    flight: str
    analysis: Analysis | None = None


def simulate_late_timestamps() -> list[Finding]:
    """Simulate attitude timestamps that are 0.2 s late, and positions that arrive later and later.

    Return the findings on both faults.
    """
    flight = simulate_flight(Scenario(passes=4, seed=2))
    age_s = pd.Series(np.linspace(0.03, 0.2, 100), index=np.linspace(5.0, 60.0, 100))
    record = replace(flight.ekf2.record, vision_age_s=age_s)
    flight = replace(
        flight,
        attitude=flight.attitude.set_axis(flight.attitude.index + 0.2),
        ekf2=replace(flight.ekf2, record=record),
    )
    faults = ("attitude_late", "source_latency_varies")
    return [finding for finding in find(unexplained(compare(flight))) if finding.id in faults]


def rename_axes(log: AidLog, **names: str) -> AidLog:
    """Rename the axes of simulated innovations, for use as innovations of another sensor.

    ``names`` contains the new name of each axis to keep. All other axes are omitted.
    """
    columns = {
        f"{quantity}_{old}": f"{quantity}_{new}"
        for old, new in names.items()
        for quantity in ("innovation", "variance", "noise", "ratio")
    }
    return replace(log, axes=tuple(names.values()), samples=log.samples.rename(columns=columns))


def collect_examples() -> dict[str, ExampleFlight]:
    """Return an example of each finding, by finding id."""
    example_by_id: dict[str, ExampleFlight] = {}

    def add_examples(findings: Any, flight: str, analysis: Analysis | None = None) -> None:
        for finding in findings:
            example_by_id.setdefault(finding.id, ExampleFlight(finding, flight, analysis))

    for name, (faults, settings) in FAULTS_AND_SETTINGS_BY_FINDING_ID.items():
        flight = simulate_flight(Scenario(passes=4, seed=2), parse_faults(faults))
        analysis = diagnose_comparison(compare(flight, Settings(**settings)))
        command = " ".join(["px4fuse simulate", *(f"--mistake {fault}" for fault in faults)])
        options = [f"--{key[:7].replace('_', '-')} {value:g}" for key, value in settings.items()]
        settings_text = f", analysed with `compare {' '.join(options)}`" if options else ""
        findings = [finding for finding in find(analysis) if finding.id == name]
        add_examples(findings, f"a flight of `{command}`{settings_text}", analysis)
    for model in (
        add_time_correlated_errors,
        partial(held, share=0.2),
        partial(white, sigma=SIGMA_Z_BY_AXIS_M),
        add_two_noise_levels,
    ):
        flight = simulate_flight(Scenario(passes=4, seed=2, ekf2=False))
        truth = flight.truth.samples[Columns.POSITION].dropna()
        true_position_m = CubicSpline(truth.index.to_numpy(), truth.to_numpy())
        analysis = diagnose_comparison(
            compare(laid_over(flight, true_position_m, model, 10.0, 2), Settings())
        )
        findings = [finding for finding in find(analysis) if finding.id.startswith("source_")]
        add_examples(
            findings,
            "a simulated flight with position errors from `tests/studies/source_errors.py`",
            analysis,
        )
    for options, drift_option in (
        ({"source": "sample_logs/loop_vio.ulg", "position_drift_m": 0.3}, "--drift 0.3"),
        ({"source": "sample_logs/aisle_uwb.ulg:ekf2"}, ""),
        ({"source": "sample_logs/loop_slam.tum"}, ""),
    ):
        loop_options = {**options, "source": f"{ROOT}/{options['source']}"}
        command = f"px4fuse loop {options['source']} {drift_option}".strip()
        add_examples(
            find_loop_findings(px4fuse.close_loop(**loop_options)), f"the result of `{command}`"
        )
    add_examples(
        convention_examples(), "a simulated loop flight with artificial faults of the positions"
    )
    add_examples(value_examples(), "a simulated test flight")
    _, odometry = laps(3, 5, OdometryNoise())
    wrong_closure = GivenClosure(20.0, 21.5 + LAP_S, 0.05)
    findings = find_loop_findings(px4fuse.close_loop(odometry, closures=(*TRUE, wrong_closure)))
    add_examples(findings, "simulated odometry of three laps")
    _, odometry = laps(3, 5, OdometryNoise(5.0, 20.0))
    add_examples(
        find_loop_findings(px4fuse.close_loop(odometry, closures=TRUE)),
        "simulated odometry of three laps",
    )
    heading_errors_of_parts = [
        HeadingErrorInPart(2.0 * n, 2.0 * n + 2.0, angle_deg, 1.0)
        for n, angle_deg in enumerate((-36.0, -20.0, -9.0))
    ]
    aisle_analysis = unexplained(compare(aisle_flight(duration_s=20.0), axes=("north",)))
    drift_analysis = replace(
        aisle_analysis,
        heading=combine_heading_parts(tuple(heading_errors_of_parts), 1e-9, "positions"),
    )
    add_examples(source_frame.detect(drift_analysis), "a heading estimate with simulated drift")
    flight = aisle_flight(duration_s=60.0)
    log_with_outage = aid_log(enabled=steps((0.0, 1.0)))
    log_with_outage = replace(log_with_outage, samples=outage_free(log_with_outage, 20.0, 41.0))
    log_with_innovation_change = aid_log()
    log_with_innovation_change.samples.loc[35.0:, "innovation_east"] -= 0.7
    aids = {"gnss_pos": log_with_outage, "baro_hgt": aid_log(sigma=1.5),
            "mag": rename_axes(aid_log(mean=-0.4), north="x", east="y"),
            "mag_heading": rename_axes(log_with_innovation_change, east="yaw")}  # fmt: skip
    aid_results = evaluate_aids(replace(flight, ekf2=replace(flight.ekf2, aids=aids)))
    add_examples(
        find_aid_findings(aid_results, flight), "simulated innovations of the aiding sources"
    )
    add_examples(
        simulate_late_timestamps(), "a simulated flight with artificial faults of the timestamps"
    )
    for fault in FAULTS:
        if fault.id in example_by_id:
            continue
        comparison = compare(fault.fly(), Settings(**fault.settings))
        analysis = (with_noises if fault.id in TUNED_IDS else unexplained)(comparison)
        findings = [finding for finding in find(analysis) if finding.id == fault.id]
        add_examples(findings, "a simulated test flight", analysis)
    return example_by_id


def find_detector_modules() -> dict[str, str]:
    """Return the module name of the detector of each finding, by finding id."""
    module_by_finding_id: dict[str, str] = {}
    for path in sorted(FINDINGS_FOLDER.glob("*.py")):
        if path.stem in ("cause_text", "model", "__init__"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in FINDING_TITLES:
                module_by_finding_id.setdefault(str(node.value), path.stem)
    # A finding id that a module composes of a name and a suffix does not appear in the source code
    # of the module, so the module is stated here
    for name in FINDING_TITLES:
        if name.startswith("sigma_") or name.endswith("confident"):
            module_by_finding_id[name] = "noises"
        elif name.startswith("ekf2_noise_"):
            module_by_finding_id[name] = "ekf2_settings"
    return module_by_finding_id


def is_numeric_literal(expression: ast.expr) -> bool:
    """Return True for a number or a tuple of numbers, False for text and for named constants."""
    try:
        return bool(np.issubdtype(np.asarray(ast.literal_eval(expression)).dtype, np.number))
    except ValueError:
        return False


def format_threshold_rows(module_name: str) -> Iterator[str]:
    """Yield a Markdown table row with value and comment of each constant of a detector module."""
    source = (FINDINGS_FOLDER / f"{module_name}.py").read_text(encoding="utf-8")
    lines = source.splitlines()
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and isinstance(
            node.value, ast.Constant | ast.UnaryOp | ast.Tuple
        ):
            name, line = ast.unparse(node.targets[0]), lines[node.lineno - 1]
            lines_above = takewhile(
                lambda text: text.startswith("# "), lines[node.lineno - 2 :: -1]
            )
            comment_above = " ".join(reversed([text.removeprefix("# ") for text in lines_above]))
            comment = line.partition("  # ")[2] or comment_above
            if name.isupper() and is_numeric_literal(node.value):
                comment = comment.replace("|", r"\|")
                yield f"| `{name}` | {ast.unparse(node.value)} | {comment} |"


def read_detection_rates() -> pd.DataFrame:
    """Read false alarm and detection rates of the findings, measured on simulated flights."""
    return pd.read_csv(ROOT / "tests" / "studies" / "rates.csv")


def format_rate_rows(name: str) -> Iterator[str]:
    """Yield Markdown table rows with the false alarm and detection rates of a finding."""
    table = read_detection_rates()
    for row in table[table["finding"] == name].itertuples():
        yield (
            f"| {row.condition} | {row.scenario} | {row.flights} | {100.0 * row.rate:.0f} % | "
            f"{100.0 * row.low:.0f} to {100.0 * row.high:.0f} % |"
        )


def format_page(name: str, example: ExampleFlight | None, folder: Path) -> Iterator[str]:
    """Yield the Markdown paragraphs of the page on a finding."""
    entry = FINDING_CATALOGUE[name]
    yield f"# {entry.title}\n\n`{name}` ({entry.group})\n"
    yield f"## What it means\n\n{entry.meaning}\n"
    causes = [cause for cause in EFFECTS_BY_CAUSE if name in find_effect_ids(cause)]
    effects = find_effect_ids(name)
    if causes:
        yield "The finding can be a consequence of: " + format_finding_links(causes) + ".\n"
    if effects:
        yield "Possible consequences of the finding: " + format_finding_links(effects) + ".\n"
    if entry.report_class == "recording":
        yield "Findings about the recording are listed before findings about noise settings.\n"
    if example is not None:
        finding = example.finding
        yield f"## Example\n\nSeverity: *{finding.severity}*. Example from {example.flight}:\n"
        yield f"> {finding.message}\n"
        if example.analysis is not None:
            file = save_picture(name, example, folder)
            yield f"![Position, innovations and σ of the example flight]({file})\n"
        yield f"## What to do\n\n> {finding.remedy}\n"
    error_rate_rows = list(format_rate_rows(name))
    if error_rate_rows:
        yield "## False alarms and detection\n"
        yield "The rates were measured on simulated flights. In flights with the fault `none`,"
        yield "each finding is a false alarm.\n"
        yield "| fault | kind of flight | number of flights | rate of the finding | 95 % interval |"
        yield "|---|---|---|---|---|"
        yield "\n".join(error_rate_rows) + "\n"
    module_name = find_detector_modules()[name]
    rows = list(format_threshold_rows(module_name))
    if rows:
        yield "## Thresholds\n"
        yield f"The file `px4fuse/findings/{module_name}.py` defines these thresholds."
        yield "Other findings also use some of these thresholds.\n"
        yield "| name | value | meaning |\n|---|---|---|"
        yield "\n".join(rows) + "\n"


def format_finding_links(names: Iterable[str]) -> str:
    """Format Markdown links to the pages of other findings."""
    return ", ".join(f"[{FINDING_TITLES[name]}]({name}.md)" for name in dict.fromkeys(names))


def collect_finding_examples_and_rates(
    simulated_example_by_id: Mapping[str, ExampleFlight],
) -> dict[str, Any]:
    """Return an example message, its action, and the error rates of each finding.

    ``px4fuse explain`` prints them. Error rates: false alarms, and detection of each fault.
    """
    table, recorded_example_by_id, contents = read_detection_rates(), load_finding_examples(), {}
    for name in FINDING_TITLES:
        rows = table[table["finding"] == name]
        fault_free_rows = rows[rows["condition"] == "none"]
        example = (
            simulated_example_by_id[name].finding
            if name in simulated_example_by_id
            else recorded_example_by_id[name]
        )
        contents[name] = {
            "message": example.message,
            "remedy": example.remedy,
            "fault_free_flight_count": int(fault_free_rows["flights"].sum()),
            "false_alarm_count": round(
                float((fault_free_rows["flights"] * fault_free_rows["rate"]).sum())
            ),
            "detection_rate_by_fault": {
                row.condition: row.rate for row in rows[rows["condition"] != "none"].itertuples()
            },
        }
    return contents


def write_examples() -> None:
    """Write the examples for ``px4fuse explain`` to ``examples.json``."""
    text = json.dumps(
        collect_finding_examples_and_rates(collect_examples()), ensure_ascii=False, indent=1
    )
    EXAMPLES_PATH.write_text(f"{text}\n", encoding="utf-8")


def save_picture(name: str, example: ExampleFlight, folder: Path) -> str:
    """Plot position, innovations and σ of an example along one axis; return the file name."""
    axis = example.finding.evidence.get("axis")
    assert example.analysis is not None
    axis_analysis = example.analysis.axes.get(str(axis)) or example.analysis.main
    figure, axes_list = pyplot.subplots(3, sharex=True, figsize=(8, 7), layout="constrained")
    drawn_panels = (POSITION_PANEL, INNOVATIONS_PANEL, POSITION_SIGMA_PANEL)
    for axes, panel in zip(axes_list, drawn_panels, strict=True):
        panel.draw(axes, axis_analysis.with_whole_flight_tracks())
        axes.set_ylabel(fill(panel.title, MAX_LABEL_LINE_LENGTH))
    axes_list[0].set_title(axis_analysis.axis.name)
    axes_list[-1].set_xlabel("time (s)")
    figure.savefig(folder / f"{name}.png", dpi=70)
    return f"{name}.png"


def format_index() -> Iterator[str]:
    """Yield the Markdown paragraphs of the index, with a table for each group of findings."""
    yield "# Findings\n\n`px4fuse explain ID` prints the page on a finding in the terminal.\n"
    for group in FINDING_GROUPS:
        names = [name for name, entry in FINDING_CATALOGUE.items() if entry.group == group]
        caption = group[0].upper() + group[1:]
        yield f"## {caption}\n\n| finding | id |\n|---|---|"
        yield "\n".join(f"| [{FINDING_TITLES[name]}]({name}.md) | `{name}` |" for name in names)
        yield f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n"
        yield "\n".join(names) + "\n```\n"


def write_finding_pages(folder: Path) -> None:
    """Write the index and the pages of all findings."""
    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    example_by_id = collect_examples()
    missing_ids = set(FINDING_TITLES) - set(example_by_id) - FINDING_IDS_WITH_RECORDED_EXAMPLE
    assert not missing_ids, f"these findings have no example: {sorted(missing_ids)}"
    for name in FINDING_TITLES:
        text = "\n".join(format_page(name, example_by_id.get(name), folder))
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
        pyplot.close("all")
    (folder / "index.md").write_text("\n".join(format_index()), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1] == "--examples":
        write_examples()
    else:
        write_finding_pages(Path(sys.argv[1]))
