"""A "network" that shows what it was given, and the ways to a trajectory."""

import math

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import evaluation
from gnio_jax.config import DataConfig, FilterSettings, ModelConfig, TrainConfig
from gnio_jax.evaluation import infer, no_displacements, perfect, prepare, reference_displacements
from gnio_jax.evaluation.estimate import PERFECT_STD
from gnio_jax.filtering import make_filter
from gnio_jax.models import Network
from gnio_jax.types import NONHOLONOMIC_LOG_FACTOR, Prediction, Waypoints
from tests.support.filter_settings import changed

RATE = 50.0
CONFIG = DataConfig(rate=RATE, context_seconds=0.2)
OPTIONS = FilterSettings()
TRAINED = TrainConfig(
    data=CONFIG, model=ModelConfig(name="tiny"), filter=changed(start={"velocity": 0.7})
)
"""The configuration of a run of the smallest network."""


def sensed(variables, windows):
    """A "network" that shows what it was given: the means of its channels."""
    means = windows.mean(axis=1)
    diagnostics = {
        "gate": jnp.tanh(means[:, 3:]),
        "attention": jnp.zeros((windows.shape[0], 8, 64)),
    }
    displacement = variables["constant"] + variables["gain"] * means[:, :3]
    log_std = variables["log_std"] + variables["log_std_gain"] * means[:, 3:]
    return Prediction(displacement, log_std, diagnostics)


def network(gain, log_std, log_std_gain=1.0, constant=(0.0, 0.0, 0.0)):
    """`sensed` with these numbers: all of them share its programs."""
    named = {"gain": gain, "log_std": log_std, "log_std_gain": log_std_gain}
    named["constant"] = np.array([constant])
    return Network(sensed, {name: jnp.float32(value) for name, value in named.items()})


def with_factors(variables, windows):
    """`sensed` that trusts the non-holonomic constraint of a car four and two times as far."""
    prediction = sensed(variables, windows)
    log_factor = -jnp.log(jnp.tile(jnp.array([[4.0, 2.0]]), (len(windows), 1)))
    return prediction._replace(
        diagnostics={**prediction.diagnostics, NONHOLONOMIC_LOG_FACTOR: log_factor}
    )


NETWORK = network(0.05, -3.0)


def with_waypoints(sequence, times=(0.5, 4.0, 7.0, 10.0)):
    """A computed walk, of which waypoints alone are known."""
    rows = np.searchsorted(sequence.time - sequence.time[0], times)
    return sequence._replace(
        valid=np.zeros_like(sequence.valid),
        **{x: getattr(sequence, x) * np.nan for x in ("orientation", "position", "velocity")},
        waypoints=Waypoints(sequence.time[rows], sequence.position[rows, :2]),
    )


def ready(walks, config=CONFIG, **how):
    """The walks prepared, none of them left out; how: options of `prepare`."""
    recordings, left_out = prepare(walks, config, **how)
    assert not left_out
    return recordings


def relabel(recording):
    """The recording with other axes of the body, of which x is the one that is nearest to the
    vertical at the start, and the matrix from the old axes to them."""
    steep = int(np.argmax(np.abs(recording.start.rotation[2])))
    labels = np.roll(np.eye(3), -steep, axis=0)
    start = recording.start._replace(
        rotation=recording.start.rotation @ labels.T, gyro_bias=labels @ recording.start.gyro_bias
    )
    signals = {"gyro": recording.gyro @ labels.T, "accel": recording.accel @ labels.T}
    return recording._replace(start=start, **signals), labels


def tight(recordings, network=NETWORK, config=CONFIG, options=OPTIONS, **how):
    """The filter with the network in it; how: options of `estimate`."""
    return evaluation.estimate(recordings, network, config, make_filter(config, options), **how)


def loose(recordings, network=NETWORK, config=CONFIG, options=OPTIONS, **how):
    """The filter with displacements that were inferred before."""
    ekf = make_filter(config, options)
    displacements = infer(network, recordings, config, least_std=math.exp(ekf.config.log_std_min))
    return evaluation.estimate(recordings, displacements, config, ekf, **how)


def summed(recordings, network=NETWORK, config=CONFIG):
    """The sum of the network's displacements."""
    return evaluation.estimate(recordings, infer(network, recordings, config), config, None)


def imu_only(recordings, config=CONFIG, options=OPTIONS):
    """The filter without displacements."""
    nothing = [no_displacements(recording) for recording in recordings]
    return evaluation.estimate(recordings, nothing, config, make_filter(config, options))


def with_truth(recordings, config=CONFIG, options=OPTIONS, filtered=True, **how):
    """The filter, or the sum of displacements, with those of the reference."""
    truth = [reference_displacements(recording, PERFECT_STD) for recording in recordings]
    ekf = perfect(make_filter(config, options)) if filtered else None
    return evaluation.estimate(recordings, truth, config, ekf, **how)


def rotations(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def unyaw(matrix):
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    return np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
