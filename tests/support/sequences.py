"""Two sequences compared, array by array."""

import numpy as np


def assert_same_arrays(found, expected):
    """Every array of a `types.Sequence`, to the bit."""
    for name in set(found._fields) - {"name", "attributes", "waypoints", "readings"}:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert (found.waypoints is None) == (expected.waypoints is None)
    for ours, theirs in zip(found.waypoints or (), expected.waypoints or (), strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg="waypoints")
    assert found.readings.keys() == expected.readings.keys()
    for sensor, readings in found.readings.items():
        for ours, theirs in zip(readings, expected.readings[sensor], strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=sensor)
