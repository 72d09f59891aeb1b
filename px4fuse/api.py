"""Python functions of px4fuse that correspond to its commands."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import pandas as pd
from msgspec import structs

from . import request
from .analysis import Analysis
from .comparison.model import FilterSummary, UntestedFilter
from .core.record import display_html
from .core.writing import write_output_files
from .diagnose import diagnose, require_available, run_what_if
from .ekf2 import whatif
from .ekf2.model import prepare_ekf2_model
from .ekf2.whatif import WhatIf
from .errors import OutputError, SettingsError
from .flight.model import Flight, Unavailable
from .loop.analysis import analyse
from .loop.model import Loop
from .loop.tracks import LoopSource, read_trajectory_source
from .readers import read_log
from .trajectory import evaluation
from .trajectory.evaluation import Evaluation
from .trajectory.model import Trajectory

Pathlike = str | Path
Progress = Callable[[str], None]
# Columns of table(): numbers, except "verdict"
SUMMARY_COLUMNS = (
    "count",
    "nis_mean",
    "nis_low",
    "nis_high",
    "verdict",
    "sigma_ratio",
    "innovation_std_m",
    "sqrt_s_median_m",
    "sigma_p_median_m",
    "position_rmse_m",
    "velocity_rmse_m_s",
    "nees_position_mean",
)


def compare(
    log: Pathlike | Flight,
    *,
    sigma_a_m_s2: float = request.SIGMA_A_M_S2,
    sigma_z_m: float | None = None,
    dt_s: float = request.DT_S,
    input: request.KfInputName | None = None,  # noqa: A002 - name of the setting
    clock_offset_s: float | Literal["auto"] | None = None,
    axes: request.AxisName | Sequence[request.AxisName] = (),
    heading_deg: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    position_source: str | None = None,
    source_kind: request.SourceKind | None = None,
    height: request.HeightSensor | None = None,
    position: Pathlike | request.PositionFile | None = None,
    system: int | None = None,
    progress: Progress = lambda _: None,
) -> Analysis:
    """Compare KF (two-state Kalman filter) with EKF2 on one flight, as ``px4fuse compare`` does.

    Parameters
    ----------
    log : str, Path or Flight
        ULog or MAVLink recording, or a flight from :func:`px4fuse.read_log`.
    sigma_a_m_s2, sigma_z_m, dt_s, input
        See :class:`px4fuse.Settings`. The default of SIGMA_Z is 0.1 m. For GNSS, it is the position
        noise (1 σ) with which EKF2 fused GNSS.
    clock_offset_s : float or "auto", optional
        Time offset to add to the position timestamps. "auto" estimates it, and is the default with
        ``position``.
    axes : str or sequence of str
        "north", "east", "down" or "aisle" (horizontal axis along the main direction of the track);
        default: all axes.
    heading_deg : float, optional
        Heading of the axis "aisle", clockwise from north; default: main direction of the track.
    start_s, end_s : float, optional
        Analysed time span, in seconds after the first sample; default: take-off and landing.
    position_source : str, optional
        Name of the position source for KF; default: the source closest to the raw measurement.
    source_kind : {"uwb", "vio", "mocap", "gnss"}, optional
        Kind of the position source; default: from its messages.
    height : {"gnss", "barometer"}, optional
        Height source of the axis "down" with GNSS; default: the height source that EKF2 fused.
    position : str, Path or px4fuse.request.PositionFile, optional
        Recording of the positioning system (CSV).
    system : int, optional
        MAVLink system id of the vehicle; default: the id with the most messages.
    progress : callable
        Called with the name of each step of the computation.

    Returns
    -------
    Analysis
        Use it with :func:`px4fuse.table`, :func:`px4fuse.find`, :func:`px4fuse.write_report` and
        :func:`px4fuse.write_page`.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, the flight lacks required data, or a setting is out of range.
    """
    known_axes = get_args(request.AxisName)
    axis_names = (axes,) if isinstance(axes, str) else tuple(axes)
    if unknown_axes := set(axis_names).difference(known_axes):
        raise SettingsError(
            f"`axes` {unknown_axes.pop()!r} is unknown. Choose from {', '.join(known_axes)}."
        )
    if isinstance(log, Flight) and (position, system) != (None, None):
        raise SettingsError(
            "`position` and `system` cannot be given with a Flight object: they determine how a "
            "log is read.",
            "Pass the path of the log, not a Flight object.",
        )
    if isinstance(clock_offset_s, str) and clock_offset_s != request.AUTO:
        raise SettingsError(
            f"`clock_offset_s` {clock_offset_s!r} is not a number of seconds or 'auto'."
        )
    if isinstance(position, str | Path):
        position = request.PositionFile(path=str(position))
    comparison_request = request.ComparisonRequest(
        log=log.log.name if isinstance(log, Flight) else str(log),
        system=system,
        position=position,
        position_source=position_source,
        source_kind=source_kind,
        height=height,
        sigma_a_m_s2=sigma_a_m_s2,
        sigma_z_m=sigma_z_m,
        dt_s=dt_s,
        input=input,
        axes=axis_names,
        heading_deg=heading_deg,
        start_s=start_s,
        end_s=end_s,
        clock_offset_s=clock_offset_s,
    )
    return diagnose(comparison_request, progress, log if isinstance(log, Flight) else None)


def table(analysis: Analysis) -> pd.DataFrame:
    """Return a table of the main numbers, with one row per axis and filter.

    ``nis_low`` and ``nis_high`` are the 95 % band of the mean NIS. RMSE and NEES are against ground
    truth. Missing numbers are NaN.
    """
    row_by_axis_and_filter = {
        (axis_name, filter_name): _make_summary_row(summary)
        for axis_name, axis in analysis.axes.items()
        for filter_name, summary in axis.filters.items()
    }
    index = pd.MultiIndex.from_tuples(row_by_axis_and_filter, names=["axis", "filter"])
    column_types = dict.fromkeys(SUMMARY_COLUMNS, "float64") | {
        "count": "Int64",
        "verdict": "object",
    }
    return pd.DataFrame(list(row_by_axis_and_filter.values()), index, SUMMARY_COLUMNS).astype(
        column_types
    )


def _make_summary_row(summary: FilterSummary | UntestedFilter) -> dict[str, Any]:
    """Return the row of :func:`table` for one filter; verdict "" and count None without a test."""
    truth = {} if isinstance(summary.truth, Unavailable) else structs.asdict(summary.truth)
    row = {"verdict": "", **truth, "count": None, **structs.asdict(summary)}
    row["nis_low"], row["nis_high"] = row.get("nis_band", (None, None))
    return row


def evaluate(
    estimate: Pathlike | Trajectory, reference: Pathlike | Trajectory, **options: Any
) -> Evaluation:
    """Compute ATE and RPE of a trajectory against a reference, with 95 % intervals.

    Parameters
    ----------
    estimate, reference : str, Path or Trajectory
        Trajectory file, or track of a flight log: "LOG:vio", "LOG:ekf2", "LOG:kf" or "LOG:truth".
    **options
        Arguments of :func:`px4fuse.trajectory.evaluation.evaluate`: ``alignment``,
        ``association``, ``max_gap_s``, ``time_offset_s``, ``rpe_deltas``, ``all_pairs``.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read, the times do not overlap, the motion is too small for the alignment,
        or an RPE delta is not above zero.
    """
    return evaluation.evaluate(
        _read_trajectory(estimate), _read_trajectory(reference, default_track="truth"), **options
    )


def _read_trajectory(
    source: Pathlike | Trajectory, default_track: Literal["truth"] | None = None
) -> Trajectory:
    """Read a trajectory from a file, unless it is already read.

    ``default_track`` is read from a flight log if ``source`` names no track (as ``LOG:vio`` does).
    """
    if isinstance(source, Trajectory):
        return source
    return read_trajectory_source(str(source), default_track=default_track).trajectory


def close_loop(
    source: Pathlike | Trajectory,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    landed_at: tuple[float, float] | tuple[float, float, float] | None = None,
    closed_loop: bool = True,
    closures: Sequence[request.GivenClosure] = (),
    reference: Pathlike | Trajectory | None = None,
    position_drift_m: float = 1.0,
    heading_drift_deg: float = 3.0,
    key_frames_m: float | None = None,
    frame: request.FrameName | None = None,
    progress: Progress = lambda _: None,
) -> Loop:
    """Measure the loop closure error of odometry and correct the path.

    Parameters
    ----------
    source : str, Path or Trajectory
        Trajectory file or flight log, as in :func:`px4fuse.evaluate`.
    start_s, end_s : float, optional
        Times of the start and the end of the loop; default: take-off and landing.
    landed_at : tuple of float, optional
        Measured landing place: distances (m) forward and right of the take-off place, and the
        clockwise rotation (°) if known.
    closed_loop : bool
        False if the vehicle did not return to the take-off place.
    closures : sequence of px4fuse.request.GivenClosure
        Further loop closures: two times at which the vehicle was at the same place.
    reference : str, Path or Trajectory, optional
        Reference for the ATE and RPE of each path, in addition to the ground truth of the log.
    position_drift_m, heading_drift_deg : float
        Drift of the odometry after 100 m (1 σ).
    key_frames_m : float, optional
        Distance between the key frames of the pose graph.
    frame : str, optional
        Frame of a trajectory file: "NED", "FRD", "ENU" or "camera"; default: detected.
    progress : callable
        Called with the name of each step of the computation.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read or lacks required data, or a number is out of range.
    """
    # ``reference`` may be a Trajectory instead of a file name. Therefore :func:`analyse` gets it as
    # an argument, and LoopRequest does not contain it
    loop_request = request.LoopRequest(
        source=str(source),
        frame=frame,
        start_s=start_s,
        end_s=end_s,
        landed_at=None if landed_at is None else request.Landing(*landed_at),
        closed_loop=closed_loop,
        closures=tuple(closures),
        position_drift_m=position_drift_m,
        heading_drift_deg=heading_drift_deg,
        key_frames_m=key_frames_m,
    )
    if isinstance(source, Trajectory):
        loop_source = LoopSource(source, None)
    else:
        loop_source = read_trajectory_source(str(source), frame=frame)
    reference_track = (
        None if reference is None else _read_trajectory(reference, default_track="truth")
    )
    return analyse(loop_source, loop_request, reference_track, progress)


def write_report(analysis: Analysis, path: Pathlike) -> Path:
    """Write the PDF report of an analysis, and its JSON results in the same folder.

    The path of the report ends in .pdf.

    Raises
    ------
    OutputError, SettingsError
        A file cannot be written, or the analysis is not from :func:`px4fuse.compare`.
    """
    from .report.pdf import render_pdf  # noqa: PLC0415 - slow import
    from .results.build import make_comparison_results  # noqa: PLC0415
    from .results.contract import to_json  # noqa: PLC0415

    report_path = _require_suffix(path, ".pdf")
    serialisable_results = make_comparison_results(analysis.require_request(), analysis)
    results_json = to_json(serialisable_results)
    pdf = render_pdf(analysis, serialisable_results, results_json)
    write_output_files({report_path: pdf, report_path.with_suffix(".json"): results_json.encode()})
    return report_path


def write_page(analysis: Analysis, path: Pathlike) -> Path:
    """Write the interactive web page of an analysis, as ``px4fuse explore`` does.

    The path of the page ends in .html.

    Raises
    ------
    OutputError, SettingsError
        The page cannot be written, or the analysis is not from :func:`px4fuse.compare`.
    """
    from .explore.page import make_analysis_page  # noqa: PLC0415 - slow import

    page_path = _require_suffix(path, ".html")
    analysis.require_request()
    write_output_files({page_path: make_analysis_page(analysis).encode()})
    return page_path


@display_html.register
def _display_card(analysis: Analysis) -> str | None:
    """Return the diagnosis card for Jupyter notebooks (HTML); None without a request."""
    from .report.card_html import make_diagnosis_card, make_notebook_html  # noqa: PLC0415 - slow import

    return None if analysis.request is None else make_notebook_html(make_diagnosis_card(analysis))


def _require_suffix(path: Pathlike, suffix: str) -> Path:
    """Return a path; raise OutputError if its name does not end in ``suffix`` (such as ".pdf")."""
    output_path = Path(path)
    if output_path.suffix.lower() != suffix:
        raise OutputError(f"{output_path}: the name of the file must end in {suffix}.")
    return output_path


def what_if(
    log: Pathlike | Flight,
    changes: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
    without: Mapping[str, float] | None = None,
) -> WhatIf:
    """Replay EKF2 with changed parameters, or without some aiding sources.

    Parameters
    ----------
    log : str, Path or Flight
        ULog or MAVLink recording, or a flight from :func:`px4fuse.read_log`.
    changes : mapping or sequence of mappings, optional
        Parameter values by PX4 name, in PX4's units; one replay per mapping. Default: estimates of
        noise and delay.
    without : mapping of str to float, optional
        Time (s) from which EKF2 does not fuse an aiding source, for example ``{"gnss_pos": 60.0}``.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        The log cannot be read, the replay is not possible or does not agree with the log, or a
        parameter, a value or an aiding source is not valid.
    """
    flight = log if isinstance(log, Flight) else read_log(log)
    if changes is None and not without:
        return run_what_if(request.WhatIfRequest(log=flight.log.name), flight=flight).statistics
    ekf2_model = require_available(prepare_ekf2_model(flight), flight)
    change_sets = changes if isinstance(changes, Sequence) else [changes or {}]
    return require_available(whatif.what_if(ekf2_model, change_sets, without or {}), flight)
