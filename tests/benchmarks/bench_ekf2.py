"""Agreement of the EKF2 model with logs, predictions with other parameters, and speed.

Prints tables, and asserts all numbers except times. Flights are the shared logs, which are not part
of the project; without them, the sample flight only.

    python tests/benchmarks/bench_ekf2.py [FOLDER] [--write]

``--write`` writes the table of the documentation again.
"""

from __future__ import annotations

import sys
import time
import timeit
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from px4fuse.ekf2.model import Ekf2Model, prepare_ekf2_model, replay_with_settings
from px4fuse.ekf2.replay import ReplayAgreement
from px4fuse.ekf2.steps import (
    ACCELEROMETER_BIAS_PROPERTY_NAME,
    ATTITUDE_PROPERTY_NAME,
    FLOW_PROPERTY_NAME,
    GNSS_VELOCITY_PROPERTY_NAME,
    MAGNETOMETER_PROPERTY_NAME,
    MEASUREMENT_NOISE_PROPERTY_NAME,
    OUTPUT_PREDICTOR_PROPERTY_NAME,
    PROCESS_NOISE_PROPERTY_NAME,
    REJECTION_PROPERTY_NAME,
    SAMPLE_TIMES_PROPERTY_NAME,
    TIMESTAMPS_PROPERTY_NAME,
)
from px4fuse.ekf2.whatif import Ekf2Statistics, WhatIf, what_if
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.readers import read_log

REPOSITORY = Path(__file__).parents[2]
SHARED = REPOSITORY.parent / "shared" / "logs"
SIMULATED, ON_GNSS = SHARED / "simulated", SHARED / "gps"
SAMPLE = REPOSITORY / "sample_logs" / "aisle_uwb.ulg"
PAGE = REPOSITORY / "docs" / "ekf2.md"
BEGIN, END = "<!-- bench_ekf2: begin -->", "<!-- bench_ekf2: end -->"
OVERCONFIDENT, OUTLIERS = "overconfident", "nlos"
# Flights in the table of the documentation
DOCUMENTED_FLIGHTS = ("v1.16.1_aisle_nominal", "v1.16.1_aisle_nlos", "v1.16.1_gps_nominal")


def opened(path: Path) -> Ekf2Model | Unavailable:
    return prepare_ekf2_model(read_log(path))


def agreement_table(paths: list[Path]) -> dict[str, Ekf2Model]:
    """Open and evaluate the model of each flight; print the reason if there is none."""
    models = {}
    for path in paths:
        model = opened(path)
        if isinstance(model, Unavailable):
            print(f"{path.stem}: {model.reason}")
            continue
        models[path.stem] = model
        judge_agreement(path.stem, model)
    return models


def judge_agreement(name: str, model: Ekf2Model) -> None:
    agreement = model.agreement
    assert agreement.good, (name, agreement.reason)
    gnss = bool(agreement.gnss_pos)
    assert agreement.doubtful.keys() <= {"optical_flow"}, (name, agreement.doubtful)
    for aid, least in (("gnss_hgt", 0.998), ("baro_hgt", 0.96)):
        for axis in getattr(agreement, aid).values():
            assert axis.innovation_correlation >= least, (name, aid)
            assert 0.99 < axis.s_ratio_p5 < axis.s_ratio_p95 < 1.01, (name, aid)
            assert axis.position_rms_difference_m < 0.05, (name, aid)
            assert axis.velocity_rms_difference_m_s < 0.02, (name, aid)
    for axis in agreement.axes.values():
        if OVERCONFIDENT in name:
            off = agreement.rejected_fraction_replayed - agreement.rejected_fraction_logged
            assert abs(off) < 0.03, name
            assert abs(axis.nis_mean_replayed / axis.nis_mean_logged - 1.0) < 0.10, name
            continue
        least = 0.99 if OUTLIERS in name else 0.998 if gnss else 0.995
        assert axis.innovation_correlation >= least, name
        assert abs(axis.s_ratio_median - 1.0) < 0.01, name
        assert axis.s_ratio_p5 > 0.96, name
        assert axis.s_ratio_p95 < 1.04, name
        assert agreement.decisions_same >= 0.99, name
        if gnss:
            assert axis.position_rms_difference_m < 0.03, name
            assert axis.velocity_rms_difference_m_s < 0.02, name
        elif OUTLIERS not in name:
            old = name.startswith(("v1.13", "v1.14"))
            assert axis.position_rms_difference_m < (0.02 if old else 0.012), name
            assert axis.velocity_rms_difference_m_s < 0.015, name


def waterfalls(models: dict[str, Ekf2Model]) -> dict[str, float]:
    """Print and check the steps of each flight: shares of the mean square over both axes.

    Returns the unexplained share of each flight.
    """
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from ekf2_tools import explained

    unexplained = {}
    steps = (
        SAMPLE_TIMES_PROPERTY_NAME,
        TIMESTAMPS_PROPERTY_NAME,
        MEASUREMENT_NOISE_PROPERTY_NAME,
        ACCELEROMETER_BIAS_PROPERTY_NAME,
        PROCESS_NOISE_PROPERTY_NAME,
        ATTITUDE_PROPERTY_NAME,
        MAGNETOMETER_PROPERTY_NAME,
        GNSS_VELOCITY_PROPERTY_NAME,
        FLOW_PROPERTY_NAME,
        REJECTION_PROPERTY_NAME,
        OUTPUT_PREDICTOR_PROPERTY_NAME,
    )
    print("\nwhy EKF2 differs | total rms m | " + " | ".join(steps) + " | left")
    for name, model in models.items():
        found = explained(model)
        assert isinstance(found, dict), found
        axes, bars = found.values(), dict.fromkeys(steps, 0.0)
        total = sum(axis.position_mean_square_m2 for axis in axes)
        for step in (step for axis in axes for step in axis.steps):
            bars[step.name] += step.position_mean_square_m2 / total
        left = sum(axis.unexplained_mean_square_m2 for axis in axes) / total
        told = " | ".join(f"{share:.1%}" for share in (*bars.values(), left))
        print(f"{name} | {np.sqrt(total):.3f} | {told}")
        assert abs(sum(bars.values()) + left - 1.0) < 1e-9, name
        assert left < (0.1 if model.agreement.gnss_pos else 0.03), name
        unexplained[name] = left
    return unexplained


def agreement_page(models: dict[str, Ekf2Model], left: dict[str, float]) -> str:
    """Return the table and notes on agreement for the documentation, of some typical flights."""
    lines = [
        "| flight | replayed and logged innovations | S replayed ÷ S logged | rejected samples | "
        "position difference replay - log |",
        "|---|---|---|---|---|",
    ]
    notes = []
    for name, model in models.items():
        if name not in DOCUMENTED_FLIGHTS:
            continue
        a, axes = model.agreement, model.agreement.axes.items()
        statistics = [statistic for _, statistic in axes]
        cells = (
            name,
            "correlation "
            + ", ".join(f"{x.innovation_correlation:.4f} {axis}" for axis, x in axes),
            f"S replayed ÷ S logged {min(x.s_ratio_p5 for x in statistics):.3f} to "
            f"{max(x.s_ratio_p95 for x in statistics):.3f}",
            f"rejected {100.0 * a.rejected_fraction_replayed:.1f} % in the replay, "
            f"{100.0 * a.rejected_fraction_logged:.1f} % in flight",
            "position difference "
            + ", ".join(f"{x.position_rms_difference_m:.3f} m {axis}" for axis, x in axes),
        )  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
        notes += height_notes(name, a)
    unexplained = max((left[name] for name in models if name in DOCUMENTED_FLIGHTS), default=np.nan)
    notes.append(
        "The section *Difference between KF and EKF2* of the reports on these flights leaves at "
        f"most {100.0 * unexplained:.1f} % of the mean square position difference unexplained."
    )
    return "\n\n".join(["\n".join(lines), *notes])


def height_notes(name: str, agreement: ReplayAgreement) -> list[str]:
    """Return the note on a flight with replayed heights, or no note."""
    heights = [*agreement.gnss_hgt.values(), *agreement.baro_hgt.values()]
    if not heights or agreement.doubtful:
        return []
    gnss, barometer = (axis.innovation_correlation for axis in heights)
    return [
        f"Height replay of {name}: replayed and logged height innovations have the correlation "
        f"{gnss:.4f} (GNSS) and {barometer:.4f} (barometer). The RMS height difference is "
        f"{heights[0].position_rms_difference_m:.3f} m."
    ]


def in_page() -> str:
    """Return the table in the documentation."""
    return PAGE.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0].strip()


def write_page(table: str) -> None:
    """Put the table into the PAGE."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(in_page(), table), encoding="utf-8")


def horizontal_rmse(summary: Ekf2Statistics) -> float:
    parts = [axis.position_rmse_to_truth_m for axis in summary.axes.values()]
    assert all(isinstance(part, float) for part in parts)
    return float(np.hypot(*parts))


def check_what_if(models: dict[str, Ekf2Model]) -> None:
    """Print and check predictions with other parameters, against ground truth."""
    clean = "v1.16.1_aisle_nominal"
    print("\nwhat if | mean NIS north, east | rejected | RMSE to truth m (as flown)")
    # expected errors: of an independent replay, or similar to a flight without the fault
    for name, change, expected_m in (
        ("v1.16.1_aisle_overconfident", {"EKF2_EVP_NOISE": 0.1}, None),
        ("v1.16.1_aisle_clock_late", {"EKF2_EV_DELAY": 250.0}, clean),
        ("v1.16.1_aisle_clock_nosync", {"EKF2_EV_DELAY": 250.0}, clean),
        ("v1.13.3_aisle_evdelay175", {"EKF2_EV_DELAY": 0.0}, None),
        ("v1.16.1_gps_delay0", {"EKF2_GPS_DELAY": 200.0}, 0.233),
        ("v1.16.1_gps_overconfident", {"EKF2_GPS_P_NOISE": 0.72}, 0.737),
        ("v1.16.1_gps_nominal", {"EKF2_GPS_P_NOISE": 0.8}, 0.193),
    ):
        if name not in models:
            continue
        made = what_if(models[name], [change])
        assert isinstance(made, WhatIf), made
        (summary,) = made.whatif
        nis = [axis.nis_mean for axis in summary.axes.values()]
        rmse = horizontal_rmse(summary)
        print(
            f"{name} {change} | {nis[0]:.2f}, {nis[1]:.2f} | {summary.rejected_fraction:.1%} | "
            f"{rmse:.3f} ({horizontal_rmse(made.logged):.3f})"
        )
        if "EKF2_EVP_NOISE" in change:
            assert all(0.9 <= value <= 1.1 for value in nis), nis
            assert summary.rejected_fraction == 0.0
        elif isinstance(expected_m, float):
            assert abs(summary.position_rmse_to_truth_m / expected_m - 1.0) < 0.06, (name, summary)
        elif expected_m in models:
            reference = what_if(models[expected_m], [])
            assert isinstance(reference, WhatIf)
            assert rmse < 1.2 * horizontal_rmse(reference.logged), (name, rmse)


def cpu_s(work: Callable[[], object], runs: int = 5) -> float:
    """Return the least CPU time of several runs, because other load only increases it."""
    return min(timeit.repeat(work, number=1, repeat=runs, timer=time.process_time))


def speed(flight: Flight, model: Ekf2Model) -> None:
    """Print CPU times of a two-minute flight, and their growth with its length."""
    first = cpu_s(lambda: prepare_ekf2_model(flight))
    print(f"\nfirst replay {first:.3f} s of CPU (aim 0.3 s)")
    count = 10
    for name, values in (
        ("EKF2_EVP_NOISE", np.geomspace(0.05, 0.5, count)),
        ("EKF2_EV_DELAY", np.linspace(5.0, 150.0, count)),
    ):
        settings = [{name: float(value)} for value in values]
        each = (
            cpu_s(lambda settings=settings: list(replay_with_settings(model, settings)), 3) / count
        )
        print(f"{count} values of {name}: {each:.4f} s of CPU each (aim 0.03 s)")
    for share in (0.25, 0.5, 1.0):
        assert not isinstance(flight.imu, Unavailable)
        part = replace(flight, imu=flight.imu.iloc[: int(share * len(flight.imu))])
        print(
            f"{share:.0%} of the flight: {cpu_s(lambda part=part: prepare_ekf2_model(part)):.3f} s"
        )


def flights(folders: list[Path]) -> list[Path]:
    """Return the logs of folders, by name; without logs, the sample flight."""
    return [log for folder in folders for log in sorted(folder.glob("*.ulg"))] or [SAMPLE]


def main(paths: list[Path], *, readme: bool) -> None:
    models = agreement_table(paths)
    left = waterfalls(models)
    print(table := agreement_page(models, left))
    if readme:
        write_page(table)
    check_what_if(models)
    flight = read_log(SAMPLE)
    model = prepare_ekf2_model(flight)
    assert isinstance(model, Ekf2Model), model
    speed(flight, model)


if __name__ == "__main__":
    folders = [word for word in sys.argv[1:] if word != "--write"]
    chosen = [Path(folder) for folder in folders] or [SIMULATED, ON_GNSS]
    main(flights(chosen), readme="--write" in sys.argv)
