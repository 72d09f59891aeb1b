"""Import of filterpy's KalmanFilter without scipy.stats, which is slow to import."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _LazyDistribution:
    """Distribution of scipy.stats that is imported at its first use."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        stats = import_module("scipy.stats")
        # filterpy calls logpdf during its import, when scipy.stats is still the stub module below
        if stats.__spec__ is None:
            return lambda *_, **__: 0.0
        return getattr(getattr(stats, self._name), attribute)


def _import_kalman_filter() -> Any:
    """Import KalmanFilter, with a stub for scipy.stats during the import.

    filterpy.kalman imports two distributions of scipy.stats, which KalmanFilter hardly needs. The
    stub replaces them by objects that import scipy.stats at their first use.
    """
    if "scipy.stats" not in sys.modules:
        stub_module = ModuleType("scipy.stats")
        for name in ("norm", "multivariate_normal"):
            setattr(stub_module, name, _LazyDistribution(name))
        sys.modules["scipy.stats"] = stub_module
        try:
            import filterpy.kalman  # noqa: PLC0415, F401 - loaded before scipy.stats is restored
        finally:
            del sys.modules["scipy.stats"]
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415

    return KalmanFilter


KalmanFilter = _import_kalman_filter()
