"""Flight log readers, one per format, selected by the content of the file."""

from pathlib import Path

from px4fuse.core.reading import display_name, read_head, read_log_bytes
from px4fuse.errors import LogError, SettingsError
from px4fuse.flight.model import Flight

_SNIFF_BYTES = 16
ULOG_MAGIC = b"\x55\x4c\x6f\x67\x01\x12\x35"
# Formats that px4fuse does not read, but users try: first bytes of the file, suffixes of its name,
# and fault and action of the error message
_FOREIGN_FORMATS = (
    # Header bytes of ArduPilot, libraries/AP_Logger/LogStructure.h
    (
        b"\xa3\x95",
        (),
        "the file is an ArduPilot DataFlash log, not a PX4 ULog",
        "Give the MAVLink recording (.tlog) of the ground station.",
    ),
    (
        b"%PDF-",
        (),
        "the file is a PDF, not a flight log",
        "Check a report with px4fuse verify {name} LOG.",
    ),
    (
        b"",
        (".csv", ".tsv"),
        "the file is a table, not a flight log",
        "If the table contains positions, use px4fuse compare LOG --position {name}.",
    ),
    (
        b"",
        (".tum", ".g2o"),
        "the file is a trajectory or pose graph, not a flight log",
        "Use px4fuse evaluate or px4fuse loop {name}.",
    ),
)


def read_log(path: str | Path, *, system: int | None = None) -> Flight:
    """Read a flight log of any supported format.

    Parameters
    ----------
    path : str or Path
        A PX4 ULog (``.ulg``) or a MAVLink recording (``.tlog`` or a raw stream).
    system : int, optional
        MAVLink system id of the vehicle; by default the autopilot with the most messages.

    Raises
    ------
    LogError
        The file is missing, empty, not a regular file, larger than
        :data:`px4fuse.core.reading.max_log_bytes`, of an unknown format, or contains no usable
        data.
    SettingsError
        ``system`` is not a system id in the recording, or the log is a ULog.
    """
    path = Path(path)
    name = display_name(path)
    head = read_head(path, _SNIFF_BYTES, LogError)
    # Imports are local, because the import of pyulog or pymavlink takes 0.1 s or more
    if head.startswith(ULOG_MAGIC):
        if system is not None:
            raise SettingsError(
                f"{name}: the file is a ULog, but `system` is only for MAVLink recordings."
            )
        from px4fuse.readers.ulog import read_ulog  # noqa: PLC0415

        return read_ulog(name, read_log_bytes(path))
    for magic, suffixes, description, remedy in _FOREIGN_FORMATS:
        has_suffix = path.suffix.lower() in suffixes and head.isascii()
        if has_suffix or (magic and head.startswith(magic)):
            raise LogError(f"{name}: {description}", remedy.format(name=name))
    from px4fuse.readers.mavlink import read_mavlink  # noqa: PLC0415

    return read_mavlink(name, read_log_bytes(path), system)
