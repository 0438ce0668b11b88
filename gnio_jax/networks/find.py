"""Trained networks by their names: those that come with gnio-jax, those in the folders of
$GNIO_WEIGHTS, and the runs below runs/."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from gnio_jax.config import FilterSettings
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.models.airimu import Corrector
from gnio_jax.networks.folder import (
    CONFIG,
    WEIGHTS,
    TrainedNetwork,
    name_of,
    read_network,
    read_settings,
)

SHIPPED = Path(__file__).parents[1] / "weights"
"""The networks that come with gnio-jax."""
VARIABLE = "GNIO_WEIGHTS"
"""Variable with the folders that contain networks, separated as in $PATH."""


def is_network(path: Path) -> bool:
    """Whether a folder or file is meant to be a network; its content is not checked."""
    return (path.is_file() and path.suffix == ".zip") or (path / CONFIG).is_file()


def list_networks() -> dict[str, Path]:
    """Networks by name (that of the folder, or of the zip without its suffix), those of gnio-jax
    first. Raises `InputError` for a folder of $GNIO_WEIGHTS that is missing."""
    folders = [Path(folder) for folder in os.environ.get(VARIABLE, "").split(os.pathsep) if folder]
    networks: dict[str, Path] = {}
    for folder in (SHIPPED, *folders):
        if not folder.is_dir():
            problem = f"'{folder}' is not a folder"
            raise InputError(f"${VARIABLE}", problem, "name folders that contain networks")
        for path in sorted(folder.iterdir()):
            if is_network(path) and (path.is_file() or (path / WEIGHTS).is_file()):
                networks.setdefault(name_of(path), path)
    return networks


def find_network(network: str | Path | None = None) -> Path:
    """The folder or zip of a network: a path, or a name of `list_networks`. None: the first one of
    gnio-jax, else the newest run below runs/. Raises `InputError` if it is none of these."""
    networks = list_networks()
    if network is None:
        shipped = [path for path in networks.values() if path.parent == SHIPPED]
        return shipped[0] if shipped else newest_run()
    if not isinstance(network, str | os.PathLike):
        kind = type(network).__name__
        raise InputError("network", f"is a {kind}", "give its folder, its zip or its name")
    path = Path(network)
    if is_network(path):
        return path
    if str(network) in networks:
        return networks[str(network)]
    if path.exists():
        raise InputError(path, f"holds no network ({CONFIG} is missing)", "train one: gnio train")
    choices = f"known names: {', '.join(networks) or 'none'}; give a folder, a zip or a name"
    raise InputError(network, "no such network", did_you_mean(str(network), networks) + choices)


def load(network: str | Path | None = None) -> TrainedNetwork:
    """The network of `network` with its variables and configuration.

    Args:
        network: a folder, a zip, or the name of a network in gnio-jax or in a folder of
            $GNIO_WEIGHTS; None is the default of `gnio track`.

    `TrainedNetwork.model.apply(variables, windows)` gives a `Prediction` of windows (b, N, 6),
    float32, [accel m/s², gyro rad/s] in the gravity frame at `config.data.rate`; `config.filter`
    has the calibrated or trained settings of the filter. Raises `InputError`.
    """
    return read_network(find_network(network))


def load_corrector(
    settings: FilterSettings, rate: float, network: TrainedNetwork | None = None
) -> Corrector | None:
    """The corrector that the settings of a filter name; None if they name none.

    If the settings of `network` name the same one and it was written with the network, it is that.
    Raises `InputError` for a network that does not exist or has no corrector, and for one of
    another rate than `rate`, Hz.
    """
    name = settings.corrector
    if name is None:
        return None
    if (carried := _carried_corrector(name, network)) is not None:
        return Corrector(carried)
    trained = load(name)
    if trained.config.model.corrector == "none":
        problem = f"names '{name}', a network without a corrector"
        raise InputError("filter.corrector", problem, "name one with model.corrector: airimu")
    if trained.config.data.rate != rate:
        problem = f"names '{name}', whose corrector works at {trained.config.data.rate:g} Hz"
        raise InputError("filter.corrector", problem, f"name one of {rate:g} Hz, as data.rate")
    parts = {kind: tree["corrector"] for kind, tree in trained.variables.items()}
    return Corrector(parts)


def digest_corrector(settings: FilterSettings, network: TrainedNetwork) -> str | None:
    """SHA-256 of the weights of the network that the settings of a filter name for its corrector;
    None if they name none, or if its corrector comes with `network`, whose digest has it, too."""
    name = settings.corrector
    if name is None or _carried_corrector(name, network) is not None:
        return None
    return read_settings(find_network(name)).digest


def _carried_corrector(name: str, network: TrainedNetwork | None) -> Any:
    """The parts of the corrector of this name that were written with `network`; None if none
    were."""
    if network is None or network.config.filter.corrector != name:
        return None
    return network.corrector


def with_corrector(network: TrainedNetwork) -> TrainedNetwork:
    """The network with the variables of its corrector, as it is written for other people."""
    corrector = load_corrector(network.config.filter, network.config.data.rate, network)
    return network if corrector is None else network._replace(corrector=corrector.variables)


def newest_run(folder: str | Path = "runs") -> Path:
    """The run below `folder` that was trained last; calibrated copies of a run do not count. Raises
    `InputError` if there is none."""
    folders = [path.parent for path in Path(folder).glob(f"*/{CONFIG}")]
    runs = [run for run in folders if not (run / "calibration.json").exists()]
    if not runs:
        remedy = "train one with gnio train, or name a network with --network"
        raise InputError(folder, "holds no run", remedy)

    def last_trained(run: Path) -> float:
        files = (run / CONFIG, run / "metrics.jsonl")
        return max(path.stat().st_mtime for path in files if path.exists())

    return max(runs, key=last_trained)
