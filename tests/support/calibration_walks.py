"""Eight simulated walks as a calibration sees them."""

import functools

import numpy as np

from gnio_jax import filtering
from gnio_jax.config import DataConfig
from gnio_jax.evaluation import Displacements
from gnio_jax.evaluation.estimate import Inputs
from gnio_jax.evaluation.prepare import Start
from tests.support.filter_settings import changed
from tests.support.walks import simulate

DATA = DataConfig(rate=50.0, window_seconds=0.4, stride_seconds=0.1)
STRIDES, N, CLONES, SIGMA = 250, 5, 4, 0.05
TRUE = changed(
    noise={"gyro_density": 2e-3, "accel_density": 2e-2, "measurement_scale": 1.0},
    start={"gyro_bias": 1e-3},
)


@functools.cache
def _simulated():
    noise = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4)
    std = filtering.InitialStd(gyro_bias=1e-3)
    return simulate(5, 8, STRIDES, N, CLONES, 1 / DATA.rate, noise, std, SIGMA)


@functools.cache
def walks():
    """Their displacements err by `SIGMA`, while the network says a third of it."""
    runs = _simulated()
    std = filtering.InitialStd(*np.ones((6, 8)))  # a fit takes that of the settings
    start = Start(
        runs.rotation0, runs.velocity0, runs.position0, np.zeros((8, 3)), std, np.zeros(8, bool)
    )
    given = Displacements(runs.displacement, np.full_like(runs.displacement, SIGMA / 3))
    return Inputs(start, runs.gyro, runs.accel, None, given)


def walks_with_truth():
    """And the true positions after each stride, (8, STRIDES, 3)."""
    return walks(), _simulated().position.copy()


def first_strides(given, strides):
    """The walks up to there."""
    samples = {name: getattr(given, name)[:, : N * strides] for name in ("gyro", "accel")}
    rows = Displacements(*(each[:, :strides] for each in given.given[:2]))
    return given._replace(**samples, given=rows)
