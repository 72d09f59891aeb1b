"""Reading a text file whole, before its format is looked at."""

from __future__ import annotations

from pathlib import Path

from px4fuse.errors import Px4FuseError


def read_whole(
    path: Path, name: str, limit_bytes: int, refuse: type[Px4FuseError], *, give: str, again: str
) -> bytes:
    """All bytes of a regular file that is neither empty nor too large.

    Parameters
    ----------
    path : Path
    name : str
        For messages.
    limit_bytes : int
    refuse : type
        Error to raise.
    give, again : str
        What to do where it is no file, and where it is empty.

    Raises
    ------
    Px4FuseError
        Of type ``refuse``.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise refuse(f"{name}: a folder or no regular file. {give}.")
        content = b"" if size > limit_bytes else path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        reason = getattr(error, "strerror", None) or error
        raise refuse(f"{name}: cannot be read ({reason}). Check its path.") from error
    if not content:
        limit = f"more than the limit of {limit_bytes / 1e6:.0f} MB. Cut it to the flight"
        what = limit if size else f"the file is empty. {again}"
        raise refuse(f"{name}: {what}.")
    return content
