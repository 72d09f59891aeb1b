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
from px4fuse.readers import px4_topics as px4
from px4fuse.readers.common import Layout, assign_fields_to_columns, join_nearest
from px4fuse.readers.ulog_topics import Topics

# Maximum time (s) between innovation and variance S; PX4 logs them every 0.5 s by default
MAX_VARIANCE_TIME_DIFFERENCE_S = 0.6
# Column and PX4 field for the time of the last fusion
LAST_FUSION_FIELD = {"last_fused_us": "time_last_fuse"}
# Optional fields of the topics estimator_aid_src_*, by aiding source and column
OPTIONAL_FIELDS = {
    "baro_hgt": {"observation_down": "observation", "filtered_down": "innovation_filtered"},
    "ev_pos": LAST_FUSION_FIELD,
    "gnss_pos": LAST_FUSION_FIELD,
}
Innovations = dict[NedAxis, TableOrUnavailable]


@dataclass(frozen=True)
class Ekf2PositionSource:
    """Position source (external vision or GNSS) and its EKF2 aiding sources."""

    name: str
    # PX4's names of the aiding sources for horizontal position and height
    horizontal_aid: str
    vertical_aid: str
    # Advice to enable fusion, for "horizontal" and "vertical" position
    remedies: Mapping[str, str]
    # Advice if the innovations are not logged
    logging_remedy: str
    # Name of a separate height sensor, if any
    height_sensor: str = ""


VISION = Ekf2PositionSource(
    name="external vision",
    horizontal_aid="ev_pos",
    vertical_aid="ev_hgt",
    remedies={
        # EKF2 starts fusion of vision at sample intervals below 0.2 s (ev_control.cpp)
        "horizontal": "Send the position at 10 Hz or more (EKF2 starts fusion at intervals below "
        "0.2 s) and set bit 0 of EKF2_EV_CTRL (bit 3 of EKF2_AID_MASK before v1.14).",
        "vertical": "Set bit 1 of EKF2_EV_CTRL (EKF2_HGT_MODE 3 before v1.14) to fuse the height "
        "of the source.",
    },
    logging_remedy="Record with SDLOG_PROFILE 129 (default and vision).",
)
GNSS = Ekf2PositionSource(
    name="GNSS",
    horizontal_aid="gnss_pos",
    vertical_aid="gnss_hgt",
    remedies={
        "horizontal": "Set bit 0 of EKF2_GPS_CTRL (bit 0 of EKF2_AID_MASK before v1.14), and wait "
        "for a fix that passes EKF2's checks.",
        "vertical": "Set bit 1 of EKF2_GPS_CTRL (EKF2_HGT_MODE 1 before v1.14) to fuse the GNSS "
        "height.",
    },
    logging_remedy=px4.DEFAULT_PROFILE_REMEDY,
)
GNSS_WITH_BAROMETER_HEIGHT = replace(
    GNSS,
    vertical_aid=BAROMETER.name,
    height_sensor="the barometer",
    remedies={
        **GNSS.remedies,
        "vertical": "Set EKF2_BARO_CTRL to 1 (EKF2_HGT_MODE to 0 before v1.14) to fuse the "
        "barometer height.",
    },
)


def has_fused_aid(ekf2: Ekf2 | Unavailable, aid: str = GNSS_POS.name) -> bool:
    """Return True if EKF2 fused the aiding source at any time."""
    if isinstance(ekf2, Unavailable):
        return False
    if aid_log := ekf2.aids.get(aid):
        if "fused" in aid_log.samples:
            return bool(aid_log.samples["fused"].any())
        if aid_log.enabled is not None:
            return True
    # a valid global position shows that EKF2 fused GNSS
    if (
        aid != GNSS_POS.name
        or "tilt_align" in ekf2.status_flags
        or "xy_global" not in ekf2.status_flags
    ):
        return False
    return bool(ekf2.status_flags["xy_global"].any())


def replace_vision_by_gnss_innovations(ekf2: Ekf2, source: Ekf2PositionSource = GNSS) -> Ekf2:
    """Return the EKF2 data with innovations of GNSS instead of external vision."""
    enabled_flags = {
        group: ekf2.status_flags[name]
        for group, name in (
            ("horizontal", source.horizontal_aid),
            ("vertical", source.vertical_aid),
        )
        if name in ekf2.status_flags
    }
    fusion_flags: TableOrUnavailable = Unavailable(
        "EKF2 fusion flags",
        "the log does not contain the fusion flags of GNSS",
        GNSS.logging_remedy,
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
        aid_name, sensor_name = source.horizontal_aid, source.name
        if axis == "down":
            axis_group, quantity = "vertical", "height"
            aid_name, sensor_name = source.vertical_aid, source.height_sensor or source.name
        remedy = source.logging_remedy
        if isinstance(fusion_flags, pd.DataFrame) and not fusion_flags[axis_group].any():
            reason = f"EKF2 never fused the {quantity} from {sensor_name} in this log"
            remedy = source.remedies[axis_group]
        elif (aid_log := aids.get(aid_name)) is None or (
            axis_innovations := select_axis_innovations(aid_log, axis, gate)
        ).empty:
            reason = (
                f"the log has no usable innovation of {sensor_name} in "
                f"estimator_aid_src_{source.horizontal_aid}, "
                f"estimator_aid_src_{source.vertical_aid}, estimator_innovations or "
                "ekf2_innovations"
            )
        else:
            innovations[axis] = axis_innovations
            used_topics |= dict.fromkeys(aid_log.topics)
            continue  # the innovations are available
        innovations[axis] = Unavailable(f"EKF2 innovations, {axis}", reason, remedy)
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
    log_by_aid = {}
    for name, aid in AIDS.items():
        enabled_flag = enabled_aids.get(name)
        aid_log = _read_aid_topic(topics, aid, enabled_flag)
        # Older topics contain wrong values of a source while its fusion is disabled
        if aid_log is None and (
            name.startswith("ev_") if enabled_flag is None else enabled_flag.any()
        ):
            aid_log = _read_common_topics(topics, aid, enabled_flag)
        if aid_log is not None:
            log_by_aid[name] = aid_log
    return log_by_aid


def read_enabled_aids(topics: Topics) -> dict[str, pd.Series[float]]:
    """Return a time series for each aiding source: 1 while its fusion is enabled, otherwise 0."""
    all_aids = (*AIDS.values(), *STATUS_FLAGS.values())
    layout = Layout(
        px4.STATUS_FLAGS_TOPIC,
        optional_columns={
            flag: flag for aid in all_aids for group in aid.flags for flag in group.split("|")
        },
        is_step_function=True,
    )
    flags = topics.primary_samples(layout)
    enabled_aids = {}
    for aid in all_aids if len(flags) else ():
        groups = (group.split("|") for group in aid.flags)
        group = next((group for group in groups if {*group} <= {*flags}), None)
        if group is not None:
            enabled_aids[aid.name] = flags[group].max(axis=1)
    if not flags.columns.empty:
        return enabled_aids
    control_bits = topics.primary_samples(px4.TOPIC_LAYOUTS["control_bits"])["bits"].dropna()
    for aid in all_aids if len(control_bits) else ():
        if aid.status_bit is not None:
            is_enabled = control_bits.astype(np.int64) & (1 << aid.status_bit) > 0
            enabled_aids[aid.name] = is_enabled.astype(float)
    return enabled_aids


def _read_aid_topic(
    topics: Topics, aid: Aid, enabled_flag: pd.Series[float] | None
) -> AidLog | None:
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
    layout = Layout(f"estimator_aid_src_{aid.name}", columns, OPTIONAL_FIELDS.get(aid.name, {}))
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
    is_in_gauss = aid.name == "mag_heading" and any(
        "cs_mag" in table for table in topics.tables_of(px4.STATUS_FLAGS_TOPIC)
    )
    layouts = []
    if aid.fields and not is_in_gauss:
        layouts.append(
            [
                Layout(topic, _assign_fields_by_axis(name, aid, aid.fields))
                for topic, name in zip(
                    px4.INNOVATION_TOPICS, ("innovation", "variance"), strict=True
                )
            ]
        )
    if aid.ekf2_innovations_fields:
        field_by_column = _assign_fields_by_axis("innovation", aid, aid.ekf2_innovations_fields)
        variance_fields = aid.ekf2_innovations_fields.replace("innov", "innov_var")
        field_by_column |= _assign_fields_by_axis("variance", aid, variance_fields)
        layouts.append([Layout(px4.OLD_INNOVATION_TOPIC, field_by_column)] * 2)
    for value_layout, variance_layout in layouts:
        innovation = topics.primary_samples(value_layout)[f"innovation_{aid.axes[0]}"]
        variance_samples = topics.primary_samples(variance_layout)
        variance = variance_samples[f"variance_{aid.axes[0]}"]
        is_new_variance = (variance > 0.0) & variance.ne(variance.shift())
        samples = topics.primary_samples(value_layout, select_rows=_drop_repeats_and_zeros)
        if variance_layout is not value_layout:
            # The nearest variance S is used, because PX4 logs it at other times
            samples = join_nearest(
                samples, variance_samples.dropna(), MAX_VARIANCE_TIME_DIFFERENCE_S
            )
        samples = samples.dropna()
        if enabled_flag is not None:
            samples = samples[sample_step_function(enabled_flag, samples.index) > 0.0]
        aid_log = _make_aid_log(
            topics,
            tuple(dict.fromkeys((value_layout.topic, variance_layout.topic))),
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
