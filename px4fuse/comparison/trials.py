"""Re-runs of a filter along the main axis with a change, and the statistics that they improve."""

import math
from collections.abc import Iterable, Mapping
from typing import Literal

from px4fuse.comparison.model import FilterName
from px4fuse.core.record import Count, NotNegative, Positive, Record, Share
from px4fuse.filter.consistency import Reference, classify_ratio

Statistic = Literal["nis", "nees", "difference"]
Change = Mapping[str, float]
Improvement = Literal["position and σ", "position", "σ only", "nothing"]
# Minimum factor on a σ ratio, or relative change of the position RMSE, for a re-run to have an
# effect
MIN_RATIO_CHANGE, MIN_RMSE_CHANGE = 1.10, 0.05
# Minimum relative reduction of the position RMSE for a re-run to improve the position
POSITION_IMPROVEMENT = 0.20
# A re-run leaves an error if ln(error ÷ σ) stays above this fraction of its value before
MAX_ERROR_LEFT = 0.75


class RunStatistics(Record, frozen=True, kw_only=True):
    """Statistics of one filter along one axis in one run (flown, or re-run with a change).

    Attributes
    ----------
    innovations : int
    nis_mean : float or None
    position_rmse_m, nees_mean : float or None
        Against ground truth, at the times of EKF2's published state.
    difference_rms_m : float or None
        RMS of KF - EKF2 in position.
    rejected_fraction : float or None
        Fraction of positions that EKF2 rejected; None for KF, which has no gate.
    """

    innovations: Count = 0
    nis_mean: Positive | None = None
    position_rmse_m: NotNegative | None = None
    nees_mean: NotNegative | None = None
    difference_rms_m: NotNegative | None = None
    rejected_fraction: Share | None = None

    def value(self, statistic: Statistic) -> float | None:
        """Return the mean NIS, mean NEES or RMS difference KF - EKF2."""
        return {
            "nis": self.nis_mean,
            "nees": self.nees_mean,
            "difference": self.difference_rms_m,
        }[statistic]


class Trial(Record, frozen=True, kw_only=True):
    """Re-run of one filter along the main axis with one or two changes.

    Attributes
    ----------
    filter : {"kf", "ekf2"}
    kinds : tuple of str
        Kind of each change: for KF noises, defaults or bias, for EKF2 delay, noise, gate or process
        noise, for both outliers, time offset or rotation.
    change : mapping from name to value
        See :class:`px4fuse.comparison.causal_replays.Intervention`.
    before : RunStatistics
        Statistics as flown, of the same samples; for EKF2 from the log.
    after : RunStatistics
        Statistics with the change; for EKF2 from its replay.
    from_s : float or None
        Start of the evaluated time; None for the whole segment.
    """

    filter: FilterName
    kinds: tuple[str, ...]
    change: Change
    before: RunStatistics
    after: RunStatistics
    from_s: float | None = None


def distance_from_one(outcome: RunStatistics) -> float:
    """Return the sum of |ln σ ratio|, against source and ground truth."""
    means = [mean for mean in (outcome.nis_mean, outcome.nees_mean) if mean]
    return sum(0.5 * abs(math.log(mean)) for mean in means)


def preference(trial: Trial) -> tuple[bool, int, float]:
    """Return the sort key of re-runs of one kind; the best re-run has the smallest key."""
    enters = enters_band(trial)
    return not enters, len(trial.change) if enters else 0, distance_from_one(trial.after)


def ratios(outcome: RunStatistics) -> dict[Reference, float]:
    """Return the σ ratios (actual over reported) against source and ground truth."""
    means: dict[Reference, float | None] = {
        "source": outcome.nis_mean,
        "truth": outcome.nees_mean,
    }
    return {against: math.sqrt(mean) for against, mean in means.items() if mean}


def reduction(trial: Trial) -> float:
    """Return the reduction of :func:`distance_from_one` by a re-run."""
    return distance_from_one(trial.before) - distance_from_one(trial.after)


def ratio_pairs(trial: Trial) -> list[tuple[Reference, float, float]]:
    """Return reference (source or ground truth) and σ ratio before and after a re-run."""
    before, after = ratios(trial.before), ratios(trial.after)
    return [(name, before[name], after[name]) for name in before.keys() & after.keys()]


def enters_band(trial: Trial) -> bool:
    """Return True if a re-run makes a σ ratio consistent."""
    return any(
        classify_ratio(before, name) != "consistent" and classify_ratio(after, name) == "consistent"
        for name, before, after in ratio_pairs(trial)
    )


def halves(trial: Trial) -> bool:
    """Return True if a re-run halves |ln σ ratio| of an inconsistent ratio."""
    return any(
        classify_ratio(before, name) != "consistent"
        and abs(math.log(after)) <= 0.5 * abs(math.log(before))
        for name, before, after in ratio_pairs(trial)
    )


def leaves_error(trial: Trial) -> bool:
    """Return True if a filter stays overconfident against ground truth by nearly as much."""
    return any(
        name == "truth"
        and classify_ratio(before, name) == classify_ratio(after, name) == "overconfident"
        and math.log(after) > MAX_ERROR_LEFT * math.log(before)
        for name, before, after in ratio_pairs(trial)
    )


def find_trial(
    trials: Iterable[Trial], owner: FilterName, kind: str, name: str = ""
) -> Trial | None:
    """Return the best re-run of one filter with one kind of change, or None if none improves.

    Parameters
    ----------
    trials : iterable of Trial
    owner : {"kf", "ekf2"}
    kind : str
        See :attr:`Trial.kinds`.
    name : str
        Setting or parameter that the change contains; empty for any.
    """
    return min(
        (
            trial
            for trial in trials
            if trial.filter == owner
            and trial.kinds == (kind,)
            and (not name or name in trial.change)
            and improvement(trial) != "nothing"
        ),
        key=preference,
        default=None,
    )


def has_effect(trial: Trial) -> bool:
    """Return True if a re-run changes a σ ratio by 10 % or the position RMSE by 5 %."""
    if any(
        not 1.0 / MIN_RATIO_CHANGE <= after / before <= MIN_RATIO_CHANGE
        for _, before, after in ratio_pairs(trial)
    ):
        return True
    before, after = trial.before.position_rmse_m, trial.after.position_rmse_m
    return bool(before and after and abs(after / before - 1.0) > MIN_RMSE_CHANGE)


def can_improve(trial: Trial) -> bool:
    """Return True if a re-run could show an improvement.

    This requires a known position RMSE, or a σ ratio that is inconsistent without the change.
    """
    return trial.before.position_rmse_m is not None or any(
        classify_ratio(before, name) != "consistent" for name, before, _ in ratio_pairs(trial)
    )


def improvement(trial: Trial) -> Improvement:
    """Return the quantities that a re-run improves: position, σ, both or nothing.

    Position: the RMSE is lower by 20 %. σ: a σ ratio (against source or ground truth) becomes
    consistent or its |ln| halves, and the other one does not get worse.
    """
    before_m, after_m = trial.before.position_rmse_m, trial.after.position_rmse_m
    is_position_better = bool(
        before_m and after_m is not None and after_m <= (1.0 - POSITION_IMPROVEMENT) * before_m
    )
    is_sigma_better = (enters_band(trial) or halves(trial)) and all(
        abs(math.log(after)) <= abs(math.log(before)) or classify_ratio(after, name) == "consistent"
        for name, before, after in ratio_pairs(trial)
    )
    if is_position_better:
        return "position and σ" if is_sigma_better else "position"
    return "σ only" if is_sigma_better else "nothing"
