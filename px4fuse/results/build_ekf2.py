"""EKF2 replayed → results: agreement, why it differs, and what if."""

from __future__ import annotations

from px4fuse.analysis import Counterfactual
from px4fuse.comparison.why import Why
from px4fuse.ekf2.replay import Agreement, Ekf2Replay
from px4fuse.ekf2.whatif import Summary
from px4fuse.flight import Unavailable
from px4fuse.request import WhatIfRequest
from px4fuse.results import ekf2 as made
from px4fuse.results.contract import WHATIF, WhatIfResults
from px4fuse.results.model import Absent
from px4fuse.results.parts import absent, copied, log_part, provenance, schema_of


def agreement_part(agreement: Agreement) -> made.Agreement:
    """Replay as flown against log."""
    axes = {name: copied(made.AxisAgreement, axis) for name, axis in agreement.axes.items()}
    return copied(made.Agreement, agreement, **axes)


def replay_part(replay: Ekf2Replay | Unavailable) -> made.Ekf2Replay | Absent:
    """The replay as flown, or why there is none."""
    if isinstance(replay, Unavailable):
        return absent(replay)
    assert replay.agreement is not None
    return copied(
        made.Ekf2Replay,
        replay,
        stretches_s=replay.stretches,
        settings=dict(replay.settings),
        agreement=agreement_part(replay.agreement),
    )


def why_part(why: Why | Unavailable) -> made.Why | Absent:
    """Why EKF2 differs along one axis, or why that is not known."""
    if isinstance(why, Unavailable):
        return absent(why)
    axis = why.axis
    return made.Why(
        count=len(why.times_s),
        spans_s=why.spans,
        position_mean_square_m2=axis.position_total_m2,
        velocity_mean_square_m2_s2=axis.velocity_total_m2_s2,
        steps=tuple(
            copied(made.Step, step, position_rmse_to_truth_m=_known(step.position_rmse_to_truth_m))
            for step in axis.steps
        ),
        position_left_mean_square_m2=axis.position_left_m2,
        velocity_left_mean_square_m2_s2=axis.velocity_left_m2_s2,
        kf_position_rmse_to_truth_m=_known(axis.student_rmse_to_truth_m),
        ekf2_position_rmse_to_truth_m=_known(axis.logged_rmse_to_truth_m),
        coast=None if why.coast is None else copied(made.Coast, why.coast),
        outside=None if why.outside is None else copied(made.Outside, why.outside),
        sentences=why.sentences,
    )


def whatif_results(request: WhatIfRequest, made_of: Counterfactual, command: str) -> WhatIfResults:
    """What ``px4fuse whatif`` found."""
    found = made_of.whatif
    every = [outcome(summary) for summary in found.whatif]
    first = 1 if made_of.changes else 0
    return WhatIfResults(
        schema=schema_of(WHATIF),
        request=request.recorded(),
        log=log_part(made_of.flight),
        agreement=agreement_part(found.agreement),
        judged_s=found.judged,
        asked=made_of.asked,
        logged=outcome(found.logged),
        replayed=outcome(found.replayed),
        whatif=every[0] if first else None,
        sweep=tuple(every[first:]),
        notes=found.notes,
        provenance=provenance(command),
    )


def outcome(summary: Summary) -> made.Outcome:
    """One EKF2 of a what-if."""
    axes = {name: copied(made.AxisOutcome, axis) for name, axis in summary.axes.items()}
    return copied(made.Outcome, summary, changed=dict(summary.changed), **axes)


def _known(value: float | Unavailable) -> float | None:
    return None if isinstance(value, Unavailable) else value
