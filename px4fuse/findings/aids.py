"""EKF2 aids that are not fused, overconfident, shifted or biased.

The external vision position is tested by the other detectors, which can replay it.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.ekf2.aids import NOT_FUSED_LIMIT_S, WINDOW_S, AidResult
from px4fuse.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.findings.cause_grouping import CAUSE, CHANGE, SENSOR
from px4fuse.findings.model import Found, format_percent, note, warning
from px4fuse.flight import Unavailable
from px4fuse.text import format_factor, format_number

EVALUATED_ELSEWHERE = ("ev_pos", "ev_hgt")


def detect(analysis: Analysis) -> Found:
    """Detect faults of the aids of a compared flight."""
    if not isinstance(analysis.aids, Unavailable):
        own = analysis.source.origin.aid
        yield from find_in(analysis.aids, "" if own is None else own.name)


def find_in(aids: Mapping[str, AidResult], source: str = "") -> Found:
    """Yield at most one finding per aid; aids of one sensor that are not fused share one finding.

    Parameters
    ----------
    aids : mapping from aid name to AidResult
    source : str
        Aid whose positions KF uses too; its variance is tested by the other detectors.
    """
    evaluated = {name: aid for name, aid in aids.items() if name not in EVALUATED_ELSEWHERE}
    not_fused: dict[str, list[AidResult]] = {}
    for name, aid in evaluated.items():
        if aid.verdict == "not_fused":
            not_fused.setdefault(AIDS[name].switch or name, []).append(aid)
    for switch, aids_of_sensor in not_fused.items():
        longest = max(aids_of_sensor, key=lambda aid: aid.longest_gap_duration_s)
        labels = ", ".join(_aid_label(aid) for aid in aids_of_sensor)
        changed = any(axis.change for aid in aids_of_sensor for axis in aid.axes.values())
        cause = _sensor_cause(switch, source) or (CHANGE if changed else "")
        yield warning(
            "aid_not_fused",
            f"EKF2 fused no sample of {labels} for {longest.longest_gap_duration_s:.0f} s, "
            f"although fusion was enabled. The limit is {NOT_FUSED_LIMIT_S:g} s; "
            f"{format_percent(longest.rejected_fraction, 1)} of the samples were rejected. EKF2 "
            "relied on its other aids and the IMU, so its error grew.",
            "Check the sensor in that time (reception, range, light), and whether EKF2 rejected "
            "its samples.",
            {
                "aid": labels,
                "longest_gap_s": longest.longest_gap_duration_s,
                "rejected_fraction": longest.rejected_fraction,
                CAUSE: cause,
            },
            (longest.longest_gap_s,),
        )
    for name, aid in evaluated.items():
        changes = {axis: one.change for axis, one in aid.axes.items() if one.change is not None}
        label = _aid_label(aid)
        if changes and not _sensor_cause(AIDS[name].switch, source):
            axis, (time_s, moved) = max(changes.items(), key=lambda item: abs(item[1][1]))
            yield warning(
                "aid_innovation_shift",
                f"The mean innovation of {label} shifts by {abs(moved):.1f} √S at about "
                f"{time_s:.0f} s ({axis}). From then on this aid and the other aids contradict "
                "each other, until the EKF2 states absorb the difference.",
                "Check what was switched, moved or passed near the sensor then (current, metal, "
                "propeller wash, heat).",
                {"aid": name, "axis": axis, "time_s": time_s, "moved": moved},
                ((time_s, time_s + WINDOW_S),),
            )
        elif aid.verdict == "overconfident" and name != source:
            # no value is proposed: innovations alone cannot separate noise from a wrong delay
            noise = AIDS[name].noise
            action = f"increase {noise}" if noise else "correct the accuracy that it reports"
            yield warning(
                "aid_overconfident",
                f"EKF2 is overconfident about {label}: σ is {format_factor(aid.nis_mean**0.5)} "
                f"times too small. The mean NIS is {format_number(aid.nis_mean)} (expected 1); "
                f"{format_percent(aid.rejected_fraction, 1)} of the samples were rejected. The "
                f"errors of this aid exceed R{_format_noise(aid)}, or another aid contradicts it.",
                "First check outliers, delay and mounting of the sensor, and the other aids. If "
                f"the sensor is noisier than assumed, {action}.",
                {
                    "aid": name,
                    "nis_mean": aid.nis_mean,
                    "rejected_fraction": aid.rejected_fraction,
                    CAUSE: _sensor_cause(AIDS[name].switch, source),
                },
            )
        elif aid.verdict == "biased":
            axis, worst = max(
                aid.axes.items(), key=lambda item: abs(item[1].mean_normalised_innovation)
            )
            yield note(
                "aid_innovation_bias",
                f"The innovations of {label} have a mean of {format_number(worst.innovation_mean)} "
                f"{aid.unit} ({axis}; √S is {format_number(worst.s_sqrt_median)} {aid.unit}). This "
                "aid and another one contradict each other.",
                "Find the wrong one: check calibration, mounting and interference. Changing noises "
                "does not correct a bias.",
                {
                    "aid": name,
                    "axis": axis,
                    "innovation_mean": worst.innovation_mean,
                    "s_sqrt_median": worst.s_sqrt_median,
                },
            )


def _aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor_cause(switch: str, source: str) -> str:
    """Return SENSOR if the parameter `switch` also enables the aid that KF uses, else ""."""
    return SENSOR if source and AIDS[source].switch == switch else ""


def _format_noise(aid: AidResult) -> str:
    if aid.noise is None:
        return ""
    return f" (√R {format_number(aid.noise)} {aid.unit}, from {aid.noise_from})"
