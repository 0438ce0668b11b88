"""gnio-jax: Gated Neural Inertial Odometry in JAX. See README.md.

The rooms are imported when they are first used: `from gnio_jax import data, filtering, models`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any

__all__ = [
    "__version__",
    "apps",
    "calibration",
    "config",
    "data",
    "evaluation",
    "filtering",
    "geometry",
    "interop",
    "load_pretrained",
    "models",
    "networks",
    "tables",
    "track",
    "training",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("gnio-jax")
    if name == "load_pretrained":
        return importlib.import_module("gnio_jax.networks").load
    if name == "track":
        return importlib.import_module("gnio_jax.apps.arrays").track
    if name in __all__:
        return importlib.import_module(f"gnio_jax.{name}")
    raise AttributeError(f"module 'gnio_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
