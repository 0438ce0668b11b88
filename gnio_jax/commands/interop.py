"""`gnio interop`: other people's checkpoints as runs."""

from __future__ import annotations

from gnio_jax.commands import console as cli
from gnio_jax.interop import ImportOptions, write_run
from gnio_jax.interop.tlio import PROGRAM

DESCRIPTION = f"""Make a run of TLIO's trained weights, which evaluate.py reads like one of train.py.

  {PROGRAM} checkpoint_best.pt runs/tlio_public
  {PROGRAM} model_torchscript.pt runs/tlio_public --stride-seconds 0.1
  python evaluate.py --workdir runs/tlio_public --dataset tlio --data-root ~/tlio

The run's filter cuts the network's windows as TLIO's tracker does (filter.window_rotation). CHECKPOINT is a checkpoint of TLIO's training,
its model_torchscript.pt, or an .npz of its state dict. Files of PyTorch need pip install gnio-jax[torch]."""


def main() -> None:
    """The command line."""
    options = cli.parse(ImportOptions, description=DESCRIPTION, prog=PROGRAM)
    write_run(options)
    print(f"run: {options.workdir}; next: python evaluate.py --workdir {options.workdir}")
