"""Minimal analyses for tests of detectors: they contain only the fields that a detector reads."""

import inspect
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any, TypeVar

import msgspec
import numpy as np
import pandas as pd
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import (
    FILTER_NAMES,
    ErrorsAgainstTruth,
    FilterSummary,
    FilterTracks,
    UntestedFilter,
)
from px4fuse.comparison.rerun_effects import Rerun, RunStatistics
from px4fuse.convention.correction import find_convention_faults
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.hypotheses import Estimate, Jump, SystematicErrors
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment, cut_to_segment
from px4fuse.filter.time_offset import FlightPartTimeOffset, SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, NoiseEstimate
from px4fuse.finding import Finding
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    NO_INVALID_ROWS,
    Columns,
    Ekf2,
    FusionRecord,
    PositionTrack,
    Unavailable,
)

T = TypeVar("T")

NONE = Unavailable("it", "no topic for it", "Log it.")
SEGMENT = Segment(10.0, 110.0, "")
DRIFTING = replace(AS_RECEIVED_ORIGIN, kind="vio")
# Settings that differ from the defaults
CHOSEN = Settings(sigma_a_m_s2=1.0, sigma_z_m=1.0)


def made(kind: type[T], **parts: Any) -> T:
    """Make an instance with these fields only; reading another field is an error."""
    if issubclass(kind, msgspec.Struct):
        return StandIn(kind, parts)  # type: ignore[return-value]
    one = object.__new__(kind)
    for name, value in parts.items():
        object.__setattr__(one, name, value)
    return one


class StandIn:
    """Stand-in for a record with some of its fields; properties and methods of it work."""

    def __init__(self, kind: type, parts: dict[str, Any]) -> None:
        self.__dict__.update(parts, _kind=kind)

    @property  # type: ignore[misc]
    def __class__(self) -> type:
        kind: type = self.__dict__["_kind"]
        return kind

    def __getattr__(self, name: str) -> Any:
        found = inspect.getattr_static(self.__dict__["_kind"], name)
        if isinstance(found, property):
            return found.fget(self)  # type: ignore[misc]
        if inspect.isfunction(found):
            return found.__get__(self)
        raise AttributeError(name)


def log(**parts: Any) -> Any:
    usual = {
        "parameters": {}, "notes": (), "format": "ULog", "writes_ulog": True, "autopilot": "PX4",
        "find_default_value": lambda name: MODEL_PARAMETERS[name].default,
        "dropouts": (), "damage": (), "ends_in_flight": False, "duration_s": 60.0, "bytes": 0,
        "bytes_read": 0, "restarts": None, "receive_time_reversals": None, "dropped": {},
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **parts})


def moving(rate_hz: float) -> pd.DataFrame:
    """Make positions that move north at 1 m/s, regular to 0.1 ms."""
    time_s = np.arange(0.0, 120.0, 1.0 / rate_hz)
    time_s[1::2] += 1e-4
    return positions(time_s, time_s)


def source(**parts: Any) -> Any:
    usual = {
        "name": "uwb", "description": "UWB", "origin": AS_RECEIVED_ORIGIN, "orientation": None,
        "frame": "NED",
        "clock_map": None, "alignment": None, "rate_hz": 5.0, "assumed_delay_s": 0.0,
        "samples": moving(parts.get("rate_hz", 5.0)), "status": pd.DataFrame(), "velocity": None,
        "invalid_reasons": NO_INVALID_ROWS,
    }  # fmt: skip
    fields = {**usual, **parts}
    rate_hz = fields.pop("rate_hz")
    return made(
        PositionTrack,
        aid=lambda axis: fields["origin"].aid,
        compute_rate_hz=lambda: rate_hz,
        **fields,
    )


def positions(time_s: Any, north_m: Any = 0.0, variance_m2: float = np.nan) -> pd.DataFrame:
    frame = pd.DataFrame(0.0, index=np.asarray(time_s, float), columns=Columns.POSITION)
    frame["north_m"] = north_m
    return frame.assign(**dict.fromkeys(Columns.POSITION_VARIANCE, variance_m2))


def analysis(
    *, ekf2: Any = NONE, log: Any = log(), source: Any = source(), axes: tuple[Any, ...] = (),  # noqa: B008
    flight: dict[str, Any] | None = None, settings: Settings = CHOSEN, notes: tuple[str, ...] = (),
    missing: tuple[Any, ...] = (), **parts: Any,
) -> Analysis:  # fmt: skip
    """Make an analysis; fields that are not given are Unavailable."""
    if isinstance(ekf2, dict):
        usual_ekf2 = {
            "status_flags": {},
            "parameters": {},
            "aids": {},
            "record": NONE,
            "fusion_flags": NONE,
        }
        ekf2 = made(Ekf2, **{**usual_ekf2, **ekf2})
    usual_flight = {
        "imu": NONE,
        "attitude": NONE,
        "positions": (),
        "streams": {},
        "airborne": NONE,
        "truth": NONE,
    }
    flown = {**usual_flight, **(flight or {})}
    usual = dict.fromkeys(
        (
            "time_offset",
            "ekf2_model",
            "loop",
            "heading",
            "systematic_errors",
            "source_low_pass",
            "time_correlated_noise",
        ),
        NONE,
    ) | {"convention": None, "request": None}
    by_name = {each.axis.name: each for each in axes}
    one_flight: Any = SimpleNamespace(log=log, ekf2=ekf2, **flown)
    return SimpleNamespace(  # type: ignore[return-value]
        flight=one_flight, source=source, axes=by_name,
        source_samples=cut_to_segment(source.samples, SEGMENT),
        convention_faults=find_convention_faults(
            parts.get("convention"), one_flight, source.frame
        ),
        main=next(iter(axes), axis()), input_axes=tuple(each.axis for each in axes),
        segment=SEGMENT, settings=settings, notes=notes, missing=missing,
        **{"tuning": {}, "difference_steps": {}, "reruns": (), **usual, **parts},
        select_main_reruns=lambda: [t for t in parts.get("reruns", ()) if t.kinds],
    )  # fmt: skip


def axis(name: str = "north", **parts: Any) -> Any:
    """Make the result of one axis; filters that are not given have no consistency test."""
    tracks = {
        key: FilterTracks(
            *(parts.pop(f"{key}_{kind}", NONE) for kind in ("state", "variance", "innovations"))
        )
        for key in FILTER_NAMES
    }
    filters = {
        key: _with_truth(parts.pop(key, NONE), parts.pop(f"{key}_truth", NONE))
        for key in FILTER_NAMES
    }
    axis = SimpleNamespace(
        name=name, label="the axis of largest motion" if name == "aisle" else name,
        measurement_time_s=np.arange(0.0, 120.0), measurement_m=np.zeros(120),
    )  # fmt: skip
    return SimpleNamespace(
        axis=axis,
        filters=filters,
        tracks=tracks,
        ekf2_tracks=tracks["ekf2"],
        **{"truth": NONE, **parts},
    )


def _with_truth(one: Any, truth: Any) -> Any:
    if one is NONE:
        return UntestedFilter("it", "no topic for it", "Log it.", truth=truth)
    known = {
        name: getattr(one, name) for name in Consistency.__struct_fields__ if hasattr(one, name)
    }
    return made(FilterSummary, **known, sigma_p_median_m=None, truth=truth)


def tried(
    owner: Any, change: dict[str, float], axis: str = "north", of: Any = "nis",
    before: float = 9.0, explained_fraction: float = 1.0,
) -> Rerun:  # fmt: skip
    """Make a re-run whose change explains a fraction of the logarithm of a statistic."""
    key, after = f"{of}_mean", before ** (1.0 - explained_fraction)
    return Rerun(
        filter=owner, axis=axis, kinds=(), change=change, discrepancies=(of,),
        before=RunStatistics(innovations=100, **{key: before}),
        after=RunStatistics(innovations=100, **{key: after}),
    )  # fmt: skip


def statement(nis: float = 1.0, verdict: str = "consistent", **parts: Any) -> Any:
    """Make the consistency of a filter with this mean NIS."""
    usual = {"lag1_autocorrelation": 0.0, "fraction_outside_gate": 0.0, "innovation_std_m": 0.3,
             "innovation_mean_m": 0.4}  # fmt: skip
    return made(
        Consistency,
        nis_mean=nis,
        nis_band=(0.8, 1.2),
        sigma_ratio=nis**0.5,
        verdict=verdict,
        **{**usual, **parts},
    )


def against_truth(nees: float, rmse_m: float = 0.4) -> ErrorsAgainstTruth:
    return ErrorsAgainstTruth(count=100, position_rmse_m=rmse_m, nees_position_mean=nees)


def hiding(nis: float = 1.0, nees: float = 4.0, name: str = "north", **parts: Any) -> Any:
    """Make an axis on which KF has this mean NIS and mean NEES."""
    return axis(name, kf=statement(nis), kf_truth=against_truth(nees), **parts)


Detect = Callable[[Any], Iterable[Finding]]


def named(detect: Detect, subject: Any) -> dict[str, str]:
    return {finding.id: finding.severity for finding in detect(subject)}


def severity(detect: Detect, subject: Any) -> str | None:
    """Severity of the only finding; None without a finding."""
    found = named(detect, subject)
    assert len(found) <= 1
    return next(iter(found.values()), None)


def only(detect: Detect, subject: Any) -> Finding:
    (finding,) = detect(subject)
    return finding


def ages(arrival: int, later: int, latency_s: float = 0.05, wrong: int = 0) -> dict[str, Any]:
    """Ages of arrival times (`wrong` of them have the latency), then of measurement times."""
    age = [latency_s] * wrong + [0.0] * (arrival - wrong) + [latency_s] * later
    series = pd.Series(age, index=20.0 + np.arange(len(age)))
    return {"record": made(FusionRecord, vision_age_s=series)}


def jump(*sizes: float, at_s: float = 50.0) -> Jump:
    return Jump(at_s, tuple(Estimate(size, 0.01 * (n + 1)) for n, size in enumerate(sizes)), 99.0)


def at_rate(rate_hz: float, start_s: float = 10.0, end_s: float = 110.0) -> pd.DataFrame:
    return pd.DataFrame({"x": 0.0}, index=np.arange(start_s, end_s, 1.0 / rate_hz))


def tuned(
    sigma_z: NoiseEstimate | None = None, sigma_a: NoiseEstimate | None = None, **parts: Any
) -> dict[str, Any]:
    right = NoiseEstimate(1.0, 0.9, 1.1)
    usual = {"name": "horizontal", "before": NONE, "held_out": NONE, "outlier_time_s": np.array([])}
    noises = (sigma_z or right).as_fields("sigma_z_m") | (sigma_a or right).as_fields(
        "sigma_a_two_state_m_s2"
    )
    one = made(AxisTuning, **noises, **{**usual, **parts})
    return {HORIZONTAL: one}


def late(
    remaining_s: float, sigma_s: float = 0.001, applied_s: float = 0.0, **parts: Any
) -> SourceTimeOffset:
    offset_s = applied_s + remaining_s
    halves = tuple(
        FlightPartTimeOffset(0.0, 1.0, at, 0.1) for at in (offset_s - 0.2, offset_s + 0.2)
    )
    usual = {
        "interval_s": (offset_s - 0.01, offset_s + 0.02), "is_determinable": True,
        "change_p_value": None, "parts": halves,
    }  # fmt: skip
    return made(
        SourceTimeOffset,
        offset_s=offset_s,
        applied_s=applied_s,
        sigma_s=sigma_s,
        **{**usual, **parts},
    )


def with_bias(forward: float, sigma: float = 0.01, right: float = 0.0) -> SystematicErrors:
    return made(
        SystematicErrors,
        forward_bias_m_s2=Estimate(forward, sigma),
        right_bias_m_s2=Estimate(right, 0.0),
    )
