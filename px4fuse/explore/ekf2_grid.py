"""EKF2 with other parameters, on a grid of stops: replayed here, since the page has no EKF2.

Only where the model of EKF2 agrees with the log, and only at the stops: nothing between them is
made up.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, replay_settings
from px4fuse.ekf2.replay import HORIZONTAL, Ekf2Replay, along, rms_to_truth, settled
from px4fuse.ekf2.whatif import MOST_REJECTED
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.explore.packing import Packer
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
    stops = _stops(model.inputs)
    settings = [
        dict(zip(stops, values, strict=True)) for values in itertools.product(*stops.values())
    ]
    segment = analysis.segment
    replays = replay_settings(model, settings)
    count = sum(len(within(replay.updates, segment)) for replay in replays)
    every = -(-count // MOST_DRAWN) if count else 1
    directions = {
        result.axis.name: result.axis.direction
        for result in analysis.axes.values()
        if result.axis.direction[2] == 0.0
    }
    flown = model.inputs.settings
    return {
        "stops": [[name, PARAMETERS[name].unit, values] for name, values in stops.items()],
        "flown": [stops[name].index(_told(flown[name])) for name in stops],
        "agreement": model.agreement.reason,
        "every": every,
        "most": MOST_REJECTED,
        "cases": [_case(analysis, model, replay, directions, every, packer) for replay in replays],
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
    analysis: Analysis,
    model: Model,
    replay: Ekf2Replay,
    directions: Mapping[str, Array],
    every: int,
    packer: Packer,
) -> dict[str, Any]:
    """One stop: north and east as drawn, and the numbers of each horizontal axis."""
    judged = model.flown.judged_s
    used = replay.updates[settled(replay.updates.index.to_numpy(), judged)]
    shown = within(replay.updates, analysis.segment)
    drawn = shown.iloc[::every]
    return {
        "time": packer.add_times(np.round(drawn.index.to_numpy(), 6)),
        "nu": [
            packer.add(drawn[f"innovation_{axis}_m"].to_numpy(), MILLIMETRES) for axis in HORIZONTAL
        ],
        "sigma": [
            packer.add(np.sqrt(drawn[f"innovation_variance_{axis}_m2"].to_numpy()), TENTHS)
            for axis in HORIZONTAL
        ],
        "flag": packer.add(drawn["rejected"].to_numpy(), 1.0),
        **_state(replay, drawn, packer),
        "rejected": packer.add(np.round(_times(shown, "rejected"), 3), MILLIMETRES),
        "reset": packer.add(np.round(_times(shown, "reset"), 3), MILLIMETRES),
        "share": float(used["rejected"].mean()) if len(used) else 0.0,
        "resets": int(used["reset"].sum()),
        "lost": replay.late + replay.lost,
        "axes": {
            name: _numbers(analysis, replay, used, direction, judged)
            for name, direction in directions.items()
        },
    }


def _state(replay: Ekf2Replay, drawn: pd.DataFrame, packer: Packer) -> dict[str, list[int]]:
    """What is published at the innovations' times, and σ after them, north and east."""
    times, published = drawn.index.to_numpy(), replay.published
    made: dict[str, list[int]] = {"p": [], "v": [], "sp": [], "sv": []}
    for axis, position, velocity in zip(
        HORIZONTAL, Columns.POSITION[:2], Columns.VELOCITY[:2], strict=True
    ):
        for name, column in (("p", position), ("v", velocity)):
            state = np.interp(times, published.index, published[column])
            made[name].append(packer.add(state, HALF_CENTIMETRES))
        for name, column in (
            ("sp", f"position_variance_{axis}_m2"), ("sv", f"velocity_variance_{axis}_m2_s2")
        ):  # fmt: skip
            made[name].append(packer.add(np.sqrt(drawn[column].to_numpy()), MILLIMETRES))
    return made


def _times(updates: pd.DataFrame, column: str) -> Array:
    times: Array = updates.index.to_numpy()[updates[column].to_numpy() > 0]
    return times


def _along(updates: pd.DataFrame, direction: Array) -> tuple[Array, Array]:
    """Innovation and variance along a horizontal direction; EKF2 fuses north and east apart."""
    c, s = float(direction[0]), float(direction[1])
    north, east = (updates[f"innovation_{axis}_m"].to_numpy() for axis in HORIZONTAL)
    s_north, s_east = (updates[f"innovation_variance_{axis}_m2"].to_numpy() for axis in HORIZONTAL)
    return c * north + s * east, c * c * s_north + s * s * s_east


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
    analysis: Analysis,
    replay: Ekf2Replay,
    used: pd.DataFrame,
    direction: Array,
    judged: tuple[tuple[float, float], ...],
) -> dict[str, Any]:
    """EKF2's column of the table at this stop."""
    flight = analysis.flight
    made = judged_numbers(assess(*_along(used, direction)))
    assert isinstance(flight.ekf2, Ekf2)
    times = flight.ekf2.state.index.to_numpy()
    times = times[settled(times, judged)]
    position = along(replay.published, Columns.POSITION, direction, times)
    error = rms_to_truth(flight, position, direction, times)
    if error is not None:
        made["truthP"] = error
    return made
