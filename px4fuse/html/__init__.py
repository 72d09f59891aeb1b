"""Web pages (one file each) with tables; data are escaped, so that they cannot run scripts."""

from __future__ import annotations
