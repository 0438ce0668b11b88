"""`gnio evaluate`: trajectories and errors of a trained network."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Command, called, execute
from gnio_jax.commands.together import MeetingOptions
from gnio_jax.config import EvaluateConfig, FilterSettings, TrainConfig
from gnio_jax.cores import usable_cores

DESCRIPTION = """Estimate the trajectories of a split with a trained network and report the errors.

  {prog}                       (the newest run below runs/)
  {prog} --workdir runs/tlio
  {prog} --workdir runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
  {prog} --workdir runs/tlio --estimator integrate --orientation device

Results go to <workdir>/eval/<dataset>_<split>_<estimator>/: metrics.json, metrics.csv,
trajectories/ and references/ in TUM format (for evo), plots/, and report.html, a page with map,
curves and a time slider. Every table has two rows to compare with: never_moves, the start pose
throughout, and perfect_displacements, the same estimator fed with the reference's displacements."""


@dataclass(frozen=True)
class EvaluateOptions(EvaluateConfig, MeetingOptions):
    """What `gnio evaluate` is asked for, and where its processes meet."""

    filter: tyro.conf.Suppress[tyro.conf.Fixed[FilterSettings]] = field(
        default_factory=FilterSettings
    )
    set: tuple[str, ...] = ()
    """Settings of the filter by name: --set filter.noise.measurement_scale=1"""


def defaults(options: EvaluateOptions) -> EvaluateOptions:
    """The newest run, where none is named, and the filter options that it has or has learnt."""
    workdir = Path(options.workdir or configuration.newest_run())
    default = EvaluateOptions(workdir=str(workdir))
    kept = workdir / "config.yaml"
    if not kept.is_file():
        return default
    config = configuration.load(kept)
    if config.through_filter.learn:
        from gnio_jax import filtering
        from gnio_jax.evaluation.run import run_config
        from gnio_jax.scaling import processes

        filtering.cores_as_devices()  # before the checkpoint's arrays settle the devices
        processes.meet(options.meeting(), "evaluate")
        config = run_config(workdir, options.checkpoint)
    return dataclasses.replace(default, filter=config.filter)


def evaluate(config: EvaluateOptions, prog: str) -> None:
    """Evaluate, and show the table."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import evaluation, filtering
    from gnio_jax.evaluation import table
    from gnio_jax.scaling import processes

    given = configuration.assign(TrainConfig(filter=config.filter), config.set)
    config = dataclasses.replace(config, filter=given.filter)
    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    processes.meet(config.meeting(), "evaluate")
    with processes.running(), console.terminal(shown=processes.is_first()) as terminal:
        call = (config, terminal.progress, usable_cores(), called(prog))
        found, folder = evaluation.evaluate(*call)
    if not processes.is_first():
        return
    console.stdout().print(table.render(found))
    print(f"results: {folder}")
    if config.rerun:
        print(f"for Rerun: {config.rerun}")
    if config.plots:
        print(f"page: {folder / 'report.html'} (open it in a browser)")
        names = "<name>_{trajectory,error,displacement}.png"
        print(f"pictures: {folder / 'plots' / 'error_cdf.png'}, and there of each sequence {names}")


COMMON = (
    "--workdir",
    "--dataset",
    "--data-root",
    "--split",
    "--estimator",
    "--coupling",
    "--orientation",
    "--init",
    "--gyro-bias",
    "--alignment",
    "--plots",
    "--rerun",
)

COMMAND = Command(EvaluateOptions, evaluate, DESCRIPTION, defaults, common=COMMON)


def main(argv: Sequence[str] | None = None, prog: str = "python evaluate.py") -> None:
    """Read the options and evaluate."""
    execute(COMMAND, argv, prog)
