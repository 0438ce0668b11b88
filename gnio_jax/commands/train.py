"""`gnio train`: trains a network on a dataset."""

from __future__ import annotations

import dataclasses
import sys
import warnings
from dataclasses import dataclass
from typing import Annotated, ClassVar

from gnio_jax import config as configuration
from gnio_jax.commands import console, options
from gnio_jax.commands.names import NETWORKS, check_names
from gnio_jax.config import ConsideredStd, TrainConfig
from gnio_jax.config.schema import Count, Location, Seed, Words
from gnio_jax.cores import usable_cores


@dataclass(frozen=True)
class TrainOptions(TrainConfig):
    MAIN: ClassVar = {
        *("data.rate", "data.train_split", "data.val_split", "model.name", "model.width"),
        *("model.uncertainty", "optim.epochs", "optim.batch_size", "optim.learning_rate"),
        *("augment.low_pass_share", "through_filter.learn"),
    }
    """Options of sections that `--help` explains."""
    WORDS_OF_HELP: ClassVar = {
        "networks": "\n".join(f"  {name:<13} {text}" for name, text in NETWORKS.items())
    }
    config: Annotated[str | None, Words("FILE")] = None
    """YAML file of settings, or the name of one that comes with the package."""
    set: Annotated[tuple[str, ...], Words("SECTION.FIELD=VALUE", repeated=True)] = ()
    """A setting by its name in YAML; it may be given several times."""
    resume: bool = False
    """Continue the run in the work folder from its latest checkpoint."""
    strict: bool = False
    """Refuse damaged recordings, instead of leaving them out with a warning."""
    seeds: tuple[Seed, ...] = ()
    """Seeds to train one after the other, instead of --seed: WORKDIR_s0, WORKDIR_s1, ..."""
    devices: Count | None = None
    """Number of devices of each process that share a batch; by default all of its GPUs, or the CPU
    as one device."""
    distributed: Annotated[str | None, Words("HOST:PORT,PROCESSES,ID")] = None
    """Address of process 0, number of processes, and number of this process; not needed with Slurm,
    Open MPI and Kubernetes."""


def train(request: TrainOptions, call: options.Call) -> None:
    """Train a network and write a run: config.yaml, checkpoints and logs in its work folder.

    Settings come from four places, and later ones override earlier ones: the paper's defaults;
    --config, or the config.yaml of the run that is resumed; the options below; --set, which reaches
    every setting of a YAML file. --resume continues from the latest checkpoint. The result is that
    of a run that was never stopped. --init-from starts from the weights of another network of the
    same kind (see gnio weights). With --through-filter.learn, network and filter are trained
    together, and the filter begins with the settings of that network (gnio calibrate).

    These come with the package, for --config: {configs}.

    These are the networks, for --model.name:

    {networks}

    examples:
      {prog} --config quickstart --workdir runs/demo
      {prog} --dataset tlio --data-root ~/tlio --workdir runs/tlio
      {prog} --workdir runs/tlio --resume
      {prog} --config quickstart --workdir runs/demo --seeds 0 1 2
      {prog} --config quickstart --set filter.noise.gyro_density=1e-3 --set optim.clip_norm=null
      {prog} --config through_filter_oxiod --init-from runs/oxiod_calibrated --workdir runs/through
    """
    config = experiment(request, call)
    check_names([config.model.name], config.datasets)
    from gnio_jax import data, filtering, parallel  # late: mistakes do not wait for JAX
    from gnio_jax.training import loop

    if not request.resume:
        loop.refuse_untrainable(config)  # first, since its network may need the part left empty
        config.refuse_unused(Location("config"))
    if config.through_filter.learn:
        filtering.cores_as_devices()  # the filter's operations are too small for several cores
    if request.strict:
        warnings.simplefilter("error", data.DamagedRecording)
    parallel.initialise(request.distributed, request.devices)
    with console.terminal(shown=parallel.is_first()) as terminal:
        configs = configuration.with_seeds(config, request.seeds) if request.seeds else [config]
        resources = terminal, usable_cores(), request.devices
        try:
            outcomes = loop.train_all(configs, request.resume, *resources)
        except FloatingPointError as error:
            terminal.line(str(error))
            sys.exit(1)
    stopped_by = next((outcome.stopped_by for outcome in outcomes if outcome.stopped_by), None)
    if not parallel.is_first():
        pass
    elif stopped_by:
        workdir = configuration.default_workdir(config)
        seeds = f" --seeds {' '.join(map(str, request.seeds))}" if request.seeds else ""
        remedy = f"{call.prog} --workdir {workdir}{seeds} --resume"
        print(f"stopped and saved; continue with: {remedy}", file=sys.stderr)
    else:
        for outcome in outcomes:
            following = f"{call.sibling('evaluate')} --network {outcome.workdir}"
            if outcome.best_loss is None:
                problem = "no epoch had a finite figure on validation"
                print(f"{outcome.workdir}: {problem}", file=sys.stderr)
            else:
                print(f"best on validation {outcome.best_loss:.4g}; look at it with: {following}")
    if stopped_by:
        sys.exit(128 + stopped_by)


def experiment(request: TrainOptions, call: options.Call) -> TrainConfig:
    """The experiment that the options describe.

    Training through the filter begins with the filter of the run that it starts from, except for
    settings of the file or of --set. The consider covariance of that filter is not used, because it
    belongs to another covariance than the one that will be trained.
    """
    file = None if request.config is None else configuration.find_experiment(request.config)
    content = None if file is None else configuration.read(file)  # once, as it may be a pipe

    def combine(base: TrainConfig) -> TrainConfig:
        base_config = base if content is None else configuration.parse(content, str(file), base)
        parsed = options.read(train, call, TrainOptions(**vars(base_config)))
        chosen = TrainConfig(**{name: getattr(parsed, name) for name in vars(base)})
        return configuration.assign(chosen, request.set)

    config = combine(TrainConfig())
    first = configuration.with_seeds(config, request.seeds)[0] if request.seeds else config
    saved = configuration.default_workdir(first) / "config.yaml"
    if request.resume and saved.exists():
        earlier = configuration.load(saved)
        if file is None:
            file, content = saved, configuration.to_yaml(earlier)
        resumed = combine(TrainConfig(filter=earlier.filter))
        return dataclasses.replace(resumed, workdir=config.workdir)  # not that of the first seed
    if not config.through_filter.learn or config.init_from is None:
        return config
    from gnio_jax import filtering, networks

    filtering.cores_as_devices()  # before the checkpoint's arrays fix the devices
    source = networks.load(config.init_from).config.filter
    start = dataclasses.replace(source, considered=ConsideredStd())
    return combine(TrainConfig(filter=start))
