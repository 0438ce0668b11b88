"""A trajectory on the earth: from a first fix and a heading to latitude and longitude (WGS 84).

The world is the plane that touches the ellipsoid at the first pose, z along its normal. Its x axis
points to `FirstFix.heading`; a filter that starts without a reference chooses that axis itself, so
the heading must come from elsewhere, e.g. from the map.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.evaluation.metrics import Trajectory

SEMI_MAJOR, FLATTENING = 6378137.0, 1.0 / 298.257223563
"""WGS 84 (NIMA TR8350.2): m, and none."""
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
UNIX_TIME = 1e9
"""s: a stamp beyond is unix time (from 2001 on), below it a clock of its own."""
LAST_YEAR = 253_370_764_800.0
"""s: unix time of the year 9999, the last that a date can say. What is later is no time in s."""


class FirstFix(NamedTuple):
    """Where the trajectory begins."""

    latitude: float
    """deg, north positive."""
    longitude: float
    """deg, east positive."""
    altitude: float | None
    """Above the ellipsoid, m; None where unknown: heights are then left out."""
    heading: float
    """Of the world's x axis, deg clockwise from true north."""


def first_fix(values: tuple[float, ...], heading: float | None) -> FirstFix:
    """The options --first-fix LAT LON [ALT] and --heading DEG. Raises `InputError`."""
    if len(values) not in (2, 3):
        raise InputError(
            "--first-fix", f"holds {len(values)} numbers", "give LAT LON or LAT LON ALT"
        )
    if heading is None:
        raise InputError(
            "--heading", "is missing", "give the direction of the world's x axis, deg from north"
        )
    latitude, longitude = values[:2]
    if not np.isfinite([*values, heading]).all() or abs(latitude) > 90 or abs(longitude) > 180:
        raise InputError(
            "--first-fix", f"{latitude:g} {longitude:g} is no place on the earth", "give LAT LON"
        )
    return FirstFix(latitude, longitude, values[2] if len(values) == 3 else None, heading)


def on_the_earth(position: Float[np.ndarray, "n 3"], fix: FirstFix) -> Float[np.ndarray, "n 3"]:
    """Latitude (deg), longitude (deg) and height above the ellipsoid (m) of positions (m), of which
    the first is at the fix. An unknown altitude counts as 0."""
    latitude, longitude, heading = np.radians([fix.latitude, fix.longitude, fix.heading])
    x, y, up = (position - position[0]).T
    east = x * np.sin(heading) - y * np.cos(heading)
    north = x * np.cos(heading) + y * np.sin(heading)
    moved = _axes(latitude, longitude).T @ np.stack([east, north, up])
    centre = _cartesian(latitude, longitude, fix.altitude or 0.0)
    return _geodetic(centre[:, None] + moved)


def _axes(latitude: float, longitude: float) -> Float[np.ndarray, "3 3"]:
    """Rows: east, north and up in the earth's frame."""
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _cartesian(latitude: float, longitude: float, height: float) -> Float[np.ndarray, "3"]:
    radius = SEMI_MAJOR / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    across = (radius + height) * np.cos(latitude)
    along = (radius * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along])


def _geodetic(place: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "n 3"]:
    """Bowring's formula (Survey Review 23, 1976), exact to micrometres near the ground; its height
    has a form that holds at the poles too."""
    x, y, z = place
    semi_minor = SEMI_MAJOR * (1.0 - FLATTENING)
    across = np.hypot(x, y)
    parametric = np.arctan2(SEMI_MAJOR * z, semi_minor * across)
    second = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
    latitude = np.arctan2(
        z + second * semi_minor * np.sin(parametric) ** 3,
        across - ECCENTRICITY_SQUARED * SEMI_MAJOR * np.cos(parametric) ** 3,
    )
    sine = np.sin(latitude)
    normal = SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    height = across * np.cos(latitude) + z * sine - normal
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)


def write_geojson(path: Path, poses: Trajectory, fix: FirstFix, name: str) -> None:
    """One LineString (RFC 7946: longitude first) with its stamps as the property `times`, s."""
    places = on_the_earth(poses.position, fix)
    line = [
        [round(lon, 9), round(lat, 9), *([] if fix.altitude is None else [round(height, 4)])]
        for lat, lon, height in places.tolist()
    ]
    if len(line) == 1:
        line = line * 2  # a line has two points
    feature = {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": line},
        "properties": {"name": name, "times": poses.time.tolist()},
    }
    text = json.dumps({"type": "FeatureCollection", "features": [feature]})
    path.write_text(text + "\n", encoding="utf-8")


def write_gpx(path: Path, poses: Trajectory, fix: FirstFix, name: str) -> None:
    """A track (GPX 1.1), with times where the stamps are unix time: no others can be given."""
    root = ElementTree.Element(
        "gpx",
        {"version": "1.1", "creator": "gnio-jax", "xmlns": "http://www.topografix.com/GPX/1/1"},
    )
    track = ElementTree.SubElement(root, "trk")
    ElementTree.SubElement(track, "name").text = name
    segment = ElementTree.SubElement(track, "trkseg")
    places = on_the_earth(poses.position, fix)
    for stamp, (lat, lon, height) in zip(poses.time.tolist(), places.tolist(), strict=True):
        point = ElementTree.SubElement(segment, "trkpt", {"lat": f"{lat:.9f}", "lon": f"{lon:.9f}"})
        if fix.altitude is not None:
            ElementTree.SubElement(point, "ele").text = f"{height:.4f}"
        if UNIX_TIME <= stamp < LAST_YEAR:
            utc = datetime.fromtimestamp(stamp, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
            ElementTree.SubElement(point, "time").text = utc
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
