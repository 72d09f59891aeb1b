"""Readers of flight logs. The format is detected from the content of the file."""

from pathlib import Path

from px4fuse.core.reading import display_name, read_head, read_log_bytes
from px4fuse.errors import LogError, SettingsError
from px4fuse.flight.model import Flight

from .recording_table import refuse_foreign_format

# Number of bytes that are read to detect the format of a file
_FORMAT_DETECTION_BYTES = 100
ULOG_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"


def read_log(path: str | Path, *, system: int | None = None) -> Flight:
    """Read a flight log of any supported format.

    Parameters
    ----------
    path : str or Path
        PX4 ULog or MAVLink recording, possibly compressed with gzip or zstd.
    system : int, optional
        MAVLink system id of the vehicle; by default the autopilot with the most messages.

    Raises
    ------
    LogError
        The file is missing, too large, of an unknown format, or contains no usable data.
    SettingsError
        The recording does not contain the system id, or the log is a ULog.
    """
    path = Path(path)
    name = display_name(path)
    first_bytes = read_head(path, _FORMAT_DETECTION_BYTES, LogError)
    # Local imports, because pyulog and pymavlink take 0.1 s or more to import
    if first_bytes.startswith(ULOG_MAGIC):
        if system is not None:
            raise SettingsError(
                f"{name}: the file is a ULog, but `system` is only for MAVLink recordings."
            )
        from .ulog import read_ulog  # noqa: PLC0415

        return read_ulog(name, read_log_bytes(path))
    refuse_foreign_format(path, first_bytes, LogError)
    text_file_suffix = path.suffix.lower() if first_bytes.isascii() else ""
    if text_file_suffix in (".csv", ".tsv", ".jsonl"):
        raise LogError(
            f"{name}: the file is a table, not a flight log",
            f"If the table contains positions, use px4fuse compare LOG --position {name}.",
        )
    if text_file_suffix in (".tum", ".g2o"):
        raise LogError(
            f"{name}: the file is a trajectory or pose graph, not a flight log",
            f"Use px4fuse evaluate or px4fuse loop {name}.",
        )
    from .mavlink import read_mavlink  # noqa: PLC0415

    return read_mavlink(name, read_log_bytes(path), system)
