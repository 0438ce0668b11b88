"""Two sequences compared, array by array."""

import numpy as np


def assert_same_arrays(sequence, expected):
    """Every array of a `types.Sequence`, to the bit."""
    for name in set(sequence._fields) - {"name", "attributes", "waypoints", "readings"}:
        np.testing.assert_array_equal(
            getattr(sequence, name), getattr(expected, name), err_msg=name
        )
    assert (sequence.waypoints is None) == (expected.waypoints is None)
    for ours, theirs in zip(sequence.waypoints or (), expected.waypoints or (), strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg="waypoints")
    assert sequence.readings.keys() == expected.readings.keys()
    for sensor, readings in sequence.readings.items():
        for ours, theirs in zip(readings, expected.readings[sensor], strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=sensor)
