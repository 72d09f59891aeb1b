"""Zip files that are the same whenever they are made."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection, Mapping

# Zip files know no earlier time
TIME = (1980, 1, 1, 0, 0, 0)


def zipped(contents: Mapping[str, bytes], executable: Collection[str] = ()) -> bytes:
    """A zip file of these contents by their names."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            entry = zipfile.ZipInfo(name, TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o100755 if name in executable else 0o100644) << 16
            archive.writestr(entry, content)
    return out.getvalue()
