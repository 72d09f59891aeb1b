"""EKF2 aids that are not fused, overconfident, shifted or biased.

Position and height of external vision are tested by the other detectors, which replay EKF2.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.ekf2.aids import NOT_FUSED_LIMIT_S, WINDOW_S, AidResult
from px4fuse.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.findings.cause_grouping import CAUSE, CHANGE, SENSOR
from px4fuse.findings.model import Findings, format_percent, note, warning
from px4fuse.flight import Unavailable
from px4fuse.text import format_factor, format_number

AIDS_OF_OTHER_DETECTORS = ("ev_pos", "ev_hgt")


def detect(analysis: Analysis) -> Findings:
    """Detect faults of the aids of a compared flight."""
    if not isinstance(analysis.aids, Unavailable):
        source_aid = analysis.source.origin.aid
        yield from detect_in_aids(analysis.aids, "" if source_aid is None else source_aid.name)


def detect_in_aids(aids: Mapping[str, AidResult], source_aid: str = "") -> Findings:
    """Yield at most one finding per aid; aids of one sensor that are not fused share one finding.

    Parameters
    ----------
    aids : mapping from aid name to AidResult
    source_aid : str
        Aid whose positions KF also uses; the other detectors test its variance.
    """
    tested_aids = {name: aid for name, aid in aids.items() if name not in AIDS_OF_OTHER_DETECTORS}
    not_fused: dict[str, list[AidResult]] = {}
    for name, aid in tested_aids.items():
        if aid.verdict == "not_fused":
            not_fused.setdefault(AIDS[name].switch or name, []).append(aid)
    for switch, aids_of_sensor in not_fused.items():
        longest_unfused = max(aids_of_sensor, key=lambda aid: aid.longest_gap_duration_s)
        labels = ", ".join(_aid_label(aid) for aid in aids_of_sensor)
        has_change = any(axis.change for aid in aids_of_sensor for axis in aid.axes.values())
        cause = _sensor_cause(switch, source_aid) or (CHANGE if has_change else "")
        yield warning(
            "aid_not_fused",
            f"EKF2 fused no sample of {labels} for {longest_unfused.longest_gap_duration_s:.0f} s, "
            f"although fusion was enabled. The limit is {NOT_FUSED_LIMIT_S:g} s; "
            f"{format_percent(longest_unfused.rejected_fraction, 1)} of the samples were rejected. "
            "EKF2 relied on its other aids and the IMU, so its error grew.",
            "Check the sensor at that time (reception, range, light). Check whether EKF2 rejected "
            "its samples.",
            {
                "aid": labels,
                "longest_gap_s": longest_unfused.longest_gap_duration_s,
                "rejected_fraction": longest_unfused.rejected_fraction,
                CAUSE: cause,
            },
            (longest_unfused.longest_gap_s,),
        )
    for name, aid in tested_aids.items():
        changes = {
            axis: axis_result.change
            for axis, axis_result in aid.axes.items()
            if axis_result.change is not None
        }
        label = _aid_label(aid)
        if changes and not _sensor_cause(AIDS[name].switch, source_aid):
            axis, (time_s, shift) = max(changes.items(), key=lambda item: abs(item[1][1]))
            yield warning(
                "aid_innovation_shift",
                f"The mean innovation of {label} shifts by {abs(shift):.1f} √S at about "
                f"{time_s:.0f} s ({axis}). From then on this aid and the other aids contradict "
                "each other, until the EKF2 states absorb the difference.",
                "Check for a disturbance of the sensor at that time (current, metal, propeller "
                "wash, heat).",
                {"aid": name, "axis": axis, "time_s": time_s, "moved": shift},
                ((time_s, time_s + WINDOW_S),),
            )
        elif aid.verdict == "overconfident" and name != source_aid:
            # no value is proposed: innovations alone cannot separate noise from a wrong delay
            noise_parameter = AIDS[name].noise
            action = "correct the accuracy that the sensor reports"
            if noise_parameter:
                action = f"increase {noise_parameter}"
            yield warning(
                "aid_overconfident",
                f"EKF2 is overconfident about {label}: σ is {format_factor(aid.nis_mean**0.5)} "
                f"times too small. The mean NIS is {format_number(aid.nis_mean)} (expected 1); "
                f"{format_percent(aid.rejected_fraction, 1)} of the samples were rejected. The "
                f"errors of this aid are larger than R{_format_noise(aid)}, or another aid is "
                "wrong.",
                "First check outliers, delay and mounting of the sensor, and the other aids. If "
                f"the sensor is noisier than assumed, {action}.",
                {
                    "aid": name,
                    "nis_mean": aid.nis_mean,
                    "rejected_fraction": aid.rejected_fraction,
                    CAUSE: _sensor_cause(AIDS[name].switch, source_aid),
                },
            )
        elif aid.verdict == "biased":
            axis, worst_axis = max(
                aid.axes.items(), key=lambda item: abs(item[1].mean_normalised_innovation)
            )
            yield note(
                "aid_innovation_bias",
                f"The innovations of {label} have a mean of "
                f"{format_number(worst_axis.innovation_mean)} {aid.unit} ({axis}; √S is "
                f"{format_number(worst_axis.s_sqrt_median)} {aid.unit}). This aid and another one "
                "contradict each other.",
                "Find the wrong aid: check calibration, mounting and interference. Changing noises "
                "does not correct a bias.",
                {
                    "aid": name,
                    "axis": axis,
                    "innovation_mean": worst_axis.innovation_mean,
                    "s_sqrt_median": worst_axis.s_sqrt_median,
                },
            )


def _aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor_cause(switch: str, source_aid: str) -> str:
    """Return SENSOR if `switch` also enables the aid that KF uses, else an empty text."""
    return SENSOR if source_aid and AIDS[source_aid].switch == switch else ""


def _format_noise(aid: AidResult) -> str:
    if aid.noise is None:
        return ""
    return f" (√R {format_number(aid.noise)} {aid.unit}, from {aid.noise_from})"
