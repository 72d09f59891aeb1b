"""What the page holds of a flight: the signals that the filter runs on, EKF2, truth and marks.

Python projects, integrates and judges EKF2; the page only replays our filter.
"""

from typing import Any

import msgspec
import numpy as np
import pandas as pd
from scipy import stats

from px4fuse.analysis import Analysis
from px4fuse.comparison.interventions import CONTENT_NIS, NEES_LARGE, beyond_claim
from px4fuse.comparison.model import AgainstTruth, AxisComparison, Comparison
from px4fuse.comparison.preparation import choose_source
from px4fuse.explore.packing import COARSE, Packer
from px4fuse.filter import settings as allowed
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import CONFIDENCE, Consistency, nis_band
from px4fuse.filter.model import INITIAL_COVARIANCE
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE, Acceleration, Axis, along, imu_gaps, within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings import Finding, by_root, find
from px4fuse.findings.causes import NOISES
from px4fuse.findings.story import story
from px4fuse.flight import Columns, PositionTrack, Unavailable
from px4fuse.request import ComparisonRequest, command_line

# How far the stamps can be moved on the page; --clock-offset takes more
OFFSET_REACH_S = 0.6
# Innovations that the running mean of NIS is taken over
RUNNING = 30
# The track on the plan is drawn with at most so many points
MAX_PLAN_POINTS = 2000
# Findings that other settings would take away or bring
OF_KNOBS = frozenset(name for name in NOISES if not name.startswith("ekf2_"))


def flight_data(analysis: Analysis, packer: Packer) -> dict[str, Any]:
    """Everything about one flight, as JSON can hold it; arrays are places in the packer.

    Parameters
    ----------
    analysis : Analysis
        Made from a request.
    packer : Packer
    """
    signals = signals_of(analysis, packer)
    events, findings, request = analysis.events, find(analysis), analysis.request
    assert request is not None
    return {
        "log": analysis.flight.log.name,
        "source": analysis.source.name,
        # what innovations ask for then is no noise
        "drifts": analysis.source.origin.may_drift,
        "story": list(story(analysis, findings)),
        "settings": _settings(analysis.settings),
        "main": analysis.main.axis.name,
        **signals,
        "axes": [
            own | _others(analysis, result, packer)
            for own, result in zip(signals["axes"], analysis.axes.values(), strict=True)
        ],
        "maps": _maps(analysis),
        "plan": _plan(analysis, packer),
        "events": {
            "silent": list(events.gaps),
            "dropout": list(events.dropouts),
            "ground": list(events.ground),
            "modes": [[mode.start_s, mode.end_s, mode.name] for mode in events.modes],
            "reset": list(events.resets_s),
        },
        "findings": [
            {**_finding(first), "more": [_finding(one) for one in followers]}
            for first, *followers in by_root(findings)
        ],
        "command": _command(request, analysis),
        "offset": _offset(request, analysis),
    }


def signals_of(comparison: Comparison, packer: Packer) -> dict[str, Any]:
    """What the page's engine replays: measurements, IMU integrals, segment and start."""
    raw = raw_source(comparison)
    return {
        "segment": [comparison.segment.start_s, comparison.segment.end_s],
        "start": list(INITIAL_COVARIANCE),
        "imu": _imu(comparison, packer),
        "axes": [_signals(comparison, line, raw, packer) for line in comparison.lines],
    }


def ranges() -> dict[str, Any]:
    """What the settings may be, as the command line takes them, and the lesson's values."""
    return {
        "sigma-a": list(allowed.SIGMA_A_RANGE_M_S2),
        "sigma-z": list(allowed.SIGMA_Z_RANGE_M),
        "dt": list(allowed.DT_RANGE_S),
        "clock-offset": list(allowed.CLOCK_OFFSET_RANGE_S),
        "lesson": _settings(Settings()),
        "running": [RUNNING, *nis_band(RUNNING)],
        "hidden": [NEES_LARGE, CONTENT_NIS],
    }


def raw_source(comparison: Comparison) -> PositionTrack:
    """The comparison's source with the stamps that it came with."""
    return choose_source(comparison.flight, comparison.source.name)[0]


def _settings(settings: Settings) -> dict[str, Any]:
    return {
        "sigmaA": settings.sigma_a_m_s2,
        "sigmaZ": settings.sigma_z_m,
        "dt": settings.dt_s,
        "input": settings.input,
        "offset": settings.clock_offset_s,
    }


def _offset(request: ComparisonRequest, analysis: Analysis) -> dict[str, Any]:
    """How far the stamps can be moved, and why not where they cannot; what fits best."""
    if request.position is not None:
        return {"why": "the clock offset of a position file is spent on placing it"}
    centre, clock = analysis.settings.clock_offset_s, analysis.clock
    likely = None
    if isinstance(clock, ClockOffset) and clock.determinable:
        likely = centre + clock.remaining_s
    return {"from": centre - OFFSET_REACH_S, "to": centre + OFFSET_REACH_S, "likely": likely}


def _imu(comparison: Comparison, packer: Packer) -> dict[str, Any] | str:
    """Times, gaps and span of the acceleration; why not where there is none."""
    acceleration = comparison.lines[0].acceleration
    if isinstance(acceleration, Unavailable):
        return acceleration.reason
    time = acceleration.time_s
    gap = np.flatnonzero(imu_gaps(time))
    edges = np.stack([time[gap], time[gap + 1]], 1)
    total = np.cumsum(edges[:, 1] - edges[:, 0])
    return {
        "time": packer.add_times(time[_used(comparison, acceleration)]),
        "span": [time[0], time[-1]],
        "gapEdges": edges.ravel().tolist(),
        "gapSum": np.stack([np.concatenate([[0.0], total])[:-1], total], 1).ravel().tolist(),
    }


def _used(comparison: Comparison, acceleration: Acceleration) -> slice:
    """The samples that steps inside the segment can need, one beyond either end."""
    segment, time = comparison.segment, acceleration.time_s
    low = int(np.searchsorted(time, segment.start_s, side="right")) - 1
    high = int(np.searchsorted(time, segment.end_s)) + 1
    return slice(max(low, 0), high)


def _signals(
    comparison: Comparison, axis: Axis, raw: PositionTrack, packer: Packer
) -> dict[str, Any]:
    """One axis: measurements as they were stamped, also beyond the segment, and acceleration."""
    segment = comparison.segment
    time = raw.samples.index.to_numpy()
    value = along(raw.samples, Columns.POSITION, axis.direction)
    reach = OFFSET_REACH_S + abs(comparison.settings.clock_offset_s)
    near = (time >= segment.start_s - reach) & (time <= segment.end_s + reach)
    near &= np.isfinite(value)
    made: dict[str, Any] = {
        "name": axis.name,
        "time": packer.add_times(time[near]),
        "z": packer.add(value[near]),
    }
    if isinstance(axis.acceleration, Acceleration):
        used = axis.acceleration.integral_m_s[_used(comparison, axis.acceleration)]
        made |= {"integral": packer.add(used - used[0]), "rms": axis.acceleration.rms_m_s2}
    return made


def _others(analysis: Analysis, result: AxisComparison, packer: Packer) -> dict[str, Any]:
    """What stands beside our filter along one axis."""
    name = result.axis.name
    return {
        "called": result.axis.called,
        "heading": result.axis.heading_deg,
        "note": result.axis.note,
        "direction": result.axis.direction.tolist(),
        "bands": _bands(len(result.axis.measurement_time_s), packer),
        # the joint likelihood map of the horizontal axes where there is one, or its own
        "map": HORIZONTAL if name != "down" and HORIZONTAL in analysis.tuning else name,
        "ekf2": _ekf2(analysis, result, packer),
        "truth": _truth(result, packer),
    }


def _bands(count: int, packer: Packer) -> list[int]:
    """Bands of the mean NIS for every number of innovations: places of both ends.

    Another clock offset moves measurements into the segment and out of it.
    """
    freedom = np.arange(1, 2 * count + 1)
    ends = ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0)
    return [packer.add(np.asarray(stats.chi2.ppf(end, freedom)) / freedom, COARSE) for end in ends]


def _ekf2(analysis: Analysis, result: AxisComparison, packer: Packer) -> dict[str, Any] | str:
    """What EKF2 did, which no setting of ours changes; why not where there is none."""
    if isinstance(result.ekf2_state, Unavailable):
        return result.ekf2_state.reason
    state = result.ekf2_state.dropna()
    judged = result.filters["ekf2"]
    made: dict[str, Any] = {
        "state": _frame(state, ["position_m", "velocity_m_s"], packer),
        "variance": "",
        "innovations": "",
        "summary": _summary(judged),
        "r": None,
    }
    if isinstance(judged.truth, AgainstTruth):
        made["summary"] |= {
            "truthP": judged.truth.position_rmse_m,
            "truthV": judged.truth.velocity_rmse_m_s,
        }
    if hidden := beyond_claim(judged):
        made["summary"]["claimed"] = hidden.claimed_m
    if isinstance(result.ekf2_variance, pd.DataFrame):
        sigma = result.ekf2_variance.dropna().pow(0.5)
        made["variance"] = _frame(
            sigma, ["position_variance_m2", "velocity_variance_m2_s2"], packer
        )
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        frame = result.ekf2_innovations
        shown = frame[np.isfinite(frame["innovation_m"]) & (frame["innovation_variance_m2"] > 0)]
        used = shown.assign(
            rejected=(shown["rejected"] > 0).astype(float),
            sigma=np.sqrt(shown["innovation_variance_m2"]),
        )
        made["innovations"] = _frame(used, ["innovation_m", "sigma", "rejected"], packer)
        r = frame["observation_variance_m2"].dropna()
        made["r"] = float(np.sqrt(r.median())) if len(r) else None
    else:
        made["why"] = result.ekf2_innovations.reason
    return made


def _summary(statement: Consistency | Unavailable) -> dict[str, Any]:
    """Return EKF2's column of the page's table; the reason where there are too few innovations."""
    if isinstance(statement, Unavailable):
        return {"why": statement.reason}
    return {
        "why": "",
        "count": statement.count,
        "nis": statement.nis_mean,
        "band": list(statement.nis_band),
        "outside": statement.outside_two_sigma,
        "lag1": statement.lag1_autocorrelation,
    }


def _truth(result: AxisComparison, packer: Packer) -> dict[str, Any] | str:
    if isinstance(result.truth, Unavailable):
        return result.truth.reason
    position = result.truth[["position_m"]].dropna()
    velocity = result.truth[["velocity_m_s"]].dropna()
    return {
        "p": _frame(position, ["position_m"], packer),
        "v": _frame(velocity, ["velocity_m_s"], packer) if len(velocity) else None,
    }


def _frame(frame: pd.DataFrame, columns: list[str], packer: Packer) -> list[int]:
    """Places of the times and of some columns."""
    values = [packer.add(frame[column].to_numpy(), COARSE) for column in columns]
    return [packer.add_times(frame.index.to_numpy()), *values]


def _maps(analysis: Analysis) -> dict[str, Any]:
    """What the map of each axis shows; why not where there is none."""
    return {
        name: {
            "sigmaA": tuned.map.sigma_a_m_s2[[0, -1]].tolist(),
            "sigmaZ": tuned.map.sigma_z_m[[0, -1]].tolist(),
            "likely": [tuned.filter_sigma_a.value, tuned.sigma_z.value],
            "count": tuned.count,
        }
        if isinstance(tuned, AxisTuning)
        else tuned.reason
        for name, tuned in analysis.tuning.items()
    }


def _plan(comparison: Comparison, packer: Packer) -> list[int] | str:
    """The source's track seen from above: places of time, north and east."""
    samples = within(comparison.source.samples, comparison.segment)
    track = samples[Columns.POSITION[:2]].dropna()
    if not len(track):
        return "the source has no horizontal position"
    some = track.iloc[:: max(1, -(-len(track) // MAX_PLAN_POINTS))]
    return _frame(some, Columns.POSITION[:2], packer)


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "severity": finding.severity,
        "message": finding.message,
        "remedy": finding.remedy,
        "knobs": finding.id in OF_KNOBS,
        "spans": [list(span) for span in finding.spans_s[:20]],
        "more": [],
    }


def _command(request: ComparisonRequest, comparison: Comparison) -> dict[str, Any]:
    """The command without what the page sets, and what holds the analysed part where it is.

    The segment and the aisle are found from the stamps, so that another clock offset would move
    them: then they are said.
    """
    offset_s = None if request.position is None else request.clock_offset_s
    bare = msgspec.structs.replace(
        request, sigma_a_m_s2=0.5, sigma_z_m=None, dt_s=0.1, input=None, clock_offset_s=offset_s
    )
    heading = next((line.heading_deg for line in comparison.lines if line.name == AISLE), None)
    held = msgspec.structs.replace(
        bare,
        start_s=comparison.segment.start_s,
        end_s=comparison.segment.end_s,
        heading_deg=heading if bare.heading_deg is None else bare.heading_deg,
    )
    return {
        "bare": command_line(bare),
        "held": command_line(held),
        "input": request.input,
        "found": "zero" if isinstance(comparison.lines[0].acceleration, Unavailable) else "imu",
    }
