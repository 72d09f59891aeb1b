"""Arrays in few characters, which the page takes apart again without loss that matters.

Values become integers of a fixed step, then differences, then planes of bytes, of which the upper
ones are nearly all the same, then deflate and base64.
"""

import base64
import zlib
from dataclasses import dataclass, field

import numpy as np

from px4fuse.arrays import Array

# Steps of 1.5e-11: of position, velocity and seconds, a hundredth of what the replay may differ by
FINE_SCALE = 2.0**36
# What is only looked at, and enters means: a micrometre
COARSE_SCALE = 1e6
# Whole numbers up to here are exact in the page, where every number is a double
MAX_EXACT = 2.0**52


@dataclass
class Packer:
    """Collects arrays; a place is what stands in the page's data for one of them."""

    specs: list[tuple[int, int, float]] = field(default_factory=list)
    _bytes: list[bytes] = field(default_factory=list)

    def add(self, values: Array, scale: float = FINE_SCALE) -> int:
        """Add one array of finite numbers and return its place.

        Parameters
        ----------
        values : ndarray, shape (n,)
        scale : float
            Steps per unit; fewer where the numbers are too large for it.
        """
        values = np.asarray(values, dtype=np.float64)
        largest = float(np.max(np.abs(values), initial=1.0))
        while largest * scale > MAX_EXACT:
            scale /= 2.0
        integers = np.rint(values * scale).astype(np.int64)
        steps = np.diff(integers, prepend=0)
        code = ((steps << 1) ^ (steps >> 63)).astype("<u8")
        planes = max(1, (int(code.max(initial=0)).bit_length() + 7) // 8)
        self._bytes.append(code.view(np.uint8).reshape(-1, 8)[:, :planes].T.tobytes())
        self.specs.append((len(values), planes, scale))
        return len(self.specs) - 1

    def add_times(self, time_s: Array) -> int:
        """Add times, in microseconds where that is what they are."""
        is_microseconds = bool(np.all(np.abs(np.rint(time_s * 1e6) / 1e6 - time_s) < 1e-10))
        return self.add(time_s, 1e6 if is_microseconds else FINE_SCALE)

    def text(self) -> str:
        """All arrays, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._bytes), 9)).decode()
