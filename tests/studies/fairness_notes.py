"""Notes as students write them, by templates: what the three students of the measurement hand in.

Two wordings for each mistake, as no two students write alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from px4fuse.assignment.drawing import Drawn
from px4fuse.comparison.model import FilterSummary
from px4fuse.filter.tuning import HORIZONTAL, Tuned
from px4fuse.findings.model import Finding
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported

WORDINGS = 2
# By name of the mistake, with its size as {size}
SENTENCES: Mapping[str, tuple[str, str]] = {
    "clock-offset": (
        "The stamps of the UWB positions have a clock offset of about {size} against the IMU: at "
        "1 m/s that moves every position along the aisle, and NIS hardly shows it.",
        "The position source has a time offset of {size}. I found it from the correlation of the "
        "innovations with the acceleration and corrected it with --clock-offset.",
    ),
    "clock-jump": (
        "For the first 50 s the stamps are times of arrival, since TIMESYNC had not converged, so "
        "the clock jumps by {size}; I analysed only the rest with --start.",
        "TIMESYNC needs 500 answers. Before that the positions carry the arrival time, {size} too "
        "late, and one clock offset cannot hold for both parts of the flight.",
    ),
    "yaw": (
        "The position frame is turned against north by {size}, because the heading of the track "
        "and the acceleration of the IMU do not point the same way at starts and stops.",
        "The anchors were surveyed in a rotated frame: its yaw is off by {size}, so the IMU pushes "
        "the prediction sideways at every start.",
    ),
    "nlos": (
        "About {size} of the positions are outliers from reflections without line of sight. They "
        "come in bursts, so I did not raise SIGMA_Z for them.",
        "Some bursts of NLOS measurements, {size} of them, are metres off; these outliers must be "
        "rejected and are no reason for a larger measurement noise.",
    ),
    "dropout": (
        "The position source has a gap of {size}, in which the filter only predicts and sigma_p "
        "grows until the next update.",
        "The UWB dropped out for {size}: during this dropout both filters coast on the IMU and "
        "their standard deviation grows.",
    ),
    "imu-rate": (
        "The IMU was logged at only {size}, so the logging rate is too low: motion between the "
        "samples is lost and the clock offset cannot be estimated.",
        "With an IMU rate of {size} the sampling is too slow for the prediction; next time I would "
        "log sensor_combined at full rate.",
    ),
    "ekf2-noise": (
        "EKF2 understates its variance: EKF2_EVP_NOISE is {size}, far below the noise of the "
        "source, so the mean NIS of EKF2 is far above 1.",
        "EKF2 is overconfident. Its EKF2_EVP_NOISE of {size} is too small, which makes S too small "
        "and its NIS too large.",
    ),
    "ekf2-gate": (
        "EKF2 rejects good samples because EKF2_EVP_GATE is only {size}; I would set it back to "
        "the default of 5.",
        "The innovation gate of EKF2 ({size} standard deviations) is too narrow, so that many good "
        "positions are rejected and the track is reset now and then.",
    ),
    "ekf2-delay": (
        "EKF2_EV_DELAY is wrong: it is {size} although the stamps are right, so EKF2 fuses each "
        "position at the wrong time.",
        "The parameter EKF2_EV_DELAY should be 0 and was flown with {size}; this delay makes the "
        "track of EKF2 run ahead.",
    ),
    "ekf2-off": (
        "EKF2 never fuses the positions, because EKF2_EV_CTRL is 0; bit 0 must be set.",
        "In this flight EKF2 is not fusing the source at all: EKF2_EV_CTRL was 0, and its track "
        "drifts away from the truth.",
    ),
    "open-end": (
        "This is a false loop closure: the vehicle landed elsewhere, {size} from where it took "
        "off, and forcing the end onto the start would bend the whole path.",
        "The vehicle did not return to its start. Drift cannot explain {size}, so the gate rightly "
        "rejects the wrong closure and the path must not be corrected with it.",
    ),
}  # fmt: skip
# Of what mistakes bring with them, where the report lists it by itself
EFFECTS: Mapping[str, str] = {
    "ekf2_resets": "EKF2 resets its position to a sample several times. That is only an effect: "
    "after a second of rejections it starts again from there.",
    "kf_variance_understated": "The variance of my filter is understated, since the bad samples "
    "pull its NIS up. I kept SIGMA_Z, because most samples fit.",
    "errors_larger_than_claimed": "Against the truth the error is larger than claimed: what causes "
    "it moves all positions together, and so the innovations hide it.",
    "ekf2_ev_delay_wrong": "EKF2 is still told EKF2_EV_DELAY 0 and fuses these positions at the "
    "wrong time; its delay follows from the clock and needs the same correction.",
    "ekf2_variance_understated": "The EKF2 variance is understated as well, and its NIS too high, "
    "for the same reason.",
}
NO_MISTAKE = (
    "I looked for a clock error, a turned frame, bad samples and missing data, and found no "
    "mistake in this flight.",
    "I checked stamps, frame, samples and rates one by one: nothing wrong, the log is clean.",
)


def sentence(typed: str, wording: int) -> str:
    """What names one mistake, as it was typed for ``px4fuse simulate``."""
    name, _, values = typed.partition("=")
    return SENTENCES[name][wording % WORDINGS].format(size=values.partition(",")[0].lstrip("-"))


def notes(results: Reported, drawn: Drawn, wording: int) -> str:
    """Notes on a report that name the mistakes, and explain what else the report finds.

    Parameters
    ----------
    results : ComparisonResults or LoopResults
        The report's.
    drawn : Drawn
        The flight.
    wording : int
        Which of them.
    """
    others = [
        _explained(one)
        for one in results.findings
        if one.severity != "info" and not {*one.ids} & {*drawn.findings}
    ]
    more = ["# What else the report says", " ".join(others)] if others else []
    return "\n\n".join((guessed(results, drawn.typed, wording), *more)) + "\n"


def guessed(results: Reported, mistakes: Sequence[str], wording: int) -> str:
    """Notes that name these mistakes, typed as for ``px4fuse simulate``, or say that none is there.

    So writes who has not read the findings of the report.
    """
    named = [sentence(one, wording) for one in mistakes] or [NO_MISTAKE[wording % WORDINGS]]
    did = _loop(results) if isinstance(results, LoopResults) else _compared(results)
    parts = ("# What I did", did, "# What is wrong with this flight", " ".join(named))
    return "\n\n".join(parts)


def _explained(finding: Finding) -> str:
    """What a student says of a finding besides the mistakes; else what the report says."""
    message, remedy = (
        text.split(". ")[0].rstrip(".") for text in (finding.message, finding.remedy)
    )
    quoted = f"The report says: {message}. To fix this: {remedy}."
    return EFFECTS.get(finding.id, quoted)


def _compared(results: ComparisonResults) -> str:
    """Settings and verdicts of a comparison."""
    settings = results.settings
    tuned = results.tuning.get(HORIZONTAL)
    said = [
        f"I compared the two-state Kalman filter with EKF2 from {settings.start_s:.0f} s to "
        f"{settings.end_s:.0f} s of the log. The measurement noise SIGMA_Z describes how far a "
        "position scatters, and the process noise SIGMA_A how wrong the acceleration is.",
        f"I set SIGMA_Z to {settings.sigma_z_m:g} m and SIGMA_A to {settings.sigma_a_m_s2:g} m/s².",
    ]
    if isinstance(tuned, Tuned):
        said.append(
            f"Those are the values for which the {tuned.count} measurements are most likely, north "
            "and east together."
        )
    for name, axis in results.axes.items():
        ours = axis.filters["kf"]
        if isinstance(ours, FilterSummary):
            said.append(
                f"On the {name} axis the mean NIS of my filter is {ours.nis_mean:.2f}, where 1 "
                "would be expected of innovations that are as large as the filter says."
            )
    said.append(
        "I prefer a filter whose NIS lies inside the band to one with a smooth track, since only "
        "its variance can be used to plan how close to a shelf the drone may fly."
    )
    return " ".join(said)


def _loop(results: LoopResults) -> str:
    """What was measured and corrected."""
    loop = results.loop
    error = "not known" if loop.closure_error_m is None else f"{loop.closure_error_m:.2f} m"
    share = "" if loop.closure_percent is None else f" ({loop.closure_percent:.1f} % of the path)"
    return (
        f"I measured the loop on visual-inertial odometry. The path is {loop.path_length_m:.1f} m "
        f"long and takes {loop.end_s - loop.start_s:.0f} s. The odometry ends {error}{share} from "
        "where the loop would close. Odometry integrates small errors of scale and heading, so "
        "the estimate slides away slowly with the distance, and nothing absolute pulls it back. I "
        "compared two corrections: the error shared out by distance, positions only and with "
        "headings, and a pose graph in which each edge has a covariance and the last one ties the "
        "end to the beginning. The chi-square gate decides before that whether such an edge may be "
        "trusted, because one wrong edge bends every pose between. With a single edge nothing else "
        "in the graph contradicts it, so robust kernels cannot help and only the gate protects the "
        "map. Next time I would land on a marked spot, measure it with a tape and write it down."
    )
