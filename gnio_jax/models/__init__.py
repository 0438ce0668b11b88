"""Networks: windows of IMU samples in, `Prediction` out."""

from gnio_jax.models.inference import Inference, InferenceVariables, Network, inference_variables
from gnio_jax.models.registry import (
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
    "create",
    "from_config",
    "inference_variables",
    "initialise",
    "names",
    "register",
    "variable_shapes",
]
