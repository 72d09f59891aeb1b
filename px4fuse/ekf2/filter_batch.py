"""Filter configurations of the EKF2 replay, and batches of them that are replayed at once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, GNSS_POS

from .inputs import ReplayInputs
from .intervals import EventIntervals, FusionDelays
from .replay_segments import ReplaySegment

# EKF2 parameters with these prefixes do not change the vertical innovations
PARAMETER_PREFIXES_WITHOUT_HEIGHT_EFFECT = (
    "EKF2_EV",
    "EKF2_MAG",
    "EKF2_OF",
    "EKF2_TAU",
    "EKF2_GPS_P_GATE",
    "EKF2_GPS_DELAY",
)


@dataclass(frozen=True)
class FilterConfiguration:
    """Configuration of the EKF2 model: parameters, estimated states and fused sources.

    Attributes
    ----------
    settings : dict
        Values of all EKF2 parameters, by PX4 name.
    estimates_biases : bool
        True if the accelerometer bias is a state.
    estimates_attitude : bool
        True if attitude and gyro bias are states.
    fuses_velocity : bool
        False to ignore the velocity of the position source.
    uses_reported_noise : bool
        False to ignore the variance that the position source reports.
    has_gate : bool
        False to fuse every sample.
    uses_logged_decisions : bool
        True to use EKF2's logged rejections and resets.
    disable_time_s_by_aid : mapping from PX4's name of an aiding source to float
        Time (s) from which the source is not fused.
    timestamp_offset_s : float or None
        Time that is added to position timestamps, instead of EKF2's delay parameter.
    """

    settings: dict[str, float]
    estimates_biases: bool = True
    estimates_attitude: bool = True
    fuses_velocity: bool = True
    uses_reported_noise: bool = True
    has_gate: bool = True
    uses_logged_decisions: bool = False
    disable_time_s_by_aid: Mapping[str, float] = field(default_factory=dict)
    timestamp_offset_s: float | None = None

    def can_use_logged_bad_acceleration_flag(self, inputs: ReplayInputs) -> bool:
        """Return True if EKF2's logged bad-acceleration flag is valid for this configuration.

        EKF2 computes the flag from vertical innovations. The flag is valid if the configuration
        rejects the same samples as EKF2 in the log, or changes nothing that has an effect on
        vertical innovations.
        """
        has_logged_height_parameters = not self.disable_time_s_by_aid and all(
            value == inputs.settings[name]
            or name.startswith(PARAMETER_PREFIXES_WITHOUT_HEIGHT_EFFECT)
            for name, value in self.settings.items()
        )
        return self.uses_logged_decisions or has_logged_height_parameters

    def compute_delays(self, inputs: ReplayInputs) -> FusionDelays:
        """Return the delay of the position source, and the delay of the fusion horizon.

        A time offset replaces the delay parameter. Otherwise, the fusion horizon depends on the
        largest delay parameter, which sets the length of EKF2's IMU buffer.
        """
        if self.timestamp_offset_s is not None:
            # The delay is timestamp minus measurement time, so it is minus the time offset. Later,
            # the replay also subtracts half a prediction step from each timestamp, as EKF2 does.
            # The delay is reduced by this half step, so that only the offset remains. With an
            # infinite delay of the fusion horizon, each sample arrives in time
            return FusionDelays(-self.timestamp_offset_s - 0.5 * inputs.mean_step_s, np.inf)
        delay_s = self.settings[inputs.aid.delay] * 1e-3
        delays_ms = [self.settings.get(aid.delay, 0.0) for aid in (GNSS_POS, EV_POS)]
        if inputs.rules.is_horizon_set_by_largest_delay:
            # The parameters contain only two delays. Another sensor may have a larger delay, so the
            # logged delay of the fusion horizon is the lower limit of the result
            min_horizon_s = inputs.horizon_s
        else:
            # EKF2 raises EKF2_DELAY_MAX to the largest delay parameter (EKF2.cpp)
            delays_ms.append(self.settings["EKF2_DELAY_MAX"])
            min_horizon_s = inputs.mean_step_s
            # With the logged EKF2_DELAY_MAX, the logged delay of the fusion horizon applies
            if max(delays_ms) == inputs.settings["EKF2_DELAY_MAX"]:
                return FusionDelays(delay_s, inputs.horizon_s)
        # Number of samples in the IMU buffer (initialise_interface, estimator_interface.cpp). The
        # fusion horizon is the oldest of them
        buffer_length = math.ceil(max(delays_ms) * 1e-3 / inputs.configured_step_s)
        return FusionDelays(delay_s, max((buffer_length - 1) * inputs.mean_step_s, min_horizon_s))


class FilterBatch:
    """Filter configurations that are replayed at once in one part of a flight.

    Attributes
    ----------
    parameters : dict from PX4's name to ndarray, shape (filters,)
    estimates_biases, has_gate, and so on : ndarray of bool, shape (filters,)
        Fields of :class:`FilterConfiguration`.
    events : ndarray, shape (events, filters)
        Fusion events of each configuration, see :data:`~px4fuse.ekf2.intervals.EVENT_DTYPE`.
    event_steps, event_time_s : ndarray, shape (events, filters)
        Prediction step of each fusion event, and its time.
    is_enabled_by_aid : dict from PX4's name to ndarray of bool, shape (events, filters)
        True before the aiding source is disabled.
    """

    def __init__(
        self,
        inputs: ReplayInputs,
        segment: ReplaySegment,
        configurations: Sequence[FilterConfiguration],
        intervals: Sequence[EventIntervals],
    ) -> None:
        self.inputs, self.segment = inputs, segment
        self.configurations, self.intervals = configurations, intervals
        self.parameters = {
            name: np.array([configuration.settings[name] for configuration in configurations])
            for name in inputs.settings
        }
        # EKF2's parameters were changed in flight before this segment. The change applies to
        # filters with the logged start value; a filter with another value keeps that value
        for name, changed_value in segment.changed_parameters.items():
            if name in self.parameters:
                values = self.parameters[name]
                values[values == inputs.settings[name]] = changed_value
        # One row per configuration; the transposed table has one row per field
        (
            self.estimates_biases,
            self.estimates_attitude,
            self.has_gate,
            self.uses_logged_decisions,
            self.uses_reported_noise,
            self.fuses_velocity,
        ) = np.array(
            [
                (
                    configuration.estimates_biases,
                    configuration.estimates_attitude,
                    configuration.has_gate,
                    configuration.uses_logged_decisions,
                    configuration.uses_reported_noise,
                    configuration.fuses_velocity,
                )
                for configuration in configurations
            ]
        ).T
        self.events = np.stack([arrays.events for arrays in intervals], axis=1)
        self.event_steps = self.events["end_step"]
        self.event_time_s = segment.time_s[self.event_steps]
        self.is_enabled_by_aid = {
            name: self.event_time_s
            < np.array(
                [
                    configuration.disable_time_s_by_aid.get(name, np.inf)
                    for configuration in configurations
                ]
            )
            for name in AIDS
        }
