"""Writing results so that a failed run leaves nothing behind and overwrites nothing."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from px4fuse.errors import OutputError


def write_all(contents: Mapping[Path, bytes]) -> None:
    """Write several files together: each to a temporary file beside its target, then rename.

    Parameters
    ----------
    contents : mapping from Path to bytes
        Missing folders are made.

    Raises
    ------
    OutputError
        A target cannot be written; none was replaced, unless renaming itself failed half-way.
    """
    temporary: dict[Path, Path] = {}
    target = next(iter(contents), Path())
    try:
        for target, content in contents.items():
            if target.is_dir():
                raise OutputError(f"{target}: is a folder. Give a file name.")
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
            temporary[target] = Path(name)
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            # mkstemp makes private files; a report is for sharing
            Path(name).chmod(0o666 & ~_umask())
        for target, path in temporary.items():
            path.replace(target)
    except OSError as error:
        raise OutputError(
            f"{target}: cannot be written ({error.strerror}). Choose another place for it."
        ) from error
    finally:
        for path in temporary.values():
            path.unlink(missing_ok=True)


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
