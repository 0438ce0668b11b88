"""Static configuration: frozen dataclasses, strict YAML, checked once before anything is loaded.

One experiment is one YAML file of a `TrainConfig`; a run keeps its own as `config.yaml`. Options on
the command line win over the file, the file wins over the defaults, and the defaults are the
paper's.
"""

from gnio_jax.config.files import (
    assign,
    default_workdir,
    find,
    flat,
    load,
    names,
    newest_run,
    parse,
    plain,
    read,
    save,
    text,
    validate,
    value_from_words,
    with_seeds,
    without_places,
)
from gnio_jax.config.requests import (
    CalibrateConfig,
    CompareConfig,
    EvaluateConfig,
    ImportOptions,
    TablesConfig,
)
from gnio_jax.config.schema import (
    AugmentConfig,
    ConsideredStd,
    CorrelatedError,
    DataConfig,
    FilterSettings,
    InitialStd,
    LossConfig,
    ModelConfig,
    NoiseModel,
    OptimConfig,
    ThroughFilter,
    TrainConfig,
)

__all__ = [
    "AugmentConfig",
    "CalibrateConfig",
    "CompareConfig",
    "ConsideredStd",
    "CorrelatedError",
    "DataConfig",
    "EvaluateConfig",
    "FilterSettings",
    "ImportOptions",
    "InitialStd",
    "LossConfig",
    "ModelConfig",
    "NoiseModel",
    "OptimConfig",
    "TablesConfig",
    "ThroughFilter",
    "TrainConfig",
    "assign",
    "default_workdir",
    "find",
    "flat",
    "load",
    "names",
    "newest_run",
    "parse",
    "plain",
    "read",
    "save",
    "text",
    "validate",
    "value_from_words",
    "with_seeds",
    "without_places",
]
