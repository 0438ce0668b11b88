"""Whether a device looks where its carrier walks, with a network whose displacement is the mean of
the horizontal acceleration."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.apps import heading
from gnio_jax.apps.summary import _warnings_of_heading
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import prepare
from gnio_jax.models import registry
from gnio_jax.networks import TrainedNetwork
from gnio_jax.types import Prediction, Sequence

RATE = 20
CONFIG = TrainConfig(
    data=DataConfig(rate=float(RATE), stride_seconds=0.2, window_rotation="body_axes"),
    model=ModelConfig(name="pushed", equivariance="device_heading"),
)


class Pushed(nn.Module):
    @nn.compact
    def __call__(self, windows, train=False):
        level = windows[..., :3].mean(axis=1) * jnp.float32([[1, 1, 0]])
        return Prediction(level, jnp.zeros_like(level), {})


@pytest.fixture(scope="module")
def trained():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "pushed", Pushed)
        model = models.from_config(CONFIG.model)
        variables = {"params": {"facing_up": jnp.zeros(6, jnp.float32)}}
        yield TrainedNetwork(CONFIG, model, variables, 0, 0)


def pushed(angle, tilt, seconds=10, yaw=2.0, size=1.0):
    """A device that is tilted about its x axis, whose y axis looks along `yaw` and which is pushed
    `angle` degrees to the left of it."""
    count = seconds * RATE + 1
    attitude = Rotation.from_euler("ZX", [yaw - np.pi / 2, np.radians(tilt)])
    way = yaw + np.radians(angle)
    force = attitude.inv().apply([size * np.cos(way), size * np.sin(way), 9.81])
    sequence = Sequence(
        name="pushed",
        time=np.arange(count) / RATE,
        gyro=np.zeros((count, 3)),
        accel=np.tile(force, (count, 1)),
        orientation=np.tile(attitude.as_quat(scalar_first=True), (count, 1)),
        position=np.zeros((count, 3)),
        velocity=np.zeros((count, 3)),
        valid=np.ones(count, bool),
    )
    (ready,), _ = prepare([sequence], CONFIG.data, orientation="filter")
    return ready


@pytest.mark.parametrize("angle", [0.0, 70.0, -120.0])
def test_the_angle_is_from_the_y_axis_to_the_left(trained, angle):
    ready = pushed(angle, tilt=40.0)
    assert heading.angle_beside(ready, trained) == pytest.approx(angle, abs=1e-2)
    warnings = _warnings_of_heading(ready, trained)
    if abs(angle) < heading.BESIDE:
        assert warnings == []
        return
    side = "left" if angle > 0 else "right"
    (warning,) = warnings
    assert f"walks {abs(angle):.0f}° to the {side}" in warning and "--heading gait" in warning
    assert _warnings_of_heading(ready, heading.without_heading(trained)) == []


@pytest.mark.parametrize(
    "ready",
    [{"tilt": 80.0}, {"tilt": 150.0}, {"tilt": 20.0, "size": 0.1}, {"tilt": 20.0, "seconds": 2}],
    ids=["upright", "face down", "at rest", "short"],
)
def test_there_is_no_angle(trained, ready):
    ready = pushed(90.0, **ready)
    if len(ready.gyro) < 3 * RATE:
        ready = ready._replace(time=ready.time[:6], gyro=ready.gyro[:RATE])
    assert np.isnan(heading.angle_beside(ready, trained))
    assert _warnings_of_heading(ready, trained) == []


def test_only_a_network_that_sees_the_axes_does_without(trained):
    alone = heading.without_heading(trained)
    assert alone.config.filter.window_rotation == "hidden_axes"
    models.check_experiment(alone.model, alone.config)
    model = dataclasses.replace(CONFIG.model, equivariance="none")
    plain = alone._replace(model=models.from_config(model))
    for config in (
        dataclasses.replace(alone.config, model=model),
        dataclasses.replace(CONFIG, model=ModelConfig(name="airio"), filter=alone.config.filter),
    ):
        with pytest.raises(InputError, match="window_rotation"):
            models.check_experiment(models.from_config(config.model), config)
    for network in (alone, plain):
        with pytest.raises(InputError, match=r"^--heading gait: .*does not use the heading"):
            heading.without_heading(network)
