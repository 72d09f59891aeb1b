"""EKF2 with other parameters, on a grid of stops: replayed here, since the page has no EKF2.

Only where the model of EKF2 agrees with the log, and only at the stops: nothing between them is
made up.
"""

import itertools
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import replay_settings
from px4fuse.ekf2.replay import HORIZONTAL, Ekf2Replay, Spans, along, rms_to_truth, settled
from px4fuse.ekf2.whatif import MOST_REJECTED
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.explore.packing import Packer
from px4fuse.filter import signals
from px4fuse.filter.consistency import Consistency, assess
from px4fuse.filter.signals import within
from px4fuse.flight import Columns, Ekf2, Unavailable

# As multiples of the noise as flown, and beside the delay (ms) and the gate as flown
NOISES = (0.25, 0.5, 1.0, 2.0, 4.0)
DELAYS_MS = (0.0, 50.0, 100.0, 150.0, 200.0)
GATES = (3.0, 5.0)
# Innovations of all stops together that the page draws; of more it draws every second, third, …
MOST_DRAWN = 60_000
HALF_CENTIMETRES, MILLIMETRES, TENTHS = 2e2, 1e3, 1e4


def grid_data(analysis: Analysis, packer: Packer) -> dict[str, Any] | str:
    """Innovations, verdicts and rejections at every stop; why not where there are none."""
    model = analysis.ekf2_model
    if isinstance(model, Unavailable):
        return model.reason
    if not model.agreement.good:
        return model.agreement.doubted("EKF2").reason
    stops, flown = _stops(model.inputs), model.inputs.settings
    settings = [
        dict(zip(stops, values, strict=True)) for values in itertools.product(*stops.values())
    ]
    replays = replay_settings(model, settings)
    count = sum(len(within(replay.updates, analysis.segment)) for replay in replays)
    every = max(1, -(-count // MOST_DRAWN))
    judged = model.flown.judged_s
    return {
        "stops": [[name, PARAMETERS[name].unit, values] for name, values in stops.items()],
        "flown": [stops[name].index(_told(flown[name])) for name in stops],
        "agreement": model.agreement.reason,
        "every": every,
        "most": MOST_REJECTED,
        "cases": [_case(analysis, replay, judged, every, packer) for replay in replays],
    }


def _told(value: float) -> float:
    """Without what a parameter's single precision adds: 0.1, not 0.10000000149."""
    return float(f"{value:.6g}")


def _stops(inputs: Inputs) -> dict[str, list[float]]:
    flown, aid = inputs.settings, inputs.aid
    noise, delay, gate = (_told(flown[name]) for name in (aid.noise, aid.delay, aid.gate))
    wanted = {
        aid.noise: {_told(noise * factor) for factor in NOISES},
        aid.delay: {*DELAYS_MS, delay},
        aid.gate: {*GATES, gate},
    }
    if inputs.received.own_times:  # whatever the delay
        del wanted[aid.delay]
    return {
        name: sorted(
            value
            for value in values
            if PARAMETERS[name].minimum <= value <= PARAMETERS[name].maximum
            or value == _told(flown[name])
        )
        for name, values in wanted.items()
    }


def _case(
    analysis: Analysis, replay: Ekf2Replay, judged: Spans, every: int, packer: Packer
) -> dict[str, Any]:
    """One stop: north and east as drawn, and the numbers of each horizontal axis."""
    used = replay.updates[settled(replay.updates.index, judged)]
    shown, published = within(replay.updates, analysis.segment), replay.published
    drawn = shown.iloc[::every]

    def column(name: str, scale: float, power: float = 1.0) -> list[int]:
        values = (drawn[name.format(axis)].to_numpy() ** power for axis in HORIZONTAL)
        return [packer.add(each, scale) for each in values]

    def state(names: list[str]) -> list[int]:
        values = (np.interp(drawn.index, published.index, published[name]) for name in names[:2])
        return [packer.add(each, HALF_CENTIMETRES) for each in values]

    def moments(name: str) -> int:
        times_s = shown.index.to_numpy()[shown[name].to_numpy() > 0]
        return packer.add(np.round(times_s, 3), MILLIMETRES)

    return {
        "time": packer.add_times(np.round(drawn.index.to_numpy(), 6)),
        "nu": column("innovation_{}_m", MILLIMETRES),
        "sigma": column("innovation_variance_{}_m2", TENTHS, 0.5),
        "flag": packer.add(drawn["rejected"].to_numpy(), 1.0),
        # what is published at the innovations' times, and σ after them
        "p": state(Columns.POSITION),
        "v": state(Columns.VELOCITY),
        "sp": column("position_variance_{}_m2", MILLIMETRES, 0.5),
        "sv": column("velocity_variance_{}_m2_s2", MILLIMETRES, 0.5),
        "rejected": moments("rejected"),
        "reset": moments("reset"),
        "share": float(used["rejected"].mean()) if len(used) else 0.0,
        "resets": int(used["reset"].sum()),
        "lost": replay.late + replay.lost,
        "axes": {
            name: _numbers(analysis, replay, used, result.axis.direction, judged)
            for name, result in analysis.axes.items()
            if result.axis.direction[2] == 0.0
        },
    }


def judged_numbers(statement: Consistency | Unavailable) -> dict[str, Any]:
    """What the page's table shows of a filter's innovations; why not where they say nothing."""
    if isinstance(statement, Unavailable):
        return {"why": statement.reason}
    return {
        "why": "",
        "count": statement.count,
        "nis": statement.nis_mean,
        "band": list(statement.nis_band),
        "outside": statement.outside_two_sigma,
        "lag1": statement.lag1_autocorrelation,
    }


def _numbers(
    analysis: Analysis, replay: Ekf2Replay, used: pd.DataFrame, direction: Array, judged: Spans
) -> dict[str, Any]:
    """EKF2's column of the table at this stop; EKF2 fuses north and east apart."""
    flight = analysis.flight
    assert isinstance(flight.ekf2, Ekf2)
    nu, s = (
        signals.along(used, [name.format(axis) for axis in HORIZONTAL], weights)
        for name, weights in (
            ("innovation_{}_m", direction[:2]), ("innovation_variance_{}_m2", direction[:2] ** 2)
        )
    )  # fmt: skip
    made = judged_numbers(assess(nu, s))
    times = flight.ekf2.state.index.to_numpy()
    times = times[settled(times, judged)]
    position = along(replay.published, Columns.POSITION, direction, times)
    error = rms_to_truth(flight, position, direction, times)
    return made if error is None else made | {"truthP": error}
