"""`gnio train`: a network on a dataset."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Command, execute, sibling
from gnio_jax.config import TrainConfig
from gnio_jax.cores import usable_cores

DESCRIPTION = """Train a network and leave a run: config.yaml, checkpoints, logs in its work folder.

  {prog} --config quickstart --workdir runs/demo
  {prog} --dataset tlio --data-root ~/tlio --workdir runs/tlio
  {prog} --workdir runs/tlio --resume
  {prog} --config through_filter_oxiod --init-from runs/oxiod --workdir runs/through

--config FILE reads options from a YAML file, or from one of the experiments that come with the
package; options given here win over it. --resume continues a run from its latest checkpoint as if
it had never stopped. --init-from RUN starts from the weights of a run with the same network; with
--through-filter.learn, network and filter then learn as one program. The defaults are the paper's
settings."""


@dataclass(frozen=True)
class RunOptions:
    """Where the experiment's settings come from."""

    config: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """YAML file of settings, or the name of one that comes with the package, e.g. quickstart."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in the work folder from its latest checkpoint."""


@dataclass(frozen=True)
class TrainOptions(TrainConfig, RunOptions):
    """What `gnio train` is asked for: an experiment, and where its settings come from."""

    def experiment(self) -> TrainConfig:
        """The experiment alone."""
        return TrainConfig(**{name: getattr(self, name) for name in vars(TrainConfig())})


def defaults(options: TrainOptions) -> TrainOptions | None:
    """The settings of --config, else those of the run that is resumed; options win over both."""
    if options.config is not None:
        return TrainOptions(**vars(configuration.load(options.config)))
    kept = configuration.default_workdir(options) / "config.yaml"
    if options.resume and kept.exists():
        return TrainOptions(**vars(configuration.load(kept)))
    return None


def train(options: TrainOptions, prog: str) -> None:
    """Train, and say how to go on."""
    # After the options: --help and mistakes do not wait for these imports.
    from gnio_jax import filtering
    from gnio_jax.training import loop

    if options.through_filter.learn:
        filtering.cores_as_devices()  # the filter's operations are too small for several cores
    with console.terminal() as terminal:
        try:
            outcome = loop.train(options.experiment(), options.resume, terminal, usable_cores())
        except FloatingPointError as error:
            terminal.line(str(error))
            sys.exit(1)
    if outcome.stopped_by:
        remedy = f"{sibling(prog, 'train')} --workdir {outcome.workdir} --resume"
        print(f"stopped and saved; continue with: {remedy}", file=sys.stderr)
        sys.exit(128 + outcome.stopped_by)
    following = f"{sibling(prog, 'evaluate')} --workdir {outcome.workdir}"
    print(f"best on validation {outcome.best_loss:.4g}; look at it with: {following}")


COMMAND = Command(TrainOptions, train, DESCRIPTION, defaults)


def main(argv: Sequence[str] | None = None, prog: str = "python train.py") -> None:
    """Read the options and train."""
    execute(COMMAND, argv, prog)
