"""EKF2's innovations: reader of all aiding sources in a ULog, and innovations along each axis.

Source: PX4-Autopilot ``EKF2.cpp`` (PublishInnovations, PublishAidSourceStatus), v1.8 to main.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, GNSS_POS, STATUS_FLAGS, Aid
from px4fuse.flight.model import (
    AXIS_NAMES,
    AidLog,
    Ekf2,
    NedAxis,
    StepFunctions,
    TableOrUnavailable,
    Unavailable,
    sample_step_function,
)

from . import px4_topics as px4
from .common import MessageLayout, assign_fields_to_columns, join_nearest_samples
from .ulog_topics import Topics

# Maximum time (s) between innovation and variance S; PX4 logs them every 0.5 s by default
MAX_TIME_FROM_INNOVATION_TO_VARIANCE_S = 0.6
# Column and PX4 field for the time of the last fusion
LAST_FUSION_FIELD = {"last_fused_us": "time_last_fuse"}
# Optional fields of the topics estimator_aid_src_*, by aiding source and column
OPTIONAL_AID_FIELDS = {
    "baro_hgt": {"observation_down": "observation", "filtered_down": "innovation_filtered"},
    "ev_pos": LAST_FUSION_FIELD,
    "gnss_pos": LAST_FUSION_FIELD,
}
Innovations = dict[NedAxis, TableOrUnavailable]


@dataclass(frozen=True)
class Ekf2Measurement:
    """Horizontal position or height that EKF2 can fuse, and its aiding source."""

    # PX4's name of the aiding source
    aid: str
    # Name of the sensor
    sensor: str
    # Advice to enable fusion
    fusion_remedy: str
    # Advice if the innovations are not logged
    logging_remedy: str = px4.DEFAULT_PROFILE_REMEDY


# Position source with its measurements, "horizontal" and "vertical"
Ekf2PositionSource = Mapping[str, Ekf2Measurement]
_VISION_LOGGING_REMEDY = "Record with SDLOG_PROFILE 129 (default and vision)."
VISION: Ekf2PositionSource = {
    "horizontal": Ekf2Measurement(
        "ev_pos",
        "external vision",
        # EKF2 starts fusion of vision at sample intervals below 0.2 s (ev_control.cpp)
        "Send the position at 10 Hz or more (EKF2 starts fusion at intervals below 0.2 s) and set "
        "bit 0 of EKF2_EV_CTRL (bit 3 of EKF2_AID_MASK before v1.14).",
        _VISION_LOGGING_REMEDY,
    ),
    "vertical": Ekf2Measurement(
        "ev_hgt",
        "external vision",
        "Set bit 1 of EKF2_EV_CTRL (EKF2_HGT_MODE 3 before v1.14) to fuse the height of the "
        "source.",
        _VISION_LOGGING_REMEDY,
    ),
}
GNSS: Ekf2PositionSource = {
    "horizontal": Ekf2Measurement(
        "gnss_pos",
        "GNSS",
        "Set bit 0 of EKF2_GPS_CTRL (bit 0 of EKF2_AID_MASK before v1.14), and wait for a fix that "
        "passes EKF2's checks.",
    ),
    "vertical": Ekf2Measurement(
        "gnss_hgt",
        "GNSS",
        "Set bit 1 of EKF2_GPS_CTRL (EKF2_HGT_MODE 1 before v1.14) to fuse the GNSS height.",
    ),
}
GNSS_WITH_BAROMETER_HEIGHT: Ekf2PositionSource = {
    **GNSS,
    "vertical": Ekf2Measurement(
        BAROMETER.name,
        "the barometer",
        "Set EKF2_BARO_CTRL to 1 (EKF2_HGT_MODE to 0 before v1.14) to fuse the barometer height.",
    ),
}


def has_fused_aid(ekf2: Ekf2 | Unavailable, aid: str = GNSS_POS.name) -> bool:
    """Return True if EKF2 fused the aiding source at any time."""
    if isinstance(ekf2, Unavailable):
        return False
    if aid_log := ekf2.aids.get(aid):
        if "fused" in aid_log.samples:
            return bool(aid_log.samples["fused"].any())
        if aid_log.enabled is not None:
            return True
    flags = ekf2.status_flags
    # Without status flags of EKF2 (such as tilt_align), a valid global position shows that EKF2
    # fused GNSS
    if aid == GNSS_POS.name and "tilt_align" not in flags and "xy_global" in flags:
        return bool(flags["xy_global"].any())
    return False


def replace_vision_by_gnss_innovations(ekf2: Ekf2, source: Ekf2PositionSource = GNSS) -> Ekf2:
    """Return the EKF2 data with innovations of GNSS instead of external vision."""
    enabled_flags = {
        axis_group: ekf2.status_flags[measurement.aid]
        for axis_group, measurement in source.items()
        if measurement.aid in ekf2.status_flags
    }
    fusion_flags: TableOrUnavailable = Unavailable(
        "EKF2 fusion flags",
        "the log does not contain the fusion flags of GNSS",
        px4.DEFAULT_PROFILE_REMEDY,
    )
    if enabled_flags:
        flags = pd.DataFrame(enabled_flags).ffill().bfill()
        fusion_flags = flags.reindex(columns=["horizontal", "vertical", "yaw"], fill_value=0.0)
    gate = ekf2.parameters.get(GNSS_POS.gate, GNSS_POS.default_gate)
    innovations, topics = collect_innovations_by_axis(ekf2.aids, fusion_flags, gate, source)
    return replace(
        ekf2,
        innovations=innovations,
        innovation_topics=topics,
        fusion_flags=fusion_flags,
        gate=gate,
    )


def collect_innovations_by_axis(
    aids: Mapping[str, AidLog],
    fusion_flags: TableOrUnavailable,
    gate: float,
    source: Ekf2PositionSource = VISION,
) -> tuple[Innovations, tuple[str, ...]]:
    """Return the innovations along each axis, and the topics that contain them.

    ``gate`` is the innovation gate, a multiple of √S, for logs without rejection flags.
    """
    innovations: Innovations = {}
    used_topics: dict[str, None] = {}
    for axis in AXIS_NAMES:
        axis_group, quantity = "horizontal", "horizontal position"
        if axis == "down":
            axis_group, quantity = "vertical", "height"
        measurement = source[axis_group]
        missing_data = f"EKF2 innovations, {axis}"
        aid_log = aids.get(measurement.aid)
        if isinstance(fusion_flags, pd.DataFrame) and not fusion_flags[axis_group].any():
            innovations[axis] = Unavailable(
                missing_data,
                f"EKF2 never fused the {quantity} from {measurement.sensor} in this log",
                measurement.fusion_remedy,
            )
        elif aid_log and len(axis_innovations := select_axis_innovations(aid_log, axis, gate)):
            innovations[axis] = axis_innovations
            used_topics |= dict.fromkeys(aid_log.topics)
        else:
            innovations[axis] = Unavailable(
                missing_data,
                f"the log has no usable innovation of {measurement.sensor} in "
                f"estimator_aid_src_{source['horizontal'].aid}, "
                f"estimator_aid_src_{source['vertical'].aid}, estimator_innovations or "
                "ekf2_innovations",
                measurement.logging_remedy,
            )
    return innovations, tuple(used_topics)


def select_axis_innovations(log: AidLog, axis: NedAxis, gate: float) -> pd.DataFrame:
    """Return the innovations along one axis, with the flags "fused" and "rejected".

    ``gate`` is the innovation gate, a multiple of √S. EKF2 rejects a sample along all
    its axes together.
    """
    samples = log.samples
    nis_by_axis = {
        name: samples[f"innovation_{name}"] ** 2 / samples[f"variance_{name}"] for name in log.axes
    }
    rejected = samples.get("rejected")
    if rejected is None:
        rejected = (pd.DataFrame(nis_by_axis).max(axis=1) > gate**2).astype(float)
    innovations = pd.DataFrame(
        {
            "innovation_m": samples[f"innovation_{axis}"],
            "innovation_variance_m2": samples[f"variance_{axis}"],
            "observation_variance_m2": samples.get(f"noise_{axis}", np.nan),
            "test_ratio": nis_by_axis[axis] / gate**2,
            "fused": samples.get("fused", np.nan),
            "rejected": rejected,
        }
    )
    return innovations[
        (innovations["fused"] > 0.0) | (innovations["rejected"] > 0.0) | innovations["fused"].isna()
    ]


def read_aids(topics: Topics, enabled_aids: StepFunctions) -> dict[str, AidLog]:
    """Read the innovations of each aiding source of EKF2, by PX4 name.

    Since v1.14, each aiding source has a topic ``estimator_aid_src_...``. Older topics contain all
    aiding sources, and repeat each innovation until the next fusion.
    """
    aid_log_by_name = {}
    for name, aid in AIDS.items():
        enabled_flag = enabled_aids.get(name)
        aid_log = _read_aid_topic(topics, aid, enabled_flag)
        if aid_log is None:
            # Older topics contain wrong values of a source while its fusion is disabled. Without
            # flags, px4fuse assumes that EKF2 fused external vision only
            may_be_fused = name.startswith("ev_") if enabled_flag is None else enabled_flag.any()
            if may_be_fused:
                aid_log = _read_common_topics(topics, aid, enabled_flag)
        if aid_log is not None:
            aid_log_by_name[name] = aid_log
    return aid_log_by_name


def read_enabled_aids(topics: Topics) -> dict[str, pd.Series[float]]:
    """Return a time series for each aiding source: 1 while its fusion is enabled, otherwise 0."""
    all_aids = (*AIDS.values(), *STATUS_FLAGS.values())
    flag_names = {flag for aid in all_aids for group in aid.flags for flag in group.split("|")}
    flags = topics.primary_samples(
        MessageLayout(
            px4.STATUS_FLAGS_TOPIC,
            optional_columns={name: name for name in flag_names},
            is_step_function=True,
        )
    )
    if flags.columns.empty:  # PX4 before v1.12 logs a bit for each aiding source
        bits = topics.primary_samples(px4.TOPIC_LAYOUTS["control_bits"])["bits"].dropna()
        return {
            aid.name: (bits.astype(np.int64) & (1 << aid.status_bit) > 0).astype(float)
            for aid in all_aids
            if aid.status_bit is not None and len(bits)
        }
    enabled_aids = {}
    for aid in all_aids:
        # The names of flags depend on the PX4 release: the first group that is logged is used. The
        # aid is enabled while any flag of the group is set
        for group in aid.flags:
            names = group.split("|")
            if {*names} <= {*flags} and len(flags):
                enabled_aids[aid.name] = flags[names].max(axis=1)
                break
    return enabled_aids


def _read_aid_topic(
    topics: Topics, aid: Aid, enabled_flag: pd.Series[float] | None
) -> AidLog | None:
    """Read the innovations of an aiding source from its topic; None if it is not logged."""
    field_by_quantity = {
        "innovation": "innovation",
        "variance": "innovation_variance",
        "noise": "observation_variance",
        "ratio": "test_ratio",
    }
    if aid.name in px4.AIDS_WITH_LOCAL_POSITION_OBSERVATION:
        field_by_quantity["observation"] = "observation"
    columns = {"fused": "fused", "rejected": "innovation_rejected"}
    for name, field in field_by_quantity.items():
        columns |= _assign_fields_by_axis(name, aid, field + "[]" * (len(aid.axes) > 1))
    layout = MessageLayout(
        f"estimator_aid_src_{aid.name}", columns, OPTIONAL_AID_FIELDS.get(aid.name, {})
    )
    if topics.find_layout(layout) is None:  # return early: reading an empty table takes time
        return None
    samples = topics.primary_samples(layout).dropna()
    if "last_fused_us" in samples:
        samples["last_fused_s"] = (samples.pop("last_fused_us") - topics.time_origin_us) * 1e-6
    if enabled_flag is not None and aid.name in px4.AIDS_ALWAYS_FUSED:
        samples["fused"] = sample_step_function(enabled_flag, samples.index)
    return _make_aid_log(topics, (layout.topic,), aid, samples, enabled_flag)


def _read_common_topics(
    topics: Topics, aid: Aid, enabled_flag: pd.Series[float] | None
) -> AidLog | None:
    """Read the innovations of an aiding source from a topic that contains all aiding sources."""
    # If the log contains the flag cs_mag, the innovation "heading" is not that of an angle, but of
    # a component of the magnetic field (gauss)
    is_in_gauss = aid.name == "mag_heading" and any(
        "cs_mag" in table for table in topics.tables_of(px4.STATUS_FLAGS_TOPIC)
    )
    # Pairs of the topics with the innovations and with their variances
    possible_layouts = []
    if aid.fields and not is_in_gauss:
        innovation_topic, variance_topic = px4.INNOVATION_TOPICS
        innovation_columns, variance_columns = (
            _assign_fields_by_axis(quantity, aid, aid.fields)
            for quantity in ("innovation", "variance")
        )
        possible_layouts.append(
            (
                MessageLayout(innovation_topic, innovation_columns),
                MessageLayout(variance_topic, variance_columns),
            )
        )
    if aid.ekf2_innovations_fields:
        field_by_column = _assign_fields_by_axis("innovation", aid, aid.ekf2_innovations_fields)
        variance_fields = aid.ekf2_innovations_fields.replace("innov", "innov_var")
        field_by_column |= _assign_fields_by_axis("variance", aid, variance_fields)
        layout = MessageLayout(px4.OLD_INNOVATION_TOPIC, field_by_column)
        possible_layouts.append((layout, layout))
    for innovation_layout, variance_layout in possible_layouts:
        innovation = topics.primary_samples(innovation_layout)[f"innovation_{aid.axes[0]}"]
        variance_samples = topics.primary_samples(variance_layout)
        variance = variance_samples[f"variance_{aid.axes[0]}"]
        is_new_variance = (variance > 0.0) & variance.ne(variance.shift())
        samples = topics.primary_samples(innovation_layout, select_rows=_drop_repeats_and_zeros)
        if variance_layout is not innovation_layout:
            # The nearest variance S is used, because PX4 logs it at other times
            samples = join_nearest_samples(
                samples, variance_samples.dropna(), MAX_TIME_FROM_INNOVATION_TO_VARIANCE_S
            )
        samples = samples.dropna()
        if enabled_flag is not None:
            samples = samples[sample_step_function(enabled_flag, samples.index) > 0.0]
        aid_log = _make_aid_log(
            topics,
            tuple(dict.fromkeys((innovation_layout.topic, variance_layout.topic))),
            aid,
            samples,
            enabled_flag,
            # Times at which EKF2 may have fused a sample whose innovation is not logged: the logged
            # innovation is 0, or the logged variance S has a new value
            times_with_unknown_fusion_s=np.union1d(
                innovation.index[innovation == 0.0], variance.index[is_new_variance]
            ),
        )
        if aid_log is not None:
            return aid_log
    return None


def _drop_repeats_and_zeros(samples: pd.DataFrame) -> pd.DataFrame:
    """Remove repeated innovations, and the zeros that PX4 logs before the first fusion."""
    finite_samples = samples.dropna()
    first_column = finite_samples.iloc[:, 0]
    return finite_samples[first_column.ne(first_column.shift()) & (first_column != 0.0)]


def _assign_fields_by_axis(name: str, aid: Aid, fields: str) -> dict[str, str]:
    return assign_fields_to_columns({",".join(f"{name}_{axis}" for axis in aid.axes): fields})


def _make_aid_log(
    topics: Topics,
    used_topics: tuple[str, ...],
    aid: Aid,
    samples: pd.DataFrame,
    enabled_flag: pd.Series[float] | None,
    **log_fields: Any,
) -> AidLog | None:
    """Return the innovations of an aiding source; None without a positive innovation variance.

    The sign is changed, because PX4 logs prediction minus measurement.
    """
    samples = samples[(samples[[f"variance_{axis}" for axis in aid.axes]] > 0.0).all(axis=1)]
    if samples.empty:
        return None
    innovation_columns = [f"innovation_{axis}" for axis in aid.axes]
    samples = samples.assign(**{name: -samples[name] for name in innovation_columns})
    parameters = aid.logged_parameters(topics.ekf2_parameters)
    return AidLog(used_topics, aid.axes, samples, enabled_flag, parameters, **log_fields)
