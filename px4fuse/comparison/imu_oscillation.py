"""Oscillation of the measured acceleration that the measured positions do not show.

Such an oscillation is not a motion of the vehicle.
"""

from typing import NamedTuple

import numpy as np

from px4fuse.core.arrays import compute_median_interval_s, integrate_cumulatively
from px4fuse.filter.frame_rotation import heading_rad
from px4fuse.flight.model import Columns, Unavailable

from .model import PreparedComparison

MIN_POSITIONS = 100
# Minimum and maximum tested frequency (Hz), and maximum tested frequency ÷ rate of the positions
MIN_OSCILLATION_FREQUENCY_HZ, MAX_OSCILLATION_FREQUENCY_HZ, MAX_FREQUENCY_TO_RATE_RATIO = (
    0.1,
    5.0,
    0.45,
)
# Spectrum of the acceleration error (second differences of positions minus those of the doubly
# integrated acceleration): the power of a peak at frequency f is compared with the median power
# from f ÷ ratio to f · ratio
BAND_LIMIT_RATIO = 1.33
# Minimum power of a peak of the acceleration error ÷ median power. In flights without an
# oscillation, this ratio is below 6
MIN_PEAK_TO_MEDIAN_POWER_RATIO = 8.0
# At the frequency of the peak, maximum power in the positions ÷ power in the measured acceleration:
# both contain a real motion
MAX_SOURCE_TO_IMU_POWER_RATIO = 0.25
MIN_AMPLITUDE_M_S2 = 0.3


class ImuOscillation(NamedTuple):
    """Frequency and amplitude of an oscillating acceleration error along one vehicle axis."""

    frequency_hz: float
    amplitude_m_s2: float


def find_imu_oscillation(comparison: PreparedComparison) -> ImuOscillation | None:
    """Find an oscillation of the horizontal acceleration that the positions do not show.

    Second differences of the positions are compared with those of the doubly integrated
    acceleration, in axes that turn with the heading. Complex numbers are north + i east.
    """
    acceleration, attitude = comparison.input_axes[0].acceleration, comparison.flight.attitude
    samples = comparison.source_samples[Columns.POSITION[:2]].dropna()
    if isinstance(acceleration, Unavailable) or isinstance(attitude, Unavailable):
        return None
    if len(samples) < MIN_POSITIONS:
        return None
    source_time_s, imu_time_s = samples.index.to_numpy(), acceleration.time_s
    interval_s = compute_median_interval_s(source_time_s)
    time_s = np.arange(
        max(source_time_s[0], imu_time_s[0]), min(source_time_s[-1], imu_time_s[-1]), interval_s
    )
    if len(time_s) < MIN_POSITIONS:
        return None
    velocity_m_s = acceleration.acceleration_integral_m_s[:2].T
    imu_position_m = integrate_cumulatively(velocity_m_s, imu_time_s)
    positions_m = np.stack(
        [
            np.interp(time_s, source_time_s, samples.to_numpy() @ [1.0, 1j]),
            np.interp(time_s, imu_time_s, imu_position_m @ [1.0, 1j]),
        ]
    )
    headings_rad = np.unwrap(heading_rad(attitude))
    rotation_to_vehicle_axes = np.exp(
        -1j * np.interp(time_s[1:-1], attitude.index.to_numpy(), headings_rad)
    )
    # Second differences are proportional to the acceleration (factor: interval²)
    window = np.hanning(len(rotation_to_vehicle_axes))
    second_differences_m = np.diff(positions_m, 2, axis=1) * rotation_to_vehicle_axes * window
    spectra = np.fft.fft([*second_differences_m, np.diff(second_differences_m, axis=0)[0]])
    count = len(rotation_to_vehicle_axes) // 2
    # The signals are complex, so an oscillation along one axis has equal powers at positive and
    # negative frequency: add both. Rows of the spectra: source, IMU, and their difference. Column
    # -n is the negative frequency of column n
    powers = np.abs(spectra[:, 1:count]) ** 2 + np.abs(spectra[:, :-count:-1]) ** 2
    source_power, imu_power, error_power = (np.convolve(row, np.ones(3), "same") for row in powers)
    frequencies_hz = np.arange(1, count) / (len(rotation_to_vehicle_axes) * interval_s)
    first, end = np.searchsorted(
        frequencies_hz,
        [
            MIN_OSCILLATION_FREQUENCY_HZ,
            min(MAX_OSCILLATION_FREQUENCY_HZ, MAX_FREQUENCY_TO_RATE_RATIO / interval_s),
        ],
    )
    peaks = 1 + np.flatnonzero(
        (error_power[1:-1] > error_power[:-2]) & (error_power[1:-1] > error_power[2:])
    )
    peaks = peaks[(peaks >= first) & (peaks < end)]
    # Rows from frequency ÷ ratio to frequency · ratio, for each peak
    band_rows = np.searchsorted(
        frequencies_hz,
        np.outer([1.0 / BAND_LIMIT_RATIO, BAND_LIMIT_RATIO], frequencies_hz[peaks]),
    ).T
    medians = [np.median(error_power[low : high + 1]) for low, high in band_rows]
    if not medians:
        return None
    peak_index = int(np.argmax(error_power[peaks] / medians))
    peak = peaks[peak_index]
    frequency_hz = float(frequencies_hz[peak])
    # The Hann window spreads an oscillation over 3 bins with a total power of 1.5 times that of the
    # middle bin. imu_power adds positive and negative frequency: 3 times the power of the middle
    # bin
    amplitude_m = 2.0 * np.sqrt(imu_power[peak] / 3.0) / window.sum()
    # Amplitude of the derivative of a sinusoid ÷ amplitude of its difference over interval_s. The
    # square is the same ratio for second derivative and second difference
    acceleration_per_difference = np.pi * frequency_hz / np.sin(np.pi * frequency_hz * interval_s)
    oscillation = ImuOscillation(frequency_hz, float(amplitude_m * acceleration_per_difference**2))
    is_oscillating = (
        error_power[peak] > MIN_PEAK_TO_MEDIAN_POWER_RATIO * medians[peak_index]
        and source_power[peak] < MAX_SOURCE_TO_IMU_POWER_RATIO * imu_power[peak]
        and oscillation.amplitude_m_s2 > MIN_AMPLITUDE_M_S2
    )
    return oscillation if is_oscillating else None
