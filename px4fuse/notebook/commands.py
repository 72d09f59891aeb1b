"""``compare``, ``close_loop``, ``evaluate``, ``what_if``, ``report`` and ``explore`` in Python."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from px4fuse import request
from px4fuse.analysis import Analysis, run, run_what_if
from px4fuse.ekf2 import whatif
from px4fuse.ekf2.model import Model, open_model
from px4fuse.ekf2.whatif import WhatIf
from px4fuse.errors import MissingDataError, OutputError, SettingsError
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.analysis import analyse
from px4fuse.loop.model import Loop
from px4fuse.loop.tracks import LoopSource, read_source
from px4fuse.readers import read_log
from px4fuse.trajectory import evaluation
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.model import Trajectory
from px4fuse.writing import write_all

Pathlike = str | Path
Progress = Callable[[str], None]


def compare(
    log: Pathlike | Flight,
    *,
    sigma_a_m_s2: float = request.SIGMA_A_M_S2,
    sigma_z_m: float | None = None,
    dt_s: float = request.DT_S,
    input: request.InputName | None = None,  # noqa: A002 - the name of the setting
    clock_offset_s: float | Literal["auto"] | None = None,
    axes: request.AxisName | Sequence[request.AxisName] = (),
    heading_deg: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    position_source: str | None = None,
    source_kind: request.SourceKind | None = None,
    height: request.HeightName | None = None,
    position: Pathlike | request.PositionFile | None = None,
    mavlink: Pathlike | None = None,
    system: int | None = None,
    progress: Progress = lambda _: None,
) -> Analysis:
    """Compare a flight's EKF2 with the two-state filter, and explain it, as the command line does.

    Parameters
    ----------
    log : str, Path or Flight
        A ULog or a MAVLink recording, or a flight that was read.
    sigma_a_m_s2, sigma_z_m, dt_s, input
        See :class:`Settings`; by default SIGMA_Z is 0.1 m, of GNSS what EKF2 takes.
    clock_offset_s : float or "auto", optional
        Added to the source's stamps; "auto" finds it.
    axes : str or sequence of str
        From "north", "east", "down", "aisle"; by default all that the source supports.
    heading_deg : float, optional
        Of the aisle.
    start_s, end_s : float, optional
        Segment, seconds from the first data.
    position_source : str, optional
        Name of a track of the flight.
    source_kind : {"uwb", "vio", "mocap", "gnss"}, optional
        What the source is, where its messages do not tell.
    height : {"gnss", "barometer"}, optional
        What "down" is from where the source is GNSS; by default the one that EKF2 fused.
    position : str, Path or PositionFile, optional
        The positioning system's own recording.
    mavlink : str or Path, optional
        MAVLink recording of the same flight.
    system : int, optional
        MAVLink system id of the vehicle.
    progress : callable
        Told what is being done.

    Returns
    -------
    Analysis
        :func:`px4fuse.find` names the mistakes in it.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        A file cannot be read, the flight lacks what was asked for, or a setting is out of range.
    """
    given = locals()  # arguments are called as the fields of the request
    known, named = get_args(request.AxisName), (axes,) if isinstance(axes, str) else tuple(axes)
    if unknown := set(named).difference(known):
        raise SettingsError(f"`axes` {unknown.pop()!r}: choose from {', '.join(known)}.")
    if isinstance(log, Flight) and (position, mavlink, system) != (None, None, None):
        raise SettingsError.of("flight_was_read")
    if isinstance(clock_offset_s, str) and clock_offset_s != request.AUTO:
        raise SettingsError(f"`clock_offset_s` {clock_offset_s!r}: give seconds, or 'auto'.")
    asked = {name: given[name] for name in request.ComparisonRequest.__struct_fields__}
    asked |= {"log": log.log.name if isinstance(log, Flight) else str(log), "axes": named}
    if mavlink is not None:
        asked["mavlink"] = str(mavlink)
    if isinstance(position, str | Path):
        asked["position"] = request.PositionFile(path=str(position))
    if isinstance(clock_offset_s, int):
        asked["clock_offset_s"] = float(clock_offset_s)
    flight = log if isinstance(log, Flight) else None
    return run(request.ComparisonRequest(**asked), progress, flight)


def evaluate(
    estimate: Pathlike | Trajectory, reference: Pathlike | Trajectory, **how: Any
) -> Evaluation:
    """Score an estimate against a reference: ATE and RPE, with intervals.

    Parameters
    ----------
    estimate, reference : str, Path or Trajectory
        A trajectory file, or a part of a flight log as "LOG:vio", "LOG:ekf2", "LOG:kf" (our
        filter) or "LOG:truth".
    **how
        As :func:`px4fuse.trajectory.evaluation.evaluate` takes it: ``alignment``,
        ``association``, ``max_gap_s``, ``time_offset_s``, ``rpe_deltas``, ``all_pairs``.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read, the two do not overlap in time, the motion does not determine the
        alignment, or a delta is not above zero.
    """
    if not isinstance(estimate, Trajectory):
        estimate = read_source(str(estimate)).trajectory
    return evaluation.evaluate(estimate, _reference(reference), **how)


def _reference(given: Pathlike | Trajectory) -> Trajectory:
    if isinstance(given, Trajectory):
        return given
    return read_source(str(given), default="truth").trajectory


def close_loop(
    source: Pathlike | Trajectory,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    landed_at: tuple[float, float] | tuple[float, float, float] | None = None,
    came_back: bool = True,
    closures: Sequence[request.GivenClosure] = (),
    reference: Pathlike | Trajectory | None = None,
    position_drift_m: float = 1.0,
    heading_drift_deg: float = 3.0,
    key_frames_m: float | None = None,
    frame: request.FrameName | None = None,
    progress: Progress = lambda _: None,
) -> Loop:
    """Measure how far a loop fails to close, and correct its path.

    Parameters
    ----------
    source : str, Path or Trajectory
        A trajectory file or a flight log, as :func:`evaluate` takes it.
    start_s, end_s : float, optional
        Override take-off and landing.
    landed_at : tuple of float, optional
        Where it landed, m along its nose at take-off and m to the right of it, and degrees that it
        was turned clockwise.
    came_back : bool
        False where the landing closes no loop.
    closures : sequence of GivenClosure
        Further times at which it was at the same place.
    reference : str, Path or Trajectory, optional
        What the paths are scored against, besides the log's ground truth.
    position_drift_m, heading_drift_deg : float
        What the odometry drifts in 100 m (1 σ).
    key_frames_m : float, optional
        Distance between key frames.
    frame : str, optional
        What a trajectory file's axes are: "NED", "FRD", "ENU" or "camera".
    progress : callable
        Told what is being done.

    Raises
    ------
    TrajectoryError, LogError, MissingDataError, SettingsError
        A file cannot be read or lacks what was asked for, or a number is out of range.
    """
    asked = {name: value for name, value in locals().items() if name != "progress"}
    asked |= {"source": str(source), "reference": None, "closures": tuple(closures)}
    asked["landed_at"] = None if landed_at is None else request.Landing(*landed_at)
    if isinstance(source, Trajectory):
        flown = LoopSource(source, None)
    else:
        flown = read_source(str(source), frame=frame)
    against = None if reference is None else _reference(reference)
    return analyse(flown, request.LoopRequest(**asked), against, progress)


def report(analysis: Analysis, path: Pathlike) -> Path:
    """Write the report that ``px4fuse compare`` writes: a PDF, and its results beside it.

    Parameters
    ----------
    analysis : Analysis
        From :func:`px4fuse.compare` or :func:`px4fuse.run`.
    path : str or Path
        Ends in .pdf.

    Returns
    -------
    Path
        The PDF.

    Raises
    ------
    OutputError, SettingsError
        It cannot be written, or the analysis was made without a request.
    """
    from px4fuse.report.pdf import render  # noqa: PLC0415 - for who writes a report
    from px4fuse.results.build import results  # noqa: PLC0415
    from px4fuse.results.contract import to_json  # noqa: PLC0415

    target = _ending(path, ".pdf")
    found = results(_request(analysis), analysis)
    text = to_json(found)
    write_all({target: render(analysis, found, text), target.with_suffix(".json"): text.encode()})
    return target


def explore(analysis: Analysis, path: Pathlike) -> Path:
    """Write the page that ``px4fuse explore`` writes.

    Parameters
    ----------
    analysis : Analysis
        From :func:`px4fuse.compare` or :func:`px4fuse.run`.
    path : str or Path
        Ends in .html.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    OutputError, SettingsError
        It cannot be written, or the analysis was made without a request.
    """
    from px4fuse.explore.page import html_text  # noqa: PLC0415 - Bokeh takes its time

    target = _ending(path, ".html")
    _request(analysis)
    write_all({target: html_text([analysis]).encode()})
    return target


def _ending(path: Pathlike, ending: str) -> Path:
    target = Path(path)
    if target.suffix.lower() != ending:
        raise OutputError(f"{target}: give a name that ends in {ending}.")
    return target


def _request(analysis: Analysis) -> request.ComparisonRequest:
    if analysis.request is None:
        raise SettingsError.of("without_request")
    return analysis.request


def what_if(
    log: Pathlike | Flight | Model,
    changes: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
    without: Mapping[str, float] | None = None,
) -> WhatIf:
    """What EKF2 would have done with other parameters.

    Parameters
    ----------
    log : str, Path, Flight or Model
        A model is a flight made ready for several questions, see :func:`px4fuse.open_model`.
    changes : mapping or sequence of mappings, optional
        Values by PX4 name, in PX4's units; by default the noise and the delay that the data ask
        for.
    without : mapping from PX4's name of an aid to float, optional
        From when on (s) EKF2 does not fuse it, as ``{"gnss_pos": 60.0}``.

    Raises
    ------
    LogError, MissingDataError, SettingsError
        The log cannot be read, EKF2 cannot be replayed from it or the replay does not agree with
        the log, or a parameter or an aid is unknown or a value out of range.
    """
    flight = log.flight if isinstance(log, Model) else log
    if not isinstance(flight, Flight):
        flight = read_log(flight)
    if changes is None and not without:
        return run_what_if(request.WhatIfRequest(log=flight.log.name), flight=flight).whatif
    model = log if isinstance(log, Model) else open_model(flight)
    if isinstance(model, Unavailable):
        raise MissingDataError(f"{model.what}: {model.reason}", model.remedy)
    changes = {} if changes is None else changes
    settings = [changes] if isinstance(changes, Mapping) else changes
    found = whatif.what_if(model, settings, without)
    if isinstance(found, Unavailable):
        raise MissingDataError(f"{found.what}: {found.reason}", found.remedy)
    return found
