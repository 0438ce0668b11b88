"""A "network" that shows what it was given, and the setups that tests of estimators share."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.evaluation import Network, Setup
from gnio_jax.types import Prediction

RATE = 50.0
CONFIG = DataConfig(rate=RATE)
OPTIONS = FilterOptions()
INTEGRATE = Setup("integrate")
LOOSE = Setup(coupling="loose")


def sensed(variables, windows):
    """A "network" that shows what it was given: the means of its channels."""
    means = windows.mean(axis=1)
    diagnostics = {
        "gate": jnp.tanh(means[:, 3:]),
        "attention": jnp.zeros((windows.shape[0], 8, 64)),
    }
    return Prediction(
        variables["gain"] * means[:, :3], means[:, 3:] + variables["log_std"], diagnostics
    )


NETWORK = Network(sensed, {"gain": jnp.float32(0.05), "log_std": jnp.float32(-3.0)})


def rotations(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def unyaw(matrix):
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    return np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
