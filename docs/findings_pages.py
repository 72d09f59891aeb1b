"""Pages of the findings, each from its detector's file and from a flight on which it is found.

``write(folder)`` makes ``index.md`` and ``<id>.md`` for every name in
``px4fuse.findings.NAMES``. Words, thresholds and remedies are the detector's own; the
flights are those of the tests, and simulated ones; the rates are ``tests/studies/rates.csv``.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib import pyplot
from scipy.interpolate import CubicSpline

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "studies")]

from exchange import replace  # noqa: E402
from flights import aisle_flight, unexplained, with_noises  # noqa: E402
from source_errors import coloured, held, laid_over, two_levels, white  # noqa: E402
from test_aids import aid_log, outage_free, steps  # noqa: E402
from test_findings import FAULTS  # noqa: E402
from test_loop import LAP_S, TRUE, GivenClosure, OdometryNoise, laps  # noqa: E402

import px4fuse  # noqa: E402
from px4fuse.analysis import Analysis, explain  # noqa: E402
from px4fuse.comparison.comparison import compare  # noqa: E402
from px4fuse.ekf2.aids import evaluate_aids  # noqa: E402
from px4fuse.filter.heading import HeadingPart, combine_heading_parts  # noqa: E402
from px4fuse.filter.settings import Settings  # noqa: E402
from px4fuse.findings import NAMES, Finding, find, find_aids, find_loop, source_frame  # noqa: E402
from px4fuse.findings.causes import CONSEQUENCES, RECORDING, SETTINGS  # noqa: E402
from px4fuse.flight import Columns, Unavailable  # noqa: E402
from px4fuse.report.panels import (  # noqa: E402
    ERROR,
    INNOVATIONS,
    POSITION,
    SIGMA_P,
    error_reference,
)
from px4fuse.simulation.flights import simulate_flight  # noqa: E402
from px4fuse.simulation.mistakes import parse  # noqa: E402
from px4fuse.simulation.scenario import Scenario  # noqa: E402

slow, louder = partial(coloured, tau_s=0.5, share=1.0), partial(two_levels, factor=3.0)
UNEQUAL_M = (0.05, 0.2, 0.1)
MEANINGS = tomllib.loads(Path(__file__).with_name("meanings.toml").read_text(encoding="utf-8"))
FINDINGS = ROOT / "px4fuse" / "findings"
LABEL_WIDTH = 26  # characters per line of an axis label
# What `px4fuse simulate` is told, with the settings of the comparison, to show a finding
SIMULATED: Mapping[str, tuple[tuple[str, ...], Mapping[str, float]]] = {
    "accelerometer_bias": (("accel-bias",), {}),
    "ekf2_ev_delay_wrong": (("ekf2-delay",), {}),
    "ekf2_gate_small": (("ekf2-gate",), {}),
    "source_clock_offset": (("clock-offset",), {}),
    "source_clock_changes": (("clock-drift=8000ppm",), {}),
    "source_stamps_of_arrival": (("clock-jump",), {}),
    "source_outliers": (("nlos",), {}),
    "source_frame_turned": (("yaw",), {}),
    "source_scale_wrong": (("scale=15%",), {}),
    "source_jumps": (("jump",), {}),
    "source_smoothed": (("smoothed",), {}),
    "source_thinned": (("decimate=3Hz",), {}),
    "source_variance_wrong": (("r-scale",), {}),
    "sigma_a_small": ((), {"sigma_a_m_s2": 0.03}),
    "sigma_a_large": ((), {"sigma_a_m_s2": 5.0}),
    "sigma_z_small": ((), {"sigma_z_m": 0.02}),
    "sigma_z_large": ((), {"sigma_z_m": 0.5}),
}


@dataclass(frozen=True)
class Example:
    """A finding as it was told, on which flight, and what can be drawn of that."""

    finding: Finding
    flight: str
    analysis: Analysis | None = None


def examples() -> dict[str, Example]:
    """An example of every finding that one could be made of."""
    made: dict[str, Example] = {}

    def keep(found: Any, flight: str, analysis: Analysis | None = None) -> None:
        for one in found:
            made.setdefault(one.id, Example(one, flight, analysis))

    for name, (typed, settings) in SIMULATED.items():
        flight = simulate_flight(Scenario(passes=4, seed=2), parse(typed))
        analysis = explain(compare(flight, Settings(**settings)))
        words = " ".join(["px4fuse simulate", *(f"--mistake {each}" for each in typed)])
        options = [f"--{key[:7].replace('_', '-')} {value:g}" for key, value in settings.items()]
        compared = f", compared with `{' '.join(options)}`" if options else ""
        found = [one for one in find(analysis) if one.id == name]
        keep(found, f"`{words}`{compared}", analysis)
    for model in (slow, partial(held, share=0.2), partial(white, sigma=UNEQUAL_M), louder):
        flight = simulate_flight(Scenario(passes=4, seed=2, ekf2=False))
        truth = flight.truth.samples[Columns.POSITION].dropna()
        known = CubicSpline(truth.index.to_numpy(), truth.to_numpy())
        analysis = explain(compare(laid_over(flight, known, model, 10.0, 2), Settings()))
        found = [one for one in find(analysis) if one.id.startswith("source_")]
        keep(found, "errors of `tests/studies/source_errors.py` on a simulated flight", analysis)
    for options, words in (
        ({"source": "sample_logs/loop_vio.ulg", "position_drift_m": 0.3}, "--drift 0.3"),
        ({"source": "sample_logs/aisle_uwb.ulg:ekf2"}, ""),
        ({"source": "sample_logs/loop_slam.tum"}, ""),
    ):
        made_of = {**options, "source": f"{ROOT}/{options['source']}"}
        typed = f"px4fuse loop {options['source']} {words}".strip()
        keep(find_loop(px4fuse.close_loop(**made_of)), f"`{typed}`")
    _, odometry = laps(3, 5, OdometryNoise())
    wrong = GivenClosure(20.0, 21.5 + LAP_S, 0.05)
    keep(
        find_loop(px4fuse.close_loop(odometry, closures=(*TRUE, wrong))), "three laps of the tests"
    )
    _, odometry = laps(3, 5, OdometryNoise(5.0, 20.0))
    keep(find_loop(px4fuse.close_loop(odometry, closures=TRUE)), "three laps of the tests")
    parts = [
        HeadingPart(2.0 * n, 2.0 * n + 2.0, at, 1.0) for n, at in enumerate((-36.0, -20.0, -9.0))
    ]
    still = unexplained(compare(aisle_flight(duration_s=20.0), axes=("north",)))
    drifts = replace(still, heading=combine_heading_parts(tuple(parts), 1e-9, "positions"))
    keep(source_frame.detect(drifts), "an estimate that was made up")
    flight = aisle_flight(duration_s=60.0)
    silent = aid_log(enabled=steps((0.0, 1.0)))
    silent = replace(silent, samples=outage_free(silent, 20.0, 41.0))
    changed = aid_log()
    changed.samples.loc[35.0:, "innovation_east"] -= 0.7
    aids = {"gnss_pos": silent, "baro_hgt": aid_log(sigma=1.5), "mag": aid_log(mean=-0.4),
            "mag_heading": changed}  # fmt: skip
    judged = evaluate_aids(replace(flight, ekf2=replace(flight.ekf2, aids=aids)))
    keep(find_aids(judged), "innovations that were made up")
    for fault in FAULTS:
        if fault.id in made:
            continue
        comparison = compare(fault.fly(), Settings(**fault.settings))
        tuned = fault.id in SETTINGS or "sigma_z_asked_m" in fault.evidence
        analysis = with_noises(comparison) if tuned else unexplained(comparison)
        keep(
            [one for one in find(analysis) if one.id == fault.id], "a flight of the tests", analysis
        )
    return made


def written_in() -> dict[str, tuple[str, str]]:
    """Of each finding the file whose detector names it, and what that detector says of itself."""
    found: dict[str, tuple[str, str]] = {}
    for path in sorted(FINDINGS.glob("*.py")):
        if path.stem in ("causes", "story", "model", "__init__"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]:
            words = [n.value for n in ast.walk(function) if isinstance(n, ast.Constant)]
            for name in [word for word in words if word in NAMES]:
                said = ast.get_docstring(function) or ast.get_docstring(tree) or ""
                found.setdefault(str(name), (path.stem, said))
    # those whose names are put together there
    said = ast.get_docstring(ast.parse((FINDINGS / "noises.py").read_text(encoding="utf-8")))
    for name in NAMES:
        if name.startswith(("sigma_", "kf_var", "ekf2_var")):
            found.setdefault(name, ("noises", said or ""))
    return found


def thresholds(stem: str) -> Iterator[str]:
    """Rows of a table of a file's thresholds, with what stands beside them."""
    source = (FINDINGS / f"{stem}.py").read_text(encoding="utf-8")
    lines = source.splitlines()
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant | ast.UnaryOp):
            name, line = ast.unparse(node.targets[0]), lines[node.lineno - 1]
            before = lines[node.lineno - 2]
            said = line.partition("  # ")[2] or (before[2:] if before.startswith("# ") else "")
            if name.isupper():
                said = said.replace("|", r"\|")
                yield f"| `{name}` | {ast.unparse(node.value)} | {said} |"


def rates(name: str) -> Iterator[str]:
    """Rows of the table of how often it is found."""
    table = pd.read_csv(ROOT / "tests" / "studies" / "rates.csv")
    for row in table[table["finding"] == name].itertuples():
        yield (
            f"| {row.condition} | {row.scenario} | {row.flights} | {row.rate:.0%} | "
            f"{row.low:.0%} to {row.high:.0%} |"
        )


def page(name: str, example: Example | None, folder: Path) -> Iterator[str]:
    """One finding's page."""
    stem, said = written_in()[name]
    title = NAMES[name]
    yield f"# {title[0].upper()}{title[1:]}\n\n`{name}`\n"
    yield f"## What it means\n\n{MEANINGS[name]}\n"
    yield f"In the detector's own words: {' '.join(said.split())}\n"
    causes = [cause for cause, brought in CONSEQUENCES.items()
              if any(each.partition(":")[0] == name for each in brought)]  # fmt: skip
    follows = [each.partition(":")[0] for each in CONSEQUENCES.get(name, ())]
    if causes:
        yield "It is told behind its cause where there is one of: " + links(causes) + ".\n"
    if follows:
        yield "It explains, and is told before: " + links(follows) + ".\n"
    if name in RECORDING:
        yield "It is about the recording, and is told before what is said about noises.\n"
    if example is not None:
        finding = example.finding
        kind = {"error": "an *error*", "warning": "a *warning*", "info": "a *remark*"}
        yield f"## How it looks\n\nOn {example.flight}, as {kind[finding.severity]}:\n"
        yield f"> {finding.message}\n"
        if example.analysis is not None:
            yield f"![Error, innovations and σ of that flight]({picture(name, example, folder)})\n"
        yield f"## What to do\n\n> {finding.remedy}\n"
    found = list(rates(name))
    if found:
        yield "## How often\n"
        yield "On simulated flights (`none`: without a mistake, so a false alarm):\n"
        yield "| mistake | flights of | flights | found | 95 % |\n|---|---|---|---|---|"
        yield "\n".join(found) + "\n"
    rows = list(thresholds(stem))
    if rows:
        yield "## Thresholds\n"
        yield f"In `px4fuse/findings/{stem}.py`, in part shared with its other findings:\n"
        yield "| name | value | |\n|---|---|---|"
        yield "\n".join(rows) + "\n"


def links(names: list[str]) -> str:
    """Links to other findings."""
    return ", ".join(f"[{NAMES[name]}]({name}.md)" for name in dict.fromkeys(names))


def picture(name: str, example: Example, folder: Path) -> str:
    """Draw the main axis of the example's flight."""
    axis = example.finding.evidence.get("axis")
    assert example.analysis is not None
    shown = example.analysis.axes.get(str(axis)) or example.analysis.main
    error = POSITION if isinstance(error_reference(shown), Unavailable) else ERROR
    figure, panels = pyplot.subplots(3, sharex=True, figsize=(8, 7), layout="constrained")
    for axes, panel in zip(panels, (error, INNOVATIONS, SIGMA_P), strict=True):
        panel.draw(axes, shown)
        axes.set_ylabel(fill(panel.named(shown), LABEL_WIDTH))
    panels[0].set_title(shown.axis.name)
    panels[-1].set_xlabel("time (s)")
    figure.savefig(folder / f"{name}.png", dpi=70)
    return f"{name}.png"


def write(folder: Path) -> None:
    """Write all pages anew."""
    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    made = examples()
    assert set(made) >= set(NAMES), f"no example: {sorted(set(NAMES) - set(made))}"
    for name in NAMES:
        text = "\n".join(page(name, made.get(name), folder))
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
        pyplot.close("all")
    (folder / "index.md").write_text(
        "# The findings\n\nWhat px4fuse calls by its name, in the order in which it is told. "
        "Each page is made from the detector's own file.\n\n"
        "| finding | id |\n|---|---|\n"
        + "\n".join(f"| [{title}]({name}.md) | `{name}` |" for name, title in NAMES.items())
        + "\n\n```{toctree}\n:hidden:\n\n"
        + "\n".join(NAMES)
        + "\n```\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    write(Path(sys.argv[1]))
