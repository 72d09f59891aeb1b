"""Earth rotation rate and radii of curvature of the earth in EKF2.

Since PX4 v1.16, EKF2 computes positions on an ellipsoid, but publishes positions on a sphere.

Sources: PX4-Autopilot ``lib/lat_lon_alt/lat_lon_alt.cpp`` (computeRadiiOfCurvature),
``EKF/ekf_helper.cpp`` (calcEarthRateNED), ``EKF/ekf.cpp`` (predictState).
"""

import numpy as np

from px4fuse.core.arrays import Array
from px4fuse.flight.model import FusionRecord
from px4fuse.readers.px4_positions import EARTH_RADIUS_M

EARTH_RATE_RAD_S = 7.292115e-5
EQUATORIAL_RADIUS_M, ECCENTRICITY = 6_378_137.0, 0.0818191908425


def compute_earth_rate_rad_s(fusion_record: FusionRecord) -> Array:
    """Return the earth rotation rate (rad/s, NED, shape (3,)); 0 if the latitude is unknown."""
    latitude_rad = np.radians(fusion_record.latitude_deg)
    return np.nan_to_num(
        EARTH_RATE_RAD_S * np.array([np.cos(latitude_rad), 0.0, -np.sin(latitude_rad)])
    )


def compute_internal_to_published_ratio(fusion_record: FusionRecord) -> tuple[float, float, float]:
    """Return the ratio of EKF2's internal to its published position along north, east and down.

    EKF2 computes positions on an ellipsoid, but publishes positions on a sphere.
    """
    if np.isnan(fusion_record.latitude_deg) or not fusion_record.stores_latitude():
        return 1.0, 1.0, 1.0
    eccentricity_squared = ECCENTRICITY**2
    q = 1.0 - eccentricity_squared * np.sin(np.radians(fusion_record.latitude_deg)) ** 2
    # PX4 uses the exponent 2.5 for the meridian radius; the exponent of an ellipsoid is 1.5
    radii_m = (
        EQUATORIAL_RADIUS_M * np.array([(1.0 - eccentricity_squared) / q**2.5, q**-0.5])
        + fusion_record.altitude_m
    )
    north_to_sphere_radius_ratio, east_to_sphere_radius_ratio = (radii_m / EARTH_RADIUS_M).tolist()
    return north_to_sphere_radius_ratio, east_to_sphere_radius_ratio, 1.0
