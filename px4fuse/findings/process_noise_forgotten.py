"""SIGMA_A so small that σ hardly grows between updates and new measurements are ignored.

A slow filter is no mistake where nothing happens: its innovations must say that it lags.
"""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, error
from px4fuse.findings.sigma import LAG1_SLOW, try_out, tuned_for
from px4fuse.flight import Unavailable, sample_rate

RESPONSE_TIME_S = 2.5  # five times the lesson's; a vehicle turns around in less


def detect(analysis: Analysis) -> Found:
    """The first axis on which the filter lags, needing too long to follow."""
    for name, result in analysis.axes.items():
        updates, statement = result.replay.updates, result.filters["kf"]
        if isinstance(statement, Unavailable) or statement.verdict != "variance understated":
            continue
        if statement.lag1_autocorrelation < LAG1_SLOW:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < RESPONSE_TIME_S:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        tuned = tuned_for(analysis, name)
        needed = None if tuned is None else tuned.filter_sigma_a.value
        more = "" if needed is None else f" {try_out(analysis, {'--sigma-a': needed})}"
        yield error(
            "process_noise_forgotten",
            f"With SIGMA_A {analysis.settings.sigma_a_m_s2:g} m/s² Q is forgotten",
            f": σ_p hardly grows between updates ({growth:.1%} in variance), the gain is "
            f"{gain:.3f}, and the filter needs {response_s:.0f} s to follow (along {name}).",
            f"Raise SIGMA_A.{more}",
            {"relative_growth": growth, "gain": gain, "response_s": response_s, "axis": name},
        )
        return
