"""Networks: windows of IMU samples in, `Prediction` out."""

from gnio_jax.models.registry import create, names

__all__ = ["create", "names"]
