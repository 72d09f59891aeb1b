"""An aid of EKF2 that it did not get, does not believe, or is pulled to one side by.

External vision's position is judged by the detectors of the lab, with what a replay shows.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.ekf2.aids import NOT_FUSED_LIMIT_S, WINDOW_S, AidResult
from px4fuse.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.findings.causes import CAUSE, CHANGE, SENSOR
from px4fuse.findings.model import Found, info, warning
from px4fuse.flight import Unavailable
from px4fuse.plain import format_factor, format_number

EVALUATED_ELSEWHERE = ("ev_pos", "ev_hgt")


def detect(analysis: Analysis) -> Found:
    """Of a comparison."""
    if not isinstance(analysis.aids, Unavailable):
        own = analysis.source.origin.aid
        yield from find_in(analysis.aids, "" if own is None else own.name)


def find_in(aids: Mapping[str, AidResult], source: str = "") -> Found:
    """One finding for each aid that has one; ``source`` is the one that our filter was given too.

    Its variance is judged beside ours. What one sensor gives is missing together, and told once.
    """
    evaluated = {name: aid for name, aid in aids.items() if name not in EVALUATED_ELSEWHERE}
    not_fused: dict[str, list[AidResult]] = {}
    for name, aid in evaluated.items():
        if aid.verdict == "starved":
            not_fused.setdefault(AIDS[name].switch or name, []).append(aid)
    for switch, aids_of_sensor in not_fused.items():
        longest = max(aids_of_sensor, key=lambda aid: aid.longest_without)
        labels = ", ".join(_aid_label(aid) for aid in aids_of_sensor)
        changed = any(axis.change for aid in aids_of_sensor for axis in aid.axes.values())
        cause = _sensor_cause(switch, source) or (CHANGE if changed else "")
        yield warning(
            "aid_starved",
            {
                "aid": labels,
                "longest_without_s": longest.longest_without,
                "rejected_share": longest.rejected_share,
                CAUSE: cause,
            },
            (longest.longest_without_s,),
            most_s=NOT_FUSED_LIMIT_S,
        )
    for name, aid in evaluated.items():
        changes = {axis: one.change for axis, one in aid.axes.items() if one.change is not None}
        if changes and not _sensor_cause(AIDS[name].switch, source):
            axis, (time_s, moved) = max(changes.items(), key=lambda item: abs(item[1][1]))
            yield warning(
                "aid_changed",
                {"aid": name, "axis": axis, "time_s": time_s, "moved": moved},
                ((time_s, time_s + WINDOW_S),),
                label=_aid_label(aid),
                by=abs(moved),
            )
        elif aid.verdict == "variance understated" and name != source:
            noise = AIDS[name].noise
            yield warning(
                "aid_understated",
                {
                    "aid": name,
                    "nis_mean": aid.nis_mean,
                    "rejected_share": aid.rejected_share,
                    CAUSE: _sensor_cause(AIDS[name].switch, source),
                },
                label=_aid_label(aid),
                times=format_factor(aid.nis_mean**0.5),
                r=_format_noise(aid),
                nis=format_number(aid.nis_mean),
                raised=bool(noise),
                noise=noise,
            )
        elif aid.verdict == "biased":
            axis, worst = max(
                aid.axes.items(), key=lambda item: abs(item[1].mean_normalised_innovation)
            )
            yield info(
                "aid_biased",
                {
                    "aid": name,
                    "axis": axis,
                    "innovation_mean": worst.innovation_mean,
                    "s_sqrt_median": worst.s_sqrt_median,
                },
                label=_aid_label(aid),
                unit=aid.unit,
                mean=format_number(worst.innovation_mean),
                s=format_number(worst.s_sqrt_median),
            )


def _aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor_cause(switch: str, source: str) -> str:
    """Whether the sensor that is switched so is the one whose positions our filter was given."""
    return SENSOR if source and AIDS[source].switch == switch else ""


def _format_noise(aid: AidResult) -> str:
    if aid.noise is None:
        return ""
    return f" (√R {format_number(aid.noise)} {aid.unit}, from {aid.noise_from})"
