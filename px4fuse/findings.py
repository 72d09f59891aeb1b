"""The mistakes that px4fuse names: each a detector with evidence and a remedy that can be typed.

Thresholds are data, with unit and source. A detector looks at a :class:`Comparison` and yields
findings; it never prints and never guesses: what it cannot see it does not mention.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.comparison import AxisComparison, Comparison
from px4fuse.consistency import Consistency
from px4fuse.flight import POSITION_COLUMNS, Ekf2, Unavailable, median_rate

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, Severity, Severity] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One named mistake or condition.

    Attributes
    ----------
    id : str
        Stable, in snake case.
    severity : {"error", "warning", "info"}
        error: the comparison or the flight is misleading as it stands; warning: a number is
        wrong or blind; info: know it when you read the report.
    message : str
        One sentence.
    evidence : dict
        Numbers, with units in their names.
    remedy : str
        What to type or to set.
    """

    id: str
    severity: Severity
    message: str
    remedy: str
    evidence: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Threshold:
    """A number that a detector compares with."""

    value: float
    unit: str
    source: str


MIN_IMU_RATE = Threshold(
    50.0, "Hz", "5 IMU samples per DT of 0.1 s and 10 with margin for aliasing"
)
MIN_ATTITUDE_RATE = Threshold(10.0, "Hz", "PX4's default is 20 Hz; slerp bridges 0.1 s of a tilt")
MIN_INNOVATION_SHARE = Threshold(
    0.75, "of the source's samples", "a quarter lost biases nothing yet"
)
LOGGER_INTERVAL_TOLERANCE = Threshold(
    0.25, "of the interval", "jitter of PX4's logger seen in flights"
)
EV_START_INTERVAL = Threshold(0.2, "s", "EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp")
EV_STOP_INTERVAL = Threshold(0.4, "s", "two times EV_MAX_INTERVAL, ev_pos_control.cpp")
FUSING_SHARE_ERROR = Threshold(
    0.5, "of the segment", "below, EKF2's track is mostly not the source's"
)
FUSING_SHARE_WARNING = Threshold(0.98, "of the segment", "one second in a flight of a minute")
REJECTED_SHARE_WARNING = Threshold(0.01, "of the innovations", "5 σ rejects 6e-7 when consistent")
REJECTED_SHARE_ERROR = Threshold(0.20, "of the innovations", "one in five: R or the clock is wrong")
GAP = Threshold(1.0, "s", "ten prediction steps without a measurement")
GAP_INTERVALS = Threshold(5.0, "median intervals", "jitter and single losses pass")
VARIANCE_FACTOR = Threshold(
    1.5, "times", "22 % in standard deviation; chance moves it less at n > 100"
)
VARIANCE_FACTOR_ERROR = Threshold(4.0, "times", "a factor of two in standard deviation")
IMU_GAP_TOTAL = Threshold(0.2, "s", "two prediction steps")
EKF2_NOISE_FLOOR = Threshold(0.01, "m", "EKF2 never trusts external vision better, EKF2.cpp")
OUTLIER_SHARE = Threshold(0.005, "outside 5√S", "6e-7 is expected")
GROWTH = Threshold(0.02, "relative growth of σ_p² between updates", "each update then brings < 2 %")
MOTION_RANGE = Threshold(0.5, "m", "5 to 95 % range; a hovering drone with 0.1 m UWB stays below")
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
# Intervals (s) at which PX4's default profile thins these topics, logged_topics.cpp
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": 0.2,
    "estimator_aid_src_ev_pos": 0.5,
    "ekf2_state_plus_innovation": 0.5,
}

Detector = Callable[[Comparison], Iterator[Finding]]


def find(comparison: Comparison) -> tuple[Finding, ...]:
    """All findings of all detectors, most severe first, each detector's own order kept."""
    found = [finding for detector in DETECTORS for finding in detector(comparison)]
    return tuple(sorted(found, key=lambda finding: SEVERITIES.index(finding.severity)))


def log_damaged(comparison: Comparison) -> Iterator[Finding]:
    """Bytes or samples that the reader had to pass over."""
    notes = [n for n in comparison.flight.log.notes if "damaged" in n or "dropped" in n]
    if notes:
        yield Finding(
            "log_damaged",
            "warning",
            f"The log is damaged: {notes[0]}"
            + (f" (and {len(notes) - 1} more such notes)." if len(notes) > 1 else "."),
            "Copy the log from the SD card again; if it stays, replace the card.",
            {"notes": float(len(notes))},
        )


def input_unavailable(comparison: Comparison) -> Iterator[Finding]:
    """No IMU or attitude: the filter ran without its input."""
    acceleration = comparison.axes[0].axis.acceleration
    if isinstance(acceleration, Unavailable):
        yield Finding(
            "input_unavailable",
            "warning",
            f"No acceleration input ({acceleration.what}: {acceleration.reason}); "
            "our filter assumes constant velocity.",
            acceleration.remedy,
        )


def source_reconstructed(comparison: Comparison) -> Iterator[Finding]:
    """The position source as it arrived is not in the log."""
    source = comparison.source
    if source.rung not in (4, 5, 6):
        return
    profile = int(comparison.flight.log.parameters.get("SDLOG_PROFILE", 1))
    yield Finding(
        "source_not_logged",
        "warning",
        "vehicle_visual_odometry, the position as it arrived, is not in this log; "
        f"{source.name} ({source.description}) stands in for it at {source.rate_hz:.1f} Hz.",
        f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again.",
        {"rate_hz": source.rate_hz, "sdlog_profile": float(profile)},
    )
    interval = LOGGER_INTERVALS_S[source.name]
    if abs(1.0 / source.rate_hz - interval) < LOGGER_INTERVAL_TOLERANCE.value * interval:
        yield Finding(
            "source_decimated",
            "warning",
            f"{source.name} is logged at {source.rate_hz:.1f} Hz, the logger's own limit for it "
            f"({1 / interval:g} Hz): the source may have run faster, the samples between are lost.",
            f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again.",
            {"rate_hz": source.rate_hz, "logger_limit_hz": 1.0 / interval},
        )


def source_frame(comparison: Comparison) -> Iterator[Finding]:
    """The source's x axis is not north."""
    ekf2 = comparison.flight.ekf2
    if comparison.source.frame != "FRD":
        return
    yaw = isinstance(ekf2, Ekf2) and isinstance(ekf2.fusing, pd.DataFrame) and ekf2.fusing["yaw"]
    aligned = yaw is not False and bool(np.mean(yaw) > FUSING_SHARE_ERROR.value)
    yield Finding(
        "source_frame_not_north",
        "info" if aligned else "warning",
        "The source's frame is FRD: its x axis is where the vehicle pointed at start, not north"
        + (
            "; EKF2 fused its yaw, so that EKF2's frame is the same."
            if aligned
            else ", while the IMU is turned into NED: north and east of the two may differ."
        ),
        "Read 'north' as the source's x axis."
        if aligned
        else "Send the position in NED, or let EKF2 fuse the yaw (EKF2_EV_CTRL bit 3).",
    )


def logging_rate_low(comparison: Comparison) -> Iterator[Finding]:
    """Topics that were logged too slowly for what is done with them."""
    flight = comparison.flight
    for part, topic, threshold in (
        (flight.imu, "sensor_combined", MIN_IMU_RATE),
        (flight.attitude, "vehicle_attitude", MIN_ATTITUDE_RATE),
    ):
        if isinstance(part, pd.DataFrame) and median_rate(part) < threshold.value:
            yield Finding(
                "logging_rate_low",
                "warning",
                f"{topic} was logged at {median_rate(part):.1f} Hz, below the "
                f"{threshold.value:g} Hz that the acceleration needs: motion between samples "
                "is lost.",
                "Set SDLOG_PROFILE to 129, which logs it at full rate.",
                {"rate_hz": median_rate(part), "needed_hz": threshold.value, "topic": topic},
            )
    innovations = next(
        (
            a.ekf2_innovations
            for a in comparison.axes
            if isinstance(a.ekf2_innovations, pd.DataFrame)
        ),
        None,
    )
    if innovations is not None and not comparison.source.reconstructed:
        count = len(comparison.axes[0].replay.updates)
        share = len(innovations) / count
        if share < MIN_INNOVATION_SHARE.value and isinstance(flight.ekf2, Ekf2):
            topic = flight.ekf2.innovation_topics[0]
            yield Finding(
                "ekf2_innovations_decimated",
                "info",
                f"The log holds {len(innovations)} EKF2 innovations for {count} measurements: "
                f"{1 - share:.0%} of what EKF2 did with the source is not in it.",
                f'Put the line "{topic} 0" into etc/logging/logger_topics.txt on the SD card.',
                {"logged": float(len(innovations)), "measurements": float(count)},
            )


def ekf2_unavailable(comparison: Comparison) -> Iterator[Finding]:
    """There is no EKF2 to compare with."""
    ekf2 = comparison.flight.ekf2
    if isinstance(ekf2, Unavailable):
        yield Finding(
            "ekf2_unavailable",
            "warning",
            f"Nothing to compare with: {ekf2.reason}. The report holds our filter alone.",
            ekf2.remedy,
        )


def ekf2_not_fusing(comparison: Comparison) -> Iterator[Finding]:
    """EKF2 did not use the source for horizontal position, or not all the time."""
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.fusing, Unavailable):
        return
    if comparison.source.rung not in (2, 4, 5, 6):
        return
    share = step_share(ekf2.fusing["horizontal"], segment.start_s, segment.end_s)
    interval = 1.0 / comparison.source.rate_hz
    parameters = comparison.flight.log.parameters
    evidence: dict[str, float | str] = {"fusing_share": share, "source_interval_s": interval}
    if share >= FUSING_SHARE_WARNING.value:
        return
    if share >= FUSING_SHARE_ERROR.value:
        yield Finding(
            "ekf2_fusion_interrupted",
            "warning",
            f"EKF2 fused the source in {share:.0%} of the segment only; in between its track is "
            "dead reckoning.",
            "Look at the gaps and rejections below; EKF2 stops after 0.4 s without a sample.",
            evidence,
        )
        return
    why, remedy = "the log does not show why", "Check EKF2_EV_CTRL (EKF2_AID_MASK before v1.14)."
    control = parameters.get("EKF2_EV_CTRL")
    mask = parameters.get("EKF2_AID_MASK")
    if control is not None and not int(control) & 1:
        why = f"EKF2_EV_CTRL is {control:.0f}, bit 0 (horizontal position) is not set"
        remedy = f"Set EKF2_EV_CTRL to {int(control) | 1}."
    elif control is None and mask is not None and not int(mask) & 8:
        why = f"EKF2_AID_MASK is {mask:.0f}, bit 3 (vision position) is not set"
        remedy = f"Set EKF2_AID_MASK to {int(mask) | 8}."
    elif control is not None and interval > EV_START_INTERVAL.value:
        why = (
            f"its samples come every {interval:.2f} s, and EKF2 (v1.14 and later) starts only when "
            f"they are less than {EV_START_INTERVAL.value:g} s apart and stops after "
            f"{EV_STOP_INTERVAL.value:g} s"
        )
        remedy = "Send the UWB position at 10 Hz; 5 Hz starts only thanks to jitter."
    yield Finding(
        "ekf2_not_fusing",
        "error",
        (
            "EKF2 never fused the source in this segment"
            if share == 0
            else f"EKF2 fused the source in only {share:.0%} of the segment"
        )
        + f": {why}.",
        remedy,
        evidence,
    )


def step_share(steps: pd.Series, start_s: float, end_s: float) -> float:
    """Share of a span in which a 0/1 step function is 1."""
    edges = np.clip(np.append(steps.index.to_numpy(), np.inf), start_s, end_s)
    edges[0] = start_s  # its first value also holds before
    return float(np.sum(np.diff(edges) * steps.to_numpy()) / (end_s - start_s))


def ekf2_rejecting(comparison: Comparison) -> Iterator[Finding]:
    """EKF2's gate threw measurements away."""
    for result in comparison.axes:
        frame = result.ekf2_innovations
        if result.axis.name not in ("north", "down") or isinstance(frame, Unavailable):
            continue
        rejected = frame["rejected"].fillna((frame["test_ratio"] > 1.0).astype(float))
        share = float(rejected.mean())
        if share < REJECTED_SHARE_WARNING.value:
            continue
        what = "height" if result.axis.name == "down" else "horizontal position"
        yield Finding(
            "ekf2_rejecting",
            "error" if share >= REJECTED_SHARE_ERROR.value else "warning",
            f"EKF2 rejected {share:.1%} of the source's samples for {what} (outside "
            f"{_gate(comparison):g} √S): outliers, a noise set too small, or a late clock.",
            "Raise EKF2_EVP_NOISE to the measured noise first; widen EKF2_EVP_GATE only after that.",
            {"rejected_share": share, "count": float(len(frame)), "axis": result.axis.name},
        )


def _gate(comparison: Comparison) -> float:
    ekf2 = comparison.flight.ekf2
    return ekf2.gate if isinstance(ekf2, Ekf2) else float("nan")


def gaps(comparison: Comparison) -> Iterator[Finding]:
    """The source, the IMU or the logger stopped for a while."""
    segment, source = comparison.segment, comparison.source
    times = comparison.axes[0].axis.measurement_time_s
    intervals = np.diff(times)
    limit = max(GAP.value, GAP_INTERVALS.value / source.rate_hz)
    long = intervals[intervals > limit]
    if len(long):
        at = float(times[:-1][intervals > limit][np.argmax(long)])
        yield Finding(
            "source_gap",
            "warning",
            f"The source was silent {_times(len(long))} for more than {limit:.1f} s, the longest "
            f"time {long.max():.1f} s at {at:.1f} s: only the IMU carries the position there.",
            "Check line of sight to the anchors and the link; analyse one side with --start, --end.",
            {"count": float(len(long)), "longest_s": float(long.max()), "at_s": at},
        )
    lost = [
        d for d in comparison.flight.log.dropouts
        if segment.start_s <= d.start_s <= segment.end_s
    ]  # fmt: skip
    if lost:
        total = sum(d.duration_s for d in lost)
        yield Finding(
            "logger_dropouts",
            "warning",
            f"The logger lost data {_times(len(lost))}, {total:.2f} s in all, the longest "
            f"{max(d.duration_s for d in lost):.2f} s.",
            "Use a faster SD card, or log less (SDLOG_PROFILE).",
            {"count": float(len(lost)), "total_s": total},
        )
    gap_s = comparison.axes[0].replay.input_gap_s
    if gap_s > IMU_GAP_TOTAL.value:
        yield Finding(
            "imu_gap",
            "warning",
            f"The IMU is missing for {gap_s:.2f} s of the segment; the process noise was raised "
            "there to the size of the motion.",
            "Use a faster SD card, or choose a segment without the gap (--start, --end).",
            {"total_s": gap_s},
        )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def resets(comparison: Comparison) -> Iterator[Finding]:
    """EKF2's output jumped, or another instance took over."""
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable):
        return
    inside = [
        r
        for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position"
    ]
    sizes = [float(np.linalg.norm(r.delta)) for r in inside]
    if any(sizes):
        largest = inside[int(np.argmax(sizes))]
        horizontal = sum(any(r.delta[:2]) for r in inside)
        said = next((note for note in comparison.notes if note.startswith("EKF2 resets")), "")
        yield Finding(
            "ekf2_resets",
            "warning" if horizontal else "info",
            f"EKF2 reset its position {_times(len(inside))} ({horizontal} horizontal), by up to "
            f"{max(sizes):.2f} m at {largest.time_s:.1f} s. In the comparison: {said[5:]}.",
            "Look for the gap, rejection or change of height source at that time.",
            {"count": float(len(inside)), "largest_m": max(sizes), "at_s": largest.time_s},
        )
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        yield Finding(
            "ekf2_instance_switch",
            "warning",
            f"The primary EKF2 instance changed {_times(len(switches))}, first at "
            f"{switches[0]:.1f} s; each part of the comparison uses the one in charge.",
            "Compare the IMUs (vehicle_imu_status); set EKF2_MULTI_IMU to 1 for a lab flight.",
            {"count": float(len(switches)), "at_s": switches[0]},
        )


def no_motion(comparison: Comparison) -> Iterator[Finding]:
    """The vehicle hardly moved: nothing about dynamics can be identified."""
    samples = comparison.source.samples
    inside = samples[
        (samples.index >= comparison.segment.start_s) & (samples.index <= comparison.segment.end_s)
    ]
    low, high = inside[POSITION_COLUMNS[:2]].quantile([0.05, 0.95]).to_numpy()
    extent = float(np.max(high - low))
    if extent < MOTION_RANGE.value:
        yield Finding(
            "no_motion",
            "warning",
            f"The vehicle moved only {extent:.2f} m horizontally (5 to 95 %): velocity, heading "
            "and clock offset cannot be judged from this flight.",
            "Fly several passes of 5 m or more, with clear starts and stops.",
            {"range_m": extent},
        )


def process_noise_forgotten(comparison: Comparison) -> Iterator[Finding]:
    """SIGMA_A so small that σ no longer grows between updates."""
    for result in comparison.axes:
        updates = result.replay.updates
        after = result.replay.steps["position_variance_m2"].reindex(updates.index)
        growth = updates["prior_position_variance_m2"].to_numpy()[1:] / after.to_numpy()[:-1] - 1
        late = growth[len(growth) // 2 :]
        if len(late) and (relative := float(np.median(late))) < GROWTH.value:
            gain = float(updates["gain_position"].iloc[-1])
            yield Finding(
                "process_noise_forgotten",
                "error",
                f"σ_p hardly grows between updates ({relative:.1%} in variance): with SIGMA_A "
                f"{comparison.settings.sigma_a_m_s2:g} m/s² the filter ends up ignoring new "
                f"measurements (last gain {gain:.3f}).",
                "Raise SIGMA_A: try --sigma-a 0.5.",
                {"relative_growth": relative, "last_gain": gain, "axis": result.axis.name},
            )
            return


def variance_wrong(comparison: Comparison) -> Iterator[Finding]:
    """S larger or smaller than the innovations deserve, for our filter and for EKF2 alike."""
    for owner in ("kf", "ekf2"):
        named: list[tuple[AxisComparison, Consistency]] = []
        for result in comparison.axes:
            summary = result.kf if owner == "kf" else result.ekf2
            if isinstance(summary, Unavailable) or isinstance(summary.consistency, Unavailable):
                continue
            statement = summary.consistency
            factor = max(statement.variance_factor, 1.0 / statement.variance_factor)
            if statement.verdict != "consistent" and factor >= VARIANCE_FACTOR.value:
                named.append((result, statement))
        for group, axes in (("horizontal", ("north", "east", "aisle")), ("vertical", ("down",))):
            members = [(r, s) for r, s in named if r.axis.name in axes]
            if members:
                yield _variance_finding(comparison, owner, group, members)


def _variance_finding(
    comparison: Comparison,
    owner: str,
    group: str,
    members: list[tuple[AxisComparison, Consistency]],
) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over = statement.variance_factor > 1.0
    factor = statement.variance_factor if over else 1.0 / statement.variance_factor
    name = "Our" if owner == "kf" else "EKF2's"
    low, high = statement.nis_band
    return Finding(
        f"{owner}_variance_{'overstated' if over else 'understated'}",
        "error" if factor >= VARIANCE_FACTOR_ERROR.value else "warning",
        f"{name} innovation variance is {'overstated' if over else 'understated'} "
        f"{factor:.3g} times along {result.axis.name} (mean NIS {statement.nis_mean:.3g}, "
        f"consistent is {low:.2f} to {high:.2f}; {group}).",
        _noise_remedy(comparison, owner, result, statement),
        {
            "axis": result.axis.name,
            "variance_factor": statement.variance_factor,
            "nis_mean": statement.nis_mean,
            "outside_gate": statement.outside_gate,
        }
        | (
            {}
            if result.noise_asked is None
            else {
                "sigma_z_asked_m": result.noise_asked.sigma_z_m,
                "sigma_z_asked_is_upper_bound": float(result.noise_asked.upper_bound),
            }
        ),
    )


def _noise_remedy(
    comparison: Comparison, owner: str, result: AxisComparison, statement: Consistency
) -> str:
    """The measurement noise that the data ask for, as what to type or to set.

    It is a property of the source, so our estimate of it serves EKF2 as well.
    """
    asked = result.noise_asked
    if asked is None:
        return (
            "No SIGMA_Z up to 30 m explains it: look at the acceleration input "
            "(IMU rate, gaps, vibration) and at the clocks."
        )
    noise = asked.sigma_z_m
    if owner == "kf":
        used = comparison.settings.sigma_z_m
        if asked.upper_bound:
            return (
                f"The source's noise is at most {noise:.2g} m, below what this rate can "
                f"show: lower SIGMA_Z (--sigma-z {max(noise, 0.005):.2g}) and SIGMA_A."
            )
        remedy = f"The data ask for SIGMA_Z {noise:.2g} m at this SIGMA_A: --sigma-z {noise:.2g}."
    else:
        used = _ekf2_noise(result)
        bound = "at most " if asked.upper_bound else ""
        if asked.upper_bound:  # EKF2's own innovations bound it too, and less tightly
            noise = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
        remedy = (
            f"The source's noise is {bound}{noise:.2g} m: set EKF2_EVP_NOISE to "
            f"{max(noise, EKF2_NOISE_FLOOR.value):.2g} (R was {used:.2g} m squared)."
        )
    tails = statement.variance_factor < 1.0 and statement.outside_gate > OUTLIER_SHARE.value
    if tails and 1 / VARIANCE_FACTOR.value < noise / used < VARIANCE_FACTOR.value:
        return (
            f"{statement.outside_gate:.1%} lie outside the gate while the bulk fits {noise:.2g} m: "
            "remove the outliers (line of sight, anchor survey) instead of raising the noise."
        )
    return remedy


def _ekf2_noise(result: AxisComparison) -> float:
    """Median √R (m) that EKF2 used; NaN where unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))


def too_few_innovations(comparison: Comparison) -> Iterator[Finding]:
    """Our own statistics could not be stated."""
    for result in comparison.axes:
        if isinstance(result.kf.consistency, Unavailable):
            yield Finding(
                "too_few_innovations",
                "warning",
                f"No statement on consistency: {result.kf.consistency.reason}.",
                result.kf.consistency.remedy,
                {"count": float(len(result.replay.updates))},
            )
            return


DETECTORS: tuple[Detector, ...] = (
    ekf2_not_fusing,
    variance_wrong,
    process_noise_forgotten,
    ekf2_rejecting,
    source_reconstructed,
    gaps,
    resets,
    no_motion,
    logging_rate_low,
    source_frame,
    ekf2_unavailable,
    input_unavailable,
    too_few_innovations,
    log_damaged,
)
