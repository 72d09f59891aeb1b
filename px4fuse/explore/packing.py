"""Compact encoding of arrays for the web page.

Numbers are rounded to integers. The bytes of their differences are compressed (deflate).
"""

import base64
import zlib
from dataclasses import dataclass, field

import numpy as np

from px4fuse.core.arrays import Array

# Rounding steps per unit (m, m/s or s) for the inputs of KF; integers compress well
KF_INPUT_STEPS_PER_UNIT = 2.0**36
# Rounding steps per unit for values that are only drawn or averaged
DRAWN_VALUE_STEPS_PER_UNIT = 1e6
# Limit of the rounded values: JavaScript represents integers exactly up to twice this limit
MAX_EXACT_INTEGER = 2.0**52


@dataclass
class ArrayEncoder:
    """Encoder of arrays; ``array_specs`` are (length, bytes per value, scale) of each array."""

    array_specs: list[tuple[int, int, float]] = field(default_factory=list)
    _encoded_arrays: list[bytes] = field(default_factory=list)

    def add(self, values: Array, scale: float = KF_INPUT_STEPS_PER_UNIT) -> dict[str, int]:
        """Add an array, rounded to ``scale`` steps per unit.

        Return ``{"array": index}``, which replaces the array in the JSON data.
        """
        values = np.asarray(values, dtype=np.float64)
        largest_value = float(np.max(np.abs(values), initial=1.0))
        while largest_value * scale > MAX_EXACT_INTEGER:
            scale /= 2.0
        integers = np.rint(values * scale).astype(np.int64)
        differences = np.diff(integers, prepend=0)
        # store the sign in the lowest bit, so that small negative numbers need few bytes
        zigzag_integers = ((differences << 1) ^ (differences >> 63)).astype("<u8")
        byte_count = max(1, (int(zigzag_integers.max(initial=0)).bit_length() + 7) // 8)
        self._encoded_arrays.append(
            zigzag_integers.view(np.uint8).reshape(-1, 8)[:, :byte_count].T.tobytes()
        )
        self.array_specs.append((len(values), byte_count, scale))
        return {"array": len(self.array_specs) - 1}

    def add_times(self, time_s: Array) -> dict[str, int]:
        has_whole_microseconds = bool(np.all(np.abs(np.rint(time_s * 1e6) / 1e6 - time_s) < 1e-10))
        return self.add(time_s, 1e6 if has_whole_microseconds else KF_INPUT_STEPS_PER_UNIT)

    def text(self) -> str:
        """Return all arrays, compressed, as one base64 text."""
        return base64.b64encode(zlib.compress(b"".join(self._encoded_arrays), 9)).decode()
