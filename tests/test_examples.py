"""Examples that no other test runs: only their first stage is run, as the rest takes minutes."""

import runpy
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import data, models
from gnio_jax.data.hdf5 import write_hdf5

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_the_walk_of_the_gradients_example_has_its_true_start_and_displacements():
    example = runpy.run_path(str(EXAMPLES / "gradient_length.py"))
    (attitude, velocity, position), signals, displacement, truth = example["walk_of"](3.0)
    walk = data.resample(data.load("synthetic", split="test")[0], 100.0)
    rotation = Rotation.from_quat(walk.orientation, scalar_first=True)
    np.testing.assert_allclose(attitude, rotation[0].as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(velocity, walk.velocity[0])
    np.testing.assert_array_equal(position, walk.position[0])
    assert signals.shape == (300, 6) and displacement.shape == truth.shape == (30, 3)
    # A window of 1 s ends with each row from the tenth on; its frame has the start's yaw.
    assert np.isnan(displacement[:9]).all()
    steps = walk.position[100:301:10] - walk.position[0:201:10]
    yaw = Rotation.from_euler("z", rotation[0:201:10].as_euler("ZYX")[:, :1])
    error = displacement[9:] - yaw.inv().apply(steps)
    assert np.abs(error).max() < 5 * 0.05 and 0.03 < error.std() < 0.07


def test_what_an_import_has_bridged_is_missing_in_a_replay(tmp_path):
    """Half a second without samples, in a file that an import has put on a uniform clock."""
    read = runpy.run_path(str(EXAMPLES / "replay_csv.py"))["read"]
    walk = data.load("synthetic", split="test")[0]
    measured = ~((walk.time > 3.0) & (walk.time < 3.5))
    imported = walk._replace(imu_valid=measured, attributes={"start_time": 1.7e9})
    for name, sequence in (("imported", imported), ("walk", walk)):
        write_hdf5(tmp_path / f"{name}.h5", sequence)
    samples = read(tmp_path / "imported.h5")
    for signal, original in zip(samples[1:], (walk.gyro, walk.accel), strict=True):
        np.testing.assert_array_equal(np.isnan(signal), np.tile(~measured[:, None], (1, 3)))
        np.testing.assert_array_equal(signal[measured], original[measured])
    np.testing.assert_allclose(samples.time - 1.7e9, walk.time, atol=1e-6)
    assert np.isfinite(read(tmp_path / "walk.h5").gyro).all()


def test_the_network_of_its_own_is_that_of_the_page():
    path = EXAMPLES / "deeper.py"
    example = runpy.run_path(str(path))
    assert models.names().count("deeper") == 1
    assert isinstance(models.create("deeper", width=4), example["Deeper"])
    page = (EXAMPLES.parent / "docs" / "networks.md").read_text(encoding="utf-8")
    classes = path.read_text(encoding="utf-8").partition("class TwoLayers")[2]
    assert classes.partition("models.register")[0] in page
