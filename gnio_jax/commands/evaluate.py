"""`gnio evaluate`: trajectories and errors of a trained network."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Command, execute
from gnio_jax.config import EvaluateConfig
from gnio_jax.cores import usable_cores

DESCRIPTION = """Estimate the trajectories of a split with a trained network and report the errors.

  {prog}                       (the newest run below runs/)
  {prog} --workdir runs/tlio
  {prog} --workdir runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
  {prog} --workdir runs/tlio --estimator integrate --orientation device

Results go to <workdir>/eval/<dataset>_<split>_<estimator>/: metrics.json, metrics.csv,
trajectories/ and references/ in TUM format (for evo), plots/. Every table has two rows to compare
with: never_moves, the start pose throughout, and perfect_displacements, the same estimator fed with
the reference's displacements."""


def defaults(options: EvaluateConfig) -> EvaluateConfig:
    """The newest run, where none is named, and the filter options that it has or has learnt."""
    workdir = Path(options.workdir or configuration.newest_run())
    default = EvaluateConfig(workdir=str(workdir))
    kept = workdir / "config.yaml"
    if not kept.is_file():
        return default
    config = configuration.load(kept)
    if config.through_filter.learn:
        from gnio_jax import filtering
        from gnio_jax.evaluation.run import run_config

        filtering.cores_as_devices()  # before the checkpoint's arrays settle the devices
        config = run_config(workdir, options.checkpoint)
    return dataclasses.replace(default, filter=config.filter)


def evaluate(config: EvaluateConfig, _prog: str) -> None:
    """Evaluate, and show the table."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import evaluation, filtering
    from gnio_jax.evaluation import table

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    with console.terminal() as terminal:
        found, folder = evaluation.evaluate(config, terminal.progress, usable_cores())
    console.stdout().print(table.render(found))
    print(f"results: {folder}")
    if config.plots:
        names = "<name>_{trajectory,error,displacement}.png"
        print(f"pictures: {folder / 'plots' / 'error_cdf.png'}, and there of each sequence {names}")


COMMAND = Command(EvaluateConfig, evaluate, DESCRIPTION, defaults)


def main(argv: Sequence[str] | None = None, prog: str = "python evaluate.py") -> None:
    """Read the options and evaluate."""
    execute(COMMAND, argv, prog)
