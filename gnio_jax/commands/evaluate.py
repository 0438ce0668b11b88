"""`gnio evaluate`: trajectories and errors of a trained network."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gnio_jax import config as configuration
from gnio_jax.commands import console, options
from gnio_jax.config import EvaluateConfig
from gnio_jax.cores import usable_cores
from gnio_jax.errors import InputError


@dataclass(frozen=True)
class EvaluateOptions(EvaluateConfig):
    """What `gnio evaluate` is asked for, and what it takes from the run."""

    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="filter.FIELD=VALUE")
    ] = ()
    """A setting of the run's filter by its name in YAML; it may be given several times."""
    distributed: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT,PROCESSES,ID")] = None
    """Where process 0 listens, how many processes there are, and the number of this one; Slurm,
    Open MPI and Kubernetes need nothing."""


def evaluate(asked: EvaluateOptions, call: options.Call) -> None:
    """Estimate the trajectories of a split with a trained network and report the errors.

    Results go to WORKDIR/eval/<dataset>_<split>_<estimator>/: metrics.json, metrics.csv,
    trajectories/ and references/ in TUM format (for evo), plots/, and report.html, a page with map,
    curves and a time slider. Every table has two rows to compare with: never_moves, the start pose
    throughout, and perfect_displacements, the same estimator fed with the reference's
    displacements.

    examples:
      {prog}                       the newest run below runs/
      {prog} --workdir runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
      {prog} --workdir runs/tlio --estimator integrate --orientation device
      {prog} --workdir runs/tlio --set filter.noise.measurement_scale=1
    """
    for setting in asked.set:
        if not setting.startswith(("filter.", "batch_size=")):
            remedy = "write filter.FIELD=VALUE; the rest are options, see --help"
            raise InputError(f"--set {setting}", "is no setting of the filter", remedy)
    workdir = Path(asked.workdir or configuration.newest_run())
    asked = dataclasses.replace(asked, workdir=str(workdir))
    import jax  # late: mistakes do not wait for it

    from gnio_jax import evaluation, filtering, parallel
    from gnio_jax.evaluation import tabulate
    from gnio_jax.evaluation.run import run_config

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    parallel.initialise(asked.distributed)
    if (workdir / "config.yaml").is_file():
        asked = dataclasses.replace(asked, filter=run_config(workdir, asked.checkpoint).filter)
    asked = configuration.assign(asked, asked.set)
    with console.terminal(shown=parallel.is_first()) as terminal:
        found, folder = evaluation.evaluate(asked, terminal.progress, usable_cores(), str(call))
    if not parallel.is_first():
        return
    output = console.stdout()
    output.print(tabulate.render(found))
    output.print(f"results: {folder}", soft_wrap=True)
    if asked.rerun:
        output.print(f"for Rerun: {asked.rerun}", soft_wrap=True)
    if asked.plots:
        output.print(f"page: {folder / 'report.html'} (open it in a browser)", soft_wrap=True)
        pictures = f"{folder / 'plots' / 'error_cdf.png'}, and there <name>.png of each sequence"
        output.print(f"pictures: {pictures}", soft_wrap=True)
