"""Artificial table of px4fuse batch for tests of its page."""

from __future__ import annotations

import numpy as np
import pandas as pd

VEHICLES = ("000200000000373731353237510500260033", "bench-2", "")
FIRMWARE = ("v1.13.3", "v1.14.0", "v1.16.1")
STORY = "Position timestamps are 0.26 s late"
NOT_LOGGED = ("position: the log has no vehicle_visual_odometry", "Set SDLOG_PROFILE to 129.")
DAMAGED = ("not a ULog file", "Give the log as the flight controller wrote it.")


def artificial_logs(count: int, seed: int = 1) -> pd.DataFrame:
    """Make logs of three vehicles over a year: every tenth failed, every twelfth is not compared.

    SIGMA_Z of the first vehicle triples in the middle of the year; the clock of the second jumps.
    """
    rng = np.random.default_rng(seed)
    rows = []
    dates = pd.date_range("2026-01-01", periods=max(count, 1), freq=f"{7200 // max(count, 1)}h")
    for number in range(count):
        late = number > count / 2
        row = {
            "log": f"flights/{number // 100}/flight {number:04d}.ulg",
            "name": f"flight {number:04d}.ulg",
            "log_sha256": f"{number:064x}", "px4fuse": "0.2.0", "settings": "a1b2",
            "status": "done", "vehicle": VEHICLES[number % 3],
        }  # fmt: skip
        if number % 10 == 9:
            rows.append(row | {"status": "failed", "reason": DAMAGED[0], "remedy": DAMAGED[1]})
            continue
        row |= {
            "firmware": FIRMWARE[min(number * 3 // count, 2)], "firmware_hash": "deadbeef",
            "airframe": "4001", "hardware": "PX4_FMU_V6X",
            "date": f"{dates[number]:%Y-%m-%dT%H:%M:%SZ}",
            "duration_s": 60.0 + 200.0 * rng.random(), "source": "vehicle_visual_odometry",
            "source_rate_hz": 10.0 + rng.normal(0.0, 0.2),
        }  # fmt: skip
        if number % 12 == 7:
            rows.append(
                row | {"status": "not compared", "reason": NOT_LOGGED[0], "remedy": NOT_LOGGED[1]}
            )
            continue
        sigma = 0.1 * (3.0 if late and number % 3 == 0 else 1.0) * np.exp(rng.normal(0.0, 0.1))
        offset = (0.08 if late and number % 3 == 1 else 0.01) + rng.normal(0.0, 0.004)
        findings = ["source_gap"] * (number % 4 == 0) + ["ekf2_rejects_positions"] * (
            number % 5 == 0
        )
        findings += ["sigma_z_too_small"] if sigma > 0.2 else []
        for axis in ("north", "east", "down"):
            nis = np.exp(rng.normal(0.0, 0.2)) * (sigma / 0.1) ** 2
            theirs = 0.3 * np.exp(rng.normal(0.0, 0.6)) * (sigma / 0.1) ** 2
            error = 0.05 * np.exp(rng.normal(0.0, 0.2))
            rows.append(
                row
                | {
                    "axis": axis, "updates": int(row["duration_s"] * 10),
                    "kf_nis_mean": nis, "kf_sigma_ratio": nis**0.5,
                    "kf_verdict": "overconfident" if nis > 1.3 else "consistent",
                    "ekf2_nis_mean": theirs, "ekf2_sigma_ratio": theirs**0.5,
                    "ekf2_verdict": "underconfident" if theirs < 0.8 else "consistent",
                    "position_rms_m": error, "velocity_rms_m_s": 2.0 * error,
                    "sigma_z_m": sigma, "sigma_z_low_m": 0.9 * sigma, "sigma_z_high_m": 1.1 * sigma,
                    "sigma_a_m_s2": 0.3, "sigma_a_low_m_s2": 0.2, "sigma_a_high_m_s2": 0.4,
                    "clock_offset_s": offset, "clock_offset_low_s": offset - 0.006,
                    "clock_offset_high_s": offset + 0.006, "rejected_fraction": 0.01,
                    "model_correlation": 0.97, "findings": ";".join(findings),
                    "severity": "error" if sigma > 0.2 else "clean", "headline": STORY,
                    "action": "param set EKF2_EVP_NOISE 0.3" if sigma > 0.2 else "",
                    "verdicts": "overconfident;consistent;consistent;not evaluated",
                    "kf_source_ratio": sigma / 0.1, "kf_truth_ratio": 12.0,
                    "ekf2_source_ratio": 0.9, "position_rmse_m": error, "difference_rms_m": error,
                    "results": f"results/flight {number:04d}.json",
                    "report": f"reports/flight {number:04d}.pdf",
                }
            )  # fmt: skip
    return pd.DataFrame(rows)
