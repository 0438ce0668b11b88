"""Networks that turn with their window, against rotations and covariances in plain NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.errors import InputError
from gnio_jax.models import equivariance, registry
from gnio_jax.models.heads import root_mean_square
from gnio_jax.models.layers import conv_norm, linear
from gnio_jax.types import Prediction
from tests.support.comparing import assert_close_in_size
from tests.support.compiling import quick

SAMPLES = 8
WINDOWS = np.random.default_rng(0).normal([0, 0, 9.8, 0, 0, 0], 2.0, (3, SAMPLES, 6))


def about_z(angles):
    return Rotation.from_rotvec(angles[:, None] * [[0.0, 0.0, 1.0]]).as_matrix()


TURNS = about_z(np.radians([0.0, 90.0, 180.0, 270.0, 37.0]))


def turned(windows, turns):
    """Windows (b, n, 6) by rotations, both parts."""
    return np.einsum("...ij,bnkj->...bnki", turns, windows.reshape(-1, SAMPLES, 2, 3)).reshape(
        *turns.shape[:-2], -1, SAMPLES, 6
    )


def turned_variance(log_std, turns):
    covariance = turns @ (np.exp(2 * log_std)[..., None] * np.eye(3)) @ turns.swapaxes(-1, -2)
    return np.diagonal(covariance, axis1=-2, axis2=-1)


EVERY = np.float32(turned(WINDOWS, TURNS).reshape(-1, SAMPLES, 6))
"""Every window at every heading, in one batch: one program a network."""


class Whole(nn.Module):
    """A small network with all that one can have: a normalisation that can be folded, dropout,
    constants like the Motion Bank's, velocities like CTIN's."""

    @nn.compact
    def __call__(self, windows, train=False, memory=None):
        x = jnp.tanh(0.1 * conv_norm(windows, 4, 3, 1, train, "conv"))
        x = nn.Dropout(0.5, deterministic=not train)(x)
        bank = self.param("bank", nn.initializers.normal(), (4,), jnp.float32)
        h = x + jnp.tanh(bank if memory is None else memory)[None, None]
        velocity, log_std = (linear(3, name)(h) for name in ("velocity", "log_std"))
        diagnostics = {"velocity": velocity, "velocity_log_std": log_std, "gate": x.mean(axis=1)}
        return Prediction(velocity.mean(axis=1), root_mean_square(log_std), diagnostics)

    @nn.nowrap
    def constants(self, variables):
        return {"memory": variables["params"]["bank"]}


@pytest.fixture(scope="module", autouse=True)
def registration():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "whole", Whole)
        yield


def network(kind="none"):
    return models.create("whole", equivariance=kind)


@functools.cache
def variables(kind):
    """Variables far from their start; standard deviations stay within a few powers of ten."""
    rng = np.random.default_rng(1)

    def draw(path, leaf):
        if path[-1].key in ("var", "scale"):
            return jnp.asarray(rng.uniform(0.5, 1.5, leaf.shape), jnp.float32)
        return jnp.asarray(0.4 * rng.standard_normal(leaf.shape), jnp.float32)

    return jax.tree.map_with_path(draw, models.variable_shapes(network(kind), SAMPLES))


@functools.cache
def program(kind):
    return quick(models.Inference(network(kind)))


def plain(kind, weights, windows):
    return jax.device_get(program(kind)(models.InferenceVariables(weights, {}), windows))


@functools.cache
def predictions(kind):
    """What the network says of every window at every heading; arrays (heading, window, ...)."""
    prediction = plain(kind, variables(kind), EVERY)
    return jax.tree.map(lambda x: x.reshape(len(TURNS), -1, *x.shape[1:]), prediction)


@pytest.mark.parametrize("kind, headings", [("four_headings", 4), ("canonical_frame", 5)])
def test_a_turned_window_gives_the_displacement_turned_alike(kind, headings):
    prediction = predictions(kind)
    expected = np.einsum("hij,bj->hbi", TURNS, prediction.displacement[0])
    scale = np.abs(expected).max()
    assert np.abs(expected[0, :, :2]).max() > 1e-2 * scale  # the plane is not idle
    assert_close_in_size(prediction.displacement[:headings], expected[:headings], 2e-5)
    if headings == 4:
        assert np.abs(prediction.displacement[4] - expected[4]).max() > 1e-3 * scale


def test_four_headings_are_the_mean_of_the_network_turned_back():
    inner = plain("none", variables("four_headings"), EVERY)
    inner = jax.tree.map(lambda x: np.float64(x).reshape(5, 3, *x.shape[1:])[:4], inner)
    prediction, back = predictions("four_headings"), TURNS[:4].transpose(0, 2, 1)[:, None]
    mean = (back @ inner.displacement[..., None])[..., 0].mean(axis=0)
    assert_close_in_size(prediction.displacement[0], mean, 1e-5)
    variance = turned_variance(inner.log_std, back)
    np.testing.assert_allclose(np.exp(2 * prediction.log_std[0]), variance.mean(axis=0), rtol=1e-4)
    diagnostics, inner_diagnostics = prediction.diagnostics, inner.diagnostics
    np.testing.assert_array_equal(
        diagnostics["gate"][0], np.float32(inner_diagnostics["gate"][0])
    )  # as it is
    velocity = np.einsum("hij,hbnj->bni", back[:, 0], inner_diagnostics["velocity"]) / 4
    np.testing.assert_allclose(diagnostics["velocity"][0], velocity, rtol=1e-4, atol=1e-5)
    squares = np.exp(2 * inner_diagnostics["velocity_log_std"])
    squares = np.einsum("hij,hbnj->bni", back[:, 0] ** 2, squares) / 4
    np.testing.assert_allclose(np.exp(2 * diagnostics["velocity_log_std"][0]), squares, rtol=1e-4)


def held(tilt, heading):
    """Axes x and y of a device in each of the windows, (b, n, 6): tilted by so much (rad) about its
    x axis, which has this heading."""
    attitude = Rotation.from_euler("ZX", np.stack([heading, tilt], axis=-1)).as_matrix()
    return np.float32(attitude[..., :2].swapaxes(-1, -2).reshape(*tilt.shape, 6))


def test_a_device_whose_screen_faces_up_is_seen_in_the_frame_of_its_heading():
    """Its tilt and heading vary within the window. One whose screen does not face up, and one whose
    axes are hidden, are seen in the frame of the window, without the constant."""
    rng = np.random.default_rng(3)
    tilt = np.array([0.4, 1.5, 0.4])[:, None] + 0.1 * rng.standard_normal((3, SAMPLES))
    heading = np.array([2.0, 2.0, 2.0])[:, None] + 0.3 * rng.standard_normal((3, SAMPLES))
    axes = held(tilt, heading)
    axes[2] = 0.0
    alone = {part: dict(tree) for part, tree in variables("device_heading").items()}
    constant = alone["params"].pop("facing_up")
    mean = np.mean(np.exp(1j * heading), axis=1)  # x is level, whatever the tilt
    frame = about_z(np.where([True, False, False], np.angle(mean), 0.0))
    pairs = np.einsum("bji,bnkj->bnki", frame, WINDOWS.reshape(3, SAMPLES, 2, 3))
    inner_windows = np.float32(pairs.reshape(WINDOWS.shape))
    inner_windows[0] += np.asarray(constant)
    inner = plain("none", alone, inner_windows)
    windows = np.concatenate([np.float32(WINDOWS), axes], axis=-1)
    prediction = plain("device_heading", variables("device_heading"), windows)
    expected = np.einsum("bij,bj->bi", frame, inner.displacement)
    assert_close_in_size(prediction.displacement, expected, 1e-5)
    squares = np.exp(2 * np.float64(inner.log_std))[..., None] * np.eye(3)
    covariance = frame @ squares @ frame.swapaxes(1, 2)
    np.testing.assert_allclose(
        prediction.covariance(-30.0, float), covariance, rtol=1e-3, atol=1e-4
    )
    # The whole turned by any angle, axes and all.
    for turn in TURNS:
        vectors = np.einsum("ij,bnkj->bnki", turn, windows.reshape(3, SAMPLES, 4, 3))
        turned_windows = np.float32(vectors.reshape(windows.shape))
        displacement = plain(
            "device_heading", variables("device_heading"), turned_windows
        ).displacement
        np.testing.assert_allclose(displacement[0], turn @ prediction.displacement[0], atol=2e-5)


def test_the_largest_tilt_of_a_screen_that_faces_up():
    """Screens at 64° and 66°, with limits of 65° and of 60°, which is the default."""
    tilt = np.radians([64.0, 66.0, 50.0])[:, None] + np.zeros((3, SAMPLES))
    axes = held(tilt, np.full((3, SAMPLES), 2.0))
    windows = np.concatenate([np.float32(WINDOWS), axes], axis=-1)
    hidden = np.concatenate([np.float32(WINDOWS), 0 * axes], axis=-1)
    parts = variables("device_heading")
    for limit, expected in ((None, [False, False, True]), (65.0, [True, False, True])):
        options = {} if limit is None else {"largest_tilt": limit}
        model = models.create("whole", equivariance="device_heading", **options)
        displacement, unknown = (
            quick(model.apply)(parts, x).displacement for x in (windows, hidden)
        )
        np.testing.assert_array_equal(
            np.any(np.abs(displacement - unknown) > 1e-4, axis=1), expected
        )
    for limit in (0.0, 90.0):
        with pytest.raises(InputError, match="'largest_tilt' must be above 0 and below 90"):
            models.create("gnio", equivariance="device_heading", largest_tilt=limit)


def test_no_device_axes_make_a_derivative_infinite():
    """Its x axis on the vertical, hidden axes, and a screen at 60°, where the frame changes."""
    axes = np.zeros((3, SAMPLES, 6), np.float32)
    axes[0, :, [2, 3]] = 1.0
    axes[2] = held(np.full(SAMPLES, np.pi / 3), np.zeros(SAMPLES))
    windows = np.concatenate([np.float32(WINDOWS), axes], axis=-1)
    frozen = models.InferenceVariables(variables("device_heading"), {})

    @quick
    @jax.grad
    def slope(windows):
        prediction = models.Inference(network("device_heading"))(frozen, windows)
        return prediction.displacement.sum() + prediction.covariance(-30.0, jnp.float32).sum()

    slopes = slope(windows)
    assert np.isfinite(slopes).all() and np.abs(slopes[..., :6]).max() > 0


def test_the_network_sees_the_window_in_its_frame():
    inner_variables = {part: dict(tree) for part, tree in variables("canonical_frame").items()}
    of_frame = {part: tree.pop("frame") for part, tree in inner_variables.items()}
    find = quick(equivariance.FrameNetwork().apply, static_argnums=2)
    cosine, sine = np.asarray(find(of_frame, EVERY, False)).T
    np.testing.assert_allclose(cosine**2 + sine**2, 1.0, rtol=1e-6)
    frame = about_z(np.arctan2(sine, cosine))
    pairs = EVERY.reshape(-1, SAMPLES, 2, 3)
    inner_windows = np.einsum("bji,bnkj->bnki", frame, pairs).reshape(EVERY.shape)
    inner = plain("none", inner_variables, np.float32(inner_windows))
    prediction = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), predictions("canonical_frame"))
    expected = np.einsum("bij,bj->bi", frame, inner.displacement)
    assert_close_in_size(prediction.displacement, expected, 1e-4)
    squares = np.exp(2 * np.float64(inner.log_std))[..., None] * np.eye(3)
    covariance = frame @ squares @ frame.swapaxes(1, 2)  # full in the plane
    np.testing.assert_allclose(
        prediction.covariance(-30.0, float), covariance, rtol=1e-3, atol=1e-4
    )
    # The loss of CTIN learns from the velocities.
    mean = prediction.diagnostics["velocity"].mean(axis=1)
    np.testing.assert_allclose(mean, prediction.displacement, atol=1e-5)
    variance = turned_variance(np.float64(inner.diagnostics["velocity_log_std"]), frame[:, None])
    predicted_variance = np.exp(2 * prediction.diagnostics["velocity_log_std"])
    np.testing.assert_allclose(predicted_variance, variance, rtol=1e-3)


@pytest.mark.parametrize("kind", ["four_headings", "canonical_frame"])
def test_frozen_it_gives_the_same_numbers_by_its_constants(kind):
    frozen = models.inference_variables(network(kind), variables(kind))
    prediction, expected = program(kind)(frozen, EVERY), predictions(kind)
    for ours, theirs in zip(prediction[:2], expected[:2], strict=True):
        np.testing.assert_allclose(ours, theirs.reshape(ours.shape), rtol=1e-3, atol=1e-4)
    other = frozen._replace(constants={"memory": frozen.constants["memory"] + 1})
    assert np.abs(program(kind)(other, EVERY).displacement - prediction.displacement).max() > 1e-2
    if kind == "canonical_frame":
        assert not np.any(frozen.variables["batch_stats"]["frame"]["bn1"]["mean"])
    assert hash(models.Inference(network(kind))) == hash(models.Inference(network(kind)))


def test_training_applies_the_network_once():
    weights = variables("four_headings")

    def train(kind):
        key = {"dropout": jax.random.key(2)}
        options = {"train": True, "mutable": ["batch_stats"], "rngs": key}
        return quick(lambda windows: network(kind).apply(weights, windows, **options))(EVERY)

    jax.tree.map(np.testing.assert_array_equal, train("four_headings"), train("none"))


def test_parameters_keep_their_names():
    shape = lambda tree: jax.tree.map(np.shape, tree)  # noqa: E731
    alone = shape(variables("none"))
    assert shape(variables("four_headings")) == alone
    of_device = shape(variables("device_heading"))
    assert of_device["params"].pop("facing_up") == (6,)
    assert of_device == alone
    framed = shape(variables("canonical_frame"))
    frame = {part: tree.pop("frame") for part, tree in framed.items()}
    assert framed == alone
    assert frame["params"].keys() == {"conv1", "bn1", "conv2", "bn2", "weights"}


def test_turned_variances_against_covariances():
    """At any angle, at quarter turns, and where one variance is e¹⁶⁰ times the other: finite, with
    finite derivatives."""
    angles = np.array([0.3, 2.0, -1.2, 0.0, np.pi / 2, np.pi])
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heading[3:] = [[1, 0], [0, 1], [-1, 0]]
    log_std = np.random.default_rng(2).normal(size=(6, 3))
    variance = turned_variance(log_std, about_z(angles))
    turned_log_std = equivariance.turn_log_std(jnp.asarray(log_std), jnp.asarray(heading))
    np.testing.assert_allclose(np.exp(2 * turned_log_std), variance, rtol=1e-6)
    derivative = quick(jax.jacrev(equivariance.turn_log_std, (0, 1)))
    for far in ([40.0, -40.0, 0.0], [-40.0, 40.0, 0.0]):
        slopes = derivative(np.tile(np.float32(far), (6, 1)), np.float32(heading))
        assert all(np.isfinite(slope).all() for slope in slopes)


def test_a_window_without_horizontal_vectors_has_a_heading_and_finite_derivatives():
    still = np.zeros((2, SAMPLES, 6), np.float32)
    still[..., 2], still[1, :, 5] = 9.81, 1.0
    frame_variables = {part: tree["frame"] for part, tree in variables("canonical_frame").items()}

    @quick
    @functools.partial(jax.value_and_grad, argnums=(0, 1), has_aux=True)
    def heading(frame_variables, windows):
        directions = equivariance.FrameNetwork().apply(frame_variables, windows, False)
        return directions.sum(), directions

    (_, directions), slopes = heading(frame_variables, still)
    np.testing.assert_array_equal(directions, [[1, 0], [1, 0]])
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))
    vectors = jnp.float32([[3.0, -4.0], [0.0, 0.0]])
    lengths, slope = jax.vjp(equivariance.length, vectors)
    np.testing.assert_array_equal(lengths, [5, 0])
    np.testing.assert_allclose(slope(jnp.ones(2, jnp.float32))[0], [[0.6, -0.8], [0, 0]], rtol=1e-6)


@pytest.mark.parametrize("kind", ["four_headings", "device_heading"])
def test_a_frame_after_a_corrector_is_refused(kind):
    with pytest.raises(InputError, match=r"^model 'tlio': has a frame.*leave model.corrector"):
        models.create("tlio", equivariance=kind, corrector="airimu")
