"""The analysis of a report once more: what was recorded, on the files that it was recorded from.

The recorded request is a stranger's. It is decoded strictly, and the analysis knows the range of
every value; files are found by their SHA-256 among those that were given, never by name; and
nothing in it names an output.
"""

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from px4fuse.errors import Px4FuseError, ResultsError, SettingsError
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_json
from px4fuse.results.model import LIBRARIES, Provenance
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Refused

ADD = "Add {} to --logs."
ASK = "Ask how the report was made, and for the log and all files that it was made from."
NOT_OURS = "the recorded request is not one that px4fuse can have made"
# A flight of ten minutes has 60,000 steps of it, which take half a minute
MIN_DT_S = 0.01
_Place = Callable[[str, str | None, str], Path]


class FileMissingError(ResultsError):
    """A file that a report rests on is not among those given; ``missing`` is what it is called."""

    def __init__(self, text: str, missing: str) -> None:
        super().__init__(text, ADD.format(missing))
        self.missing = missing


@dataclass(frozen=True)
class Recomputed:
    """What the analysis gives now.

    Attributes
    ----------
    results : ComparisonResults or LoopResults
        As a report attaches them.
    draw : callable
        Draws the report: with the student, and with the versions, that were recorded.
    """

    results: Reported
    draw: Callable[[], bytes]


def log_sha256(results: Reported) -> str:
    """SHA-256 of the log that a report is about."""
    return results.track.sha256 if isinstance(results, LoopResults) else results.log.sha256


def log_name(results: Reported) -> str:
    """Name of the log that a report is about, as the report gives it."""
    loop = isinstance(results, LoopResults)
    return split_part(results.track.name)[0] if loop else results.log.name  # type: ignore[union-attr]


def recompute(results: Reported, logs: Mapping[str, Path]) -> Recomputed | Refused:
    """Repeat the analysis from what a report recorded.

    Parameters
    ----------
    results : ComparisonResults or LoopResults
        What is attached to the report.
    logs : mapping of str to Path
        Files by their SHA-256.

    Returns
    -------
    Recomputed or Refused
        Refused where the command is not px4fuse's, a file is missing, or the analysis fails.
    """
    try:
        if tuple(results.provenance.libraries) != LIBRARIES:
            raise ResultsError("the results do not say which libraries they were made with", ASK)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            place = partial(_place, logs, Path(folder))
            if isinstance(results, LoopResults):
                return _looped(results, place)
            return _compared(results, place)
    except SettingsError as error:  # no run with these settings can have made a report
        return Refused(f"{NOT_OURS}: {error}", ASK)
    except ResultsError as error:
        return Refused(error.reason, error.remedy, getattr(error, "missing", ""))
    except Px4FuseError as error:
        return Refused(str(error), ASK)
    except Exception as error:  # noqa: BLE001 - settings made to fail may fail anywhere
        return Refused(f"the analysis cannot be repeated ({type(error).__name__})", ASK)


def _place(
    logs: Mapping[str, Path], within: Path, recorded: str, sha256: str | None, what: str
) -> Path:
    """A file with this content where the analysis finds it, under the recorded name.

    Names are printed in the report. They are those of links in a folder of this run alone, and
    only where they are plain names.
    """
    path = None if sha256 is None else logs.get(sha256)
    if path is None:
        asked = f"none of the files given has the SHA-256 of {what}"
        raise FileMissingError(asked, one_line(recorded, 80) or "its file")
    name = recorded
    plain = name == Path(name).name != ".." and "\\" not in name and name.isprintable()
    if not plain:
        raise ResultsError(f"{NOT_OURS}: a file name in it is not a plain name", ASK)
    # each in a folder of its own: two may have one name
    folder = Path(tempfile.mkdtemp(dir=within))
    target = folder / name
    try:
        target.symlink_to(path.resolve())
    except OSError:  # on Windows for administrators only
        shutil.copyfile(path, target)
    return target


def split_part(source: str) -> tuple[str, str]:
    """File and part of ``LOG:vio``, without a look at any file."""
    from px4fuse.loop.tracks import PARTS  # noqa: PLC0415

    name, colon, tail = source.rpartition(":")
    return (name, f":{tail}") if colon and tail in PARTS else (source, "")


def _compared(handed_in: ComparisonResults, place: _Place) -> Recomputed:
    from px4fuse.analysis import run  # noqa: PLC0415
    from px4fuse.results.build import results  # noqa: PLC0415

    recorded = handed_in.request
    if recorded.dt_s < MIN_DT_S:
        raise ResultsError(f"DT is below {MIN_DT_S:g} s, which takes too long to repeat", ASK)
    joined = {file.role: file.sha256 for file in handed_in.log.joined}
    request = replace(recorded, log=str(place(recorded.log, handed_in.log.sha256, "the log")))
    if (mavlink := recorded.mavlink) is not None:
        placed = place(mavlink, joined.get("mavlink"), "--mavlink")
        request = replace(request, mavlink=str(placed))
    if (position := recorded.position) is not None:
        placed = place(position.path, joined.get("position"), "--position")
        request = replace(request, position=replace(position, path=str(placed)))
    analysis = run(request)
    made = results(recorded, analysis, handed_in.student)
    return Recomputed(made, partial(_drawn, analysis, made, handed_in.provenance))


def _looped(handed_in: LoopResults, place: _Place) -> Recomputed:
    from px4fuse.analysis import run_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results  # noqa: PLC0415

    recorded = handed_in.request
    path, part = split_part(recorded.source)
    placed = place(path, handed_in.track.sha256, "the log")
    request = replace(recorded, source=f"{placed}{part}")
    if recorded.reference is not None:
        path, part = split_part(recorded.reference)
        sha256 = handed_in.references[-1].sha256 if handed_in.references else None
        placed = place(path, sha256, "--reference")
        request = replace(request, reference=f"{placed}{part}")
    found = run_loop(request)
    made = loop_results(recorded, found, handed_in.student)
    return Recomputed(made, partial(_drawn, found, made, handed_in.provenance))


def _drawn(found: object, results: Reported, versions: Provenance) -> bytes:
    """Draw the report with the versions that were recorded."""
    from px4fuse.report.pdf import render  # noqa: PLC0415

    made = replace(versions, command=results.provenance.command)
    return render(found, replace(results, provenance=made), to_json(results))
