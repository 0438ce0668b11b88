"""The network against its specification: how it starts, its ablations, and a plain NumPy forward
pass."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.models.convolution import convolve
from gnio_jax.models.motion_bank import MotionBank
from tests.support import networks
from tests.support.compiling import quick
from tests.support.networks import drawn

shapes = functools.partial(networks.shapes, "gnio")


SMALL = models.create("gnio", width=2, bank_size=4)


@pytest.fixture(scope="module")
def fresh():
    """First variables of the small network."""
    return models.initialise(SMALL, jax.random.key(0), 64)


@quick
def trained_once(variables, windows):
    return SMALL.apply(variables, windows, train=True, mutable=["batch_stats"])


def noise(mean=0.0):
    return np.random.default_rng(1).normal(mean, 1.0, (16, 64, 6)).astype(np.float32)


def test_prototypes_start_as_far_apart_as_asked():
    windows = jnp.zeros((1, 50, 6), jnp.float32)
    for options, std in (({}, 1.0), ({"bank_std": 64**-0.5}, 64**-0.5)):
        model = models.create("gnio", width=8, bank_size=400, **options)

        @quick  # what else is drawn is not compiled
        def prototypes(key, model=model):
            return model.init(key, windows)["params"]["bank"]["prototypes"]

        np.testing.assert_allclose(np.std(prototypes(jax.random.key(0))), std, rtol=0.03)


def test_the_bank_starts_alive():
    """Windows attend to different prototypes before training, and their contexts differ; near each
    other the prototypes are a saddle."""
    rng = np.random.default_rng(0)
    features = jnp.asarray(np.maximum(rng.normal(0.4, 1.0, (200, 512)), 0), jnp.float32)
    entropy, spread = {}, {}
    for std in (1.0, 512**-0.5):
        bank = MotionBank(std=std)
        drawn = quick(lambda key, bank=bank: bank.init_with_output(key, features)[0])
        context, attention = map(np.asarray, drawn(jax.random.key(1)))
        entropy[std] = -np.mean(np.sum(attention * np.log(attention), axis=-1)) / np.log(64)
        spread[std] = np.mean(np.std(context, axis=0)) / np.mean(np.std(features, axis=0))
    assert entropy[1.0] < 0.98 and entropy[512**-0.5] > 0.999
    assert spread[1.0] > 100 * spread[512**-0.5]


def test_the_projections_start_as_those_of_pytorch():
    """Xavier-uniform over query, key and value as one (3d, d) matrix, a linear layer's bound for
    the output, biases zero."""
    bank = MotionBank(size=3, heads=2, width=64)
    params = quick(bank.init)(jax.random.key(0), jnp.zeros((1, 64), jnp.float32))["params"]
    for name, bound in [
        ("query", (6 / (64 + 192)) ** 0.5),
        ("key", (6 / (64 + 192)) ** 0.5),
        ("value", (6 / (64 + 192)) ** 0.5),
        ("output", 64**-0.5),
    ]:
        kernel = np.abs(params[name]["kernel"])
        assert (
            0.99 * bound < kernel.max() <= bound and abs(kernel.mean() - bound / 2) < 0.02 * bound
        )
        np.testing.assert_array_equal(params[name]["bias"], 0)


def numpy_forward(variables, windows):
    """The whole network, one sample, one output at a time: direct sums, no matrix tricks."""
    p = jax.tree.map(np.asarray, variables["params"])
    s = jax.tree.map(np.asarray, variables["batch_stats"])

    def conv(x, kernel, stride, padding):
        size = kernel.shape[0]
        x = np.pad(x, ((padding, padding), (0, 0)))
        rows = range(0, len(x) - size + 1, stride)
        return np.stack([sum(x[r + k] @ kernel[k] for k in range(size)) for r in rows])

    def bn(x, scale, stats):
        return (x - stats["mean"]) / np.sqrt(stats["var"] + 1e-5) * scale["scale"] + scale["bias"]

    def block(x, params, stats, stride):
        y = np.maximum(
            bn(conv(x, params["conv1"]["kernel"], stride, 1), params["bn1"], stats["bn1"]), 0
        )
        y = bn(conv(y, params["conv2"]["kernel"], 1, 1), params["bn2"], stats["bn2"])
        if "shortcut_conv" in params:
            x = bn(
                conv(x, params["shortcut_conv"]["kernel"], stride, 0),
                params["shortcut_bn"],
                stats["shortcut_bn"],
            )
        return np.maximum(x + y, 0)

    e, t = p["encoder"], s["encoder"]
    displacement, log_std, gates, attention = [], [], [], []
    for x in np.asarray(windows, np.float64):
        x = np.maximum(bn(conv(x, e["stem_conv"]["kernel"], 2, 3), e["stem_bn"], t["stem_bn"]), 0)
        x = np.stack([x[max(0, r - 1) : r + 2].max(axis=0) for r in range(0, len(x), 2)])
        for group in range(4):
            for b in range(2):
                name = f"group{group + 1}_block{b + 1}"
                x = block(x, e[name], t[name], 2 if group and not b else 1)
        f = x.mean(axis=0)
        bank = p["bank"]
        heads = []
        weights = []
        for h in range(bank["query"]["bias"].shape[0]):
            q = f @ bank["query"]["kernel"][:, h] + bank["query"]["bias"][h]
            k = bank["prototypes"] @ bank["key"]["kernel"][:, h] + bank["key"]["bias"][h]
            v = bank["prototypes"] @ bank["value"]["kernel"][:, h] + bank["value"]["bias"][h]
            a = np.exp(k @ q / np.sqrt(len(q)))
            weights.append(a / a.sum())
            heads.append(weights[-1] @ v)
        h = (
            f
            + np.concatenate(heads) @ bank["output"]["kernel"].reshape(len(f), len(f))
            + bank["output"]["bias"]
        )
        linear = lambda q, h=h: h @ q["kernel"] + q["bias"]  # noqa: E731
        gate = np.tanh(linear(p["head"]["gate"]))
        displacement.append(np.log1p(np.exp(linear(p["head"]["scale"]))) * gate)
        log_std.append(linear(p["uncertainty"]["log_std"]))
        gates.append(gate)
        attention.append(weights)
    return tuple(map(np.array, (displacement, log_std, gates, attention)))


@pytest.mark.parametrize("samples", [100, 200])
def test_forward_against_numpy(samples):
    options = {"width": 8, "bank_size": 5}
    model, variables = models.create("gnio", **options), drawn(shapes(**options))
    windows = np.random.default_rng(1).standard_normal((2, samples, 6)).astype(np.float32)
    found = quick(model.apply)(variables, windows)
    displacement, log_std, gate, attention = numpy_forward(variables, windows)
    np.testing.assert_allclose(found.displacement, displacement, rtol=2e-4, atol=2e-5)
    np.testing.assert_allclose(found.log_std, log_std, rtol=2e-4, atol=2e-5)
    np.testing.assert_allclose(found.diagnostics["gate"], gate, rtol=2e-4, atol=2e-5)
    np.testing.assert_allclose(found.diagnostics["attention"], attention, rtol=2e-4, atol=2e-6)


SCALES = {
    "softplus": lambda x: np.log1p(np.exp(x)),
    "pos_elu": lambda x: np.where(x > 0, x + 1, np.exp(np.minimum(x, 0))),
    "abs": np.abs,
    "exp": np.exp,
    "linear": lambda x: x,
}
GATES = {"tanh": np.tanh, "sigmoid": lambda x: 1 / (1 + np.exp(-x))}


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("gate", GATES)
def test_gates_and_scales(gate, scale):
    from gnio_jax.models.heads import GatedHead

    head = GatedHead(gate, scale)
    random = np.random.default_rng(0)
    h = random.standard_normal((4, 16)).astype(np.float32)
    variables = jax.tree.map(
        lambda leaf: 0.3 * random.standard_normal(leaf.shape).astype(leaf.dtype),
        jax.eval_shape(head.init, jax.random.key(1), h),
    )
    displacement, seen = quick(head.apply)(variables, h)
    linear = lambda q: np.asarray(h, np.float64) @ np.asarray(q["kernel"]) + np.asarray(q["bias"])  # noqa: E731
    s, g = (
        SCALES[scale](linear(variables["params"]["scale"])),
        GATES[gate](linear(variables["params"]["gate"])),
    )
    np.testing.assert_allclose(displacement, s * g, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(seen["gate"], g, rtol=1e-4, atol=1e-5)


def test_a_new_network_predicts_that_it_stands_still(fresh):
    prediction, _ = trained_once(fresh, noise())
    assert np.abs(prediction.displacement).max() < 0.1


@pytest.mark.parametrize(
    "options", [{}, {"scale": "abs"}, {"head": "linear", "bank_size": 0}], ids=str
)
def test_gradient_is_finite_where_everything_is_zero(options):
    """Zero input, zero parameters, zero gate, |0| as scale."""
    model = models.create("gnio", width=8, **options)
    still = jnp.zeros((2, 32, 6), jnp.float32)
    variables = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(model.init, jax.random.key(0), still),
    )
    gradient = quick(jax.grad(lambda v: jnp.sum(model.apply(v, still).displacement)))(variables)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_training_mode_updates_the_statistics_with_momentum(fresh):
    windows = noise(3.0)
    _, changed = trained_once(fresh, windows)
    stem = quick(lambda x, kernel: convolve(x, kernel, (2,), [(3, 3)]))
    kernel = fresh["params"]["encoder"]["stem_conv"]["kernel"]
    expected = 0.1 * np.asarray(stem(windows, kernel)).mean(axis=(0, 1))
    np.testing.assert_allclose(
        changed["batch_stats"]["encoder"]["stem_bn"]["mean"], expected, rtol=1e-4, atol=1e-5
    )


def test_keys_and_values_are_projected_once_per_call():
    """Cost of the compiled program: the multiply-adds of a window counted by hand, the bank's
    projections not repeated per window."""

    def products(length, size, stride, channels, features):  # those that do not meet the padding
        before = (size - 1) // 2
        outputs = (length + 2 * before - size) // stride + 1
        inside = sum(
            0 <= i * stride + j - before < length for i in range(outputs) for j in range(size)
        )
        return inside * channels * features, outputs

    total, length = products(200, 7, 2, 6, 64)
    length, channels = (length - 1) // 2 + 1, 64
    for features, stride in ((64, 1), (128, 2), (256, 2), (512, 2)):
        shortcut = 0 if stride == 1 else products(length, 1, stride, channels, features)[0]
        first, length = products(length, 3, stride, channels, features)
        total += first + shortcut + 3 * products(length, 3, 1, features, features)[0]
        channels = features
    total += (
        2 * 512 * 512 + 2 * 64 * 512 + 3 * 3 * 512
    )  # the bank's query, output, scores and context, and the heads
    model = models.create("gnio")
    variables = shapes()

    def flops(batch):
        lowered = jax.jit(model.apply).lower(
            variables, jax.ShapeDtypeStruct((batch, 200, 6), jnp.float32)
        )
        return lowered.cost_analysis()["flops"]

    per_window = (flops(65) - flops(1)) / 64
    assert per_window == pytest.approx(2 * total, rel=0.02)
    assert flops(1) - per_window == pytest.approx(2 * 2 * 64 * 512 * 512, rel=0.05)


def test_a_frozen_network_does_not_project_the_bank_again():
    model = models.create("gnio", width=4, bank_size=16)
    variables, windows = (
        drawn(models.variable_shapes(model, 64)),
        jnp.zeros((1, 64, 6), jnp.float32),
    )

    def operations(apply, given):
        return quick(apply).lower(given, windows).compile().cost_analysis()["flops"]

    saved = operations(model.apply, variables) - operations(
        models.Inference(model), models.inference_variables(model, variables)
    )
    assert saved >= 2 * 2 * 16 * 32 * 32  # two projections of 16 prototypes of 32 features


def test_first_parameters_are_those_of_flax_and_another_seed_compiles_nothing(fresh, caplog):
    def drawn(seed):
        model = models.create("gnio", width=2, bank_size=4)
        return models.initialise(model, jax.random.key(seed), 64)

    variables = fresh
    with jax.log_compiles(), caplog.at_level("WARNING"):
        other = drawn(1)
    assert not [line for line in caplog.messages if "Compiling" in line]
    of = lambda found: found["params"]["bank"]["prototypes"]  # noqa: E731
    assert not np.array_equal(of(variables), of(other))
    wanted = quick(SMALL.init)(jax.random.key(0), jnp.zeros((1, 64, 6), jnp.float32))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), variables, wanted)
    shapes = models.variable_shapes(SMALL, 64)
    assert jax.tree.structure(shapes) == jax.tree.structure(variables)
    for shape, leaf in zip(*map(jax.tree.leaves, (shapes, variables)), strict=True):
        assert (shape.shape, shape.dtype) == (leaf.shape, leaf.dtype)


def test_constant_uncertainty_leaves_the_displacement_as_it_is(fresh):
    constant = SMALL.clone(uncertainty="constant")
    params = {name: part for name, part in fresh["params"].items() if name != "uncertainty"}
    log_std = np.array([-1.0, -2.0, -3.0], np.float32)
    given = {
        "params": params,
        "batch_stats": fresh["batch_stats"] | {"uncertainty": {"log_std": log_std}},
    }
    assert jax.tree.structure(given) == jax.tree.structure(models.variable_shapes(constant, 64))
    windows = noise()[:2]
    found, of_plain = quick(constant.apply)(given, windows), quick(SMALL.apply)(fresh, windows)
    np.testing.assert_array_equal(found.displacement, of_plain.displacement)
    np.testing.assert_array_equal(found.log_std, [log_std, log_std])
    frozen = models.inference_variables(constant, given)
    np.testing.assert_allclose(
        quick(models.Inference(constant))(frozen, windows).displacement,
        found.displacement,
        atol=1e-6,
    )
