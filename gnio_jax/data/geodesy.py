"""Places on the earth as metres east, north and up of a place nearby (WGS 84)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
"""Of the ellipsoid, m and 1."""
_ECCENTRICITY = FLATTENING * (2 - FLATTENING)  # its square


class Place(NamedTuple):
    """A place on the earth."""

    latitude: float
    """Degrees north."""
    longitude: float
    """Degrees east."""
    altitude: float
    """Height above the ellipsoid, m."""


def east_north_up(places: Float[np.ndarray, "n 3"], origin: Place) -> Float[np.ndarray, "n 3"]:
    """Latitude, longitude (degrees) and altitude (m) as metres east, north and up of `origin`, in
    the plane that touches the ellipsoid there."""
    latitude, longitude, _ = np.radians(origin)
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)]
    axes = np.array([east, np.cross([*up, np.sin(latitude)], east), [*up, np.sin(latitude)]])
    return (_earth_frame(places) - _earth_frame(np.array([origin]))) @ axes.T


def geodetic(position: Float[np.ndarray, "n 3"], origin: Place) -> Float[np.ndarray, "n 3"]:
    """The inverse of `east_north_up`: latitude, longitude (degrees, -180 to 180) and altitude
    (m). Steps by the radii of curvature at the origin reach 1 mm up to 100 km from it."""
    latitude = np.radians(origin.latitude)
    across = SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY * np.sin(latitude) ** 2)
    along = across * (1 - _ECCENTRICITY) / (1 - _ECCENTRICITY * np.sin(latitude) ** 2)
    degrees = np.degrees([1 / along, 1 / (across * max(np.cos(latitude), 1e-6))])
    places = np.tile(np.array(origin), (len(position), 1))
    for _ in range(6):
        error = position - east_north_up(places, origin)
        places = places + error[:, [1, 0, 2]] * [*degrees, 1.0]
    places[:, 1] = near_longitude(places[:, 1], 0.0)
    return places


def near_longitude(longitude: Float[np.ndarray, " n"], other: float) -> Float[np.ndarray, " n"]:
    """The same longitudes, degrees, within 180 of another one: the antimeridian is no step."""
    return longitude - 360.0 * np.round((longitude - other) / 360.0)


def _earth_frame(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Positions in the frame that turns with the earth (ECEF), m."""
    latitude, longitude = np.radians(places[:, :2].T)
    radius = SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY * np.sin(latitude) ** 2)
    level = (radius + places[:, 2]) * np.cos(latitude)
    height = (radius * (1 - _ECCENTRICITY) + places[:, 2]) * np.sin(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude), height], axis=1)
