"""Places as metres, against the radii of curvature and against each other."""

import numpy as np
import pytest

from gnio_jax.data.geodesy import Place, east_north_up, geodetic


@pytest.mark.parametrize("latitude", [-77.0, -12.0, 0.0, 48.1, 85.0])
def test_a_small_step_is_that_of_the_radii_of_curvature(latitude):
    """By the formulas of the meridian's and of the normal's radius of the ellipsoid."""
    square = 2 / 298.257223563 - 1 / 298.257223563**2
    bent = 1 - square * np.sin(np.radians(latitude)) ** 2
    along, across = 6378137.0 * (1 - square) / bent**1.5, 6378137.0 / bent**0.5
    places = np.array([[latitude + 1e-4, 11.6, 500.0], [latitude, 11.6 + 1e-4, 500.0]])
    north, east = east_north_up(places, Place(latitude, 11.6, 500.0))
    step = np.radians(1e-4)
    np.testing.assert_allclose(north, [0.0, (along + 500.0) * step, 0.0], atol=1e-3)
    level = (across + 500.0) * np.cos(np.radians(latitude)) * step
    np.testing.assert_allclose(east, [level, 0.0, 0.0], atol=1e-3)


@pytest.mark.parametrize("origin", [(48.1, 11.6, 500.0), (-33.9, 179.99999, 0.0), (0.0, 0.0, -30)])
def test_metres_and_degrees_are_inverse_to_each_other(origin):
    position = np.array([[0.0, 0, 0], [4000.0, -7000.0, 120.0], [-9.0, 3.0, -4.0]])
    back = east_north_up(geodetic(position, Place(*origin)), Place(*origin))
    np.testing.assert_allclose(back, position, atol=1e-3)


def test_a_longitude_beyond_180_degrees_is_that_of_the_other_side():
    radius = 6378137.0  # at the equator
    step = np.degrees(2000.0 / radius)
    for side in (1.0, -1.0):
        position = np.array([[2000.0 * side, 0.0, 0.0], [0.0, 0.0, 0.0]])
        longitude = geodetic(position, Place(0.0, side * 179.99, 0.0))[:, 1]
        expected = [side * (179.99 + step - 360.0), side * 179.99]
        np.testing.assert_allclose(longitude, expected, atol=1e-8)
