"""Worked Examples 1 and 2 of module 2 ("SLAM and sensor fusion") in the course UAT 366.

Example 1 runs the Kalman filter KF. Example 2 distributes a loop closure error along the path.
"""

from collections.abc import Iterator

import numpy as np

from .filter.kalman import KfRun, run_kf
from .filter.settings import Settings
from .filter.signals import Axis
from .flight.model import Unavailable
from .loop.closure import distribute_by_distance
from .trajectory.model import cumulative_distance

TRUE_VELOCITY_M_S = 1.0
PREDICTION_COUNT = 30
PREDICTIONS_PER_UPDATE = 5
# Errors (m) of the six UWB positions in Example 1: fixed numbers instead of random noise
UWB_ERRORS_M = (0.08, -0.12, 0.05, 0.10, -0.06, -0.09)
# Corners (m) of the odometry path in Example 2; the true path returns to its start
ODOMETRY_CORNERS_M = ((0.0, 0.0), (20.3, 0.2), (20.6, 20.4), (0.8, 20.9), (1.2, 0.8))


def run_aisle_example() -> KfRun:
    """Run KF on Example 1 of the lesson: UWB positions every 0.5 s along an aisle at 1 m/s."""
    settings = Settings(sigma_a_m_s2=0.5, sigma_z_m=0.10, dt_s=0.1, input="zero")
    time_s = settings.dt_s * np.arange(0.0, PREDICTION_COUNT + 1, PREDICTIONS_PER_UPDATE)
    axis = Axis(
        name="aisle",
        direction=np.array([1.0, 0.0, 0.0]),
        heading_deg=0.0,
        note="Example 1",
        measurement_time_s=time_s,
        # The initial position is known
        measurement_m=TRUE_VELOCITY_M_S * time_s + np.array([0.0, *UWB_ERRORS_M]),
        acceleration=Unavailable("acceleration", "the lesson example contains no IMU data", ""),
    )
    return run_kf(axis, settings)


def format_kalman_example_lines() -> Iterator[str]:
    """Yield the lines of Example 1 of the lesson: KF's state after each UWB update."""
    kf_run = run_aisle_example()
    for index, state in kf_run.steps.loc[kf_run.updates.index].iterrows():
        time_s = float(str(index))
        yield (
            f"t {time_s:.1f} s: p {state['position_m']:.2f} (true "
            f"{TRUE_VELOCITY_M_S * time_s:.2f}), v {state['velocity_m_s']:.2f}, "
            f"sigma_p {np.sqrt(state['position_variance_m2']):.3f} m, "
            f"sigma_v {np.sqrt(state['velocity_variance_m2_s2']):.3f} m/s"
        )


def format_loop_example_lines() -> Iterator[str]:
    """Yield the lines of Example 2 of the lesson: a loop closure error and its correction.

    The correction changes the five corners of an odometry path.
    """
    odometry = np.array(ODOMETRY_CORNERS_M)
    distance_m = cumulative_distance(odometry)
    length_m = distance_m[-1]
    x_error_m, y_error_m = closure_error_m = odometry[-1] - odometry[0]
    yield (
        f"loop closure error ({x_error_m:.1f}, {y_error_m:.1f}) m over {length_m:.1f} m = "
        f"{np.hypot(x_error_m, y_error_m) / length_m:.1%}"
    )
    corrected_path = distribute_by_distance(odometry, closure_error_m, distance_m)
    for (x, y), (x_corrected, y_corrected) in zip(odometry, corrected_path, strict=True):
        yield f"({x:5.1f}, {y:5.1f}) -> ({x_corrected:5.2f}, {y_corrected:5.2f})"
