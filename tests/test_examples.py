"""Examples that no other test runs: only their first stage is run, as the rest takes minutes."""

import runpy
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import data, models

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


def test_the_network_of_its_own_is_that_of_the_page():
    path = EXAMPLES / "deeper.py"
    example = runpy.run_path(str(path))
    assert models.names().count("deeper") == 1
    assert isinstance(models.create("deeper", width=4), example["Deeper"])
    page = (EXAMPLES.parent / "docs" / "networks.md").read_text(encoding="utf-8")
    classes = path.read_text(encoding="utf-8").partition("class TwoLayers")[2]
    assert classes.partition("models.register")[0] in page
