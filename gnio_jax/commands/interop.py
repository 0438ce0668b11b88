"""`gnio interop`: other people's checkpoints as runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gnio_jax.commands.options import Command, execute, sibling
from gnio_jax.config import DataConfig

DESCRIPTION = """Make a run of TLIO's trained weights, which `evaluate` reads like one of `train`.

  {prog} checkpoint_best.pt runs/tlio_public
  {prog} model_torchscript.pt runs/tlio_public --stride-seconds 0.1
  gnio evaluate --workdir runs/tlio_public --dataset tlio --data-root ~/tlio

The run's filter cuts the network's windows as TLIO's tracker does (filter.window_rotation).
CHECKPOINT is a checkpoint of TLIO's training, its model_torchscript.pt, or an .npz of its state
dict. Files of PyTorch need pip install gnio-jax[torch]."""


@dataclass(frozen=True)
class InteropOptions:
    """What `gnio interop` is asked for."""

    checkpoint: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="CHECKPOINT")]]
    """File of the weights."""
    workdir: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="WORKDIR")]]
    """Folder of the run, which is made."""
    rate: float = 200.0
    """Samples per second that the network was trained with, Hz (imu_freq in TLIO's
    parameters.json)."""
    window_seconds: float = 1.0
    """Length of its window, s (past_time + window_time there)."""
    stride_seconds: float = 0.05
    """Distance between window starts, and between the filter's clones, s (TLIO's filter: 0.05; the
    paper: 0.1)."""
    dataset: str = "tlio"
    """Dataset that `evaluate` takes where none is named."""


def write_run(options: InteropOptions, prog: str) -> None:
    """Write the run, and say what to do with it."""
    from gnio_jax import interop

    data = DataConfig(
        rate=options.rate,
        window_seconds=options.window_seconds,
        stride_seconds=options.stride_seconds,
    )
    interop.write_run(options.checkpoint, options.workdir, data, options.dataset)
    following = f"{sibling(prog, 'evaluate')} --workdir {options.workdir}"
    print(f"run: {options.workdir}; next: {following}")


COMMAND = Command(InteropOptions, write_run, DESCRIPTION)


def main(argv: Sequence[str] | None = None, prog: str = "gnio interop") -> None:
    """Read the options and write the run."""
    execute(COMMAND, argv, prog)
