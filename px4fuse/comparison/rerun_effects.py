"""Re-runs of KF or EKF2 with changed settings or data, and the effect of each change."""

import math
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

from px4fuse.core.record import Count, NonNegativeFloat, PositiveFloat, Record, Share
from px4fuse.filter.consistency import Reference, classify_sigma_ratio, compute_nis_band
from px4fuse.flight.ekf2_parameters import EV_POS

from .model import FilterName

Statistic = Literal["nis", "nees", "difference"]
CONSISTENCY_STATISTICS: tuple[Statistic, Statistic] = ("nees", "nis")
# Changed KF settings, EKF2 parameters or data, by name
ChangedValues = Mapping[str, float]
# Names of data corrections in ChangedValues: time offset (s), clockwise rotation of the positions
# (°), number of omitted outliers, and accelerometer bias (m/s²)
TIME_OFFSET_KEY, ROTATION_KEY, OUTLIERS_KEY = "clock_offset_s", "turned_deg", "outliers_left_out"
FORWARD_BIAS_KEY, RIGHT_BIAS_KEY = "bias_forward_m_s2", "bias_right_m_s2"
Improvement = Literal["position and σ", "position", "σ only", "nothing"]
# A position error is reported only if the mean NEES is at least this value. Without a fault, the
# mean NEES is below 3
MIN_REPORTED_NEES = 4.0
# A re-run with a smaller noise setting makes a filter overconfident if it increases a mean NEES
# above 1 to this value or more
MIN_OVERCONFIDENT_NEES_AFTER_CHANGE = 2.0
# ln(mean NIS) and ln(mean NEES) are 0 for a consistent filter. A changed setting or corrected data
# is a possible cause of a wrong σ if the re-run reduces |ln(mean)| to at most this fraction of its
# value before the change
POSSIBLE_CAUSE_EXPLAINED_FRACTION_TOLERANCE = 0.5
# A sensor fault is sufficient as the only cause of a wrong σ if its correction reduces |ln(mean
# NIS)| or |ln(mean NEES)| to at most this fraction of its value before
ONLY_CAUSE_EXPLAINED_FRACTION_TOLERANCE = 0.25
# ln(mean NIS) and ln(mean NEES) are 0 for a consistent filter. A change is combined with another
# change if it alone reduces |ln(mean)| to less than this fraction of the value without it
COMBINED_CHANGE_EXPLAINED_FRACTION_TOLERANCE = 0.9
SENSOR_CORRECTION_KEYS = frozenset((OUTLIERS_KEY, TIME_OFFSET_KEY, ROTATION_KEY, FORWARD_BIAS_KEY))
# Settings and data corrections that have an effect only together with another change
CHANGE_KEYS_WITHOUT_EFFECT_ALONE = frozenset(
    ("EKF2_DELAY_MAX", EV_POS.noise_mode_parameter, RIGHT_BIAS_KEY)
)
# A re-run has an effect if it changes actual σ ÷ reported σ by at least this factor
MIN_SIGMA_RATIO_CHANGE_FACTOR = 1.10
# A re-run has an effect if it changes the position RMSE by more than this fraction
MIN_RMSE_CHANGE_FRACTION = 0.05
# A re-run improves the position if it reduces the position RMSE by at least this fraction
MIN_RMSE_REDUCTION = 0.20
# A re-run does not correct an overconfident filter if ln(actual σ ÷ reported σ) after the re-run is
# above this fraction of its value before
MAX_OVERCONFIDENCE_FRACTION_AFTER_RERUN = 0.75


class RunStatistics(Record, kw_only=True):
    """Statistics of one run of a filter along one axis; RMSE and NEES are against ground truth."""

    innovations: Count = 0
    nis_mean: PositiveFloat | None = None
    position_rmse_m: NonNegativeFloat | None = None
    nees_mean: NonNegativeFloat | None = None
    difference_rms_m: NonNegativeFloat | None = None
    rejected_fraction: Share | None = None

    def value(self, statistic: Statistic) -> float | None:
        return {
            "nis": self.nis_mean,
            "nees": self.nees_mean,
            "difference": self.difference_rms_m,
        }[statistic]


class Rerun(Record, kw_only=True):
    """Re-run of one filter with changed settings or data, and the effect along one axis.

    Attributes
    ----------
    kinds : tuple of str
        Kinds of change, for example "noise", "delay", "outliers" or "rotation".
    change : mapping from name to value
        Changed KF settings, EKF2 parameters or data.
    discrepancies : tuple of {"nis", "nees"}
        Statistics that the change may correct.
    before, after : RunStatistics
        Statistics without and with the change, over the same time span.
    is_logged : bool
        True if ``before`` is from the log (EKF2) or the first run (KF), not from a replay.
    from_s : float or None
        Start (s) of the evaluated time; None for the whole segment.
    """

    filter: FilterName
    axis: str
    kinds: tuple[str, ...]
    change: ChangedValues
    discrepancies: tuple[Statistic, ...] = ()
    before: RunStatistics
    is_logged: bool = True
    after: RunStatistics
    from_s: float | None = None

    @property
    def corrects_sensor(self) -> bool:
        """True if the change corrects faulty sensor data, False if it only changes settings."""
        return not SENSOR_CORRECTION_KEYS.isdisjoint(self.change)


def compute_explained_fraction(rerun: Rerun, statistic: Statistic) -> float:
    """Return the fraction of an inconsistency that disappears with the change of a re-run.

    - "nis", "nees": fraction of ln(mean NIS) or ln(mean NEES). It is 1 if the mean is 1 after the
      change, and above 1 if the change overshoots.
    - "difference": fraction of the mean square difference KF - EKF2.
    """
    before, after = rerun.before.value(statistic), rerun.after.value(statistic)
    if not before or not after:
        return 0.0
    if statistic == "difference":
        return 1.0 - (after / before) ** 2
    return 1.0 - float(np.log(after) / np.log(before))


def _compute_explained_fraction_error(rerun: Rerun, statistic: Statistic) -> float:
    """Return |explained fraction - 1|: 0 if the change makes the mean NIS or mean NEES 1."""
    return abs(compute_explained_fraction(rerun, statistic) - 1.0)


def brings_inside_limits(rerun: Rerun, statistic: Statistic) -> bool:
    """Return True if the mean NIS or mean NEES is inside its limits after the change.

    The mean NIS must be inside its 95 % band. The mean NEES must not be large enough to be
    reported, so MIN_REPORTED_NEES is its upper limit.
    """
    low, high = 0.0, MIN_REPORTED_NEES
    if statistic == "nis":
        low, high = compute_nis_band(rerun.after.innovations)
    return low <= (rerun.after.value(statistic) or np.nan) <= high


def makes_overconfident(rerun: Rerun, statistic: Statistic) -> bool:
    """Return True if the change makes an underconfident filter overconfident."""
    if statistic != "nis" or (rerun.before.nis_mean or 1.0) >= 1.0:
        return False
    min_nees = MIN_REPORTED_NEES
    if (rerun.before.nees_mean or 0.0) > 1.0:
        min_nees = MIN_OVERCONFIDENT_NEES_AFTER_CHANGE
    return (rerun.after.nees_mean or 0.0) >= min_nees


def find_reruns(
    reruns: Iterable[Rerun], filter_name: FilterName, axis: str, statistic: Statistic = "nis"
) -> list[Rerun]:
    """Return the re-runs of a filter along an axis that may correct the mean NIS or mean NEES."""
    return [
        rerun
        for rerun in reruns
        if (rerun.filter, rerun.axis) == (filter_name, axis) and statistic in rerun.discrepancies
    ]


def find_cause_rerun(
    reruns: Iterable[Rerun], filter_name: FilterName, axis: str, statistic: Statistic = "nis"
) -> Rerun | None:
    """Return the re-run that best brings the mean NIS or mean NEES inside its limits.

    A corrected sensor fault is preferred to a changed setting.
    """

    def rank(rerun: Rerun) -> tuple[bool, int, bool, float]:
        """Return the sort key of a re-run; the smallest key is the most likely cause."""
        explained_fraction_error = _compute_explained_fraction_error(rerun, statistic)
        is_sufficient = brings_inside_limits(rerun, statistic) or (
            rerun.corrects_sensor
            and explained_fraction_error <= ONLY_CAUSE_EXPLAINED_FRACTION_TOLERANCE
        )
        # A parameter without effect alone, for example EKF2_DELAY_MAX, does not count as a change
        change_count = len(rerun.change.keys() - CHANGE_KEYS_WITHOUT_EFFECT_ALONE)
        # False is sorted before True: prefer changes that explain the inconsistency alone, then few
        # changed values, then corrections of the sensor data, then the smallest remaining
        # inconsistency
        return (
            not is_sufficient,
            change_count,
            not rerun.corrects_sensor,
            explained_fraction_error,
        )

    causes = (
        rerun
        for rerun in find_reruns(reruns, filter_name, axis, statistic)
        if _compute_explained_fraction_error(rerun, statistic)
        <= POSSIBLE_CAUSE_EXPLAINED_FRACTION_TOLERANCE
        and not makes_overconfident(rerun, statistic)
    )
    return min(causes, key=rank, default=None)


def find_partial_corrections(reruns: Iterable[Rerun], statistic: Statistic) -> list[Rerun]:
    """Return the re-runs that bring the mean NIS or mean NEES only partly to 1, best first.

    Return no re-run if one of them brings the mean inside its limits.
    """
    candidates = [
        rerun
        for rerun in reruns
        if statistic in rerun.discrepancies
        and _compute_explained_fraction_error(rerun, statistic)
        < COMBINED_CHANGE_EXPLAINED_FRACTION_TOLERANCE
    ]
    candidates.sort(key=lambda rerun: _compute_explained_fraction_error(rerun, statistic))
    return [] if any(brings_inside_limits(rerun, statistic) for rerun in candidates) else candidates


def compute_sigma_ratio_deviation(statistics: RunStatistics) -> float:
    """Return the sum of |ln(actual σ ÷ reported σ)| over the available ratios; 0 if consistent.

    The ratios are those of :func:`compute_sigma_ratios`: from innovations, and from errors against
    ground truth.
    """
    return sum(abs(math.log(ratio)) for ratio in compute_sigma_ratios(statistics).values())


def compute_preference_key(rerun: Rerun) -> tuple[bool, int, float]:
    """Return a key to sort re-runs, best first.

    Re-runs that make the filter consistent are best, and among them those with few changes. The
    other re-runs are sorted by the remaining deviation of the reported σ.
    """
    is_made_consistent = becomes_consistent(rerun)
    return (
        not is_made_consistent,
        len(rerun.change) if is_made_consistent else 0,
        compute_sigma_ratio_deviation(rerun.after),
    )


def compute_sigma_ratios(statistics: RunStatistics) -> dict[Reference, float]:
    """Return the ratios of actual to reported σ: √(mean NIS) and √(mean NEES).

    The keys are "source" (from innovations) and "truth" (from errors against ground truth).
    """
    squared_ratios: dict[Reference, float | None] = {
        "source": statistics.nis_mean,
        "truth": statistics.nees_mean,
    }
    return {name: math.sqrt(value) for name, value in squared_ratios.items() if value}


def compute_sigma_ratio_improvement(rerun: Rerun) -> float:
    return compute_sigma_ratio_deviation(rerun.before) - compute_sigma_ratio_deviation(rerun.after)


def compare_sigma_ratios(rerun: Rerun) -> list[tuple[Reference, float, float]]:
    """Return reference ("source" or "truth"), and σ ratios before and after the change."""
    before, after = compute_sigma_ratios(rerun.before), compute_sigma_ratios(rerun.after)
    return [(name, before[name], after[name]) for name in before.keys() & after.keys()]


def becomes_consistent(rerun: Rerun, tested_reference: Reference | None = None) -> bool:
    """Return True if a change makes an inconsistent filter consistent in its re-run.

    Innovations ("source") or errors against ground truth ("truth") must show the improvement.
    ``tested_reference`` selects one of them; by default, either is sufficient.
    """
    return any(
        tested_reference in (None, reference)
        and classify_sigma_ratio(ratio_before, reference) != "consistent"
        and classify_sigma_ratio(ratio_after, reference) == "consistent"
        for reference, ratio_before, ratio_after in compare_sigma_ratios(rerun)
    )


def halves_discrepancy(rerun: Rerun) -> bool:
    """Return True if a re-run at least halves |ln(actual σ ÷ reported σ)|.

    The ratios are from innovations, and from errors against ground truth. Only ratios that are not
    consistent before the change count; one halved ratio is sufficient.
    """
    return any(
        classify_sigma_ratio(ratio_before, reference) != "consistent"
        and abs(math.log(ratio_after)) <= 0.5 * abs(math.log(ratio_before))
        for reference, ratio_before, ratio_after in compare_sigma_ratios(rerun)
    )


def remains_overconfident(rerun: Rerun) -> bool:
    """Return True if a filter is overconfident against ground truth before and after a re-run."""
    return any(
        reference == "truth"
        and classify_sigma_ratio(ratio_before, reference)
        == classify_sigma_ratio(ratio_after, reference)
        == "overconfident"
        and math.log(ratio_after) > MAX_OVERCONFIDENCE_FRACTION_AFTER_RERUN * math.log(ratio_before)
        for reference, ratio_before, ratio_after in compare_sigma_ratios(rerun)
    )


def find_rerun(
    reruns: Iterable[Rerun], filter_name: FilterName, kind: str, name: str = ""
) -> Rerun | None:
    """Return the re-run with one kind of change that improves a filter most, or None.

    ``name`` limits the search to one setting or EKF2 parameter.
    """
    return min(
        (
            rerun
            for rerun in reruns
            if rerun.filter == filter_name
            and rerun.kinds == (kind,)
            and (not name or name in rerun.change)
            and classify_improvement(rerun) != "nothing"
        ),
        key=compute_preference_key,
        default=None,
    )


def has_effect(rerun: Rerun) -> bool:
    """Return True if a re-run changes the filter's results noticeably.

    The ratio of actual to reported σ changes by more than 10 %, or the position RMSE by more than
    5 %.
    """
    rmse_before_m, rmse_after_m = rerun.before.position_rmse_m, rerun.after.position_rmse_m
    if (
        rmse_before_m
        and rmse_after_m
        and abs(rmse_after_m / rmse_before_m - 1.0) > MIN_RMSE_CHANGE_FRACTION
    ):
        return True
    return any(
        max(after / before, before / after) > MIN_SIGMA_RATIO_CHANGE_FACTOR
        for _, before, after in compare_sigma_ratios(rerun)
    )


def can_show_improvement(rerun: Rerun) -> bool:
    """Return True if the statistics of a re-run can show an improvement of the filter.

    An improvement of the position RMSE requires ground truth. An improvement of the reported σ
    requires a filter that is inconsistent before the change.
    """
    return rerun.before.position_rmse_m is not None or any(
        classify_sigma_ratio(ratio_before, reference) != "consistent"
        for reference, ratio_before, _ in compare_sigma_ratios(rerun)
    )


def classify_improvement(rerun: Rerun) -> Improvement:
    """Return the quantities that a re-run improves: position, σ, both or nothing.

    The position improves if its RMSE decreases by at least 20 %. σ improves if a ratio (actual ÷
    reported σ) becomes consistent, or |ln(ratio)| is halved, and no other ratio worsens. The ratios
    are from innovations, and from errors against ground truth.
    """
    rmse_before_m, rmse_after_m = rerun.before.position_rmse_m, rerun.after.position_rmse_m
    is_position_better = bool(
        rmse_before_m
        and rmse_after_m is not None
        and rmse_after_m <= (1.0 - MIN_RMSE_REDUCTION) * rmse_before_m
    )
    # A ratio worsens if it is farther from 1 and not consistent
    has_worse_ratio = any(
        abs(math.log(ratio_after)) > abs(math.log(ratio_before))
        and classify_sigma_ratio(ratio_after, reference) != "consistent"
        for reference, ratio_before, ratio_after in compare_sigma_ratios(rerun)
    )
    is_sigma_better = not has_worse_ratio and (
        becomes_consistent(rerun) or halves_discrepancy(rerun)
    )
    if is_position_better:
        return "position and σ" if is_sigma_better else "position"
    return "σ only" if is_sigma_better else "nothing"
