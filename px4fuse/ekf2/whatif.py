"""What EKF2 would have done with other parameters: logged, replayed and changed side by side.

All three are judged over the same times, in the same way.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace

from px4fuse.arrays import Array
from px4fuse.display import one_line_repr
from px4fuse.ekf2.inputs import horizontal_resets_s
from px4fuse.ekf2.model import Model, modelled_aids, replay_settings, with_position_noise
from px4fuse.ekf2.replay import (
    HORIZONTAL,
    Agreement,
    Ekf2Replay,
    Spans,
    along,
    axes_of,
    inside_spans,
    logged_aid_innovations,
    logged_innovations,
    rms_to_truth,
)
from px4fuse.ekf2_parameters import EV_POS, GNSS_POS, MAG, check_parameters
from px4fuse.errors import SettingsError
from px4fuse.filter.consistency import nis_band
from px4fuse.filter.heading import heading_rad
from px4fuse.flight import AxisName, Columns, Ekf2, Flight, Unavailable
from px4fuse.record import Count, NotNegative, Record, Share, missing_data

ANALYSIS_NAME = "EKF2 what-if"
# Below this share of EKF2's samples in the log, gaps between fusions cannot be told from it
MIN_COMPLETE_SHARE = 0.9
NO_TRUTH = missing_data("rmse_without_truth")
# Of a flight on GNSS
HEADING_FOLLOWS = (
    "The heading follows, with the magnetometer as EKF2 fused it (as flown it is {:.1f}° off the "
    "log, RMS)"
)
HEADING_STAYS = (
    "The heading is EKF2's own as flown, whatever is changed: the log does not hold what EKF2 "
    "fused of a magnetometer, all axes throughout"
)
HEIGHT_FOLLOWS, HEIGHT_STAYS = "The height follows too", "The height is EKF2's own as flown"
OWN_HEADING, OWN_HEIGHT = missing_data("heading_own"), missing_data("height_own")
# What must be left to judge once an aid is taken away
MIN_EVALUATED_S = 5.0
SWEEP_VALUES = 9
MAX_SWEEP_VALUES = 200
# Each rejection decides the next: a prediction is steady where millimetres of noise on positions
# leave it where it was, and never where most samples are rejected
DISTURBED_M, DISTURBED_RUNS = 0.002, 4
MIN_REJECTED_SHARE, MAX_REJECTED_SHARE = 0.02, 0.35
# After so long without a height EKF2 resets it (hgt_fusion_timeout_max, common.h)
HEIGHT_TIMEOUT_S = 5.0
MAX_NIS_RATIO, MAX_REJECTED_SPREAD, MAX_RMSE_RATIO = 1.10, 0.03, 1.15


class AxisSummary(Record, frozen=True):
    """One axis of one EKF2.

    Attributes
    ----------
    nis_mean : float
        Of all samples that it tried to fuse, rejected ones included.
    nis_band : (float, float)
        Two-sided 95 % band of that mean for a consistent filter.
    innovation_std_m : float
    sigma_p_median_m : float or Unavailable
        Standard deviation of position that it states.
    position_rmse_to_truth_m : float or Unavailable
        Of what it publishes.
    """

    nis_mean: NotNegative
    nis_band: tuple[NotNegative, NotNegative]
    innovation_std_m: NotNegative
    sigma_p_median_m: NotNegative | Unavailable
    position_rmse_to_truth_m: NotNegative | Unavailable


class HeightSummary(Record, frozen=True):
    """One sensor of height, or vision besides GNSS, of one EKF2: of all that it tried to fuse.

    Attributes
    ----------
    nis_mean : float
    nis_band : (float, float)
    innovation_std_m : float
    rejected_share : float
    longest_without_fusion_s : float
    """

    nis_mean: NotNegative
    nis_band: tuple[NotNegative, NotNegative]
    innovation_std_m: NotNegative
    rejected_share: Share
    longest_without_fusion_s: NotNegative

    @property
    def steady(self) -> bool:
        """Whether it goes on without the resets of EKF2's height, which the model does not have."""
        is_without_reset = self.longest_without_fusion_s <= HEIGHT_TIMEOUT_S
        return is_without_reset and self.rejected_share <= MAX_REJECTED_SHARE


class Summary(Record, frozen=True, kw_only=True, omit_defaults=False):
    """One EKF2: as logged, as replayed, or with other parameters.

    Attributes
    ----------
    changed : mapping
        Parameters that differ from those flown.
    without : mapping from PX4's name of an aid to float
        From when on (s) it is not fused.
    north, east : AxisSummary
    samples : int
    rejected_share : float
    longest_without_fusion_s : float or Unavailable
    resets : int
        Of horizontal position.
    heading_error_mean_deg : float or Unavailable
        Heading minus the truth's, clockwise seen from above.
    heights : mapping from PX4's name of an aid to HeightSummary
        Of the sensors of height that the replay fuses; empty where the height is EKF2's own.
    others : mapping from PX4's name of an aid to HeightSummary
        Of vision that is fused besides GNSS, north and east together; empty where there is none.
    height_rmse_to_truth_m : float or Unavailable
    late, lost : int
        Samples that arrived after the fusion horizon had passed them: fused late, and never.
    steady : bool
        False where it is chaotic: single rejections decide, so that its numbers predict nothing.
    """

    changed: Mapping[str, float]
    north: AxisSummary
    east: AxisSummary
    samples: Count
    rejected_share: Share
    longest_without_fusion_s: NotNegative | Unavailable
    resets: Count
    heading_error_mean_deg: float | Unavailable = OWN_HEADING
    heights: Mapping[str, HeightSummary] = {}
    others: Mapping[str, HeightSummary] = {}
    height_rmse_to_truth_m: NotNegative | Unavailable = OWN_HEIGHT
    late: Count = 0
    lost: Count = 0
    steady: bool = True
    without: Mapping[str, float] = {}

    @property
    def axes(self) -> dict[str, AxisSummary]:
        """By axis."""
        return {"north": self.north, "east": self.east}

    @property
    def nis_mean(self) -> float:
        """Of north and east together."""
        return float(np.mean([axis.nis_mean for axis in self.axes.values()]))

    @property
    def position_rmse_to_truth_m(self) -> float | Unavailable:
        """Horizontal, of what it publishes."""
        squares = 0.0
        for axis in self.axes.values():
            if isinstance(axis.position_rmse_to_truth_m, Unavailable):
                return axis.position_rmse_to_truth_m
            squares += axis.position_rmse_to_truth_m**2
        return float(np.sqrt(squares))


@dataclass(frozen=True)
class WhatIf:
    """Side by side.

    Attributes
    ----------
    agreement : Agreement
        Of replay and log: what entitles one to believe the rest.
    logged, replayed : Summary
        As flown, by the log and by the model.
    whatif : tuple of Summary
        With each of the settings.
    judged : tuple of (float, float)
        Times that all of them are judged over.
    notes : tuple of str
        What to keep in mind, each a sentence.
    """

    agreement: Agreement
    logged: Summary
    replayed: Summary
    whatif: tuple[Summary, ...]
    judged: Spans
    notes: tuple[str, ...]

    __repr__ = one_line_repr


def what_if(
    model: Model,
    settings: Sequence[Mapping[str, float]],
    without: Mapping[str, float] | None = None,
) -> WhatIf | Unavailable:
    """What EKF2 would have done with other parameters.

    Parameters
    ----------
    model : Model
    settings : sequence of mapping
        What each changes, by PX4 name and in PX4's units.
    without : mapping from PX4's name of an aid to float, optional
        From when on (s) it is not fused, besides; all are judged from then on.

    Returns
    -------
    WhatIf or Unavailable
        Unavailable where the model does not reproduce what was logged.

    Raises
    ------
    SettingsError
        A parameter or an aid that the model does not have, a value outside PX4's range, or a time
        after which nothing is left to judge.
    """
    if not model.agreement.good:
        return model.agreement.as_unavailable(ANALYSIS_NAME)
    without = without or {}
    replays = replay_settings(model, settings, without=without)
    flight, judged = model.flight, model.flown.judged_s
    if without:
        since = min(without.values())
        # each further stretch starts anew from the log, which had the aid
        remaining_spans = [
            (max(start, since), end) for start, end in judged if end - since > MIN_EVALUATED_S
        ]
        judged = tuple(remaining_spans[:1])
        if not judged:
            raise SettingsError.of(
                "since_late",
                since=since,
                least_s=MIN_EVALUATED_S,
                end_s=model.flown.judged_s[-1][1],
            )
    gnss = model.inputs.aid == GNSS_POS
    return WhatIf(
        agreement=model.agreement,
        logged=_summarise_log(flight, model.flown, judged),
        replayed=_summarise_replay(flight, model.flown, judged),
        whatif=_mark_unpredictable(
            model, [_summarise_replay(flight, r, judged) for r in replays], judged, without
        ),
        judged=judged,
        notes=(
            *(_heading_and_height_notes(model) if replays and gnss else ()),
            *(note for replay in replays for note in _notes(model, replay)),
            *(_deviation_note(model, replay, without, judged) for replay in replays if without),
        ),
    )


def _heading_and_height_notes(model: Model) -> tuple[str, str]:
    off_deg = model.agreement.heading_rms_difference_deg
    heading = HEADING_STAYS if off_deg is None else HEADING_FOLLOWS.format(off_deg)
    return heading, HEIGHT_STAYS if model.inputs.imposed else HEIGHT_FOLLOWS


def sweep_values(name: str, low: float, high: float, count: int = SWEEP_VALUES) -> list[float]:
    """Values of a parameter from one to another, both included.

    Equal ratios between values above zero, else equal steps.

    Raises
    ------
    SettingsError
        Unknown name, a value outside PX4's range, ends in the wrong order, or a senseless count.

    Examples
    --------
    >>> sweep_values("EKF2_EV_DELAY", 0, 200, 3)
    [0.0, 100.0, 200.0]
    """
    check_parameters({name: low})
    check_parameters({name: high})
    if not low < high:
        raise SettingsError(f"{name}={low:g}:{high:g}: the first value must be the smaller one.")
    if not 2 <= count <= MAX_SWEEP_VALUES:
        raise SettingsError(f"{count} values are not between 2 and {MAX_SWEEP_VALUES}.")
    values = np.geomspace(low, high, count) if low > 0 else np.linspace(low, high, count)
    values[[0, -1]] = low, high
    return [float(value) for value in values]


def _mark_unpredictable(
    model: Model, summaries: Sequence[Summary], judged: Spans, without: Mapping[str, float]
) -> tuple[Summary, ...]:
    """Predictions, with whether each stays where it is when the positions are disturbed."""
    runs = [[summary] for summary in summaries]
    uncertain_runs = [
        repeated_runs
        for repeated_runs in runs
        if repeated_runs[0].changed
        and MIN_REJECTED_SHARE < repeated_runs[0].rejected_share <= MAX_REJECTED_SHARE
    ]
    for seed in range(DISTURBED_RUNS if uncertain_runs else 0):
        disturbed_model = with_position_noise(model, DISTURBED_M, seed)
        repeated_replays = replay_settings(
            disturbed_model,
            [repeated_runs[0].changed for repeated_runs in uncertain_runs],
            without=without,
        )
        for repeated_runs, replay in zip(uncertain_runs, repeated_replays, strict=True):
            repeated_runs.append(_summarise_replay(model.flight, replay, judged))
    return tuple(
        replace(
            summary,
            steady=all(height.steady for height in summary.heights.values())
            and all(
                disturbed_model.rejected_share <= MAX_REJECTED_SHARE
                for disturbed_model in summary.others.values()
            )
            and (
                not summary.changed
                or (summary.rejected_share <= MAX_REJECTED_SHARE and _agree(repeated_runs))
            ),
            without=without,
        )
        for summary, repeated_runs in zip(summaries, runs, strict=True)
    )


def _agree(runs: Sequence[Summary]) -> bool:
    """Whether all say the same of consistency, rejections and error."""
    rmse = [e for summary in runs if isinstance(e := summary.position_rmse_to_truth_m, float)]
    shares = [summary.rejected_share for summary in runs]
    nis = [[summary.axes[axis].nis_mean for summary in runs] for axis in HORIZONTAL]
    return (
        all(max(values) <= MAX_NIS_RATIO * min(values) for values in nis)
        and max(shares) - min(shares) <= MAX_REJECTED_SPREAD
        and (not rmse or max(rmse) <= MAX_RMSE_RATIO * min(rmse))
    )


def _summarise_replay(flight: Flight, replay: Ekf2Replay, judged: Spans) -> Summary:
    updates = replay.updates
    evaluated_updates, fused_at_s = (
        updates[inside_spans(updates.index, judged)],
        updates["fused_at_s"].to_numpy(),
    )
    # between the samples the variance grows from after one to before the next
    variance = pd.DataFrame(index=np.column_stack([fused_at_s - 1e-6, fused_at_s]).ravel())
    for axis in HORIZONTAL:
        s, r = (updates[f"{of}_variance_{axis}_m2"] for of in ("innovation", "observation"))
        after = updates[f"position_variance_{axis}_m2"]
        variance[f"{axis}_m2"] = np.column_stack([s - r, after]).ravel()
    fused = evaluated_updates["fused_at_s"][
        (evaluated_updates["fused"] > 0) | (evaluated_updates["reset"] > 0)
    ]
    resets = evaluated_updates["reset"].sum()
    if (vision := replay.other_aid_updates.get(EV_POS.name)) is not None:
        resets += vision["reset"][inside_spans(vision["fused_at_s"], judged)].sum()
    return _make_summary(
        flight,
        replay,
        judged,
        evaluated_updates,
        replay.published,
        variance,
        replay.other_aid_updates,
        replay.delayed["heading_rad"],
        changed=replay.changed,
        longest_without_fusion_s=_longest_between_fusions(fused.to_numpy(), judged),
        resets=int(resets),
        late=replay.late,
        lost=replay.lost,
    )


def _summarise_log(flight: Flight, replay: Ekf2Replay, judged: Spans) -> Summary:
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    logged = logged_innovations(ekf2)
    evaluated_updates = logged[inside_spans(logged.index, judged)]
    horizon_s = 0.0 if isinstance(ekf2.horizon_s, Unavailable) else ekf2.horizon_s
    resets = horizontal_resets_s(ekf2) - horizon_s
    resets = resets[inside_spans(resets, judged)]
    replayed = int(inside_spans(replay.updates.index, judged).sum())
    longest: float | Unavailable = missing_data(
        "fusions_few", count=len(evaluated_updates), of=replayed
    )
    if len(evaluated_updates) > MIN_COMPLETE_SHARE * replayed:
        fused = evaluated_updates.index[evaluated_updates["rejected"] == 0].to_numpy()
        longest = _longest_between_fusions(np.concatenate([fused, resets]), judged)
    assert isinstance(flight.attitude, pd.DataFrame)  # it was replayed
    heading = pd.Series(heading_rad(flight.attitude), flight.attitude.index)
    other_aid_updates = {
        name: logged_aid_innovations(name, ekf2.aids[name]) for name in replay.other_aid_updates
    }
    return _make_summary(
        flight,
        replay,
        judged,
        evaluated_updates,
        ekf2.state,
        None,
        other_aid_updates,
        heading,
        changed={},
        longest_without_fusion_s=longest,
        resets=len(resets),
    )


def _make_summary(
    flight: Flight,
    replay: Ekf2Replay,
    judged: Spans,
    evaluated_updates: pd.DataFrame,
    published: pd.DataFrame,
    variance: pd.DataFrame | None,
    other_aid_updates: Mapping[str, pd.DataFrame],
    heading: pd.Series,
    **more: Any,
) -> Summary:
    """What innovations, the published position and its stated variance show, and ``more``.

    None is the variance that EKF2 logs; any other is taken at its times too.
    """
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    logged = ekf2.variance
    times = ekf2.state.index[inside_spans(ekf2.state.index, judged)].to_numpy()

    def error_m(direction: Array) -> float | Unavailable:
        position = along(published, Columns.POSITION, direction, times)
        error = rms_to_truth(flight, position, direction, times)
        return NO_TRUTH if error is None else error

    for axis, direction in zip(HORIZONTAL, np.eye(3), strict=False):
        sigma: float | Unavailable
        if isinstance(logged, Unavailable):
            sigma = logged
        else:
            variance_s = logged.index[inside_spans(logged.index, judged)].to_numpy()
            known_variance = logged if variance is None else variance
            stated = np.interp(variance_s, known_variance.index, known_variance[f"{axis}_m2"])
            sigma = float(np.sqrt(np.median(stated)))
        more[axis] = AxisSummary(
            *_innovation_statistics(evaluated_updates, axis), sigma, error_m(direction)
        )
    heights = {
        name: _summarise_aid(evaluated, judged)
        for name, each in other_aid_updates.items()
        if len(evaluated := each[inside_spans(each.index, judged)])
    }
    if vision := heights.pop(EV_POS.name, None):
        more["others"] = {EV_POS.name: vision}
    if other_aid_updates.keys() - {EV_POS.name}:
        more["heights"], more["height_rmse_to_truth_m"] = heights, error_m(np.eye(3)[2])
    return Summary(
        samples=len(evaluated_updates),
        rejected_share=float(evaluated_updates["rejected"].mean()),
        heading_error_mean_deg=_heading_error(flight, replay, heading, judged),
        **more,
    )


def _innovation_statistics(
    updates: pd.DataFrame, *axes: AxisName
) -> tuple[float, tuple[float, float], float]:
    """Mean NIS, its band, and the innovations' standard deviation, of some axes together."""
    nu = updates[[f"innovation_{axis}_m" for axis in axes]].to_numpy().ravel()
    s = updates[[f"innovation_variance_{axis}_m2" for axis in axes]].to_numpy().ravel()
    return float(np.mean(nu**2 / s)), nis_band(len(nu)), float(np.std(nu))


def _summarise_aid(evaluated_updates: pd.DataFrame, judged: Spans) -> HeightSummary:
    rejected = evaluated_updates["rejected"].to_numpy()
    fused_s = evaluated_updates.index.to_numpy()[rejected == 0.0]
    fusions_by_span = ((fused_s[(fused_s > a) & (fused_s < b)], ((a, b),)) for a, b in judged)
    longest_s = max(_longest_between_fusions(*part) for part in fusions_by_span)
    return HeightSummary(
        *_innovation_statistics(evaluated_updates, *axes_of(evaluated_updates)),
        float(rejected.mean()),
        longest_s,
    )


def _heading_error(
    flight: Flight, replay: Ekf2Replay, heading: pd.Series, judged: Spans
) -> float | Unavailable:
    """Mean of a heading (rad) minus the truth's, in degrees."""
    if GNSS_POS.noise not in replay.settings:
        return OWN_HEADING
    true_attitude = None if isinstance(flight.truth, Unavailable) else flight.truth.attitude
    if true_attitude is None:
        return replace(NO_TRUTH, what="heading error", reason="the log holds no true attitude")
    evaluated_heading = heading[inside_spans(heading.index, judged)]
    true_at_samples = np.interp(
        evaluated_heading.index, true_attitude.index, heading_rad(true_attitude), np.nan, np.nan
    )
    error = np.angle(np.exp(1j * (evaluated_heading.to_numpy() - true_at_samples)))
    return float(np.degrees(np.nanmean(error)))


def _longest_between_fusions(fused_s: Array, judged: Spans) -> float:
    """Longest time between two fusions, the ends of what is judged included."""
    ends = [judged[0][0], judged[-1][1]]
    return float(np.max(np.diff(np.sort(np.concatenate([fused_s, ends])))))


def _deviation_note(
    model: Model, replay: Ekf2Replay, without: Mapping[str, float], judged: Spans
) -> str:
    """How far from the replay as flown EKF2 comes without some aids."""
    flown, changed_position = (
        replay_run.published.loc[inside_spans(replay_run.published.index, judged), Columns.POSITION]
        for replay_run in (model.flown, replay)
    )
    *horizontal, down = np.abs((changed_position - flown).to_numpy()).T
    distance = np.hypot(*horizontal)
    lost_text = ", ".join(f"{name} from {since:g} s on" for name, since in without.items())
    heights = {*model.flown.other_aid_updates} - {EV_POS.name}
    position = {*modelled_aids(model.inputs)} - {MAG.name} - heights
    height = f"; its height is {down.max():.3g} m from it at most" if heights & {*without} else ""
    give_up_note = (
        "; with no horizontal aid EKF2 itself gives its position up after EKF2_NOAID_TOUT (5 s), "
        "while the model dead-reckons on"
    )
    return (
        f"Without {lost_text}, what is published is {distance.max():.3g} m from the replay as flown at "
        f"most (at {changed_position.index[distance.argmax()]:.1f} s), {distance[-1]:.3g} m at the end{height}"
        + (give_up_note if position <= without.keys() else "")
    )


def _notes(model: Model, replay: Ekf2Replay) -> Iterator[str]:
    min_noise = replay.settings.get(GNSS_POS.noise, 0.0)
    if min_noise >= replay.changed.get(EV_POS.noise, np.inf):
        yield (
            "While EKF2 fuses GNSS it takes no position of vision to be more exact than "
            f"{GNSS_POS.noise}, {min_noise:g} m"
        )
    if replay.late or replay.lost:
        remedy = "" if model.inputs.rules.horizon_by_delay else ": raise EKF2_DELAY_MAX"
        change = ", ".join(f"{name}={value:g}" for name, value in replay.changed.items())
        yield (
            f"{change or 'As flown'}: {replay.late + replay.lost} of "
            f"{len(replay.updates) + replay.lost} samples would reach EKF2 after its fusion "
            f"horizon has passed them ({replay.lost} would never be fused){remedy}"
        )
