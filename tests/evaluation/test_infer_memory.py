"""A network with memory along whole recordings, against the same network step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import DataConfig
from gnio_jax.evaluation import estimate, infer
from gnio_jax.evaluation.estimate import integrate
from gnio_jax.filtering import make_filter
from gnio_jax.models import Network
from tests.support.compiling import quick
from tests.support.estimators import OPTIONS, RATE, ready, rotations
from tests.support.networks import SMALL, drawn

CONFIG = DataConfig(rate=RATE)
N, W = CONFIG.stride, CONFIG.window // CONFIG.stride


def drawn_network(equivariance="none"):
    options = {"bank_size": 3, "head": "gated", "equivariance": equivariance}
    model = models.create("ronin_tcn", **options, **SMALL["ronin_tcn"])
    return Network.of(model, drawn({"batch_stats": {}, **models.variable_shapes(model, N)}))


NETWORK = drawn_network()


def stepwise(network, recording, strides, axes):
    """Displacements in the yaw frame of each window's start, with the attitude of the
    recording. The axes of the body, in the body, come after the samples."""
    predict = network.predict()
    step, memory, rows = quick(predict.step), predict.begin(), []
    for k in strides:
        samples = slice(k * N, k * N + N)
        of_body = np.tile(axes, (N, 1))
        signals = np.concatenate(
            [recording.accel[samples], recording.gyro[samples], of_body], axis=1
        )
        poses = recording.attitude[k * N : k * N + N + 1].transpose(1, 2, 0)
        memory, prediction = step(memory, jnp.asarray(signals), jnp.asarray(poses))
        start = recording.attitude[max(k * N + N - CONFIG.window, 0)]
        turn = np.arctan2(*memory.heading[::-1]) - np.arctan2(start[1, 0], start[0, 0])
        prediction = jax.device_get(prediction)
        matrix = Rotation.from_euler("z", float(turn)).as_matrix()
        covariance = matrix @ np.diag(np.exp(2 * prediction.log_std)) @ matrix.T
        rows.append((matrix @ prediction.displacement, covariance, prediction.diagnostics["gate"]))
    return rows


@pytest.mark.parametrize(
    "rotation, equivariance, axes",
    [
        ("per_sample", "none", []),
        ("body_axes", "device_heading", [1, 0, 0, 0, 1, 0]),
        ("hidden_axes", "device_heading", [0, 0, 0, 0, 0, 0]),
    ],
)
def test_each_stretch_is_one_run_with_a_memory_of_its_own(walks, rotation, equivariance, axes):
    """Behind a sample that was not measured the memory is empty."""
    network, config = drawn_network(equivariance), DataConfig(rate=RATE, window_rotation=rotation)
    measured = np.ones(len(walks[0].time), bool)
    measured[203] = False
    sequence = walks[0]._replace(imu_valid=measured)
    (recording,) = ready([sequence], config, orientation="reference")
    (displacements,) = infer(network, [recording], config)
    turns = rotations(walks[0].orientation).as_matrix()
    np.testing.assert_allclose(recording.attitude[:50], turns[:50], atol=1e-9)
    hole, last = 203 // N, recording.strides
    for strides in (range(hole), range(hole + 1, last)):
        rows = stepwise(network, recording, strides, axes)
        for k, (value, covariance, gate) in zip(strides, rows, strict=True):
            if k - strides.start < W - 1:
                assert (
                    np.isnan(displacements.value[k]).all()
                    and np.isnan(displacements.covariance[k]).all()
                )
                continue
            np.testing.assert_allclose(displacements.value[k], value, atol=2e-3)
            np.testing.assert_allclose(
                displacements.covariance[k], covariance, atol=2e-3, rtol=2e-3
            )
            np.testing.assert_allclose(displacements.diagnostics["gate"][k], gate, atol=2e-3)
    assert np.isnan(displacements.value[hole]).all() and set(displacements.diagnostics) == {
        "gate",
        "scale",
    }
    assert np.isfinite(integrate(recording, displacements, config).trajectory.position).all()


def test_the_filter_runs_with_it_over_several_recordings(walks):
    recordings = ready(walks[:2], CONFIG)
    ekf = make_filter(CONFIG, OPTIONS)
    together = estimate(recordings, NETWORK, CONFIG, ekf)
    for one, recording in zip(together, recordings, strict=True):
        (alone,) = estimate([recording], NETWORK, CONFIG, ekf)
        np.testing.assert_allclose(
            one.trajectory.position, alone.trajectory.position, rtol=1e-3, atol=1e-3
        )
        measured = np.isfinite(one.displacements.value).all(1)
        np.testing.assert_array_equal(np.flatnonzero(measured)[0], W + 1)
        diagnostics = one.displacements.diagnostics
        assert measured[W + 1 :].all() and set(diagnostics) == {"gate", "scale"}
        np.testing.assert_array_equal(np.isfinite(diagnostics["gate"]).all(1), measured)
