"""AI-IMU's network against plain NumPy: its factors, and the samples on which they depend."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from tests.support.compiling import quick
from tests.support.networks import count, drawn, predicted, shapes
from tests.support.numpy_layers import float64, linear, relu

RNG = np.random.default_rng(7)
FACTOR = "nonholonomic_log_factor"


def in_windows(body):
    """Windows of 12 channels from [accel, gyro] in the body, with an attitude at every sample."""
    attitude = Rotation.random(body.shape[0] * body.shape[1], RNG).as_matrix()
    attitude = attitude.reshape(*body.shape[:2], 3, 3)
    vectors = np.einsum("bnij,bnkj->bnki", attitude, body.reshape(*body.shape[:2], 2, 3))
    axes = np.moveaxis(attitude[..., :2], 3, 2).reshape(*body.shape[:2], 6)
    return np.float32(np.concatenate([vectors.reshape(*body.shape), axes], -1))


def samples(count=20):
    scale = np.repeat([1.0, 0.1], 3)
    return scale * RNG.standard_normal((3, count, 6)) + np.array([0, 0, 9.81, 0, 0, 0])


def dilated(x, layer, dilation):
    """A sum over five samples that are `dilation` apart, row by row."""
    rows = range(len(x) - 4 * dilation)
    taps = [[x[row + k * dilation] for k in range(5)] for row in rows]
    return np.einsum("rkc,kcd->rd", np.array(taps), layer["kernel"]) + layer["bias"]


def test_the_factors_are_those_of_the_published_layers():
    body = samples()
    model = models.create("ai_imu")
    variables = drawn({"batch_stats": {}, **models.variable_shapes(model, 20)})
    (layers, _), expected = float64(variables), []
    for window in body:
        x = (window[-17:] - [0, 0, 9.81, 0, 0, 0]) / np.repeat([1.0, 0.1], 3)
        x = relu(dilated(x, layers["filter1"], 1))
        (x,) = relu(dilated(x, layers["filter2"], 3))
        variance = 10 ** (3 * np.tanh(linear(x, layers["log_std"])))
        expected.append(np.log(np.sqrt(variance)))
    for prediction in predicted(model, variables, in_windows(body), False):
        np.testing.assert_allclose(prediction.diagnostics[FACTOR], expected, atol=1e-5)
        assert np.isnan(prediction.displacement).all()


def test_it_has_as_many_parameters_as_published():
    layers = shapes("ai_imu", 20)["params"]
    assert count(layers) == 6_210
    assert [count(layers[name]) for name in ("filter1", "filter2", "log_std")] == [992, 5_152, 66]


def test_an_output_depends_on_the_last_17_samples_and_all_of_them():
    windows = in_windows(samples())
    model = models.create("ai_imu")
    variables = drawn(models.variable_shapes(model, 20))

    def total(imu):
        whole = jnp.concatenate([imu, windows[..., 6:]], axis=-1)
        return jnp.sum(model.apply(variables, whole).diagnostics[FACTOR])

    slopes = np.asarray(quick(jax.grad(total))(jnp.asarray(windows[..., :6])))
    np.testing.assert_array_equal(np.abs(slopes).max((0, 2)) > 0, np.arange(20) >= 3)


def test_training_begins_with_the_constants():
    model = models.create("ai_imu")
    variables = models.initialise(model, jax.random.key(0), 20)
    factor = model.apply(variables, jnp.asarray(in_windows(samples()))).diagnostics[FACTOR]
    np.testing.assert_array_equal(factor, np.zeros((3, 2)))


def test_windows_that_are_too_short_are_refused():
    with pytest.raises(ValueError, match="at least 17 samples, found 16"):
        models.variable_shapes(models.create("ai_imu"), 16)
