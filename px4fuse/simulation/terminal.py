"""Terminal output of ``px4fuse simulate``."""

from pathlib import Path

from px4fuse.core.text import format_count
from px4fuse.errors import to_one_line
from px4fuse.report.page import Page
from px4fuse.simulation.faults import FAULT_TYPES, format_fault, injected_fault_names
from px4fuse.simulation.flights import Simulation

POSITION_SOURCE_BY_KIND = {"aisle": "UWB", "loop": "VIO", "outdoor": "GNSS"}


def summary(simulation: Simulation, answer: Path | None) -> Page:
    """Format the simulated flight with its injected faults."""
    scenario, page = simulation.scenario, Page()
    path = f"{format_count(scenario.passes, 'lap')} of a square of {scenario.length_m:g} m"
    if scenario.kind == "aisle":
        plural_suffix = "es" * (scenario.passes > 1)
        path = f"{scenario.passes} pass{plural_suffix} of {scenario.length_m:g} m"
    texts = {
        "Flight": f"{scenario.kind}, {path} at {scenario.speed_m_s:g} m/s, "
        f"{simulation.motion.duration_s:g} s, seed {scenario.seed}",
        "Position": f"{POSITION_SOURCE_BY_KIND[scenario.kind]}, {scenario.source_sigma_m:g} m at "
        f"{scenario.source_rate_hz:g} Hz",
    }
    if scenario.kind == "loop":
        texts["VIO drift"] = f"{scenario.vio_drift:.1%} of the distance flown"
    texts["IMU"] = f"{scenario.imu_rate_hz:g} Hz, SIGMA_A {scenario.sigma_a_m_s2:g} m/s²"
    page.write_labelled_texts(texts)
    fault_texts = [
        f"{format_fault(name, simulation.faults)}: {FAULT_TYPES[name].help}"
        for name in injected_fault_names(simulation.faults)
    ]
    page.write_labelled("Faults", *(fault_texts or ["none"]))
    texts = {
        "Truth": "logged" if scenario.truth else "not logged",
        "EKF2": "EKF2 data are from px4fuse's model of EKF2"
        if scenario.ekf2
        else "EKF2 is not simulated (--no-ekf2)",
    }
    if answer is not None:
        texts["Answer"] = f"{to_one_line(str(answer))} (do not give this answer file to students)"
    page.write_labelled_texts(texts)
    return page
