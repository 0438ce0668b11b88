"""Training's programs compile once per shape, whatever their values."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data.windows import WindowSource
from gnio_jax.training import task, window_task
from gnio_jax.training.losses import loss_stage
from gnio_jax.training.task import create_model
from gnio_jax.training.window_task import WindowTask
from tests.support.compiling import quick
from tests.support.drawn_state import fresh_state
from tests.support.tiny_network import Tiny

CONFIG = TrainConfig(
    data=DataConfig(rate=20.0),
    model=ModelConfig(width=1, bank_size=2),
    optim=OptimConfig(epochs=3, batch_size=2, warmup_epochs=1.0),
)
WINDOWS = 6


@pytest.fixture(autouse=True)
def trace_counts():
    """chex counts the traces of a function over the whole process."""
    chex.clear_trace_counter()


def source(seed):
    rng = np.random.default_rng(seed)
    rows = CONFIG.data.window + WINDOWS
    draw = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    number = np.arange(WINDOWS, dtype=np.int32)
    rotation = np.tile(np.eye(3, dtype=np.float32), (WINDOWS, 1, 1))
    unyaw = np.tile(np.float32([1, 0]), (WINDOWS, 1))
    displacement, step = draw(WINDOWS, 3), draw(rows, 3)
    recording = np.tile(np.int32([0, rows - 1]), (WINDOWS, 1))
    windows = draw(rows, 6), number, rotation, displacement, step, unyaw, recording, number
    return jax.device_put(WindowSource(*windows))


def once(function, **options):
    """Jitted, and an AssertionError where it is traced a second time."""
    return quick(chex.assert_max_traces(function.__wrapped__, n=1), **options)


def test_a_step_of_training_and_a_validation():
    """Other windows, another order, more steps, another learning rate, another stage."""
    with jax.enable_x64(False):
        model = Tiny()  # a trace of another is no different
        training = WindowTask(model, CONFIG, WINDOWS // 2)
        train = functools.partial(once(task.train_steps, static_argnames="task"), task=training)
        validate = once(window_task.validate, static_argnames="task")
        validate = functools.partial(validate, task=training)
        state = fresh_state(model, CONFIG, WINDOWS // 2, jax.random.key(0))
        for epoch, (first, count, factor) in enumerate([(0, 1, 1.0), (1, 2, 0.5)]):
            windows = source(epoch)
            order = training.order(jax.random.key(1), epoch, windows)
            numbers = jnp.int32(first), jnp.int32(count), jnp.float32(factor)
            state, progress = train(state, windows, order, *numbers, jax.random.key(2))
            found = validate(state, windows, loss_stage(CONFIG.loss, state.step, WINDOWS // 2))
            chex.assert_tree_all_finite((progress.sums, found.losses))
        assert int(state.step) == 3


def test_no_type_of_a_fresh_state_is_weak():
    """Steps give types that are none: the second one would be compiled anew."""
    with jax.enable_x64(False):
        create = functools.partial(fresh_state, create_model(CONFIG), CONFIG, WINDOWS // 2)
        fresh = jax.eval_shape(create, jax.random.key(0))
    assert not [leaf for leaf in jax.tree.leaves(fresh) if leaf.weak_type]
