"""What innovations cannot show: errors against the truth, and the drift of a source.

Innovations judge a filter against its source, truth judges both: an error that filter and source
share shows in no innovation. Normalised by the variance that the filter states, the squared error
is the NEES (1 is consistent).
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.interventions import Hidden, Intervention, beyond_claim, cause_of
from px4fuse.comparison.model import AgainstTruth, AxisComparison, Comparison, FilterName
from px4fuse.errors import TrajectoryError
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.causes import CAUSE
from px4fuse.findings.model import WORDS, Finding, Found, finding, info
from px4fuse.findings.since import cure_words, kind_of, since_words
from px4fuse.loop.model import Loop
from px4fuse.plain import factor_words, number_words
from px4fuse.trajectory.alignment import fit

NEES_ERROR = 16.0  # errors four times as large as σ
SMALL_NIS = 0.5  # innovations are 30 % smaller than claimed
OWN_ERROR = 0.7  # times: of EKF2's mean square error half is its own
FRAME_SHARE = 0.5  # of the error: what is left is less than what turning took away
FILTERS: Mapping[FilterName, str] = {"kf": "our filter", "ekf2": "EKF2"}
REMEDIES: Mapping[str, str] = WORDS["errors_larger_than_claimed"]["remedy"]


def hidden_errors(comparison: Comparison) -> list[tuple[FilterName, str, Hidden]]:
    """Where the error is larger than claimed and no innovation says so, by filter and axis.

    The worst comes first.
    """
    found = [
        (owner, name, hidden)
        for name, result in comparison.axes.items()
        for owner, statement in result.filters.items()
        if (hidden := beyond_claim(statement))
    ]
    return sorted(found, key=lambda each: -each[2].nees)


def detect(analysis: Analysis) -> Found:
    """Errors that innovations hide, or a drift that nothing shows."""
    if hidden := hidden_errors(analysis):
        yield larger(analysis, hidden)
    elif analysis.source.origin.may_drift:
        yield drift(analysis)


def larger(analysis: Analysis, hidden: list[tuple[FilterName, str, Hidden]]) -> Finding:
    """Told of each filter's worst axis."""
    (erring, main, worst), drifts = hidden[0], analysis.source.origin.may_drift
    evidence: dict[str, float | str] = {"axis": main, "filter": erring}
    said, causes = [], dict[FilterName, Intervention | None]()
    for owner, name in FILTERS.items():
        for _, axis, one in [each for each in hidden if each[0] == owner][:1]:
            evidence |= {
                f"{owner}_nis_mean": one.nis_mean,
                f"{owner}_nees_position_mean": one.nees,
                f"{owner}_position_rmse_m": one.rmse_m,
                f"{owner}_sigma_p_m": one.claimed_m,
            }
            causes[owner] = cause_of(analysis.causes, owner, axis, "nees")
            said.append(
                f"{name} claims σ {one.claimed_m:.2g} m along {axis} and errs by "
                f"{one.rmse_m:.2f} m RMS (mean NEES {factor_words(one.nees)}, mean NIS "
                f"{number_words(one.nis_mean, 2)}; 1 is consistent)"
                f"{since_words(analysis, causes[owner])}"
            )
    words = "; ".join(said) + "."
    ours = analysis.axes[main].filters["kf"].truth
    less = isinstance(ours, AgainstTruth) and ours.position_rmse_m < OWN_ERROR * worst.rmse_m
    alone = less and all(owner == "ekf2" for owner, *_ in hidden)
    shared = "gnss" if analysis.source.origin.is_gnss else "shared"
    remedy = "drift" if drifts else "ekf2" if alone else shared
    known = filter(None, (causes[erring], *causes.values()))
    evidence |= {CAUSE: kind_of(analysis, next(known, None))}
    if cures := {
        cure_words(analysis, cause): None for cause in causes.values() if cause is not None
    }:
        remedy = "cured"
    elif frame := _after_turning(analysis, erring):
        before, left = frame
        evidence |= {"position_rmse_horizontal_m": before, "position_rmse_aligned_m": left}
        remain = f"of {before:.2f} m horizontally {left:.2f} m remain after the best shift and turn"
        if left < FRAME_SHARE * before:
            words += f" Most of it is how the source's frame lies: {remain}."
            remedy = "frame"
        elif drifts:
            words += f" The source drifts, and the filter follows it: {remain}."
    return finding(
        "error" if worst.nees >= NEES_ERROR else "warning",
        "errors_larger_than_claimed",
        evidence,
        small=worst.nis_mean < SMALL_NIS,
        words=words,
        remedy=remedy,
        cures=" ".join(cures),
    )


def _after_turning(comparison: Comparison, owner: str) -> tuple[float, float] | None:
    """Horizontal RMSE (m) to the truth, and what of it the best shift and turn leave."""
    axes = [comparison.axes[name] for name in ("north", "east") if name in comparison.axes]
    truths = [result.truth for result in axes if isinstance(result.truth, pd.DataFrame)]
    if len(truths) < 2:
        return None
    times = truths[0].index.to_numpy()
    tracks = [
        state_at(result.replay, times)[0] if owner == "kf" else _published(result, times)
        for result in axes
    ]
    level = np.zeros(len(times))
    estimate = np.column_stack([*tracks, level])
    true = np.column_stack([*(truth["position_m"] for truth in truths), level])
    known = np.isfinite(estimate).all(axis=1) & np.isfinite(true).all(axis=1)
    estimate, true = estimate[known], true[known]
    try:
        aligned = fit(estimate, true, "yaw").apply(estimate)
    except TrajectoryError:  # too little motion to turn by
        return None
    errors = (estimate - true, aligned - true)
    before, left = (float(np.linalg.norm(error)) / len(true) ** 0.5 for error in errors)
    return before, left


def _published(result: AxisComparison, times: Array) -> Array:
    """Position (m) of EKF2 along one axis; NaN where it is not known."""
    assert isinstance(result.ekf2_state, pd.DataFrame)  # else no error of EKF2 is hidden
    state = result.ekf2_state["position_m"]
    return np.asarray(np.interp(times, state.index, state, left=np.nan, right=np.nan))


def drift(analysis: Analysis) -> Finding:
    """Neither truth nor anything else judges it: what it scatters by, and what its loop shows."""
    name, tuned, loop = analysis.source.name, analysis.tuning.get(HORIZONTAL), analysis.loop
    evidence: dict[str, float | str] = {"source": name}
    more = ""
    if isinstance(tuned, AxisTuning) and (noise := tuned.sigma_z.value or tuned.sigma_z.high):
        bound = "at most " if tuned.sigma_z.value is None else ""
        evidence |= {"short_term_noise_m": noise}
        more = f" Over a second or so it scatters by {bound}{noise:.2g} m, which is not its error."
    if isinstance(loop, Loop) and (gap_m := loop.closure_error_m) is not None:
        evidence |= {"closure_error_m": gap_m, "path_length_m": loop.path_length_m}
        more += f" Its loop misses by {gap_m:.2f} m after {loop.path_length_m:.0f} m."
    return info("source_may_drift", evidence, shown=more)
