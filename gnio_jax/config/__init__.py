"""Static configuration: frozen dataclasses, strict YAML, checked once before anything is loaded.

One experiment is one YAML file of a `TrainConfig`; a run keeps its own as `config.yaml`. Options on
the command line win over the file, the file wins over the defaults, and the defaults are the
paper's.
"""

from gnio_jax.config.requests import CalibrateConfig, CompareConfig, EvaluateConfig, TablesConfig
from gnio_jax.config.runs import default_workdir, newest_run, with_seeds
from gnio_jax.config.schema import (
    CONSIDERED_FIELDS,
    AugmentConfig,
    DataConfig,
    FilterOptions,
    LossConfig,
    ModelConfig,
    OptimConfig,
    TrainConfig,
)
from gnio_jax.config.through_filter import ThroughFilter
from gnio_jax.config.validation import validate
from gnio_jax.config.yaml_files import find, load, names, parse, save, text

__all__ = [
    "CONSIDERED_FIELDS",
    "AugmentConfig",
    "CalibrateConfig",
    "CompareConfig",
    "DataConfig",
    "EvaluateConfig",
    "FilterOptions",
    "LossConfig",
    "ModelConfig",
    "OptimConfig",
    "TablesConfig",
    "ThroughFilter",
    "TrainConfig",
    "default_workdir",
    "find",
    "load",
    "names",
    "newest_run",
    "parse",
    "save",
    "text",
    "validate",
    "with_seeds",
]
