"""Networks, which map windows of IMU samples to a `Prediction`. Some of them also carry a memory
from one clone interval to the next (`models.memory`)."""

from gnio_jax.models.inference import Inference, InferenceVariables, Network, inference_variables
from gnio_jax.models.registry import (
    channels,
    create,
    from_config,
    initialise,
    names,
    predicts_displacement,
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
    "predicts_displacement",
    "register",
    "variable_shapes",
]
