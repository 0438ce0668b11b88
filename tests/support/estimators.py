"""A "network" that shows what it was given, and the setups that tests of estimators share."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.evaluation import Network, Setup
from gnio_jax.types import Prediction

RATE = 50.0
CONFIG = DataConfig(rate=RATE)
OPTIONS = FilterSettings()
INTEGRATE = Setup("integrate")
LOOSE = Setup(coupling="loose")


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


NETWORK = network(0.05, -3.0)


def rotations(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def unyaw(matrix):
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    return np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
