"""Print the JSON Schema of the results (``python -m px4fuse.results``)."""

import sys

from .contract import schema, to_json

sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
sys.stdout.write(to_json(schema()))
