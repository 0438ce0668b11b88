"""Networks: windows of IMU samples in, `Prediction` out."""

from gnio_jax.models.inference import Frozen, Inference, freeze
from gnio_jax.models.registry import create, initialise, names

__all__ = ["Frozen", "Inference", "create", "freeze", "initialise", "names"]
