"""Web pages with tables; data are escaped, so that they cannot run scripts."""

from __future__ import annotations
