"""What every network promises: its size, options that are checked, float32, and finite gradients of
every parameter."""

import functools
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.config import DataConfig, FilterSettings, ModelConfig
from gnio_jax.errors import InputError
from gnio_jax.filtering import initial_state, make_filter, run_odometry
from gnio_jax.models import registry, resnet
from gnio_jax.types import GRAVITY
from tests.support.checks import unchecked
from tests.support.compiling import quick
from tests.support.networks import SMALL, count, drawn, shapes
from tests.support.tiny_network import Tiny


def test_networks_have_as_many_parameters_as_published():
    for name, options, expected_count in (
        ("gnio", {}, 4_934_153),
        ("gnio", {"bank_size": 128}, 4_966_921),
        ("gnio", {"bank_size": 0}, 3_846_144 + 3 * (512 * 3 + 3)),
        ("tlio", {}, 5_424_646),
        ("ronin_resnet", {"output_dim": 2}, 4_634_882),
        ("ronin_resnet", {"output_dim": 2, "normalisation": "group"}, 4_634_882),
        ("ronin_lstm", {"output_dim": 2}, 216_620),
        # Weights, weight norms, biases and shortcuts of six blocks, three slopes each, the output.
        ("ronin_tcn", {"output_dim": 2}, 152_688 + 1_392 + 23_004 + 3 * 6 + 74),
        ("deepils", {"output_dim": 2}, 2_290_226),
        ("ctin", {"output_dim": 2}, 555_364 + 2),  # the publication's 557,100 to 1 %
        ("imot", {"output_dim": 2}, 14_492_810),
        ("imot_text", {"output_dim": 2}, 7_137_482),
        ("ionet", {}, 302_978),
        ("ai_imu", {}, 6_210),
        ("airio", {}, 354_278),
        ("tlio", {"corrector": "airimu"}, 5_424_646 + 520_044),
        ("tlio", {"equivariance": "o2_frame"}, 6_020_230),
        ("ronin_resnet", {"equivariance": "o2_frame", "output_dim": 2}, 5_230_466),
        ("tlio", {"equivariance": "so2_frame"}, 8_884_870),
        ("ronin_resnet", {"equivariance": "so2_frame_shallow", "output_dim": 2}, 6_456_194),
        ("ionext", {"output_dim": 2}, 10_641_506),
        # Of our own sizes.
        ("trunk", {"block": "star"}, 1_193_434),
        ("trunk", {"block": "rep"}, 819_718),
        ("trunk", {"block": "fourier"}, 646_802),
        ("trunk", {"block": "wavelet"}, 646_303),
        ("experts", {}, 1_933_422),
    ):
        assert count(shapes(name, 200, **options)["params"]) == expected_count, (name, options)


SOFTMAX = {("key", "bias"), ("key_content", "bias"), ("key_position", "bias")}
"""One number added to all scores, which a softmax does not see."""
FIRST = {("value", "bias"), ("output", "bias"), ("output", "kernel")}
"""What iMoT's first attention of particles learns: all contents are zero there, so whom a particle
attends to makes no difference."""


SHIFTS = ("filter1", "filter2", "projection", "stem", "down1", "down2", "down3", "mixer")
"""Layers of AirIO and IONext before a batch normalisation, which takes their bias off again."""


SLOW = {"ctin", "deepils", "imot"}
"""To compile; each is compared with NumPy in a test of its own."""
NETWORKS = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name in models.names()
    if name != "imot_text"
]


@pytest.mark.parametrize("name", NETWORKS)
def test_every_parameter_that_can_be_is_trained_in_float32_and_dropout_is_drawn(name, monkeypatch):
    """Whatever the windows come in; of networks with fewer layers. `imot_text` is `imot` with other
    numbers of them. At rest the gradients are finite, those of the windows too."""
    monkeypatch.setattr(resnet, "BLOCKS_PER_GROUP", 1)
    if name != "gnio":  # whose bank is as wide as four groups make it
        monkeypatch.setattr(resnet, "GROUP_STRIDES", (1, 2))
    # A width of their own: JAX keeps the shapes of a network.
    fewer = {"ctin": {"decoder_layers": 1}, "imot": {"encoder_layers": 1}}
    fewer |= {"ridi": {}, "ionext": {"width": 4}, "ai_imu": {}}
    model = models.create(name, **SMALL[name] | fewer.get(name, {"width": 5}))
    samples = {"gru": 60, "state_space": 60, "ronin_lstm": 20, "ionet": 9, "airio": 40}
    samples = (samples | {"ai_imu": 17}).get(name, 12 if name in fewer else 64)
    shape = (4, samples, models.channels(model))
    windows = jnp.asarray(np.random.default_rng(1).standard_normal(shape))
    variables = drawn({"batch_stats": {}, **models.variable_shapes(model, samples)})
    statistics = variables["batch_stats"]

    def loss(params, windows, key):
        network_variables = {"params": params, "batch_stats": statistics}
        prediction, changed = model.apply(
            network_variables, windows, train=True, mutable=["batch_stats"], rngs={"dropout": key}
        )
        balance = prediction.diagnostics.get("task_log_std", jnp.zeros((1, 2), jnp.float32))
        if not models.predicts_displacement(model):  # what it says in its place
            factor = prediction.diagnostics["nonholonomic_log_factor"]
            moved = jnp.pad(factor, ((0, 0), (0, 1)))
            prediction = prediction._replace(displacement=moved)
        value = jnp.sum((prediction.displacement - 1) ** 2) + jnp.sum(prediction.log_std**2)
        return value + jnp.sum(balance**2), (prediction, changed.get("batch_stats", {}))

    gradient = quick(jax.grad(loss, (0, 1), has_aux=True))
    ((grads, _), (one, changed)), ((others, _), (other, _)) = (
        jax.device_get(gradient(variables["params"], windows, jax.random.key(seed)))
        for seed in (0, 1)
    )
    for gravity in (0.0, GRAVITY):
        still = np.zeros(shape)
        still[..., 2] = gravity
        still[..., [6, 10][: shape[-1] - 6]] = 1  # axes of a body that is level
        slopes, _ = gradient(variables["params"], jnp.asarray(still), jax.random.key(0))
        for path, leaf in jax.tree.leaves_with_path(slopes):
            assert np.isfinite(leaf).all(), (gravity, path)
    everything = jax.tree.leaves((variables, grads, one, changed))
    assert windows.dtype == float and {leaf.dtype for leaf in everything} == {np.dtype("float32")}
    assert one.displacement.shape == one.log_std.shape == (4, 3)
    assert all(value.shape[0] == 4 for value in one.diagnostics.values())
    for (path, leaf), another in zip(
        jax.tree.leaves_with_path(grads), jax.tree.leaves(others), strict=True
    ):
        names = tuple(key.key for key in path)
        trained = np.abs(leaf).max() + np.abs(another).max()
        assert np.isfinite(leaf).all(), path
        if names[:2] == ("decoder_1", "self") and name != "ctin" and names[2:] not in FIRST:
            assert trained < 1e-5, path
        elif name == "ridi":  # whose supports are far from windows without gravity
            assert trained > 0, path
        elif names[-2:] not in SOFTMAX and (names[-1] != "bias" or names[-2] not in SHIFTS):
            assert trained > 1e-6, path
    dropped = np.abs(one.displacement - other.displacement).max() > 1e-3
    without = ("ai_imu", "experts", "gnio", "gru", "ionext", "ridi", "ronin_lstm", "state_space")
    assert dropped == (name not in (*without, "trunk"))
    assert jax.tree.structure(changed) == jax.tree.structure(statistics)
    before = jax.tree.leaves_with_path(statistics)
    for (path, old), new in zip(before, jax.tree.leaves(changed), strict=True):
        if path[-1].key in ("mean", "var"):
            assert np.abs(old - new).max() > 0, path
        else:  # constants of the uncertainty
            np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize("name", SMALL)
def test_inference_has_no_random_number(name):
    """No key either, not even one that nothing reads: an export would have to convert it."""
    model = models.create(name, **SMALL[name])
    ready = jax.eval_shape(
        functools.partial(models.inference_variables, model), models.variable_shapes(model, 40)
    )
    windows = jax.ShapeDtypeStruct((1, 40, models.channels(model)), jnp.float32)
    program = str(jax.make_jaxpr(models.Inference(model))(ready, windows))
    assert "dot_general" in program or name == "ai_imu"
    assert "random" not in program and "threefry" not in program


def test_options_that_cannot_be_are_refused():
    for name, options, problem in (
        ("gnoi", {}, r"unknown; did you mean 'gnio'\? known models: ai_imu, airio, ctin"),
        ("gnio", {"bank_sise": 3}, r"unknown option 'bank_sise'; did you mean 'bank_size'\?"),
        (
            "gnio",
            {"head": "gatd"},
            "'head' must be one of gated, linear, bins, found 'gatd'; did",
        ),
        ("tlio", {"equivariance": "so3"}, "'equivariance' must be one of none, four_headings"),
        ("gnio", {"width": 0}, "'width' must be at least 1.*, found 0"),
        ("gnio", {"width": "8"}, "'width' must be a whole number, found '8'"),
        ("tlio", {"dropout": 1.0}, "'dropout' must be at least 0 and below 1, found 1.0"),
        ("imot", {"ffn_ratio": 0.0}, "'ffn_ratio' must be positive.*, found 0.0"),
        ("ctin", {"width": 90}, "width must be even and a multiple of the 8 heads, found 90"),
        ("ctin", {"encoder_width": 20}, "encoder_width must be a multiple of the 8 heads and of 4"),
    ):
        with pytest.raises(InputError, match=f"^model '{name}': (field )?{problem}"):
            models.create(name, **options)


def choices(kind):
    """The choices in a type, also in those of a union's members."""
    kinds = [kind, *typing.get_args(kind)]
    literals = [member for member in kinds if typing.get_origin(member) is typing.Literal]
    return set().union(*(typing.get_args(literal) for literal in literals))


def test_the_settings_have_the_options_and_choices_of_the_networks():
    """`ModelConfig` repeats them for YAML and the command line, which do not wait for JAX."""
    networks = [registry.options(name) for name in models.names()]
    networks += [registry.frame_options(kind) for kind in registry._EQUIVARIANT]
    for option, kind in typing.get_type_hints(ModelConfig).items():
        if option in ("name", "options"):
            continue
        kinds = [options[option] for options in networks if option in options]
        assert kinds and choices(kind) == set().union(*map(choices, kinds)), option


def test_a_network_of_ones_own_is_created_by_its_name(monkeypatch):
    monkeypatch.setattr(registry, "_MODELS", dict(registry._MODELS))
    for _ in range(2):  # a cell of a notebook that runs again
        models.register("own", Tiny)
    assert "own" in models.names() and models.create("own", width=5) == Tiny(width=5)
    with pytest.raises(InputError, match="model 'gnio': is a network of gnio-jax"):
        models.register("gnio", Tiny)
    for module in (Tiny(), lambda: Tiny()):
        with unchecked(), pytest.raises(InputError, match="model 'mine': is no class of Flax"):
            models.register("mine", module)
    for name in (None, 3):
        with (
            unchecked(),
            pytest.raises(InputError, match=rf"^model '{name}': unknown; .*known"),
        ):
            models.create(name)


def test_the_channels_that_a_memory_has_room_for_are_no_option_but_those_of_ones_own_are(
    monkeypatch,
):
    class Own(Tiny):
        inputs: int = 4

    monkeypatch.setattr(registry, "_MODELS", dict(registry._MODELS))
    models.register("own", Own)
    assert models.create("own", inputs=5) == Own(inputs=5)
    with pytest.raises(InputError, match="unknown option 'inputs'"):
        models.create("gru", inputs=9)


@pytest.mark.parametrize("equivariance", ["none", "four_headings", "o2_frame", "device_heading"])
@pytest.mark.parametrize("name", ["gnio", "airio", "ai_imu", "gru", "ronin_tcn", "ctin", "ridi"])
def test_windows_of_another_shape_are_refused_by_name(name, equivariance):
    """Not by an assertion deep inside, whatever the network and what is around it."""
    if equivariance != "none" and name not in ("gnio", "gru"):
        pytest.skip("one network stands for all")
    if (name, equivariance) == ("gru", "o2_frame"):
        pytest.skip("a network with memory has no frame")
    model = models.create(name, **SMALL[name], equivariance=equivariance)
    variables, channels = models.variable_shapes(model, 100), models.channels(model)
    kind = "axes of the body" if channels == 12 else "samples alone"
    for shape in ((2, 100, 18 - channels), (2, 100, 7), (100, channels), (2, 100, channels, 1)):
        windows = jax.ShapeDtypeStruct(shape, jnp.float32)
        with unchecked(), pytest.raises(ValueError) as refusal:
            jax.eval_shape(model.apply, variables, windows)
        problem = f"windows: must be (b, n, {channels}), found {shape}: this network sees"
        assert str(refusal.value).startswith(problem) and kind in str(refusal.value)


@pytest.mark.parametrize("name", ["gnio", "airio"])
def test_the_filter_refuses_a_network_whose_windows_have_other_channels(name):
    model = models.create(name, **SMALL[name])
    predict = models.Network.of(model, drawn(models.variable_shapes(model, 100))).predict()
    rotation = "per_sample" if name == "airio" else "body_axes"
    windows = DataConfig(rate=100.0, window_rotation=rotation)
    ekf = make_filter(windows, FilterSettings())
    state = initial_state(ekf, np.eye(3), np.zeros(3), np.zeros(3))
    samples = np.tile([[0.0, 0.0, GRAVITY]], (200, 1))
    with unchecked(), pytest.raises(ValueError, match=r"^windows: must be \(b, n, (6|12)\)") as no:
        run_odometry(predict, ekf, state, 0 * samples, samples)
    assert "as window_rotation" in str(no.value)
