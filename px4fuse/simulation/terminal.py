"""Terminal output of ``px4fuse simulate``."""

from pathlib import Path

from px4fuse.core.text import format_count
from px4fuse.errors import to_one_line
from px4fuse.report.page import Page

from .faults import FAULT_TYPES, format_fault, injected_fault_names
from .flights import Simulation

PATH_AND_SOURCE_BY_KIND = {
    "aisle": ("straight path", "UWB"),
    "loop": ("square", "VIO"),
    "outdoor": ("square", "GNSS"),
}


def summary(simulation: Simulation, answer_key_path: Path | None) -> Page:
    """Format the simulated flight with its injected faults."""
    scenario, page = simulation.scenario, Page()
    path, source = PATH_AND_SOURCE_BY_KIND[scenario.kind]
    page.write_labelled_text(
        "Flight",
        f"{scenario.kind}, {path} of {scenario.length_m:g} m, "
        f"{format_count(scenario.passes, 'time')} at {scenario.speed_m_s:g} m/s, "
        f"{simulation.motion.duration_s:g} s, seed {scenario.seed}",
    )
    page.write_labelled_text(
        "Position", f"{source}, {scenario.source_sigma_m:g} m at {scenario.source_rate_hz:g} Hz"
    )
    if scenario.kind == "loop":
        page.write_labelled_text("VIO drift", f"{scenario.vio_drift:.1%} of the distance flown")
    page.write_labelled_text(
        "IMU", f"{scenario.imu_rate_hz:g} Hz, SIGMA_A {scenario.sigma_a_m_s2:g} m/s²"
    )
    fault_texts = [
        f"{format_fault(name, simulation.faults)}: {FAULT_TYPES[name].help}"
        for name in injected_fault_names(simulation.faults)
    ]
    page.write_labelled_text("Faults", *(fault_texts or ["none"]))
    page.write_labelled_text("Truth", "logged" if scenario.truth else "not logged")
    page.write_labelled_text(
        "EKF2", "from px4fuse's model of EKF2" if scenario.ekf2 else "not simulated (--no-ekf2)"
    )
    if answer_key_path is not None:
        page.write_labelled_text(
            "Answer", f"{to_one_line(str(answer_key_path))} (not for students)"
        )
    return page
