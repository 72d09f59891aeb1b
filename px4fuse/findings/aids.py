"""An aid of EKF2 that it did not get, does not believe, or is pulled to one side by.

External vision's position is judged by the detectors of the lab, with what a replay shows.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.ekf2.aids import STARVED_S, WINDOW_S, AidResult
from px4fuse.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.findings.causes import CAUSE, CHANGE, SENSOR
from px4fuse.findings.model import Found, info, warning
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words

JUDGED_ELSEWHERE = ("ev_pos", "ev_hgt")


def detect(analysis: Analysis) -> Found:
    """Of a comparison."""
    if not isinstance(analysis.aids, Unavailable):
        own = analysis.source.origin.aid
        yield from find_in(analysis.aids, "" if own is None else own.name)


def find_in(aids: Mapping[str, AidResult], source: str = "") -> Found:
    """One finding for each aid that has one; ``source`` is the one that our filter was given too.

    Its variance is judged beside ours. What one sensor gives is missing together, and told once.
    """
    judged = {name: aid for name, aid in aids.items() if name not in JUDGED_ELSEWHERE}
    starved: dict[str, list[AidResult]] = {}
    for name, aid in judged.items():
        if aid.verdict == "starved":
            starved.setdefault(AIDS[name].switch or name, []).append(aid)
    for switch, together in starved.items():
        longest = max(together, key=lambda aid: aid.longest_without)
        labels = ", ".join(_named(aid) for aid in together)
        changed = any(axis.change for aid in together for axis in aid.axes.values())
        cause = _sensor(switch, source) or (CHANGE if changed else "")
        yield warning(
            "aid_starved",
            {
                "aid": labels,
                "longest_without_s": longest.longest_without,
                "rejected_share": longest.rejected_share,
                CAUSE: cause,
            },
            (longest.longest_without_s,),
            most_s=STARVED_S,
        )
    for name, aid in judged.items():
        changes = {axis: one.change for axis, one in aid.axes.items() if one.change is not None}
        if changes and not _sensor(AIDS[name].switch, source):
            axis, (time_s, moved) = max(changes.items(), key=lambda item: abs(item[1][1]))
            yield warning(
                "aid_changed",
                {"aid": name, "axis": axis, "time_s": time_s, "moved": moved},
                ((time_s, time_s + WINDOW_S),),
                label=_named(aid),
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
                    CAUSE: _sensor(AIDS[name].switch, source),
                },
                label=_named(aid),
                times=factor_words(aid.nis_mean**0.5),
                r=_noise_words(aid),
                nis=number_words(aid.nis_mean),
                raised=bool(noise),
                noise=noise,
            )
        elif aid.verdict == "biased":
            axis, worst = max(aid.axes.items(), key=lambda item: abs(item[1].pull))
            yield info(
                "aid_biased",
                {
                    "aid": name,
                    "axis": axis,
                    "innovation_mean": worst.innovation_mean,
                    "s_sqrt_median": worst.s_sqrt_median,
                },
                label=_named(aid),
                unit=aid.unit,
                mean=number_words(worst.innovation_mean),
                s=number_words(worst.s_sqrt_median),
            )


def _named(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor(switch: str, source: str) -> str:
    """Whether the sensor that is switched so is the one whose positions our filter was given."""
    return SENSOR if source and AIDS[source].switch == switch else ""


def _noise_words(aid: AidResult) -> str:
    if aid.noise is None:
        return ""
    return f" (√R {number_words(aid.noise)} {aid.unit}, from {aid.noise_from})"
