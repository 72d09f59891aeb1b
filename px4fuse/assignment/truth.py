"""What the right answers to a simulated flight are: the key to its form."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from px4fuse.answers import GATED, AskedNumber, asked
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.estimates import noises_and_clock
from px4fuse.comparison.model import AxisComparison, Comparison, FilterName, FilterSummary
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import SIGMA_OFF
from px4fuse.filter.kalman import replay
from px4fuse.filter.model import COVARIANCES, matrix, noise, transition
from px4fuse.filter.settings import Settings
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.loop.analysis import analyse
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.record import Record
from px4fuse.simulation import flights
from px4fuse.simulation.mistakes import MISTAKES as SIMULATED
from px4fuse.simulation.sensors import TIMESYNC_CONVERGED_S

# A size may be off by this share and is right
TOLERANCE = 0.15
# How closely a closure error can be read off
CLOSURE_WITHIN_M = 0.3
# EKF2 has rejected samples from this share on
REJECTED = 0.005
# A reset of position that is seen, after EKF2 has found its first position
RESET_M, SETTLED_S = 0.2, 5.0
# What EKF2 does with a source that has this; after the semicolon what may be said as well
DID: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "clock-offset": (("followed the wrong positions",), ("fused at the wrong time",)),
    "clock-drift": (("followed the wrong positions",), ("fused at the wrong time",)),
    "clock-jump": ((), ("fused at the wrong time", "followed the wrong positions")),
    "yaw": (("followed the wrong positions",), ()),
    "scale": (("followed the wrong positions",), ()),
    "jump": ((), ("followed the wrong positions",)),
    "slow-error": (("followed the wrong positions",), ()),
    "heading": ((), ("followed the positions",)),
    "mag": ((), ("rejected the bad samples", "followed the positions")),
    "smoothed": (("followed the wrong positions",), ("fused at the wrong time",)),
    "ekf2-delay": (("fused at the wrong time",), ()),
    "ekf2-off": (("never fused",), ()),
    "dropout": ((), ("coasted, then reset",)),
    "nlos": ((), ("followed the wrong positions",)),
    "decimate": ((), ("never fused",)),
}
NOTHING: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())


class Wrong(Record, frozen=True):
    """One mistake of a flight.

    Attributes
    ----------
    size : float or None
        In the first unit of :data:`px4fuse.answers.MISTAKES`; from ``low`` to ``high`` is right.
    from_s, until_s : float or None
        Since the first data; both None for the whole flight.
    """

    kind: str
    size: float | None = None
    low: float | None = None
    high: float | None = None
    from_s: float | None = None
    until_s: float | None = None


class VerdictTruth(Record, frozen=True):
    """What the report says of a filter's innovation variance, and its factor in σ; or ""."""

    verdict: str
    factor: float | None = None

    @property
    def clear(self) -> bool:
        """Whether nobody can take it for another."""
        return self.factor is None or self.factor >= SIGMA_OFF


class FormTruth(Record, frozen=True):
    """The right answers to the form of one flight.

    Attributes
    ----------
    sigma_z_m : float
        Of the source as it is.
    ekf2_did, ekf2_did_also : tuple of str
        What has to be said, and what may be.
    quantities : tuple
        As :func:`px4fuse.answers.asked` asks them; None where the flight is too short.
    """

    mistakes: tuple[Wrong, ...]
    sigma_z_m: float
    ours: VerdictTruth
    ekf2: VerdictTruth
    ekf2_did: tuple[str, ...]
    ekf2_did_also: tuple[str, ...]
    quantities: tuple[float | tuple[float, ...] | None, ...]


def truth_of(simulation: flights.Simulation, log_sha256: str) -> FormTruth:
    """The right answers, from what was simulated and from the report as it comes."""
    known = flights.answer(simulation)
    comparison = compare(flights.to_flight(simulation), Settings())
    mistakes = tuple(
        _wrong(name, given, known["truth"], comparison) for name, given in known["mistakes"].items()
    )
    sigma_z_m = known["truth"]["sigma_z_m"]
    return FormTruth(
        mistakes,
        sigma_z_m,
        _verdict(comparison, "kf"),
        _verdict(comparison, "ekf2"),
        *_ekf2_did(comparison, mistakes, sigma_z_m),
        tuple(quantity_truth(comparison.main, each) for each in asked(log_sha256)),
    )


def _wrong(
    name: str, given: Mapping[str, Any], truth: Mapping[str, Any], comparison: Comparison
) -> Wrong:
    sizes = SIMULATED[name].sizes
    if not sizes:
        return Wrong(name)
    size, off = given[sizes[0]], TOLERANCE * abs(given[sizes[0]])
    if name == "open-end":  # the log tells it with the drift of the odometry in it
        odometry = trajectory_of(comparison.flight, "vio")
        measured = analyse(LoopSource(odometry, comparison.flight)).closure_error_m
        size, off = measured if isinstance(measured, float) else size, CLOSURE_WITHIN_M
    low, high = size - off, size + off
    if name == "clock-offset":  # what an ideal analysis of the log can tell
        _, found = noises_and_clock(comparison)
        if isinstance(found, ClockOffset) and found.determinable:
            low, high = min(low, -found.interval_s[1]), max(high, -found.interval_s[0])
    start_s, end_s = truth["airborne_s"]
    from_s: float | None = None
    until_s: float | None = None
    match name:
        case "clock-jump":
            until_s = TIMESYNC_CONVERGED_S
        case "open-end":
            from_s = end_s
        case "nlos" if truth["outlier_time_s"]:
            from_s, *_, until_s = truth["outlier_time_s"] * 2
        case "heading":
            from_s = given["heading_at_s"]
        case "dropout" | "imu-dropout" | "jump" | "mag":
            share = 2.0 / 3.0 if name == "jump" else 0.5
            from_s = given[sizes[1]]
            from_s = start_s + share * (end_s - start_s) if from_s is None else from_s
            until_s = None if name in ("jump", "mag") else from_s + abs(size)
    return Wrong(name, size, low, high, from_s, until_s)


def _verdict(comparison: Comparison, which: FilterName) -> VerdictTruth:
    judged = comparison.main.filters[which]
    if not isinstance(judged, FilterSummary):
        return VerdictTruth("")
    word = judged.verdict.removeprefix("variance ")
    if word == "consistent":
        return VerdictTruth(word)
    return VerdictTruth(word, judged.times_off)


def _ekf2_did(
    comparison: Comparison, mistakes: tuple[Wrong, ...], sigma_z_m: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What EKF2 did in this flight: by what is wrong with it, and by what the log shows."""
    by_kind = {wrong.kind: wrong for wrong in mistakes}
    must = [said for kind in by_kind for said in DID.get(kind, NOTHING)[0]]
    also = [said for kind in by_kind for said in DID.get(kind, NOTHING)[1]]
    noise = by_kind.get("ekf2-noise")
    if noise is not None and (noise.size or 0.0) > sigma_z_m:
        must.append("trusted the positions too little")
    innovations = comparison.main.ekf2_innovations
    if not isinstance(innovations, Unavailable):
        bad = "nlos" in by_kind or "jump" in by_kind
        if (innovations["rejected"] > 0).mean() > REJECTED:
            must.append("rejected the bad samples" if bad else "rejected good samples")
    ekf2 = comparison.flight.ekf2
    since_s = comparison.segment.start_s + SETTLED_S
    for reset in ekf2.resets if isinstance(ekf2, Ekf2) else ():
        large = reset.quantity == "position" and math.hypot(*reset.delta[:2]) > RESET_M
        if large and reset.time_s > since_s:
            must.append("coasted, then reset")
    if not must:
        must, also = ["nothing unusual"], ["followed the positions", *also]
    return tuple(dict.fromkeys(must)), tuple(one for one in dict.fromkeys(also) if one not in must)


def quantity_truth(
    result: AxisComparison, quantity: AskedNumber
) -> float | tuple[float, ...] | None:
    """The answer to a question, from a replay with its settings; None where it never comes so far.

    "silence" is the variance after the update, taken on by F and Q for so long (DT steps).
    """
    settings = Settings(quantity.sigma_a_m_s2, quantity.sigma_z_m)
    run = replay(result.axis, settings)
    updates = run.updates
    at = quantity.update - 1
    if at >= len(updates):
        return None
    row, covariance = updates.iloc[at], run.steps.loc[updates.index[at], COVARIANCES]
    match quantity.kind:
        case "gate":
            part = updates.iloc[at : at + GATED + 1]
            nis = part["innovation_m"] ** 2 / part["innovation_variance_m2"]
            outside = np.flatnonzero(nis > quantity.extra**2) + quantity.update
            return tuple(outside.astype(float).tolist())
        case "silence":
            p, f = matrix(tuple(covariance)), transition(settings.dt_s)
            q = settings.sigma_a_m_s2**2 * settings.dt_s * matrix(noise(settings.dt_s))
            for _ in range(round(quantity.extra / settings.dt_s)):
                p = f @ p @ f.T + q
            return math.sqrt(p[0, 0])
        case "nis":
            return float(row["innovation_m"] ** 2 / row["innovation_variance_m2"])
        case "variance":
            return float(covariance.iloc[0])
    return float(row["gain_position" if quantity.kind == "gain" else "innovation_m"])
