"""Networks, which map windows of IMU samples to a `Prediction`. Some of them also carry a memory
from one clone interval to the next (`models.memory`)."""

from gnio_jax.models.inference import Inference, InferenceVariables, Network, inference_variables
from gnio_jax.models.registry import (
    channels,
    check_experiment,
    create,
    fitted_options,
    frame_options,
    from_config,
    from_experiment,
    initialise,
    innermost,
    names,
    predicts_displacement,
    quantities,
    register,
    trained_by,
    variable_shapes,
)

__all__ = [
    "Inference",
    "InferenceVariables",
    "Network",
    "channels",
    "check_experiment",
    "create",
    "fitted_options",
    "frame_options",
    "from_config",
    "from_experiment",
    "inference_variables",
    "initialise",
    "innermost",
    "names",
    "predicts_displacement",
    "quantities",
    "register",
    "trained_by",
    "variable_shapes",
]
