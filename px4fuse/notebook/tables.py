"""Results in words and as tables; importing this module teaches them both."""

from collections.abc import Iterator
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTERS, AxisComparison, Comparison
from px4fuse.display import frame, words
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2.whatif import Summary, WhatIf
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.tuning import AxisTuning, Noise
from px4fuse.findings import SEVERITIES, find
from px4fuse.findings.story import story
from px4fuse.flight import Columns, Ekf2, Flight, Truth, Unavailable, sample_rate
from px4fuse.loop.model import Loop
from px4fuse.record import Record, written
from px4fuse.report.evaluation import interval_words, summary
from px4fuse.report.loop import closure_words
from px4fuse.report.words import settings_words, verdict_words
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.model import AXES_OF_FRAME, Trajectory
from px4fuse.trajectory.scores import PairwiseError

EKF2 = "EKF2"
OURS = "our filter"
WIDTH = 100
# Standard deviations, by the columns of their squares
SIGMAS = {"position_variance_m2": "sigma_p_m", "velocity_variance_m2_s2": "sigma_v_m_s"}


def row(record: Any) -> dict[str, Any]:
    """A record's numbers and words by the names of its fields, parts by their field's name too.

    The ends of an interval are ``_low`` and ``_high``; what is not available is missing.
    """
    cells: dict[str, Any] = {}
    fields = {} if isinstance(record, Unavailable) else structs.asdict(written(record))
    for name, value in fields.items():
        if isinstance(value, Record):
            cells |= {f"{name}_{below}": cell for below, cell in row(value).items()}
        elif isinstance(value, tuple) and len(value) == 2:
            cells |= {f"{name}_low": number(value[0]), f"{name}_high": number(value[1])}
        elif value is None or isinstance(value, int | float | str):
            cells[name] = np.nan if value is None else value
    return cells


def number(value: Any) -> float:
    """A number of a table; what is not available is missing there."""
    return np.nan if value is None or isinstance(value, Unavailable) else float(value)


def tracks(flight: Flight) -> Iterator[tuple[str, pd.DataFrame]]:
    """Every position over time that a flight has, by name."""
    for track in flight.positions:
        yield track.name, track.samples
    if isinstance(flight.ekf2, Ekf2):
        yield EKF2, flight.ekf2.state
    if isinstance(flight.truth, Truth):
        yield f"truth, {flight.truth.name}", flight.truth.samples


# -- a flight --------------------------------------------------------------------------------------


@words.register
def _(flight: Flight) -> str:
    log, airborne = flight.log, flight.airborne
    flown = ""
    if not isinstance(airborne, Unavailable) and airborne:
        flown = f", in the air {airborne[0][0]:.1f} to {airborne[-1][1]:.1f} s"
    head = f"{log.name}: {log.format}, {log.firmware}, {log.duration_s:.1f} s{flown}"
    has = [f"{name} at {sample_rate(samples):.1f} Hz" for name, samples in tracks(flight)]
    return f"{head}\n{'; '.join(has) or 'no position'}"


@frame.register
def _(flight: Flight) -> pd.DataFrame:
    """Positions, one below the other: ``track, time_s, north_m, east_m, down_m``."""
    parts = [
        samples[Columns.POSITION].reset_index().assign(track=name)
        for name, samples in tracks(flight)
    ]
    columns = ["track", "time_s", *Columns.POSITION]
    if not parts:
        return pd.DataFrame(columns=columns)
    return pd.concat(parts, ignore_index=True)[columns]


# -- a comparison ----------------------------------------------------------------------------------


def _filters(result: AxisComparison) -> tuple[tuple[str, Any], ...]:
    return tuple(zip((OURS, EKF2), (result.filters[name] for name in FILTERS), strict=True))


@words.register
def _(result: AxisComparison) -> str:
    parts = []
    for name, judged in _filters(result):
        if name == EKF2 and isinstance(result.ekf2_state, Unavailable):
            parts.append(f"no {name}")
            continue
        said = _nis(judged)
        if not isinstance(judged.truth, Unavailable):
            said += f", {judged.truth.position_rmse_m:.3g} m RMS from the truth"
        parts.append(f"{name} {said}")
    return f"{result.axis.name}: {'; '.join(parts)}"


def _nis(statement: Consistency | Unavailable) -> str:
    if isinstance(statement, Unavailable):
        return f"not judged ({statement.reason})"
    return f"mean NIS {statement.nis_mean:.2f} ({verdict_words(statement)})"


@words.register
def _(statement: Consistency) -> str:
    low, high = statement.nis_band
    return (
        f"{_nis(statement)}, 95 % band {low:.2f} to {high:.2f}, {statement.count} innovations of "
        f"{statement.innovation_std_m:.3g} m (standard deviation) where √S is "
        f"{statement.sqrt_s_median_m:.3g} m"
    )


@words.register
def _(comparison: Comparison) -> str:
    segment = comparison.segment
    return "\n".join(
        [
            f"{comparison.flight.log.name}, {segment.start_s:.1f} to {segment.end_s:.1f} s, "
            f"{comparison.source.name}; {settings_words(comparison.settings)}",
            *map(words, comparison.axes.values()),
        ]
    )


@words.register
def _(analysis: Analysis) -> str:
    found = find(analysis)
    lines = [f"{analysis.flight.log.name}, {settings_words(analysis.settings)}"]
    for sentence in story(analysis, found):
        lines += wrap(sentence, WIDTH)
    for severity in SEVERITIES:
        named = (one.id for one in found if one.severity == severity and one.caused_by is None)
        if names := ", ".join(named):
            lines += wrap(f"{severity}: {names}", WIDTH)
    return "\n".join(lines)


@frame.register
def _(statement: Consistency) -> pd.DataFrame:
    return pd.DataFrame([row(statement)])


@frame.register
def _(comparison: Comparison) -> pd.DataFrame:
    """A row per axis and filter."""
    table = pd.DataFrame(
        {"axis": result.axis.name, "filter": name} | row(summary)
        for result in comparison.axes.values()
        for name, summary in _filters(result)
    )
    return table.astype({"count": "Int64"}) if "count" in table else table


@frame.register
def _(result: AxisComparison) -> pd.DataFrame:
    """Over time, at the filter's steps; EKF2 and truth interpolated, innovations at updates."""
    steps, updates = result.replay.steps, result.replay.updates
    table = pd.DataFrame(index=steps.index)
    for owner, state, variance in (
        ("kf", steps, steps),
        ("ekf2", result.ekf2_state, result.ekf2_variance),
        ("truth", result.truth, None),
    ):
        if isinstance(state, pd.DataFrame):
            for column in ("position_m", "velocity_m_s"):
                table[f"{owner}_{column}"] = _at(state[column], steps.index)
        if isinstance(variance, pd.DataFrame):
            for column, name in SIGMAS.items():
                table[f"{owner}_{name}"] = np.sqrt(_at(variance[column], steps.index))
    table["measurement_m"] = updates["measurement_m"]
    table["kf_innovation_m"] = updates["innovation_m"]
    table["kf_sqrt_s_m"] = np.sqrt(updates["innovation_variance_m2"])
    return table


def _at(series: pd.Series, times: pd.Index) -> Any:
    return np.interp(times, series.index, series, left=np.nan, right=np.nan)


@words.register
def _(why: Why) -> str:
    return "\n".join(line for sentence in why.sentences for line in wrap(sentence, WIDTH))


@frame.register
def _(why: Why) -> pd.DataFrame:
    """What each step brings our filter nearer to EKF2, in mean square."""
    rows = [
        (step.name, step.position_mean_square_m2, step.velocity_mean_square_m2_s2)
        for step in why.steps
    ]
    rows += [("left", why.position_left_mean_square_m2, why.velocity_left_mean_square_m2_s2)]
    columns = ["step", "position_mean_square_m2", "velocity_mean_square_m2_s2"]
    return pd.DataFrame(rows, columns=columns)


# -- noises and clock ------------------------------------------------------------------------------


@words.register
def _(tuning: AxisTuning) -> str:
    return (
        f"{tuning.name}: SIGMA_A {noise_words(tuning.filter_sigma_a)} m/s², SIGMA_Z "
        f"{noise_words(tuning.sigma_z)} m (95 %); {len(tuning.outlier_time_s)} of {tuning.count} "
        "measurements are outliers"
    )


def noise_words(noise: Noise) -> str:
    """A noise and its interval, without a unit."""
    if noise.value is None:
        ends = (("at most", noise.high), ("at least", noise.low))
        known = (f"{word} {end:.2g}" for word, end in ends if end is not None)
        return next(known, "not determinable")
    low = "0" if noise.low is None else f"{noise.low:.2g}"
    high = "?" if noise.high is None else f"{noise.high:.2g}"
    return f"{noise.value:.3g} ({low}-{high})"


@frame.register
def _(tuning: AxisTuning) -> pd.DataFrame:
    return pd.DataFrame([{"axis": tuning.name} | row(tuning)])


@words.register
def _(clock: ClockOffset) -> str:
    if not clock.determinable:
        return f"clock offset not determinable: {clock.reason}"
    low, high = clock.interval_s
    return f"clock offset {clock.offset_s:+.3f} s to add (95 %: {low:+.3f} to {high:+.3f} s)"


@frame.register
def _(clock: ClockOffset) -> pd.DataFrame:
    """The whole flight first, then its consecutive parts."""
    rows = [{"part": "flight", "offset_s": clock.offset_s, "sigma_s": clock.sigma_s}]
    rows += [{"part": f"part {at}"} | row(part) for at, part in enumerate(clock.parts, 1)]
    return pd.DataFrame(rows, columns=["part", "start_s", "end_s", "offset_s", "sigma_s"])


@words.register
def _(heading: HeadingError) -> str:
    ends = (f"{part.heading_error_deg:+.1f}°" for part in heading.ends)
    changes = f"from {' to '.join(ends)}" if heading.drifts else "the same all along"
    return (
        f"the source's frame is turned by {heading.turn_deg:+.1f}° (± {heading.sigma_deg:.1f}) "
        f"against the vehicle's heading, {changes} (by the {heading.by})"
    )


@frame.register
def _(heading: HeadingError) -> pd.DataFrame:
    return pd.DataFrame([row(part) for part in heading.parts])


# -- paths -----------------------------------------------------------------------------------------


@words.register
def _(trajectory: Trajectory) -> str:
    oriented = "" if trajectory.rotation is not None else ", positions only"
    start, end = trajectory.time_s[[0, -1]]
    return (
        f"{trajectory.name}: {len(trajectory):,} poses in {trajectory.frame}, {start:.2f} to "
        f"{end:.2f} s{oriented}"
    )


@frame.register
def _(trajectory: Trajectory) -> pd.DataFrame:
    names = [f"{axis}_m" for axis in AXES_OF_FRAME[trajectory.frame]]
    table = pd.DataFrame(
        trajectory.position_m, pd.Index(trajectory.time_s, name="time_s"), columns=names
    )
    if trajectory.rotation is not None:
        table[Columns.QUATERNION] = trajectory.rotation.as_quat(scalar_first=True)
    return table


@words.register
def _(loop: Loop) -> str:
    path = loop.odometry.trajectory
    lines = wrap(f"{path.name}: {closure_words(loop)}", WIDTH)
    for reference in loop.references:
        scores = ((path.name, path.scores.get(reference.name)) for path in loop.reported)
        found = ", ".join(
            f"{name} {score.ate.translation_m.rmse:.3g} m"
            for name, score in scores
            if isinstance(score, Evaluation)
        )
        lines += [f"ATE to {reference.name}: {found}"] if found else []
    return "\n".join(lines)


@frame.register
def _(loop: Loop) -> pd.DataFrame:
    """A row per path and reference."""
    rows: list[dict[str, Any]] = []
    for path in loop.reported:
        moved = {"path": path.name, "moved_max_m": float(path.moved_m.max())}
        for name, score in path.scores.items():
            ate = score.ate.translation_m.rmse if isinstance(score, Evaluation) else np.nan
            rows.append(moved | {"reference": name, "ate_rmse_m": ate})
        rows += [] if path.scores else [moved]
    return pd.DataFrame(rows, columns=["path", "moved_max_m", "reference", "ate_rmse_m"])


@words.register
def _(found: Evaluation) -> str:
    within = interval_words(found.ate.interval_m)
    lines = wrap(summary(found) + (f" RMSE, 95 %: {within} m." if within else ""), WIDTH)
    return "\n".join([*lines, *map(words, found.rpe)])


@frame.register
def _(found: Evaluation) -> pd.DataFrame:
    """ATE, then the RPE over each delta; over poses, or pairs of them."""
    return pd.DataFrame(
        [{"score": "ATE"} | row(found.ate)]
        + [{"score": f"RPE {part.delta_words}"} | row(part) for part in found.rpe]
    )


@words.register
def _(part: PairwiseError) -> str:
    if isinstance(part.translation_m, Unavailable):
        return f"RPE over {part.delta_words}: {part.translation_m.reason}"
    found = part.translation_m
    return f"RPE over {part.delta_words}: {found.rmse:.3g} m, {found.count} pairs"


@frame.register
def _(part: PairwiseError) -> pd.DataFrame:
    """Every pair: its poses, as indices into the evaluation, and its errors."""
    columns = ("start", "end", "translation_error_m", "rotation_error_deg")
    return pd.DataFrame({column: getattr(part, column) for column in columns})


# -- what if ---------------------------------------------------------------------------------------


def variants(found: WhatIf) -> list[tuple[str, Summary]]:
    """Every EKF2 of a what-if, by what was changed."""
    changed = [
        (", ".join(f"{name}={value:g}" for name, value in part.changed.items()) or "as flown", part)
        for part in found.whatif
    ]
    return [("logged", found.logged), ("replayed", found.replayed), *changed]


@words.register
def _(found: WhatIf) -> str:
    lines = []
    for name, part in variants(found):
        truth = part.position_rmse_to_truth_m
        lines.append(
            f"{name}: mean NIS {part.nis_mean:.2f}, {part.rejected_share:.1%} rejected"
            + ("" if isinstance(truth, Unavailable) else f", {truth:.3g} m RMS from the truth")
        )
    return "\n".join(lines)


@frame.register
def _(found: WhatIf) -> pd.DataFrame:
    return pd.DataFrame({"ekf2": name} | row(part) for name, part in variants(found))
