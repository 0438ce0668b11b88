"""Evaluate a trained network: python evaluate.py --workdir runs/synthetic_gnio. Everything it does is in gnio_jax.evaluation."""

import dataclasses
import os
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax

from gnio_jax import config as configuration
from gnio_jax.commands import console as cli
from gnio_jax.config import EvaluateConfig
from gnio_jax.cores import usable_cores

DESCRIPTION = """Estimate the trajectories of a split with the network of a run, and report their errors.

  python evaluate.py                       (the newest run below runs/)
  python evaluate.py --workdir runs/tlio
  python evaluate.py --workdir runs/tlio --dataset oxiod --data-root ~/oxiod --split unseen
  python evaluate.py --workdir runs/tlio --estimator integrate --orientation device

Results go to <workdir>/eval/<dataset>_<split>_<estimator>/: metrics.json, metrics.csv, trajectories/ and references/ in TUM
format (for evo), plots/. Every table has two rows to compare with: never_moves, the start pose throughout, and
perfect_displacements, the same estimator fed with the reference's displacements."""


def main() -> None:
    jax.config.update(
        "jax_enable_x64", True
    )  # the filter needs float64; the network states its float32 everywhere
    workdir = cli.parse(EvaluateConfig, description=DESCRIPTION).workdir or str(
        configuration.newest_run()
    )
    default = EvaluateConfig(workdir)
    kept = Path(workdir) / "config.yaml"
    if kept.is_file():  # the run's own filter options are the defaults of those that are not given
        default = dataclasses.replace(default, filter=configuration.load(kept).filter)
    config = cli.parse(EvaluateConfig, default, DESCRIPTION)

    from rich.console import Console

    from gnio_jax import (  # after the options: --help and mistakes should not wait for the imports
        evaluation,
        filtering,
    )
    from gnio_jax.evaluation import table

    filtering.cores_as_devices()
    with cli.progress() as progress:
        found, folder = evaluation.evaluate(config, progress, workers=usable_cores())
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(
            highlight=False, width=200
        )  # into a file or a pipe: no line is cut to a terminal's width
    console.print(table.render(found))
    print(f"results: {folder}")
    if config.plots:
        print(
            f"pictures: {folder / 'plots' / 'error_cdf.png'}, and there of each sequence <name>_{{trajectory,error,displacement}}.png"
        )
