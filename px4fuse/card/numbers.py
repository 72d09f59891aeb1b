"""Number formats of the card, the same on every surface, and the logarithmic axis of ratios."""

import math

from px4fuse.card.model import AXIS_ENDS
from px4fuse.core.text import format_metres as format_metres  # noqa: PLC0414 - public re-export
from px4fuse.core.text import format_ratio as format_ratio  # noqa: PLC0414 - public re-export


def axis_fraction(ratio: float) -> float:
    """Return the place of a ratio of actual to reported σ on the logarithmic axis (0 to 1).

    >>> axis_fraction(0.1), axis_fraction(1.0), axis_fraction(10.0)
    (0.0, 0.5, 1.0)
    """
    low, high = (math.log10(end) for end in AXIS_ENDS)
    return (math.log10(ratio) - low) / (high - low)
