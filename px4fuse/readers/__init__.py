"""Readers: one file per format, picked by content, not by suffix."""

from __future__ import annotations

from pathlib import Path

from px4fuse.errors import LogError
from px4fuse.flight import Flight

_SNIFF_BYTES = 16


def read_log(path: str | Path) -> Flight:
    """Read a flight log of any supported format.

    Parameters
    ----------
    path : str or Path
        A PX4 ULog (``.ulg``); the format is recognised by content.

    Returns
    -------
    Flight

    Raises
    ------
    LogError
        The file is missing, empty, of an unknown format, or holds no usable data.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(_SNIFF_BYTES)
    except OSError as error:
        raise LogError(f"{path.name}: cannot be read ({error.strerror}).") from error
    if not head:
        raise LogError(f"{path.name}: the file is empty. Copy it from the vehicle again.")
    # each reader is imported when its format is met: pyulog costs time
    from px4fuse.readers import ulog  # noqa: PLC0415

    if head.startswith(ulog.MAGIC):
        return ulog.read_ulog(path)
    raise LogError(
        f"{path.name}: not a PX4 ULog (its first bytes are not ULog's). "
        "Give the .ulg file that PX4 wrote on its SD card."
    )
