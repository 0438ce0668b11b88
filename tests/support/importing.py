"""`import_recording` with what the recording does not say given by name."""

import numpy as np
import pytest

from gnio_jax.apps import importing
from gnio_jax.config import ImportOptions
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk


def import_recording(path, columns=None, rate=None, name=None, **stated):
    """(sequence, notes). `columns`: from our names to the file's; `stated`: the other fields of
    `ImportOptions`."""
    return imported(path, columns, rate, name, **stated)[:2]


def imported(path, columns=None, rate=None, name=None, **stated):
    words = tuple(f"{ours}={theirs}" for ours, theirs in (columns or {}).items())
    options = ImportOptions(columns=words, **stated)
    return importing.import_recording(path, options, rate=rate, name=name)


def refused(path, words, *columns, **stated):
    """It is, in one line that holds the `words`."""
    with pytest.raises(InputError, match=words) as caught:
        import_recording(path, *columns, **stated)
    assert "\n" not in str(caught.value)


def compare_reference(sequence, rows, atol):
    """It is the known walk's in these rows, where it is valid: to `atol` m, 20 `atol` m/s and 10
    `atol` rad."""
    time = sequence.time[rows]
    assert sequence.valid[rows].all()
    np.testing.assert_allclose(sequence.position[rows], known_walk.position(time), atol=atol)
    speed = known_walk.velocity(time)
    np.testing.assert_allclose(sequence.velocity[rows], speed, atol=20 * atol)
    turned = rotations(sequence.orientation[rows]).inv() * known_walk.attitude(time)
    assert turned.magnitude().max() < 10 * atol
