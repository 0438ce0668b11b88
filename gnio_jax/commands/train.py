"""Train a network on a dataset: python train.py --dataset synthetic. Everything it does is in gnio_jax.training."""

import os
import sys

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from gnio_jax import config as configuration
from gnio_jax.commands import console as cli
from gnio_jax.config import TrainConfig
from gnio_jax.cores import usable_cores

DESCRIPTION = """Train GNIO and leave a run: config.yaml, checkpoints/, metrics.jsonl and TensorBoard events in its work folder.

  python train.py --dataset synthetic --config configs/quickstart.yaml
  python train.py --dataset tlio --data-root ~/tlio --workdir runs/tlio
  python train.py --workdir runs/tlio --resume

--resume continues a run from its latest checkpoint as if it had never stopped. The defaults are the paper's settings."""


def main() -> None:
    arguments = sys.argv[1:]
    resume = "--resume" in arguments
    arguments = [argument for argument in arguments if argument != "--resume"]
    config = cli.parse(TrainConfig, description=DESCRIPTION, argv=arguments)

    from gnio_jax.training import (
        loop,  # after the options: --help and mistakes should not wait for the imports
    )

    kept = loop.default_workdir(config) / "config.yaml"
    if (
        resume
        and kept.exists()
        and not any(argument.startswith("--config") for argument in arguments)
    ):
        config = cli.parse(
            TrainConfig, default=configuration.load(kept), description=DESCRIPTION, argv=arguments
        )
    try:
        outcome = loop.train(config, resume, workers=usable_cores())
    except FloatingPointError as error:
        print(error, file=sys.stderr)
        sys.exit(1)
    if outcome.stopped_by:
        print(
            f"stopped and saved; continue with: python train.py --workdir {outcome.workdir} --resume",
            file=sys.stderr,
        )
        sys.exit(128 + outcome.stopped_by)
    print(
        f"best on validation {outcome.best_loss:.4g}; look at it with: python evaluate.py --workdir {outcome.workdir}"
    )
