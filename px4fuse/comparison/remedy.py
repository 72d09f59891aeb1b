"""What a replay says of a remedy, of EKF2 or of our filter: what the findings share.

A change is proposed with its effect, and only where the replay confirms it. Where EKF2 cannot be
replayed, the words say so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from px4fuse.comparison.comparison import compare, kf_against_truth
from px4fuse.comparison.model import AgainstTruth, Comparison
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.whatif import Summary, what_if
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.kalman import replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.plain import capital

# How a remedy to type is written; who prints it knows the log (px4fuse.report.commands)
COMMAND = "px4fuse compare LOG"
# A noise must bring |log mean NIS| below this share of itself: what does less is not its cause
NIS_NEARER = 0.8
# Half of the rejections are an effect, not a single sample
REJECTED_FEWER = 0.5
# Times of the error to the truth; the replayed position is off by 5 mm in 0.1 m
WORSE_ERROR = 1.05
# The same of our filter, which is replayed exactly: hardly a settings changes it by less
WORSE_FILTER_ERROR = 1.005
# Shares of rejected samples below this are not worth a word
REJECTED_SHOWN = 0.005


@dataclass(frozen=True)
class Effect:
    """EKF2 replayed as flown and with a change.

    Attributes
    ----------
    changes : mapping
        By PX4 name and in PX4's units.
    before, after : Summary
    """

    changes: Mapping[str, float]
    before: Summary
    after: Summary

    def words(self) -> str:
        """What the change does, in numbers."""
        before, after = self.before, self.after
        parts = []
        if max(before.rejected_share, after.rejected_share) >= REJECTED_SHOWN:
            parts.append(f"rejected {before.rejected_share:.0%} → {after.rejected_share:.0%}")
        parts.append(f"mean NIS {_short(before.nis_mean)} → {_short(after.nis_mean)}")
        errors = before.position_rmse_to_truth_m, after.position_rmse_to_truth_m
        if any(isinstance(error, Unavailable) for error in errors):
            parts.append(f"innovations {_std(before):.3f} → {_std(after):.3f} m rms, no truth")
        else:
            parts.append(f"position error {errors[0]:.2f} → {errors[1]:.2f} m")
        return f"{', '.join(parts)} (replayed)"


Judge = Callable[[Summary, Summary], bool]


def replayed(
    model: Model | Unavailable, *candidates: Mapping[str, float]
) -> list[Effect] | Unavailable:
    """What each of some changes would do.

    Parameters
    ----------
    model : Model or Unavailable
        Of the flight.
    *candidates : mapping
        Changes by PX4 name and in PX4's units.
    """
    if isinstance(model, Unavailable):
        return model
    found = what_if(model, candidates)
    if isinstance(found, Unavailable):
        return found
    return [
        Effect(changes, found.replayed, after)
        for changes, after in zip(candidates, found.whatif, strict=True)
    ]


def remedy_words(
    model: Model | Unavailable,
    changes: Mapping[str, float],
    helps: Judge,
    *,
    why: str = "",
    otherwise: str,
) -> tuple[str, bool]:
    """A change of EKF2's parameters in words, and whether it is a remedy: no replay denies it.

    Parameters
    ----------
    model : Model or Unavailable
        Of the flight.
    changes : mapping
    helps : callable
        From EKF2 as flown and as changed to whether that is a remedy.
    why : str
        Words before it: what the data ask for.
    otherwise : str
        What to do where the replay says that it is none.
    """
    setting = f"{why}set {settings_words(changes)}"
    found = replayed(model, changes)
    if isinstance(found, Unavailable):
        return f"{capital(setting)}. {not_replayed(found)}", True
    (effect,) = found
    if helps(effect.before, effect.after):
        return f"{capital(setting)}: {effect.words()}.", True
    said = ", ".join(f"{name} {value:.3g}" for name, value in changes.items())
    return f"{otherwise} {said} is no remedy: {effect.words()}.", False


def filter_errors_m(comparison: Comparison, changed: Settings) -> tuple[float, float] | None:
    """Position error (m) of our filter to the truth, as it is and with other settings.

    Root of the sum of the mean squares of all axes but the aisle, which is made of the others.
    None without a truth.
    """
    names = set(comparison.axes)
    results = [r for r in comparison.axes.values() if r.axis.name != AISLE or names == {AISLE}]
    before = [result.filters["kf"].truth for result in results]
    if changed.clock_offset_s == comparison.settings.clock_offset_s:
        runs = [replay(result.axis, changed) for result in results]
        after = []
        for result, run in zip(results, runs, strict=True):
            state = result.ekf2_state
            timed = result.replay.steps if isinstance(state, Unavailable) else state
            after.append(kf_against_truth(run, result.truth, timed.index.to_numpy()))
    else:  # the measurements themselves are at other times
        again = compare(
            comparison.flight,
            changed,
            axes=tuple(result.axis.name for result in results),
            heading_deg=results[0].axis.heading_deg if names == {AISLE} else None,
            position_source=comparison.source.name,
            start_s=comparison.segment.start_s,
            end_s=comparison.segment.end_s,
        )
        after = [result.filters["kf"].truth for result in again.axes.values()]
    first, second = (
        [error.position_rmse_m for error in errors if isinstance(error, AgainstTruth)]
        for errors in (before, after)
    )
    if min(len(first), len(second)) < len(results):
        return None
    return math.hypot(*first), math.hypot(*second)


def filter_words(
    comparison: Comparison, changed: Settings, typed: str, unseen_nats: float | None = None
) -> str:
    """Other settings of our filter as a remedy, as far as truth or unseen data confirm it.

    Parameters
    ----------
    comparison : Comparison
    changed : Settings
    typed : str
        The options that make them.
    unseen_nats : float or None
        What settings found on one half gain per measurement of the other; None where not known.
    """
    errors = filter_errors_m(comparison, changed)
    if errors is None:
        if unseen_nats is not None and unseen_nats <= 0.0:
            return (
                f"Leave it: {typed} is most likely, but settings found on the first half of the "
                "flight do no better on the second."
            )
        return f"{COMMAND} {typed}."
    before, after = errors
    effect = f"position error {before:.3f} → {after:.3f} m (replayed)"
    if after > WORSE_FILTER_ERROR * before:
        return f"Leave it: {typed} fits the innovations better, but not the truth: {effect}."
    return f"{COMMAND} {typed}: {effect}."


def not_replayed(why: Unavailable) -> str:
    """That a remedy was not tried, and why."""
    return f"Not replayed: {why.reason}."


def settings_words(changes: Mapping[str, float]) -> str:
    """Parameters and the values to set."""
    parts = []
    for name, value in changes.items():
        unit = f" {PARAMETERS[name].unit}" if PARAMETERS[name].unit else ""
        parts.append(f"{name} to {value:.3g}{unit}")
    return " and ".join(parts)


def noise_helps(before: Summary, after: Summary) -> bool:
    """Whether another noise brings the mean NIS nearer to 1, and neither rejects nor errs more."""
    nearer = abs(math.log(after.nis_mean)) < NIS_NEARER * abs(math.log(before.nis_mean))
    more = after.rejected_share > before.rejected_share or _errs_more(before, after)
    return nearer and not more


def rejects_less(before: Summary, after: Summary) -> bool:
    """Whether far fewer samples are rejected, and the position is not worse."""
    fewer = after.rejected_share < REJECTED_FEWER * before.rejected_share
    return fewer and not _errs_more(before, after)


def delay_helps(before: Summary, after: Summary) -> bool:
    """Whether the innovations become smaller, and the error to the truth where there is one."""
    errors = before.position_rmse_to_truth_m, after.position_rmse_to_truth_m
    if isinstance(errors[0], float) and isinstance(errors[1], float) and errors[1] >= errors[0]:
        return False
    return _std(after) < _std(before) and after.rejected_share <= before.rejected_share


def _errs_more(before: Summary, after: Summary) -> bool:
    errors = before.position_rmse_to_truth_m, after.position_rmse_to_truth_m
    if isinstance(errors[0], Unavailable) or isinstance(errors[1], Unavailable):
        return False
    return errors[1] > WORSE_ERROR * errors[0]


def _std(summary: Summary) -> float:
    """Standard deviation of the innovations per axis (m)."""
    squares = [axis.innovation_std_m**2 for axis in summary.axes.values()]
    return math.sqrt(sum(squares) / len(squares))


def _short(nis: float) -> str:
    return f"{nis:.0f}" if nis >= 9.95 else f"{nis:.1f}" if nis >= 0.095 else f"{nis:.2g}"
