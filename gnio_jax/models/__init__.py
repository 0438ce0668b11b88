"""Networks: windows of IMU samples in, `Prediction` out."""

from gnio_jax.models.inference import Inference, InferenceVariables, inference_variables
from gnio_jax.models.registry import create, initialise, names, register, variable_shapes

__all__ = [
    "Inference",
    "InferenceVariables",
    "create",
    "inference_variables",
    "initialise",
    "names",
    "register",
    "variable_shapes",
]
