"""Networks that turn with their window, against rotations and covariances in plain NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import ModelConfig
from gnio_jax.models import equivariance
from tests.support.compiling import quick

SAMPLES = 32
OPTIONS = {
    "gnio": {"width": 2, "bank_size": 3},
    "ctin": {"width": 4, "encoder_width": 4, "ffn": 4, "heads": 2, "decoder_layers": 1},
}
WINDOWS = np.random.default_rng(0).normal([0, 0, 9.8, 0, 0, 0], 2.0, (3, SAMPLES, 6))
KINDS = ("four_headings", "canonical_frame")


def about_z(angles):
    """Rotation matrices by angles, rad."""
    return Rotation.from_rotvec(angles[:, None] * [[0.0, 0.0, 1.0]]).as_matrix()


TURNS = about_z(np.radians([0.0, 90.0, 180.0, 270.0, 37.0]))


def turned(windows, turns):
    """Windows (b, n, 6) by rotations, both parts."""
    return np.einsum("...ij,bnkj->...bnki", turns, windows.reshape(-1, SAMPLES, 2, 3)).reshape(
        *turns.shape[:-2], -1, SAMPLES, 6
    )


def turned_variance(log_std, turns):
    """Diagonals of turned covariances."""
    covariance = turns @ (np.exp(2 * log_std)[..., None] * np.eye(3)) @ turns.swapaxes(-1, -2)
    return np.diagonal(covariance, axis1=-2, axis2=-1)


EVERY = np.float32(turned(WINDOWS, TURNS).reshape(-1, SAMPLES, 6))
"""Every window at every heading, in one batch: one program a network."""


def network(name, kind="none"):
    return models.create(name, equivariance=kind, **OPTIONS[name])


@functools.cache
def variables(name, kind):
    """Variables far from their start; standard deviations stay within a few powers of ten."""
    rng = np.random.default_rng(1)

    def draw(path, leaf):
        if path[-1].key in ("var", "scale"):
            return jnp.asarray(rng.uniform(0.5, 1.5, leaf.shape), jnp.float32)
        size = 0.05 if path[1].key in ("uncertainty", "log_std") else 0.4
        return jnp.asarray(size * rng.standard_normal(leaf.shape), jnp.float32)

    return jax.tree.map_with_path(draw, models.variable_shapes(network(name, kind), SAMPLES))


@functools.cache
def applied(name):
    return quick(network(name).apply)


@functools.cache
def predictions(name, kind):
    """What the network says of every window at every heading; arrays (heading, window, ...)."""
    said = quick(network(name, kind).apply)(variables(name, kind), EVERY)
    return jax.tree.map(lambda x: np.asarray(x).reshape(len(TURNS), -1, *x.shape[1:]), said)


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("kind, headings", [(KINDS[0], 4), (KINDS[1], 5)])
def test_a_turned_window_gives_the_displacement_turned_alike(name, kind, headings):
    said = predictions(name, kind)
    wanted = np.einsum("hij,bj->hbi", TURNS, said.displacement[0])
    scale = np.abs(wanted).max()
    assert np.abs(wanted[0, :, :2]).max() > 1e-2 * scale  # the plane is not idle
    np.testing.assert_allclose(said.displacement[:headings], wanted[:headings], atol=2e-5 * scale)
    if headings == 4:
        assert np.abs(said.displacement[4] - wanted[4]).max() > 1e-3 * scale


@pytest.mark.parametrize("name", OPTIONS)
def test_four_headings_are_the_mean_of_the_network_turned_back(name):
    inner = applied(name)(variables(name, "four_headings"), EVERY[:12])
    said = predictions(name, "four_headings")
    back = TURNS[:4].transpose(0, 2, 1)[:, None]
    each = np.asarray(inner.displacement, np.float64).reshape(4, 3, 3)
    mean = (back @ each[..., None])[..., 0].mean(axis=0)
    np.testing.assert_allclose(said.displacement[0], mean, atol=1e-5 * np.abs(each).max())
    variance = turned_variance(np.asarray(inner.log_std, np.float64).reshape(4, 3, 3), back)
    np.testing.assert_allclose(np.exp(2 * said.log_std[0]), variance.mean(axis=0), rtol=1e-4)
    for key, value in inner.diagnostics.items():
        wanted = value[:3]  # of the window as it is
        every = np.asarray(value, np.float64).reshape(4, 3, *value.shape[1:])
        if key == "velocity":
            wanted = np.einsum("hij,hbnj->bni", back[:, 0], every) / 4
        elif key == "velocity_log_std":
            squares = np.einsum("hij,hbnj->bni", back[:, 0] ** 2, np.exp(2 * every)) / 4
            wanted = 0.5 * np.log(squares)
        np.testing.assert_allclose(said.diagnostics[key][0], wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", OPTIONS)
def test_the_network_sees_the_window_in_its_frame(name):
    """Frame network, network and rotations one after the other."""
    kind = "canonical_frame"
    own = {part: dict(tree) for part, tree in variables(name, kind).items()}
    of_frame = {part: tree.pop("frame") for part, tree in own.items()}
    find = quick(equivariance.FrameNetwork().apply, static_argnums=2)
    cosine, sine = np.asarray(find(of_frame, EVERY[:12], False)).T
    np.testing.assert_allclose(cosine**2 + sine**2, 1.0, rtol=1e-6)
    frame = about_z(np.arctan2(sine, cosine))
    pairs = EVERY[:12].reshape(12, SAMPLES, 2, 3)
    seen = np.einsum("bji,bnkj->bnki", frame, pairs).reshape(12, SAMPLES, 6)
    inner = applied(name)(own, np.float32(seen))
    said = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:12], predictions(name, kind))
    wanted = np.einsum("bij,bj->bi", frame, np.asarray(inner.displacement))
    np.testing.assert_allclose(said.displacement, wanted, atol=1e-4 * np.abs(wanted).max())
    variance = turned_variance(np.asarray(inner.log_std, np.float64), frame)
    np.testing.assert_allclose(np.exp(2 * said.log_std), variance, rtol=1e-3)
    if name == "ctin":  # its loss learns from the velocities
        mean = said.diagnostics["velocity"].mean(axis=1)
        np.testing.assert_allclose(mean, said.displacement, atol=1e-5)
        each = np.asarray(inner.diagnostics["velocity_log_std"], np.float64)
        variance = turned_variance(each, frame[:, None])
        found = np.exp(2 * said.diagnostics["velocity_log_std"])
        np.testing.assert_allclose(found, variance, rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_frozen_it_gives_the_same_numbers(kind):
    model = network("gnio", kind)
    frozen = models.inference_variables(model, variables("gnio", kind))
    assert frozen.constants.keys() == {"memory"}
    found = quick(models.Inference(model).__call__)(frozen, EVERY)
    wanted = predictions("gnio", kind)
    for ours, theirs in zip(found[:2], wanted[:2], strict=True):
        theirs = theirs.reshape(ours.shape)
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * np.abs(theirs).max())
    if kind == "canonical_frame":
        normalisation = frozen.variables["batch_stats"]["frame"]["bn1"]
        assert not np.any(normalisation["mean"])
    assert hash(models.Inference(model)) == hash(models.Inference(network("gnio", kind)))


def test_training_applies_the_network_once():
    """The same numbers as without, dropout included."""
    given = variables("ctin", "four_headings")

    def train(kind):
        model = network("ctin", kind)
        key = {"dropout": jax.random.key(2)}
        options = {"train": True, "mutable": ["batch_stats"], "rngs": key}
        return quick(lambda windows: model.apply(given, windows, **options))(EVERY)

    jax.tree.map(np.testing.assert_array_equal, train("four_headings"), train("none"))


def test_parameters_keep_their_names():
    shape = lambda tree: jax.tree.map(np.shape, tree)  # noqa: E731
    alone = shape(variables("gnio", "none"))
    assert shape(variables("gnio", "four_headings")) == alone
    framed = shape(variables("gnio", "canonical_frame"))
    frame = {part: tree.pop("frame") for part, tree in framed.items()}
    assert framed == alone
    assert frame["params"].keys() == {"conv1", "bn1", "conv2", "bn2", "weights"}
    assert models.from_config(ModelConfig(**OPTIONS["gnio"])) == network("gnio")


def test_turned_variances_against_covariances():
    """At any angle, at quarter turns, and where one variance is e¹⁶⁰ times the other: finite, with
    finite derivatives."""
    angles = np.array([0.3, 2.0, -1.2, 0.0, np.pi / 2, np.pi])
    heading = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heading[3:] = [[1, 0], [0, 1], [-1, 0]]
    log_std = np.random.default_rng(2).normal(size=(6, 3))
    wanted = turned_variance(log_std, about_z(angles))
    found = equivariance.turn_log_std(jnp.asarray(log_std), jnp.asarray(heading))
    np.testing.assert_allclose(np.exp(2 * found), wanted, rtol=1e-6)
    derivative = quick(jax.jacrev(equivariance.turn_log_std, (0, 1)))
    for far in ([40.0, -40.0, 0.0], [-40.0, 40.0, 0.0]):
        slopes = derivative(np.tile(np.float32(far), (6, 1)), np.float32(heading))
        assert all(np.isfinite(slope).all() for slope in slopes)


def test_a_window_without_horizontal_vectors_has_a_heading_and_finite_derivatives():
    still = np.zeros((2, SAMPLES, 6), np.float32)
    still[..., 2], still[1, :, 5] = 9.81, 1.0
    given = {part: tree["frame"] for part, tree in variables("gnio", "canonical_frame").items()}

    @quick
    @functools.partial(jax.value_and_grad, argnums=(0, 1), has_aux=True)
    def heading(given, windows):
        found = equivariance.FrameNetwork().apply(given, windows, False)
        return found.sum(), found

    (_, found), slopes = heading(given, still)
    np.testing.assert_array_equal(found, [[1, 0], [1, 0]])
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))
    vectors = jnp.float32([[3.0, -4.0], [0.0, 0.0]])
    lengths, slope = jax.vjp(equivariance.length, vectors)
    np.testing.assert_array_equal(lengths, [5, 0])
    np.testing.assert_allclose(slope(jnp.ones(2, jnp.float32))[0], [[0.6, -0.8], [0, 0]], rtol=1e-6)
