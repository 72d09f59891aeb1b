"""Inputs of the EKF2 replay, read from a flight log.

Sources: PX4-Autopilot ``EKF/aid_sources/external_vision/ev_pos_control.cpp`` and, before v1.15,
``EKF/ev_pos_control.cpp`` (frames), ``logged_topics.cpp`` (logging rates).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray, IntArray, compute_median_interval_s
from px4fuse.filter.signals import interpolate_attitude
from px4fuse.flight.ekf2_parameters import (
    AID_MASK_PARAMETER,
    AIDS,
    BAROMETER,
    EV_POS,
    FLOW,
    GNSS_MODE_PARAMETER,
    GNSS_POS,
    GNSS_VEL,
    MAG,
    Aid,
    fill_parameters_with_defaults,
    uses_aid_mask,
)
from px4fuse.flight.model import (
    DEAD_RECKONING_FLAG,
    FASTER_LOGGING_ACTION,
    FULL_IMU_RATE_ACTION,
    POSITION_FILE_ORIGIN,
    Columns,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Unavailable,
    sample_step_function,
)
from px4fuse.readers.common import find_spans
from px4fuse.readers.px4_innovations import has_fused_aid, replace_vision_by_gnss_innovations
from px4fuse.readers.px4_positions import MAX_DOWNSAMPLED_HZ
from px4fuse.readers.px4_topics import DEFAULT_PROFILE_REMEDY
from px4fuse.trajectory.rotation import conjugate, multiply, rotate, to_rotation_matrix

from .height_samples import add_heights
from .replay_segments import (
    MIN_IMU_GAP_S,
    MIN_SEGMENT_DURATION_S,
    ReplaySegment,
    add_flow_samples,
    compute_internal_to_published_position_ratio,
    find_replay_segments,
    read_prediction_step_s,
)

ANALYSIS_NAME = "EKF2 replay"
# Note in the log of a simulated flight
SIMULATED_EKF2_NOTE = (
    "EKF2 in this log is px4fuse's model of EKF2, run on the simulated sensors, not PX4's EKF2"
)
# Maximum median interval (s) of the EKF2 topics that repeat the vision positions. The default
# profile logs them every 0.2 s and 0.5 s (logged_topics.cpp); a shorter interval means that the log
# contains all positions
MAX_INTERVAL_BY_VISION_TOPIC_S = {
    "estimator_visual_odometry_aligned": 0.18,
    "estimator_aid_src_ev_pos": 0.25,
}
# Bit of EKF2_AID_MASK that rotates vision positions (PX4 v1.13 and earlier)
ROTATE_VISION_BIT = 64
# Maximum difference (s) between the logged time of an innovation and the time of its sample
SAMPLE_MATCH_TOLERANCE_S = 0.006
# Tolerance (s) for rounding errors between sample times and prediction times
TIME_ROUNDING_TOLERANCE_S = 1e-4
# EKF2 reports inertial dead reckoning after this time (s) without horizontal aiding
# (no_aid_timeout_max, common.h)
DEAD_RECKONING_TIMEOUT_S = 1.0
# Bit of EKF2_GPS_CTRL that enables fusion of GNSS velocity
GNSS_VELOCITY_BIT = 4
# Maximum time (s) from a reset to its publication: vehicle_local_position is logged every 0.1 s
MAX_RESET_PUBLICATION_DELAY_S = 0.2
# Maximum median IMU interval (s) for an EKF2 replay: EKF2 predicts every 8 to 13 ms
MAX_IMU_INTERVAL_S = 0.012
# Maximum fraction of IMU samples that are missing between logged samples, for an EKF2 replay. Gaps
# in the IMU data are not counted
MAX_MISSING_IMU_FRACTION = 0.1
# First PX4 release with the time of the fusion horizon in estimator_states
FIRST_RELEASE_WITH_HORIZON_TIMES = "PX4 v1.13"
# Maximum time (s) between two fusions of height and heading during a gap of the position source
MAX_HEIGHT_FUSION_INTERVAL_IN_POSITION_GAP_S = 0.25


@dataclass(frozen=True)
class ReceivedPositions:
    """Position samples that EKF2 received, in time order.

    Attributes
    ----------
    timestamp_s, arrival_s : ndarray, shape (m,)
        Timestamps and arrival times.
    position_m, variance_m2 : ndarray, shape (m, 3)
        Position in NED, and variance reported by the sender; 0 if not reported.
    velocity_m_s, velocity_variance_m2_s2 : ndarray, shape (m, 3), or None
        Velocity in NED, and variance reported by the sender.
    rejected_flags : ndarray, shape (m,)
        1 if EKF2 rejected the sample; NaN if not logged.
    is_reset_to_sample : ndarray of bool, shape (m,)
        True if EKF2 reset its position to the sample.
    uses_sender_timestamps : bool
        True if EKF2 ignores its delay parameter and uses the sender's measurement times.
    reset_times_s : ndarray
        Timestamps at which the sender requests a reset (``reset_counter``).
    is_every_reset_logged : bool
        True if the log contains all resets of EKF2's position to a sample.
    """

    timestamp_s: Array
    arrival_s: Array
    position_m: Array
    variance_m2: Array
    rejected_flags: Array
    is_reset_to_sample: BoolArray
    source: str
    velocity_m_s: Array | None = None
    velocity_variance_m2_s2: Array | None = None
    uses_sender_timestamps: bool = False
    reset_times_s: Array | tuple[()] = ()
    is_every_reset_logged: bool = False


@dataclass(frozen=True)
class FusionRules:
    """Rules of one PX4 release for start, stop and reset of position fusion.

    Attributes
    ----------
    max_sample_interval_to_start_s : float
        EKF2 starts fusion if two samples arrive within this time.
    stop_timeout_s : float
        EKF2 stops fusion after this time without a sample.
    reset_timeout_s : float
        EKF2 resets its position if it rejects all samples for this time.
    max_resets : int
        EKF2 stops fusion after this number of successive resets; by default unlimited.
    min_accelerometer_bias_variance_m2_s4 : float or None
        Minimum accelerometer bias variance (m²/s⁴).
    is_horizon_set_by_largest_delay : bool
        True if the largest delay parameter sets the delay of the fusion horizon (before v1.15).
    reset_variance_factor : float
        Position variance after a reset, divided by the measurement variance.
    resets_velocity : bool
        True if EKF2 resets its velocity together with its position.
    bad_acceleration_flag_duration_s : float
        Time for which the flag for a bad acceleration stays set.
    """

    max_sample_interval_to_start_s: float = np.inf
    stop_timeout_s: float = np.inf
    reset_timeout_s: float = 7.0
    max_resets: int = 1_000_000
    min_accelerometer_bias_variance_m2_s4: float | None = None
    is_horizon_set_by_largest_delay: bool = False
    reset_variance_factor: float = 1.0
    resets_velocity: bool = False
    bad_acceleration_flag_duration_s: float = 3.0


# Rules for external vision in PX4 v1.14 and later: EV_MAX_INTERVAL (ev_control.cpp),
# no_aid_timeout_max and reset_timeout_max (common.h)
VISION_RULES = FusionRules(
    max_sample_interval_to_start_s=0.2, stop_timeout_s=0.4, reset_timeout_s=1.0, max_resets=5
)
# Rules for GNSS in PX4 v1.16 (resetHorizontalPositionTo, gps_control.cpp)
GNSS_RULES = FusionRules(reset_variance_factor=2.0, resets_velocity=True)


@dataclass(frozen=True)
class ReplayInputs:
    """Data of a flight that the EKF2 replay needs.

    Attributes
    ----------
    settings : dict
        Logged EKF2 parameters, by PX4 name.
    aid : Aid
        Aiding source of the horizontal position: external vision or GNSS.
    received_positions : ReceivedPositions
        Position samples of ``aid``.
    mean_step_s, configured_step_s : float
        Length of a prediction step: mean in the log, and EKF2_PREDICT_US.
    horizon_s : float
        Delay of EKF2's fusion horizon.
    fuses_vision_height : bool
        True if EKF2 fused the height of external vision.
    imu_offset_m : ndarray, shape (3,)
        Position of the IMU (EKF2_IMU_POS, body FRD).
    max_height_fusion_interval_in_position_gap_s : float
        Maximum interval between fusions of height and heading in a gap of the position source.
    reason_to_use_logged_height : str
        Reason why a replay with GNSS uses EKF2's logged height.
    vision_positions : ReceivedPositions or None
        Vision positions in a flight with GNSS; NaN while vision is disabled.
    """

    settings: dict[str, float]
    segments: tuple[ReplaySegment, ...]
    received_positions: ReceivedPositions
    rules: FusionRules
    mean_step_s: float
    horizon_s: float
    configured_step_s: float
    fuses_vision_height: bool
    imu_offset_m: Array
    aid: Aid = EV_POS
    max_height_fusion_interval_in_position_gap_s: float = (
        MAX_HEIGHT_FUSION_INTERVAL_IN_POSITION_GAP_S
    )
    reason_to_use_logged_height: str = ""
    vision_positions: ReceivedPositions | None = None


def prepare_inputs(  # noqa: PLR0911, PLR0912, PLR0915 (one return per reason)
    flight: Flight, omitted_aids: Mapping[str, str] = {}
) -> ReplayInputs | Unavailable:
    """Return the inputs of the EKF2 replay, or the reason why the log is insufficient.

    ``omitted_aids`` contains PX4's names of aiding sources to omit, with the reasons.
    """
    imu, attitude, ekf2 = flight.imu, flight.attitude, flight.ekf2
    if isinstance(imu, Unavailable):
        return imu
    if isinstance(attitude, Unavailable):
        return attitude
    if isinstance(ekf2, Unavailable):
        return ekf2
    # 1. Position source, and data without which no replay is possible
    aid = find_replayed_position_source(ekf2)
    is_gnss = aid == GNSS_POS
    logged_ekf2 = ekf2
    if is_gnss:
        ekf2 = replace_vision_by_gnss_innovations(ekf2)
    fusion_record = ekf2.record
    if isinstance(fusion_record, Unavailable):
        return fusion_record
    # Without a latitude, the model omits earth rotation, which simulated flights do not contain
    if SIMULATED_EKF2_NOTE in flight.log.notes:
        fusion_record = replace(fusion_record, latitude_deg=np.nan)
    if isinstance(innovations := ekf2.innovations["north"], Unavailable):
        return innovations
    flow_samples = fusion_record.flow if is_gnss else pd.DataFrame()
    if missing := _explain_unmodelled_aids(
        fusion_record, is_gnss, len(flow_samples) > 0
    ) or _explain_missing_imu(imu.index.to_numpy()):
        return missing
    # 2. Positions that EKF2 received
    vision_positions = None
    if is_gnss:
        received_positions = read_gnss(flight, ekf2, fusion_record)
        if EV_POS.name not in omitted_aids and not isinstance(received_positions, Unavailable):
            vision_positions = _read_vision_in_gnss_flight(
                flight, logged_ekf2, fusion_record, attitude
            )
    else:
        received_positions = read_vision(flight, ekf2, fusion_record, attitude)
    if isinstance(received_positions, Unavailable):
        return received_positions
    if not len(received_positions.timestamp_s):
        return Unavailable(
            ANALYSIS_NAME,
            f"EKF2 reports fusion of {aid.label}, but the log contains no sample of this source",
            "Record estimator_status_flags and the position source for the whole flight.",
        )
    if isinstance(vision_positions, Unavailable):
        return vision_positions
    if isinstance(horizon_s := ekf2.horizon_s, Unavailable):
        if not flight.log.firmware.startswith(FIRST_RELEASE_WITH_HORIZON_TIMES):
            return horizon_s
        # If EKF2_EV_DELAY is at most one prediction step, EKF2 fuses without delay
        horizon_s = 0.0
    # 3. Parts of the flight without gaps, with the samples of further sensors
    aiding_times_s = received_positions.timestamp_s
    if len(flow_samples) and FLOW.name not in omitted_aids:
        aiding_times_s = np.union1d(aiding_times_s, flow_samples.index)
    segments = find_replay_segments(
        flight, imu, attitude, ekf2, fusion_record, aiding_times_s, is_gnss=is_gnss
    )
    if not segments:
        return Unavailable(
            ANALYSIS_NAME,
            f"EKF2 fused {aid.label.removesuffix(', position')} for less than "
            f"{MIN_SEGMENT_DURATION_S:g} s without a gap in position or IMU data",
            "Record without dropouts (faster SD card, fewer topics) and send positions at a "
            "constant rate.",
        )
    if len(flow_samples):
        flow_gate = fusion_record.parameters.get(FLOW.gate, FLOW.default_gate)
        segments = tuple(add_flow_samples(segment, flow_samples, flow_gate) for segment in segments)
    reason_to_use_logged_height = "; ".join(
        f"{AIDS[name].label}: {reason}"
        for name, reason in omitted_aids.items()
        if name not in (FLOW.name, EV_POS.name)
    )
    if is_gnss and not reason_to_use_logged_height:
        segments_with_heights = add_heights(flight, ekf2, fusion_record, segments)
        if isinstance(segments_with_heights, str):
            reason_to_use_logged_height = segments_with_heights
        else:
            segments = segments_with_heights
    # 4. Parameters of the fused aiding sources
    fused_aids = [aid]
    if vision_positions is not None:
        fused_aids.append(EV_POS)
    if any(segment.magnetic_field for segment in segments):
        fused_aids.append(MAG)
    height_samples = segments[0].height_samples
    if height_samples and BAROMETER.name in height_samples.fused_sensors:
        fused_aids.append(BAROMETER)
    settings = fill_parameters_with_defaults(fusion_record.parameters, *fused_aids)
    if is_gnss and (gnss_track := _find_gnss_track(flight)):
        # Since PX4 v1.17, GNSS messages contain the lever arm of the receiver
        settings |= dict(zip(aid.lever_arm, gnss_track.lever_arm_m, strict=True))
    return ReplayInputs(
        settings=settings,
        segments=segments,
        received_positions=received_positions,
        rules=_make_fusion_rules(fusion_record, ekf2.step_s, is_gnss=is_gnss),
        mean_step_s=ekf2.step_s,
        horizon_s=horizon_s,
        configured_step_s=read_prediction_step_s(fusion_record),
        # The model fuses vision heights only if EKF2 never flagged a bad acceleration: with the
        # flag, EKF2 clips height innovations to the gate, but the model does not
        fuses_vision_height=not is_gnss
        and isinstance(ekf2.fusion_flags, pd.DataFrame)
        and bool(ekf2.fusion_flags["vertical"].mean() > 0.5)
        and not any(np.any(segment.is_acceleration_bad) for segment in segments),
        imu_offset_m=np.array(
            [fusion_record.parameters.get(f"EKF2_IMU_POS_{x}", 0.0) for x in "XYZ"]
        ),
        aid=aid,
        reason_to_use_logged_height=reason_to_use_logged_height,
        vision_positions=vision_positions,
    )


def _explain_unmodelled_aids(
    fusion_record: FusionRecord, is_gnss: bool, has_flow: bool
) -> Unavailable | None:
    modelled_labels = [GNSS_POS.label, GNSS_VEL.label] * is_gnss + [FLOW.label] * has_flow
    unmodelled_labels = [
        label for label in fusion_record.other_horizontal_aids if label not in modelled_labels
    ]
    if not unmodelled_labels:
        return None
    return Unavailable(
        ANALYSIS_NAME,
        f"EKF2 also fused {', '.join(unmodelled_labels)}, which the replay does not contain",
        "Before the next flight, disable optical flow (EKF2_OF_CTRL 0), "
        f"{'' if is_gnss else 'GNSS (EKF2_GPS_CTRL 0) '}"
        "or vision velocity (bit 2 of EKF2_EV_CTRL).",
    )


def compute_lost_imu_fraction(time_s: Array) -> float:
    """Return the fraction of missing IMU samples, without gaps above MIN_IMU_GAP_S."""
    intervals_s = np.diff(time_s)
    missing_samples_by_interval = (
        np.rint(intervals_s[intervals_s <= MIN_IMU_GAP_S] / np.median(intervals_s)) - 1.0
    )
    lost_count = missing_samples_by_interval.clip(0.0).sum()
    return float(lost_count / (lost_count + len(time_s)))


def _explain_missing_imu(time_s: Array) -> Unavailable | None:
    """Return Unavailable if the log contains too few IMU samples for an EKF2 replay, else None."""
    median_interval_s = compute_median_interval_s(time_s)
    if median_interval_s > MAX_IMU_INTERVAL_S:
        return Unavailable(
            ANALYSIS_NAME,
            f"the IMU is logged at {1.0 / median_interval_s:.0f} Hz, below EKF2's prediction rate",
            FULL_IMU_RATE_ACTION,
        )
    if (lost_fraction := compute_lost_imu_fraction(time_s)) > MAX_MISSING_IMU_FRACTION:
        return Unavailable(
            ANALYSIS_NAME,
            f"{100.0 * lost_fraction:.0f} % of the IMU samples are missing from the log",
            FASTER_LOGGING_ACTION,
        )
    return None


def _make_fusion_rules(fusion_record: FusionRecord, step_s: float, *, is_gnss: bool) -> FusionRules:
    """Return EKF2's rules for position fusion in the PX4 release of the log."""
    fusion_rules, parameters = VISION_RULES, fusion_record.parameters
    if is_gnss:
        # PX4 with EKF2_GPS_MODE (main of 2026) does not reset velocity with position
        fusion_rules = replace(GNSS_RULES, resets_velocity=GNSS_MODE_PARAMETER not in parameters)
        if not fusion_record.stores_latitude():
            # Before PX4 v1.16. The flag for a bad acceleration stays set for 10 s
            # (BADACC_PROBATION, common.h)
            fusion_rules = replace(
                fusion_rules, reset_variance_factor=1.0, bad_acceleration_flag_duration_s=10.0
            )
    elif uses_aid_mask(parameters):
        # External vision before PX4 v1.14
        fusion_rules = FusionRules(stop_timeout_s=7.0)
    return replace(
        fusion_rules,
        # EKF2 up to v1.14 has a lower limit (5e-8 m²/s²) for the variance of the velocity change
        # that the accelerometer bias causes in one prediction step
        min_accelerometer_bias_variance_m2_s4=5e-8 / step_s**2
        if fusion_record.has_delta_angle_biases
        else None,
        is_horizon_set_by_largest_delay="EKF2_DELAY_MAX" not in parameters,
    )


def find_replayed_position_source(ekf2: Ekf2) -> Aid:
    """Return the position source of the replay: GNSS if EKF2 fused GNSS, else external vision."""
    vision_log = ekf2.aids.get(EV_POS.name)
    is_vision_used = bool(vision_log and (vision_log.enabled is None or vision_log.enabled.any()))
    has_gnss = _find_enabled_flag_changes(ekf2, GNSS_POS) is not None
    return GNSS_POS if has_fused_aid(ekf2) and (has_gnss or not is_vision_used) else EV_POS


def _find_enabled_flag_changes(ekf2: Ekf2, aid: Aid) -> pd.Series | None:
    """Return the times at which EKF2 enables (1) or disables (0) an aiding source.

    Return None if the source is never enabled.
    """
    aid_log = ekf2.aids.get(aid.name)
    enabled_changes = aid_log.enabled if aid_log else None
    return enabled_changes if enabled_changes is not None and enabled_changes.any() else None


def _find_gnss_track(flight: Flight) -> PositionTrack | None:
    return next((track for track in flight.positions if track.origin.is_gnss), None)


def read_gnss(
    flight: Flight, ekf2: Ekf2, fusion_record: FusionRecord
) -> ReceivedPositions | Unavailable:
    """Return the GNSS fixes that EKF2 received (NED), or the reason why they are incomplete."""
    track = _find_gnss_track(flight)
    if track is None or track.velocity is None:
        return Unavailable(
            ANALYSIS_NAME, "the log has no topic vehicle_gps_position", DEFAULT_PROFILE_REMEDY
        )
    if track.compute_rate_hz() < MAX_DOWNSAMPLED_HZ:
        return Unavailable(
            ANALYSIS_NAME,
            f"GNSS is logged at {track.compute_rate_hz():.1f} Hz, but EKF2 fused more samples",
            "Set bit 1 of SDLOG_PROFILE to log all GNSS fixes.",
        )
    parameters = fusion_record.parameters
    gnss_control_bits = int(parameters.get(GNSS_POS.switch, 7.0))
    # 1. Fixes. EKF2 ignores GNSS fixes while GNSS is disabled
    position_samples, velocity_samples = track.samples, track.velocity
    if (enabled_changes := ekf2.aids[GNSS_POS.name].enabled) is not None:
        is_enabled = sample_step_function(enabled_changes, position_samples.index) > 0.0
        position_samples = position_samples[is_enabled]
        velocity_samples = velocity_samples[is_enabled]
    # 2. Timestamps. EKF2_GPS_DELAY is already subtracted from the times of the track. It is added
    # here, because the replay subtracts it again
    logged_delay_s = fill_parameters_with_defaults(parameters, GNSS_POS)[GNSS_POS.delay] * 1e-3
    timestamp_s = position_samples.index.to_numpy() + logged_delay_s
    # 3. Reported variances, and velocity. Maximum reported position noise (m) that EKF2 uses:
    # gps_control.cpp
    max_reported_noise_m = max(parameters.get("EKF2_NOAID_NOISE", 10.0), 1.0)
    reported_variance = (
        position_samples[Columns.POSITION_VARIANCE].fillna(0.0).clip(upper=max_reported_noise_m**2)
    )
    velocity = velocity_variance = None
    fuses_velocity = uses_aid_mask(parameters) or gnss_control_bits & GNSS_VELOCITY_BIT
    if fuses_velocity and velocity_samples[Columns.VELOCITY].notna().all(axis=None):
        velocity = velocity_samples[Columns.VELOCITY].to_numpy()
        velocity_variance = velocity_samples[Columns.VELOCITY_VARIANCE].fillna(0.0).to_numpy()
    # Fixes are assumed to arrive at their timestamps
    rejected_flags, is_reset_to_sample = _read_logged_decisions(
        ekf2, fusion_record, timestamp_s, timestamp_s, GNSS_POS
    )
    return ReceivedPositions(
        timestamp_s=timestamp_s,
        arrival_s=timestamp_s,
        # The replay computes positions in EKF2's internal coordinates
        position_m=position_samples[Columns.POSITION].to_numpy()
        * compute_internal_to_published_position_ratio(fusion_record),
        variance_m2=reported_variance.to_numpy(),
        rejected_flags=rejected_flags,
        is_reset_to_sample=is_reset_to_sample,
        source=track.name,
        velocity_m_s=velocity,
        velocity_variance_m2_s2=velocity_variance,
        uses_sender_timestamps=track.assumed_delay_s == 0.0 and logged_delay_s != 0.0,
    )


def read_vision(
    flight: Flight, ekf2: Ekf2, fusion_record: FusionRecord, attitude: pd.DataFrame
) -> ReceivedPositions | Unavailable:
    """Return the vision positions that EKF2 received (NED), or the reason why they are incomplete.

    Positions in FRD are rotated to NED with EKF2's published ``attitude``.
    """
    track = _find_vision_track(flight)
    if isinstance(track, Unavailable):
        return track
    position_samples = track.samples.dropna(subset=Columns.POSITION[:2])
    timestamp_s = position_samples.index.to_numpy()
    position_m = position_samples[Columns.POSITION].to_numpy(copy=True)
    variance_m2 = position_samples[Columns.POSITION_VARIANCE].fillna(0.0).to_numpy(copy=True)
    # Rotation to NED. If EKF2 fuses the vision heading, its heading is that of the vision frame.
    # Otherwise, EKF2 rotates the positions to north. Before PX4 v1.14, a parameter decides this
    if uses_aid_mask(fusion_record.parameters):
        aid_mask = int(fusion_record.parameters[AID_MASK_PARAMETER])
        is_rotated_by_ekf2 = aid_mask & ROTATE_VISION_BIT > 0
    else:
        is_rotated_by_ekf2 = (
            not isinstance(ekf2.fusion_flags, pd.DataFrame) or not ekf2.fusion_flags["yaw"].any()
        )
    if track.frame == "FRD" and is_rotated_by_ekf2:
        if track.orientation is None:
            return Unavailable(
                ANALYSIS_NAME,
                f"the positions of {track.name} are in an FRD frame, without an orientation to "
                "rotate them to NED",
                "Send the positions in NED, or also send the orientation.",
            )
        ekf2_attitude = interpolate_attitude(attitude, timestamp_s)
        source_attitude = interpolate_attitude(track.orientation, timestamp_s)
        # From the vision frame to NED, at each sample
        rotation = to_rotation_matrix(multiply(ekf2_attitude, conjugate(source_attitude)))
        position_m = rotate(rotation, position_m)
        # Variance of a sum of independent errors: Σ r² σ²
        variance_m2 = rotate(rotation**2, variance_m2)
    vision_age_s = fusion_record.vision_age_s
    # If the arrival times are unknown, no sample is treated as late
    arrival_s = np.full(len(timestamp_s), -np.inf)
    if len(vision_age_s) and "vehicle_visual_odometry" in track.topics:
        arrival_s = timestamp_s + np.interp(timestamp_s, vision_age_s.index, vision_age_s)
    logged_decisions = _read_logged_decisions(ekf2, fusion_record, timestamp_s, arrival_s)
    return ReceivedPositions(
        timestamp_s,
        arrival_s,
        position_m,
        variance_m2,
        *logged_decisions,
        track.name,
        reset_times_s=track.reset_times_s,
        is_every_reset_logged=DEAD_RECKONING_FLAG in fusion_record.status_flags,
    )


def _read_vision_in_gnss_flight(
    flight: Flight, ekf2: Ekf2, fusion_record: FusionRecord, attitude: pd.DataFrame
) -> ReceivedPositions | Unavailable | None:
    """Return the vision positions of a flight with GNSS; None if EKF2 did not fuse vision."""
    if (enabled_changes := _find_enabled_flag_changes(ekf2, EV_POS)) is None:
        return None
    if uses_aid_mask(fusion_record.parameters):
        return Unavailable(
            ANALYSIS_NAME,
            f"in flights with GNSS, {flight.log.firmware} fuses position increments of external "
            "vision, which the EKF2 model cannot fuse",
            "Use PX4 v1.14 or later, or fly with GNSS only or with vision only.",
        )
    received_positions = read_vision(flight, ekf2, fusion_record, attitude)
    if isinstance(received_positions, Unavailable):
        return received_positions
    is_vision_disabled = (
        sample_step_function(enabled_changes, received_positions.timestamp_s) == 0.0
    )
    # The replay computes positions in EKF2's internal coordinates
    position_m = received_positions.position_m * compute_internal_to_published_position_ratio(
        fusion_record
    )
    return replace(
        received_positions, position_m=np.where(is_vision_disabled[:, None], np.nan, position_m)
    )


def _read_logged_decisions(
    ekf2: Ekf2, fusion_record: FusionRecord, timestamp_s: Array, arrival_s: Array, aid: Aid = EV_POS
) -> tuple[Array, BoolArray]:
    """Return EKF2's logged rejection of each position, and True for a reset to this position.

    The rejection is 1, 0, or NaN if it is not logged.
    """
    rejected_flags = np.full(len(timestamp_s), np.nan)
    is_reset = np.zeros(len(timestamp_s), dtype=bool)
    innovations = ekf2.innovations["north"]
    horizon_s = ekf2.horizon_s
    if (
        isinstance(innovations, Unavailable)
        or isinstance(horizon_s, Unavailable)
        or innovation_topic(aid) not in ekf2.innovation_topics
    ):
        return rejected_flags, is_reset
    delay_s = fill_parameters_with_defaults(fusion_record.parameters, aid)[aid.delay] * 1e-3
    measurement_times_s = timestamp_s - delay_s - 0.5 * ekf2.step_s
    # EKF2 fuses a late sample when it arrives
    earliest_fusion_times_s = np.maximum.accumulate(
        np.maximum(measurement_times_s, arrival_s - horizon_s)
    )
    # EKF2 fused no sample between its last fusion (last_fused_s) and the log row that contains this
    # time. It also fused none during dead reckoning. The last sample of each of these time spans is
    # excluded: its decision is in the log row, or it ended dead reckoning
    last_fused_s = ekf2.aids[aid.name].samples.reindex(columns=["last_fused_s"]).dropna()
    fusion_to_log_row_s = np.column_stack([last_fused_s, last_fused_s.index])
    dead_reckoning_s = _find_dead_reckoning_spans(ekf2, fusion_record, aid)
    # First row in each span, and first row after it
    fusion_to_log_rows, dead_reckoning_rows = (
        np.searchsorted(earliest_fusion_times_s, spans_s + TIME_ROUNDING_TOLERANCE_S)
        for spans_s in (fusion_to_log_row_s, dead_reckoning_s)
    )
    for begin, end in (*fusion_to_log_rows, *dead_reckoning_rows):
        rejected_flags[begin : max(end - 1, 0)] = 1.0
    may_be_reset_sample = np.isnan(rejected_flags)
    # The log contains EKF2's decision (fused or rejected) on some of the samples
    innovation_rows = find_matching_samples(innovations.index.to_numpy(), measurement_times_s)
    is_logged = innovation_rows >= 0
    innovations_of_samples = innovations.iloc[innovation_rows[is_logged]]
    rejected_flags[is_logged] = innovations_of_samples["rejected"]
    # EKF2 logs innovation 0 for a sample to which it resets its position
    may_be_reset_sample[is_logged] &= (innovations_of_samples["rejected"] > 0.0) | (
        innovations_of_samples["innovation_m"] == 0.0
    )
    # Find the sample to which EKF2 reset its position. A reset is published later than its
    # measurement by the delay of the fusion horizon
    publication_times_s = earliest_fusion_times_s + horizon_s
    for reset_s in find_horizontal_reset_times_s(ekf2):
        is_published_near_reset = (publication_times_s <= reset_s) & (
            publication_times_s > reset_s - MAX_RESET_PUBLICATION_DELAY_S
        )
        reset_rows = np.flatnonzero(is_published_near_reset & may_be_reset_sample)
        rows_after_dead_reckoning = np.intersect1d(reset_rows, dead_reckoning_rows[:, 1] - 1)
        # EKF2 reset its position to the candidate that ended dead reckoning. If no candidate ended
        # dead reckoning, EKF2 reset its position to the newest candidate
        if len(rows_after_dead_reckoning):
            is_reset[rows_after_dead_reckoning[0]] = True
        elif len(reset_rows):
            is_reset[reset_rows[-1]] = True
    # EKF2 fused the sample before each span that starts at last_fused_s. Set its rejection to 0,
    # unless another decision on it is already known
    rows_after_fusion = fusion_to_log_rows[:, 0]
    fused_rows = rows_after_fusion[rows_after_fusion > 0] - 1
    is_undecided = ~is_reset[fused_rows] & np.isnan(rejected_flags[fused_rows])
    rejected_flags[fused_rows[is_undecided]] = 0.0
    return rejected_flags, is_reset


def _find_dead_reckoning_spans(ekf2: Ekf2, fusion_record: FusionRecord, aid: Aid) -> Array:
    """Return start and end (s) of each time in which EKF2 used only the IMU (dead reckoning).

    The start is the last fusion of vision, the end is the next fusion or reset. The result is empty
    if GNSS is the position source.
    """
    dead_reckoning_flag = fusion_record.status_flags.get(DEAD_RECKONING_FLAG)
    vision_enabled_flag = ekf2.status_flags.get(EV_POS.name)
    if aid != EV_POS or dead_reckoning_flag is None or vision_enabled_flag is None:
        return np.zeros((0, 2))
    spans_s = np.array(find_spans(dead_reckoning_flag != 0.0, np.inf)).reshape(-1, 2)
    # EKF2 sets the flag some time after the last fusion, or at once if vision is disabled
    spans_s[:, 0] -= DEAD_RECKONING_TIMEOUT_S * (
        sample_step_function(vision_enabled_flag, spans_s[:, 0]) > 0.0
    )
    return spans_s


def innovation_topic(aid: Aid) -> str:
    """Return the uORB topic with the innovations of an aiding source."""
    return f"estimator_aid_src_{aid.name}"


def find_matching_samples(sample_times_s: Array, measurement_times_s: Array) -> IntArray:
    """Return the index of the sample at each measurement time, or -1 without a sample."""
    sample_index = np.searchsorted(sample_times_s, measurement_times_s - SAMPLE_MATCH_TOLERANCE_S)
    sample_index = np.minimum(sample_index, len(sample_times_s) - 1)
    return np.where(
        np.abs(sample_times_s[sample_index] - measurement_times_s) <= SAMPLE_MATCH_TOLERANCE_S,
        sample_index,
        -1,
    )


def find_horizontal_reset_times_s(ekf2: Ekf2) -> Array:
    """Return the times (s) of EKF2's horizontal position resets."""
    return np.array([reset.time_s for reset in ekf2.find_horizontal_resets()])


def _find_vision_track(flight: Flight) -> PositionTrack | Unavailable:
    """Return the vision track with all positions that EKF2 received."""
    missing_reasons = ["the log has no topic vehicle_visual_odometry"]
    # Topics of the log are preferred to a position file
    for track in sorted(flight.positions, key=lambda track: track.origin == POSITION_FILE_ORIGIN):
        if track.origin.is_vision and track.origin.has_all_samples:
            return track
        if track.name in MAX_INTERVAL_BY_VISION_TOPIC_S:
            median_interval_s = compute_median_interval_s(track.samples.index)
            if median_interval_s <= MAX_INTERVAL_BY_VISION_TOPIC_S[track.name]:
                return track
            missing_reasons.append(
                f"{track.name} is logged every {median_interval_s:.2g} s; EKF2 may have fused more "
                "samples than are logged"
            )
    return Unavailable(
        ANALYSIS_NAME,
        "; ".join(missing_reasons),
        "Set SDLOG_PROFILE to 129 (default and vision), or give the file of the positioning system "
        "with --position.",
    )
