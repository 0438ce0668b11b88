"""`gnio train`: a network on a dataset."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import tyro

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Command, execute, sibling
from gnio_jax.commands.together import MeetingOptions
from gnio_jax.config import ConsideredStd, FilterSettings, TrainConfig
from gnio_jax.cores import usable_cores

if TYPE_CHECKING:
    from gnio_jax.training.loop import Outcome

DESCRIPTION = """Train a network and leave a run: config.yaml, checkpoints, logs in its work folder.

  {prog} --config quickstart --workdir runs/demo
  {prog} --dataset tlio --data-root ~/tlio --workdir runs/tlio
  {prog} --workdir runs/tlio --resume
  {prog} --config quickstart --workdir runs/demo --seeds 0 1 2
  {prog} --config through_filter_oxiod --init-from runs/oxiod_calibrated --workdir runs/through

--config FILE reads options from a YAML file, or from an experiment that comes with the package;
options given here win over it. --resume goes on from the latest checkpoint as if the run had never
stopped. --init-from starts from the weights of a run or package (gnio weights) of the same network;
with --through-filter.learn, network and filter then learn as one program, from the filter of that
run (gnio calibrate). --seeds trains several runs together, in WORKDIR_s0, WORKDIR_s1, ..."""


@dataclass(frozen=True)
class RunOptions:
    """Where the experiment's settings come from."""

    config: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """YAML file of settings, or the name of one that comes with the package, e.g. quickstart."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in the work folder from its latest checkpoint."""
    set: tuple[str, ...] = ()
    """Further settings by name, which win over all else: --set filter.noise.gyro_density=3e-4"""
    seeds: tuple[int, ...] = ()
    """Seeds to train together, in the place of --seed: WORKDIR_s0, ..."""
    devices: int | None = None
    """Devices of each process that share a batch, or the --seeds; by default all of its GPUs, or
    the one that a CPU is."""


@dataclass(frozen=True)
class TrainOptions(TrainConfig, RunOptions, MeetingOptions):
    """What `gnio train` is asked for: an experiment, and where its settings come from."""

    filter: tyro.conf.Suppress[tyro.conf.Fixed[FilterSettings]] = field(
        default_factory=FilterSettings
    )

    def experiment(self) -> TrainConfig:
        """The experiment alone."""
        given = {name: getattr(self, name) for name in vars(TrainConfig())}
        return configuration.assign(TrainConfig(**given), self.set)


def defaults(options: TrainOptions) -> TrainOptions:
    """The settings of --config, else those of the run that is resumed; options win over both.

    The filter, as far as they leave it open, is that of the run that is resumed, or of the run that
    training through the filter starts from.
    """
    runs = configuration.with_seeds(options, options.seeds) if options.seeds else [options]
    kept = configuration.default_workdir(runs[0]) / "config.yaml"
    resumed = configuration.load(kept) if options.resume and kept.exists() else None
    named = options.config
    found = configuration.load(named) if named else resumed or TrainConfig()
    own = resumed.filter if resumed else _filter_to_begin_with(options, found)
    base = dataclasses.replace(TrainConfig() if named else found, filter=own)
    if options.seeds:
        base = dataclasses.replace(base, workdir=options.workdir)  # not that of the first seed
    return TrainOptions(**vars(configuration.load(named, base) if named else base))


def _filter_to_begin_with(options: TrainOptions, config: TrainConfig) -> FilterSettings:
    """The filter that training through the filter starts from, that of a run or package; else the
    default one.

    What that run's filter considers belongs to its own covariance, not to the one that will learn.
    """
    initial = options.init_from or config.init_from
    learns = options.through_filter.learn or config.through_filter.learn
    if initial is None or not learns:
        return FilterSettings()
    from gnio_jax import filtering, pretrained
    from gnio_jax.evaluation.run import run_config
    from gnio_jax.pretrained.package import is_package

    place = pretrained.find(initial)
    filtering.cores_as_devices()  # before the checkpoint's arrays settle the devices
    found = pretrained.load_pretrained(place).config if is_package(place) else run_config(place)
    return dataclasses.replace(found.filter, considered=ConsideredStd())


def train(options: TrainOptions, prog: str) -> None:
    """Train, and say how to go on."""
    # After the options: --help and mistakes do not wait for these imports.
    from gnio_jax import filtering, pretrained
    from gnio_jax.scaling import devices, processes
    from gnio_jax.training import loop, run_folder

    if options.through_filter.learn:
        filtering.cores_as_devices()  # the filter's operations are too small for several cores
    elif options.devices:
        devices.cpu_devices(options.devices)
    processes.meet(options.meeting(), f"train {run_folder.identity(options.experiment())}")
    with processes.running():
        with console.terminal(shown=processes.is_first()) as terminal:
            try:
                load = pretrained.load_pretrained
                given = (options.resume, terminal, usable_cores(), options.devices, load)
                if options.seeds:
                    outcomes = loop.train_seeds(options.experiment(), options.seeds, *given)
                else:
                    outcomes = [loop.train(options.experiment(), *given)]
            except FloatingPointError as error:
                terminal.line(str(error))
                sys.exit(1)
    if processes.is_first():
        _say_how_to_go_on(prog, options, outcomes)
    if outcomes[0].stopped_by:
        sys.exit(128 + outcomes[0].stopped_by)


def _say_how_to_go_on(prog: str, options: TrainOptions, outcomes: Sequence[Outcome]) -> None:
    if outcomes[0].stopped_by:
        workdir, seeds = outcomes[0].workdir, ""
        if options.seeds:
            workdir = configuration.default_workdir(options)
            seeds = " --seeds " + " ".join(map(str, options.seeds))
        remedy = f"{sibling(prog, 'train')} --workdir {workdir}{seeds} --resume"
        print(f"stopped and saved; continue with: {remedy}", file=sys.stderr)
        return
    for outcome in outcomes:
        following = f"{sibling(prog, 'evaluate')} --workdir {outcome.workdir}"
        print(f"best on validation {outcome.best_loss:.4g}; look at it with: {following}")


COMMON = (
    "--config",
    "--dataset",
    "--data-root",
    "--workdir",
    "--resume",
    "--init-from",
    "--seed",
    "--seeds",
    "--devices",
    "--model.name",
    "--model.width",
    "--optim.epochs",
    "--optim.batch-size",
    "--optim.learning-rate",
    "--data.rate",
)

COMMAND = Command(TrainOptions, train, DESCRIPTION, defaults, common=COMMON)


def main(argv: Sequence[str] | None = None, prog: str = "python train.py") -> None:
    """Read the options and train."""
    execute(COMMAND, argv, prog)
