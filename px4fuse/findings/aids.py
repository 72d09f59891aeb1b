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
            f"EKF2 had {longest.longest_without:.0f} s without {labels} that it meant to fuse",
            f" (more than {STARVED_S:g} s; {longest.rejected_share:.1%} of its samples were "
            "rejected): it went on by its other aids and the IMU, whose errors grow.",
            "See what the sensor lacked then (reception, range, light), or whether EKF2 rejected "
            "it; what carried EKF2 meanwhile is in the table.",
            {"aid": labels, "longest_without_s": longest.longest_without,
             "rejected_share": longest.rejected_share, CAUSE: cause},
            (longest.longest_without_s,),
        )  # fmt: skip
    for name, aid in judged.items():
        changes = {axis: one.change for axis, one in aid.axes.items() if one.change is not None}
        if changes and not _sensor(AIDS[name].switch, source):
            axis, (time_s, moved) = max(changes.items(), key=lambda item: abs(item[1][1]))
            yield warning(
                "aid_changed",
                f"Innovations of {_named(aid)} change in flight: from about {time_s:.0f} s on "
                f"their mean is {abs(moved):.1f} √S from where it was ({axis})",
                ": the sensor and what else EKF2 fuses contradict each other from then on, and "
                "EKF2 is pulled until its own states have taken it in.",
                "See what was switched, moved or passed near the sensor then (current, metal, "
                "wash, heat).",
                {"aid": name, "axis": axis, "time_s": time_s, "moved": moved},
                ((time_s, time_s + WINDOW_S),),
            )
        elif aid.verdict == "variance understated" and name != source:
            factor, noise = aid.nis_mean**0.5, AIDS[name].noise
            raised = f"raise {noise}" if noise else "its reported accuracy is too small"
            yield warning(
                "aid_understated",
                f"EKF2 is {factor_words(factor)} times too sure of {_named(aid)}",
                f" (mean NIS {number_words(aid.nis_mean)}, 1 is consistent; "
                f"{aid.rejected_share:.1%} rejected): its errors are larger than R"
                f"{_noise_words(aid)} says, or another aid pulls against it.",
                # never a value: innovations alone do not tell noise from a wrong delay
                "Look for what is wrong first (outliers, the sensor's delay or place, another "
                f"aid); where it is the sensor's own noise, {raised}.",
                {
                    "aid": name,
                    "nis_mean": aid.nis_mean,
                    "rejected_share": aid.rejected_share,
                    CAUSE: _sensor(AIDS[name].switch, source),
                },
            )
        elif aid.verdict == "biased":
            axis, worst = max(aid.axes.items(), key=lambda item: abs(item[1].pull))
            yield info(
                "aid_biased",
                f"Innovations of {_named(aid)} are not zero in the mean",
                f" ({number_words(worst.innovation_mean)} {aid.unit}, {axis}; √S is "
                f"{number_words(worst.s_sqrt_median)}): it and another aid contradict each other, "
                "and EKF2 stands between them.",
                "Find the one that is wrong (calibration, place of the sensor, interference): "
                "noises do not cure a bias.",
                {"aid": name, "axis": axis, "innovation_mean": worst.innovation_mean,
                 "s_sqrt_median": worst.s_sqrt_median},
            )  # fmt: skip


def _named(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor(switch: str, source: str) -> str:
    """Whether the sensor that is switched so is the one whose positions our filter was given."""
    return SENSOR if source and AIDS[source].switch == switch else ""


def _noise_words(aid: AidResult) -> str:
    if aid.noise is None:
        return ""
    return f" (√R {number_words(aid.noise)} {aid.unit}, from {aid.noise_from})"
