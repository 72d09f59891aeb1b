"""Oscillation of the measured acceleration that the measured positions do not show.

Such an oscillation is not a motion of the vehicle.
"""

from typing import NamedTuple

import numpy as np

from px4fuse.core.arrays import Array, compute_median_interval_s, integrate_cumulatively
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
# Maximum power in the positions ÷ power in the measured acceleration, at the frequency of the peak.
# A larger ratio means that the vehicle really oscillates, because the positions also show it
MAX_SOURCE_TO_IMU_POWER_RATIO = 0.25
MIN_AMPLITUDE_M_S2 = 0.3


class ImuOscillation(NamedTuple):
    """Frequency and amplitude of an oscillating acceleration error along one vehicle axis."""

    frequency_hz: float
    amplitude_m_s2: float


def find_imu_oscillation(comparison: PreparedComparison) -> ImuOscillation | None:
    """Find an oscillation of the horizontal acceleration that the positions do not show.

    Second differences of the positions are compared with those of the doubly integrated
    acceleration. Complex numbers are forward + i · right, in axes that turn with the heading.
    Return None if no frequency shows a large oscillation of the IMU that is missing in the
    positions.
    """
    signals = _compute_second_differences(comparison)
    if signals is None:
        return None
    second_differences_m, interval_s = signals
    # 1. Power spectra of source, IMU, and their difference (the error)
    sample_count = second_differences_m.shape[1]
    window = np.hanning(sample_count)
    source_m, imu_m = second_differences_m * window
    spectra = np.fft.fft([source_m, imu_m, imu_m - source_m])
    # The signals are complex: an oscillation along one axis has equal powers at positive and at
    # negative frequency. Add both. Column -n is the negative frequency of column n
    count = sample_count // 2
    powers = np.abs(spectra[:, 1:count]) ** 2 + np.abs(spectra[:, :-count:-1]) ** 2
    # The Hann window spreads an oscillation over 3 frequencies: add their powers
    source_power, imu_power, error_power = (np.convolve(row, np.ones(3), "same") for row in powers)
    frequencies_hz = np.arange(1, count) / (sample_count * interval_s)
    # 2. The peak of the error with the largest ratio to the median power at similar frequencies
    peaks = 1 + np.flatnonzero(
        (error_power[1:-1] > error_power[:-2]) & (error_power[1:-1] > error_power[2:])
    )
    max_frequency_hz = min(MAX_OSCILLATION_FREQUENCY_HZ, MAX_FREQUENCY_TO_RATE_RATIO / interval_s)
    is_tested = (frequencies_hz >= MIN_OSCILLATION_FREQUENCY_HZ) & (
        frequencies_hz < max_frequency_hz
    )
    ratio_by_peak: dict[int, float] = {}
    for peak in peaks[is_tested[peaks]].tolist():
        low, high = np.searchsorted(
            frequencies_hz,
            [frequencies_hz[peak] / BAND_LIMIT_RATIO, frequencies_hz[peak] * BAND_LIMIT_RATIO],
        )
        ratio_by_peak[peak] = float(error_power[peak] / np.median(error_power[low : high + 1]))
    if not ratio_by_peak:
        return None
    peak, peak_to_median_ratio = max(ratio_by_peak.items(), key=lambda item: item[1])
    frequency_hz = float(frequencies_hz[peak])
    # 3. Compute the amplitude of the acceleration error. imu_power[peak] is the sum over three
    # frequencies and both signs. For a Hann window, it is 2 · 1.5 = 3 times the power at the middle
    # frequency
    amplitude_m = 2.0 * np.sqrt(imu_power[peak] / 3.0) / window.sum()
    # The amplitude of a sinusoid's derivative is this factor times the amplitude of its difference
    # between samples. The squared factor converts second differences to accelerations
    acceleration_per_difference = np.pi * frequency_hz / np.sin(np.pi * frequency_hz * interval_s)
    oscillation = ImuOscillation(frequency_hz, float(amplitude_m * acceleration_per_difference**2))
    is_oscillating = (
        peak_to_median_ratio > MIN_PEAK_TO_MEDIAN_POWER_RATIO
        and source_power[peak] < MAX_SOURCE_TO_IMU_POWER_RATIO * imu_power[peak]
        and oscillation.amplitude_m_s2 > MIN_AMPLITUDE_M_S2
    )
    return oscillation if is_oscillating else None


def _compute_second_differences(comparison: PreparedComparison) -> tuple[Array, float] | None:
    """Return the second differences (m) of source and IMU positions, and their interval (s).

    Row 0: source, row 1: IMU. The numbers are complex: forward + i · right, in axes that turn with
    the heading. Return None without acceleration or attitude, or with too few positions.
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
    positions_m = [
        np.interp(time_s, source_time_s, samples.to_numpy() @ [1.0, 1j]),
        np.interp(time_s, imu_time_s, imu_position_m @ [1.0, 1j]),
    ]
    headings_rad = np.unwrap(heading_rad(attitude))
    rotation_to_vehicle_axes = np.exp(
        -1j * np.interp(time_s[1:-1], attitude.index.to_numpy(), headings_rad)
    )
    return np.diff(positions_m, 2, axis=1) * rotation_to_vehicle_axes, interval_s
