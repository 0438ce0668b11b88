"""A run made of other people's weights, for `gnio evaluate`."""

from __future__ import annotations

import math
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.config import DataConfig, FilterSettings, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import replacing_folder
from gnio_jax.interop.layouts import load_state_dict
from gnio_jax.networks import TrainedNetwork, write_network


def write_run(weights: Path, workdir: Path, data: DataConfig, dataset: str = "tlio") -> None:
    """Make a run of the weights of TLIO, RoNIN or EqNIO that all commands read: config.yaml and
    weights.safetensors. The folder appears whole or not at all.

    `data` gives rate, window and stride that the network was trained with. The filter cuts windows
    as TLIO's tracker does for networks that were trained with it. RoNIN's predicts no uncertainty:
    its σ is 1 m until `gnio calibrate` fits it. Raises `InputError` for weights that do not fit, or
    a folder that exists already.
    """
    if workdir.exists():
        raise InputError(workdir, "exists already", "name another folder")
    model, variables, features = load_state_dict(weights)
    rotation = "tlio" if model.name == "tlio" else None
    settings = FilterSettings(window_rotation=rotation)
    config = TrainConfig(dataset=dataset, data=data, model=model, filter=settings)
    configuration.validate(config, "gnio interop")
    if features != math.ceil(data.window / 32):
        samples = f"{32 * features - 31} to {32 * features} samples"
        remedy = "give the --rate and --window-seconds that it was trained with"
        raise InputError(weights, f"is for windows of {samples}, not {data.window}", remedy)
    network = TrainedNetwork(config, models.from_config(model), variables, epoch=0, step=0)
    with replacing_folder(workdir) as new:
        write_network(new, network)
