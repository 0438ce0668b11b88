"""Recordings of many lengths in a stream: the results of each alone, in order, few at a time."""

import numpy as np

from gnio_jax.filtering import stream

N = 5


def recordings(count, alive):
    rng = np.random.default_rng(0)
    for i in range(count):
        alive.append(i)
        rows = int(rng.integers(N, 900))
        gyro, accel = rng.normal(size=(2, rows, 3))
        yield stream.Recorded({"offset": np.float64(i)}, gyro, accel)


def run(starts, gyro, accel):
    """Sums over each interval, from an offset of the recording."""
    batch = len(gyro)
    sums = (gyro - accel).reshape(batch, -1, N, 3).sum(axis=2)
    return {"path": starts["offset"][:, None, None] + np.cumsum(sums, axis=1)}


def test_every_recording_has_its_own_result_in_order():
    ours = stream.stream(run, recordings(70, []), N, batch_size=4)
    for i, (found, given) in enumerate(zip(ours, recordings(70, []), strict=True)):
        rows = len(given.gyro) // N * N
        moved = (given.gyro - given.accel)[:rows].reshape(-1, N, 3).sum(axis=1)
        np.testing.assert_allclose(found["path"], i + np.cumsum(moved, axis=0), atol=1e-9)


def test_few_recordings_are_read_ahead_and_few_shapes_are_compiled():
    read, shapes = [], set()

    def noted(starts, gyro, accel):
        shapes.add(gyro.shape)
        return run(starts, gyro, accel)

    for taken, found in enumerate(stream.stream(noted, recordings(2000, read), N, batch_size=4)):
        assert len(read) - taken <= stream.AHEAD * 4
        assert found["path"].base is None, "a part of a batch would keep all of it"
    assert len(read) == 2000 and len(shapes) < 16
    assert {shape[0] for shape in shapes} == {4}
