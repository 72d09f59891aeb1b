"""SIGMA_Z or SIGMA_A is not what the innovations ask for, each told from the other.

The mean NIS alone cannot tell them apart: both make S larger. The likelihood can, since
SIGMA_A makes the innovations of a stretch agree with each other and SIGMA_Z does not.

Both are fitted together, so that they are put right together: one finding, of the one that is
further off. A setting that nobody chose is advice, one step less severe than one that was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import filter_words
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.errors_larger_than_claimed import hidden_errors
from px4fuse.findings.model import Detector, Finding, Found, Severity, Threshold, lowered
from px4fuse.findings.no_motion import MOTION_RANGE, motion_range_m
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words

NOISE_OFF = Threshold(1.5, "times", "in standard deviation; below, the tracks hardly change")
NOISE_OFF_ERROR = Threshold(4.0, "times", "the gain is a different one")
BEYOND = Threshold(1.5, "times the 95 % interval's reach", "0.3 % of clean flights lie beyond")
# What a filter is run with where the source is better than its rate can show
SMALLEST_SIGMA_Z = Threshold(0.005, "m", "what motion capture resolves in flight")


@dataclass(frozen=True)
class Off:
    """One of the two settings, and what the data ask for in its place."""

    label: str
    option: str
    unit: str
    chosen: float
    found: Noise
    value: float
    severity: Severity

    @property
    def factor(self) -> float:
        """Chosen against asked for."""
        return self.chosen / self.value

    @property
    def size(self) -> float:
        """By how much it is off, either way."""
        return max(self.factor, 1.0 / self.factor)

    @property
    def is_advice(self) -> bool:
        """Whether nobody chose it."""
        return self.severity == "info"

    @property
    def id(self) -> str:
        """Of the finding."""
        return f"{self.label.lower()}_{'small' if self.factor < 1.0 else 'large'}"


def _detect(analysis: Analysis) -> Found:
    tunings = map(analysis.tuning.get, (HORIZONTAL, "aisle", "down"))
    tuned = next((tuned for tuned in tunings if isinstance(tuned, AxisTuning)), None)
    if tuned is None:
        return
    comparison = analysis
    settings = comparison.settings
    off = [
        each
        for each in (
            _off("SIGMA_Z", "--sigma-z", "m", settings.sigma_z_m, tuned.sigma_z),
            _off("SIGMA_A", "--sigma-a", "m/s²", settings.sigma_a_m_s2, tuned.filter_sigma_a),
        )
        if each is not None
    ]
    # without motion the acceleration's noise is hardly seen
    if motion_range_m(comparison) < MOTION_RANGE.value:
        off = [each for each in off if each.label != "SIGMA_A"]
    # where a source may drift, or the truth shows it, innovations tell too little noise alone
    hidden = any(one.owner == "kf" for one in hidden_errors(comparison))
    # and a filter may follow such a source as closely as it likes
    drifts = comparison.source.origin.may_drift
    if hidden or drifts:
        off = [each for each in off if each.factor < 1.0 and not (drifts and each.is_advice)]
    if not off:
        return
    off.sort(key=lambda each: -each.size)
    remedy = _remedy(analysis, tuned, off)
    found = [
        Finding(
            each.id,
            each.severity,
            _message(each, tuned),
            remedy,
            {
                "chosen": each.chosen,
                "most_likely": each.value,
                "factor": each.factor,
                "lag1_autocorrelation": getattr(tuned.before, "lag1_autocorrelation", float("nan")),
            },
        )
        for each in off
    ]
    yield structs.replace(found[0], consequences=tuple(found[1:]))


def _off(label: str, option: str, unit: str, chosen: float, found: Noise) -> Off | None:
    """By what factor a setting is off, and how bad that is; None where it is not."""
    value = found.value if found.value is not None else found.high
    if value is None:
        return None
    high, low = found.high, found.low or 0.0
    if found.value is not None and high is not None:
        high = found.value * (high / found.value) ** BEYOND.value
        low = found.value * (low / found.value) ** BEYOND.value
    above = high is not None and chosen > high
    below = found.value is not None and chosen < low
    size = max(chosen / value, value / chosen)
    if not (above or below) or size < NOISE_OFF.value:
        return None
    severity: Severity = "error" if size >= NOISE_OFF_ERROR.value else "warning"
    defaults = Settings()
    if chosen == (defaults.sigma_z_m if label == "SIGMA_Z" else defaults.sigma_a_m_s2):
        severity = lowered(severity)
    return Off(label, option, unit, chosen, found, value, severity)


def _message(off: Off, tuned: AxisTuning) -> str:
    small = off.factor < 1.0
    bounded = off.found.value is None
    range_ = "" if bounded else f", 95 % {off.found.low or 0.0:.3g} to {off.found.high:.3g}"
    return (
        f"{off.label} {off.chosen:g} {off.unit} is {'at least ' if bounded else ''}"
        f"{factor_words(off.size)} times too {'small' if small else 'large'}: the innovations "
        f"({tuned.name}) ask for {'at most ' if bounded else ''}{off.value:.3g} {off.unit}{range_}"
        f". {_reading(off.label, small)}"
    )


def _remedy(analysis: Analysis, tuned: AxisTuning, off: list[Off]) -> str:
    """What to type, as far as a replay with it holds what the likelihood promises."""
    comparison = analysis
    values = {each.label: float(f"{each.value:.3g}") for each in off}
    if "SIGMA_Z" in values and tuned.sigma_z.value is None:
        values["SIGMA_Z"] = max(values["SIGMA_Z"], SMALLEST_SIGMA_Z.value)
    changed = replace(
        comparison.settings,
        sigma_z_m=values.get("SIGMA_Z", comparison.settings.sigma_z_m),
        sigma_a_m_s2=values.get("SIGMA_A", comparison.settings.sigma_a_m_s2),
    )
    typed = " ".join(f"{each.option} {values[each.label]:g}" for each in off)
    unseen = None if isinstance(tuned.held_out, Unavailable) else tuned.held_out.gain_nats
    return filter_words(comparison, changed, typed, unseen)


def _reading(label: str, small: bool) -> str:
    if label == "SIGMA_Z":
        return (
            "The filter mistakes the noise of the measurements for motion."
            if small
            else "The filter distrusts measurements that are better than it thinks."
        )
    return (
        "The variance grows too little between updates, the gain is too small, and the filter "
        "lags behind."
        if small
        else "The variance grows too much between updates, and the filter jumps to every "
        "measurement."
    )


DETECTOR = Detector(
    _detect,
    {
        "sigma_z_small": tuple(f"sigma_z_m={value:g}" for value in (0.07, 0.05, 0.03)),
        "sigma_z_large": tuple(f"sigma_z_m={value:g}" for value in (0.15, 0.2, 0.3)),
        "sigma_a_small": tuple(f"sigma_a_m_s2={value:g}" for value in (0.18, 0.1, 0.02)),
        "sigma_a_large": tuple(f"sigma_a_m_s2={value:g}" for value in (0.4, 0.8, 2.0)),
    },
    names={
        "sigma_z_small": "a SIGMA_Z that is too small",
        "sigma_z_large": "a SIGMA_Z that is too large",
        "sigma_a_small": "a SIGMA_A that is too small",
        "sigma_a_large": "a SIGMA_A that is too large",
    },
)
