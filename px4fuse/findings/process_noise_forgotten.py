"""SIGMA_A so small that σ hardly grows between updates and new measurements are ignored.

A slow filter is no mistake where nothing happens: its innovations must say that it lags.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import filter_words
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.findings.variance import LAG1_SLOW, tuned_for
from px4fuse.flight import Unavailable, sample_rate

RESPONSE_TIME = Threshold(2.5, "s", "five times the lesson's; a vehicle turns around in less")


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    for result in comparison.axes.values():
        updates, statement = result.replay.updates, result.filters["kf"]
        if isinstance(statement, Unavailable) or statement.verdict != "variance understated":
            continue
        if statement.lag1_autocorrelation < LAG1_SLOW.value:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < RESPONSE_TIME.value:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        tuned = tuned_for(analysis, result.axis.name)
        needed = None if tuned is None else tuned.filter_sigma_a.value
        remedy = "Raise SIGMA_A."
        if needed is not None:
            asked = float(f"{needed:.3g}")
            changed = replace(comparison.settings, sigma_a_m_s2=asked)
            remedy += f" {filter_words(comparison, changed, f'--sigma-a {asked:g}')}"
        yield Finding(
            "process_noise_forgotten",
            "error",
            f"With SIGMA_A {comparison.settings.sigma_a_m_s2:g} m/s² Q is forgotten: σ_p hardly "
            f"grows between updates ({growth:.1%} in variance), the gain is {gain:.3f}, and the "
            f"filter needs {response_s:.0f} s to follow (along {result.axis.name}).",
            remedy,
            {
                "relative_growth": growth,
                "gain": gain,
                "response_s": response_s,
                "axis": result.axis.name,
            },
        )
        return


DETECTOR = Detector(
    _detect,
    {"process_noise_forgotten": ("sigma_a_m_s2=0.001",)},
    names={"process_noise_forgotten": "process noise that is nearly zero"},
)
