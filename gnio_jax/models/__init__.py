"""Networks, which map windows of IMU samples to a `Prediction`."""

from gnio_jax.models.inference import Inference, InferenceVariables, Network, inference_variables
from gnio_jax.models.registry import (
    channels,
    create,
    from_config,
    initialise,
    names,
    register,
    variable_shapes,
)

__all__ = [
    "Inference",
    "InferenceVariables",
    "Network",
    "channels",
    "create",
    "from_config",
    "inference_variables",
    "initialise",
    "names",
    "register",
    "variable_shapes",
]
