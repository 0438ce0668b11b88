"""A run of GNIO at width 2, whose weights are drawn, and what is exported of it, once for all."""

import contextlib
import io
from collections import namedtuple
from pathlib import Path

import jax
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.apps.onnx.run import PACKAGES
from gnio_jax.commands import app
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.models import Network
from gnio_jax.networks import read_network
from gnio_jax.numerics import matrix_from_quaternion
from gnio_jax.types import GRAVITY
from tests.support import drawn_run
from tests.support.filter_settings import changed

CONFIG = TrainConfig(
    data=DataConfig(rate=20.0, stride_seconds=0.25),
    model=ModelConfig(name="gnio", width=2, bank_size=3),
    filter=changed(
        noise={"std_factor": (1.5, 1.0, 1.0)}, start={"velocity": 0.3, "gyro_bias": 1e-3}
    ),
)
SECONDS = 60.0
BIAS = np.array([0.02, -0.01, 0.03])
"""Of the gyro, rad/s."""


Walked = namedtuple("Walked", "gyro accel")
"""A second at rest and a pedestrian, a minute in all, by a gyro with a bias."""


def draw(random, kind, shape):
    """Weights that leave a network of so many layers alive."""
    if kind == "batch_stats":
        return random.uniform(0.5, 1.5, shape)
    return random.normal(0, 1.2 * max(1, np.prod(shape[:-1])) ** -0.5, shape)


def call(*arguments):
    """What `gnio` prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        app.main(list(map(str, arguments)))
    return printed.getvalue()


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    return drawn_run.save(tmp_path_factory.mktemp("trained") / "walk", CONFIG, draw)


@pytest.fixture(scope="package")
def package(run):
    """The odometry of the package over the walk, from a state made of its ekf."""
    loaded = read_network(run)
    ekf = filtering.make_filter(loaded.config.data, loaded.config.filter)
    network = Network.of(loaded.model, loaded.variables)

    def predict(windows):
        return network.apply(network.variables, windows)._replace(diagnostics={})

    @jax.jit
    def odometry(state, gyro, accel):
        return filtering.run_odometry(predict, ekf, state, gyro, accel)[1]

    return lambda start, *signals: odometry(start(ekf), *signals)


@pytest.fixture(scope="package")
def walked():
    rate = CONFIG.data.rate
    drawn, second = pedestrian(5, 5, seconds=SECONDS - 1, rate=rate), round(rate)
    gravity = matrix_from_quaternion(drawn.orientation[0]).T @ [0, 0, GRAVITY]
    gyro = np.concatenate([np.zeros((second, 3)), drawn.gyro])
    return Walked(gyro + BIAS, np.concatenate([np.tile(gravity, (second, 1)), drawn.accel]))


@pytest.fixture(scope="session")
def converter():
    """Packages of the export. Without them a test is skipped."""
    for name in PACKAGES:
        pytest.importorskip(name, reason="needs pip install 'gnio-jax[onnx]'")


@pytest.fixture(scope="package")
def models(converter, run):
    """Folder of the ONNX models, and what the command printed."""
    out = run.parent / "models"
    with pytest.MonkeyPatch.context() as patch:
        # jax2onnx checks itself after each operation over the whole graph: half of its time.
        check = "jax2onnx.converter.output_binding.assert_eqn_outputs_bound"
        patch.setattr(check, lambda *_, **__: None, raising=False)
        return Path(out), call("export", run, "--out", out)
