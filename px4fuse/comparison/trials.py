"""Re-runs of a filter along the main axis, and which numbers they improve.

The re-runs are made by :mod:`px4fuse.comparison.causal_replays`.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Literal

from px4fuse.comparison.model import FilterName
from px4fuse.filter.consistency import Reference, classify_ratio
from px4fuse.record import Count, NotNegative, Positive, Record, Share

Statistic = Literal["nis", "nees", "difference"]
Change = Mapping[str, float]
Improvement = Literal["position and σ", "position", "σ only", "nothing"]
# A re-run that changes ratios and error by less has no effect
MIN_RATIO_CHANGE, MIN_RMSE_CHANGE = 1.10, 0.05
# Reduction of the position RMSE from which a re-run improves the position
POSITION_IMPROVEMENT = 0.20


class Outcome(Record, frozen=True, kw_only=True):
    """Statistics of one filter along one axis in one run.

    Attributes
    ----------
    innovations : int
    nis_mean : float or None
    position_rmse_m, nees_mean : float or None
        Against ground truth, at the times of EKF2's published state.
    difference_rms_m : float or None
        RMS of KF - EKF2 in position.
    rejected_fraction : float or None
        Of EKF2; None for KF, which has no gate.
    """

    innovations: Count = 0
    nis_mean: Positive | None = None
    position_rmse_m: NotNegative | None = None
    nees_mean: NotNegative | None = None
    difference_rms_m: NotNegative | None = None
    rejected_fraction: Share | None = None

    def value(self, statistic: Statistic) -> float | None:
        """Return one of the three statistics."""
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
        Kind of each change: noises, defaults, outliers, time offset, delay, rotation, bias, noise,
        gate or process noise.
    change : mapping from name to value
        See :class:`px4fuse.comparison.causal_replays.Intervention`.
    before : Outcome
        As flown, of the same samples: KF as run, EKF2 from the log.
    after : Outcome
        With the change; EKF2 by its replay.
    from_s : float or None
        Start of the replay.
    """

    filter: FilterName
    kinds: tuple[str, ...]
    change: Change
    before: Outcome
    after: Outcome
    from_s: float | None = None


def distance_from_one(outcome: Outcome) -> float:
    """Return the sum of |ln ratio| of actual to reported σ, against source and ground truth."""
    means = [mean for mean in (outcome.nis_mean, outcome.nees_mean) if mean]
    return sum(0.5 * abs(math.log(mean)) for mean in means)


def preference(trial: Trial) -> tuple[bool, int, float]:
    """Sort key of re-runs of one kind; the best one is the smallest."""
    enters = enters_band(trial)
    return not enters, len(trial.change) if enters else 0, distance_from_one(trial.after)


def ratios(outcome: Outcome) -> dict[Reference, float]:
    """Return the ratios of actual to reported σ, against source and ground truth."""
    means: dict[Reference, float | None] = {
        "source": outcome.nis_mean,
        "truth": outcome.nees_mean,
    }
    return {against: math.sqrt(mean) for against, mean in means.items() if mean}


def reduction(trial: Trial) -> float:
    """Return by how much a re-run reduces :func:`distance_from_one`."""
    return distance_from_one(trial.before) - distance_from_one(trial.after)


def ratio_pairs(trial: Trial) -> list[tuple[Reference, float, float]]:
    """Return the ratios before and after a re-run, by reference."""
    before, after = ratios(trial.before), ratios(trial.after)
    return [(name, before[name], after[name]) for name in before.keys() & after.keys()]


def enters_band(trial: Trial) -> bool:
    """Return True if a re-run brings a ratio into its band."""
    return any(
        classify_ratio(before, name) != "consistent" and classify_ratio(after, name) == "consistent"
        for name, before, after in ratio_pairs(trial)
    )


def halves(trial: Trial) -> bool:
    """Return True if a re-run halves the logarithm of a ratio that is outside its band."""
    return any(
        classify_ratio(before, name) != "consistent"
        and abs(math.log(after)) <= 0.5 * abs(math.log(before))
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
    """Return True if a re-run changes a ratio by 10 % or the position RMSE by 5 %."""
    if any(
        not 1.0 / MIN_RATIO_CHANGE <= after / before <= MIN_RATIO_CHANGE
        for _, before, after in ratio_pairs(trial)
    ):
        return True
    before, after = trial.before.position_rmse_m, trial.after.position_rmse_m
    return bool(before and after and abs(after / before - 1.0) > MIN_RMSE_CHANGE)


def can_improve(trial: Trial) -> bool:
    """Return True if a re-run could show an improvement.

    The position RMSE must be known, or a ratio be outside its band before.
    """
    return trial.before.position_rmse_m is not None or any(
        classify_ratio(before, name) != "consistent" for name, before, _ in ratio_pairs(trial)
    )


def improvement(trial: Trial) -> Improvement:
    """Return which numbers a re-run improves.

    Position: RMSE lower by 20 %. σ: |ln ratio| halves or enters the band, against the source or
    ground truth, and gets worse against neither.
    """
    before_m, after_m = trial.before.position_rmse_m, trial.after.position_rmse_m
    is_position_better = bool(
        before_m and after_m is not None and after_m <= (1.0 - POSITION_IMPROVEMENT) * before_m
    )
    changes = [
        (
            abs(math.log(was)),
            abs(math.log(becomes)),
            classify_ratio(was, name),
            classify_ratio(becomes, name),
        )
        for name, was, becomes in ratio_pairs(trial)
    ]
    is_sigma_better = any(
        word != "consistent" and (word_after == "consistent" or becomes <= 0.5 * was)
        for was, becomes, word, word_after in changes
    ) and all(
        becomes <= was or word_after == "consistent" for was, becomes, _, word_after in changes
    )
    if is_position_better:
        return "position and σ" if is_sigma_better else "position"
    return "σ only" if is_sigma_better else "nothing"
