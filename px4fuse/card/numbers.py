"""Number formats of the card, the same on every surface, and the logarithmic axis of ratios."""

import math

from px4fuse.card.model import AXIS_ENDS


def format_ratio(ratio: float) -> str:
    """Format a ratio of actual to reported uncertainty.

    >>> [format_ratio(ratio) for ratio in (128.2, 21.04, 4.52, 1.214, 0.926, 0.0012)]
    ['128', '21', '4.5', '1.21', '0.93', '0.001']
    """
    decimals = 0 if ratio >= 9.95 else 1 if ratio >= 1.995 else 2 if ratio >= 0.00995 else 3
    return f"{ratio:.{decimals}f}"


def format_metres(length_m: float) -> str:
    """Format a length in metres without the unit.

    >>> [format_metres(length) for length in (2981.4, 12.34, 2.114, 0.388, 0.0623, 0.0004)]
    ['2981', '12.3', '2.11', '0.39', '0.062', '0.000']
    """
    size = abs(length_m)
    decimals = 0 if size >= 99.95 else 1 if size >= 9.995 else 2 if size >= 0.0995 else 3
    return f"{length_m:.{decimals}f}"


def axis_fraction(ratio: float) -> float:
    """Return the position of a ratio on the logarithmic axis; 0 and 1 are its ends.

    >>> axis_fraction(0.1), axis_fraction(1.0), axis_fraction(10.0)
    (0.0, 0.5, 1.0)
    """
    low, high = (math.log10(end) for end in AXIS_ENDS)
    return (math.log10(ratio) - low) / (high - low)
