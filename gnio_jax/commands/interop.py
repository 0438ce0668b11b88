"""`gnio interop`: runs from checkpoints of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gnio_jax.commands import options
from gnio_jax.config import DataConfig
from gnio_jax.config.schema import UNNAMED, Positive


@dataclass(frozen=True)
class InteropOptions:
    checkpoint: Annotated[Path, UNNAMED]
    """File of the weights."""
    workdir: Annotated[Path, UNNAMED]
    """Folder of the new run."""
    rate: Positive = 200.0
    """Rate at which the network was trained, Hz (imu_freq in TLIO's parameters.json)."""
    window_seconds: Positive = 1.0
    """Length of its window, s (past_time + window_time there)."""
    stride_seconds: Positive = 0.05
    """Distance between window starts, and between the filter's clones, s (TLIO's filter: 0.05; the
    paper: 0.1)."""
    dataset: str = "tlio"
    """Dataset that gnio evaluate uses if none is named."""


def interop(request: InteropOptions, _call: options.Call) -> None:
    """Make a run from weights that were trained with the code of TLIO, RoNIN or EqNIO, for gnio
    evaluate.

    CHECKPOINT is a checkpoint of their training, TLIO's model_torchscript.pt, or an .npz of a state
    dict; files of PyTorch need pip install 'gnio-jax[torch]'. RoNIN's is its ResNet-18, EqNIO's one
    of its frames around TLIO or RoNIN. For weights of TLIO's kind the run's filter cuts windows as
    TLIO's tracker does (filter.window_rotation).

    examples:
      {prog} checkpoint_best.pt runs/tlio_public
      {prog} model_torchscript.pt runs/tlio_public --stride-seconds 0.1
      {prog} ronin_resnet/checkpoint_gsn_latest.pt runs/ronin_public --dataset ronin
      gnio evaluate --network runs/tlio_public --dataset tlio --data-root ~/tlio
    """
    from gnio_jax import interop as weights  # late: mistakes do not wait for JAX

    data = DataConfig(
        rate=request.rate,
        window_seconds=request.window_seconds,
        stride_seconds=request.stride_seconds,
    )
    weights.write_run(request.checkpoint, request.workdir, data, request.dataset)
    print(f"run: {request.workdir}; next: gnio evaluate --network {request.workdir}")
