"""The model card of a package: README.md, for people."""

from __future__ import annotations

from typing import Any, NamedTuple

from gnio_jax.config import TrainConfig
from gnio_jax.pretrained import figures
from gnio_jax.pretrained.arrays import StorageLoss
from gnio_jax.pretrained.package import About


class Description(NamedTuple):
    """What only the publisher knows."""

    name: str
    data: str
    """What the network was trained on: recordings, devices, people, carrying positions."""
    license: str
    """Under which the data may be used and the weights passed on."""
    fails: tuple[str, ...] = ()
    """Where it is known to fail, a sentence each."""


class Origin(NamedTuple):
    """Where the weights are from."""

    calibrated: bool
    begun_with: str
    """Name of the run whose weights training began with; empty if they were drawn."""
    loss: StorageLoss


def text(
    said: Description,
    about: About,
    config: TrainConfig,
    origin: Origin,
    evaluations: dict[str, dict[str, Any]],
) -> str:
    """README.md."""
    parts = [
        [f"# {said.name}"],
        [_summary(about, config)],
        ["```", f"gnio track RECORDING --weights {said.name}", "```"],
        ["## Data and licence", "", f"Trained on: {said.data}", "", f"Licence: {said.license}"],
        ["## Recipe", "", *_recipe(said, config, origin)],
        ["## Figures", "", *figures.table(evaluations)],
        ["## Where it fails", "", *_failures(said.fails)],
        ["## Storage", "", _storage(about, origin.loss)],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _summary(about: About, config: TrainConfig) -> str:
    windows = config.data
    return (
        f"Network `{about.network}` for neural inertial odometry by {about.made_by}: "
        f"windows of {windows.window_seconds:g} s at {windows.rate:g} Hz, a displacement every "
        f"{windows.stride_seconds:g} s. Epoch {about.epoch}, step {about.step}."
    )


def _recipe(said: Description, config: TrainConfig, origin: Origin) -> list[str]:
    train = f"gnio train --config config.yaml --workdir runs/{said.name}"
    if origin.begun_with:
        train += f" --init-from runs/{origin.begun_with}"
    lines = ["```", train]
    if origin.calibrated:
        lines.append(f"gnio calibrate --workdir runs/{said.name}")
    lines += ["```", "", f"Dataset `{config.dataset}`, seed {config.seed}; all settings are in "]
    lines[-1] += "config.yaml, with the filter's options as they are used."
    considered = [name for name, std in config.filter.considered._asdict().items() if std > 0]
    if considered:
        lines += ["", f"The filter's covariance counts errors in: {', '.join(considered)}."]
    return lines


def _failures(fails: tuple[str, ...]) -> list[str]:
    if not fails:
        return ["Its publisher has not said. Try it on recordings like yours before you trust it."]
    return [f"- {each}" for each in fails]


def _storage(about: About, loss: StorageLoss) -> str:
    if about.storage == "float32":
        return "Weights are stored as they were trained, in float32."
    return (
        f"Parameters are stored in float16, which changes a displacement by up to "
        f"{1000 * loss.displacement:.3g} mm and its standard deviation by up to "
        f"{100 * loss.std:.2g} %, over drawn windows."
    )
