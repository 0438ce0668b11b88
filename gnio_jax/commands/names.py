"""The names of the package's networks and datasets, which the commands know before JAX is
imported: a mistake does not wait for it."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from importlib.metadata import entry_points
from os import environ

from gnio_jax import plugins
from gnio_jax.errors import InputError, did_you_mean

NETWORKS = {
    "gnio": "the paper's: ResNet-18 with a Motion Bank and a gated head",
    "tlio": "ResNet-18 with a head for the covariance (Liu et al. 2020)",
    "ronin_resnet": "ResNet-18 for a velocity in 2-D (Herath et al. 2020)",
    "ronin_lstm": "three LSTM layers with memory (Herath et al. 2020)",
    "ronin_tcn": "dilated causal convolutions with memory (Herath et al. 2020)",
    "deepils": "separable convolutions with channel and time attention, small",
    "ctin": "a contextual transformer with two branches (Rao et al. 2022)",
    "imot": "an inertial motion transformer (Nguyen et al. 2025)",
    "imot_text": "the same, in those details in which its text differs",
    "ai_imu": "how far a car's constraint is to be trusted, no displacement (Brossard et al. 2020)",
    "airio": "velocities in the body's axes, with the attitude as an input (Qiu et al. 2025)",
    "ionet": "a bidirectional LSTM for polar displacements (Chen et al. 2018)",
    "ionext": "convolutions that choose between three sizes of kernel (arXiv 2507.17089)",
    "trunk": "one trunk with four kinds of block, for ideas published without sizes (ours)",
    "experts": "a ResNet-18 each for low and high speed, chosen by a router (ours)",
    "ridi": "support vectors on features of the window (Yan et al. 2018)",
    "gru": "a gated recurrent unit with memory, the smallest (ours)",
    "state_space": "a state-space network with memory (ours)",
}
"""Networks of --model.name, in the order of the help, and what each is."""
DATASETS = ("blackbird", "comma2k19", "csv", "euroc", "idol", "indoor_location", "kitti")
DATASETS += ("onavdata", "oxiod", "pedlocdata", "ridi", "ronin", "synthetic", "tlio", "tumvi")
DATASETS += ("tyrex",)
"""Datasets of --dataset."""


def check_names(networks: Iterable[str] = (), datasets: Iterable[str] = ()) -> None:
    """Raise `InputError` for a network or dataset that does not exist.

    Names are not checked where a plugin, or the program that has imported JAX, may have added
    others: the registries check them later.
    """
    added = "jax" in sys.modules or environ.get(plugins.VARIABLE)
    if added or entry_points(group=plugins.GROUP):
        return
    for kind, names, choices in (("model", networks, NETWORKS), ("dataset", datasets, DATASETS)):
        for name in names:
            if name not in choices:
                remedy = f"{did_you_mean(name, choices)}known {kind}s: {', '.join(choices)}"
                raise InputError(kind, f"unknown name '{name}'", remedy)
