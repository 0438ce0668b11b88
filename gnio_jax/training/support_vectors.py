"""RIDI's support vectors, fitted by scikit-learn (`pip install gnio-jax[ridi]`).

`gnio train` comes here for networks that say `trained_by = "support_vectors"`, as `ridi` does.
There are no steps and no gradients, and the whole training split is seen at once.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import models
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError, require_packages
from gnio_jax.models.ridi import features
from gnio_jax.networks import TrainedNetwork, read_network, write_network
from gnio_jax.networks.folder import WEIGHTS
from gnio_jax.reporting import Reporter
from gnio_jax.training.recordings import read_splits
from gnio_jax.training.run_folder import write_splits
from gnio_jax.training.windows import gather, refuse_no_window, usable_starts, window_source
from gnio_jax.types import Sequence

GRID = {"C": [1.0, 10.0], "epsilon": [0.001, 0.01]}
"""Values among which three folds choose, for each machine; ε is in m."""
MOST_WINDOWS = 5000
"""Windows from which a machine learns (ours). The time of a fit grows with their square: 5,000
windows of 50 samples take a minute for each axis, and all windows of a large data set take days."""
CHUNK = 1024
"""Windows whose kernels are in memory at once."""
CLASS_C = 10.0
"""C of the machine that tells the placements apart."""


class LabelledWindows(NamedTuple):
    """Windows with their horizontal displacements, m, and the placement of the phone."""

    windows: Float[np.ndarray, "m n 6"]
    displacement: Float[np.ndarray, "m 2"]
    placement: list[str]


def labelled_windows(sequences: Iterable[Sequence], config: TrainConfig) -> LabelledWindows:
    """The windows of recordings, all at the network's rate, `data.train_stride_seconds` apart. The
    placement is that of the recording's attributes. Raises `InputError` if no window fits."""
    parts, names, stride = [], [], config.data.train_stride
    for sequence in sequences:
        if not usable_starts(sequence, config.data, stride).size:
            continue
        source = window_source([sequence], config.data, stride)
        source = jax.tree.map(jnp.asarray, source)
        part = jax.device_get(gather(source, source.visited, config.data.input_samples))
        parts.append(part)
        names += [str(sequence.attributes.get("placement", ""))] * len(part.imu)
    if not parts:
        refuse_no_window(config.data)
    windows, displacement = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return LabelledWindows(windows, displacement[:, :2], names)


def join_windows(parts: list[LabelledWindows]) -> LabelledWindows:
    """The windows of several datasets, one after the other."""
    windows, displacement, placements = zip(*parts, strict=True)
    placement = list(itertools.chain.from_iterable(placements))
    return LabelledWindows(np.concatenate(windows), np.concatenate(displacement), placement)


def train(
    config: TrainConfig, workdir: Path, reporter: Reporter, workers: int = 1, resume: bool = False
) -> float:
    """Fit the recordings of the training split and write the run. Returns the mean squared error on
    the validation split, m², summed over both axes. With `resume` a run that has its weights stays
    as it is, because it is written whole after the fit. Raises `InputError` as `fit` does, and for
    missing data."""
    if resume and (workdir / WEIGHTS).exists():
        reporter.line(f"{workdir}: is finished; the support vectors stay as they are")
        return validation_error(read_network(workdir))
    require_library()
    training, held_out, splits = read_splits(
        config,
        reporter,
        workers,
        lambda sequences, _: labelled_windows(sequences, config),
        lambda source: f"{len(source.placement):,} windows",
    )
    network = fit(join_windows(training), join_windows(list(held_out.values())), config)
    workdir.mkdir(parents=True, exist_ok=True)
    write_splits(workdir, splits)
    write_network(workdir, network)
    return validation_error(network)


def validation_error(network: TrainedNetwork) -> float:
    """The mean squared error on the validation split, m², summed over both axes: the variances of
    the constant uncertainty."""
    log_std = np.asarray(network.variables["batch_stats"]["uncertainty"]["log_std"])
    return float(np.sum(np.exp(2 * log_std[:2])))


def require_library() -> None:
    """Raise `InputError` without scikit-learn."""
    require_packages("network 'ridi'", "ridi", "sklearn")


def fit(data: LabelledWindows, held_out: LabelledWindows, config: TrainConfig) -> TrainedNetwork:
    """The network of these windows: a machine for each placement and axis, chosen by three folds,
    and one that tells the placements apart. Each learns from at most `MOST_WINDOWS` windows, drawn
    by the seed. The constant uncertainty is that of the windows that are held out. Raises
    `InputError` without scikit-learn, or for a placement with fewer than 9 windows."""
    require_library()
    from sklearn.model_selection import GridSearchCV  # pyright: ignore[reportMissingImports]
    from sklearn.svm import SVC, SVR  # pyright: ignore[reportMissingImports]

    x = np.asarray(jax.jit(features)(jnp.asarray(data.windows, jnp.float32)), float)
    gamma, names = 1 / x.shape[1], sorted(set(data.placement))
    labels = np.array([names.index(name) for name in data.placement])
    rows_of_names = [np.flatnonzero(labels == number) for number in range(len(names))]
    generator, machines = np.random.default_rng(config.seed), []
    for name, rows in zip(names, rows_of_names, strict=True):
        rows = draw_rows(generator, rows, MOST_WINDOWS)
        if len(rows) < 9:
            problem = f"placement '{name}' has {len(rows)} windows, 9 are needed"
            raise InputError("the training split", problem, "leave its recordings out")
        for axis in (0, 1):
            search = GridSearchCV(SVR(kernel="rbf", gamma=gamma), GRID, cv=3)
            machines.append(search.fit(x[rows], data.displacement[rows, axis]).best_estimator_)
    most = max(len(machine.support_vectors_) for machine in machines) or 1
    shape = len(names), 2, most
    support, weight = np.zeros((*shape, x.shape[1])), np.zeros(shape)
    for entry, machine in zip(np.ndindex(len(names), 2), machines, strict=True):
        count = len(machine.support_vectors_)
        support[entry][:count], weight[entry][:count] = machine.support_vectors_, machine.dual_coef_
    offset = np.array([machine.intercept_[0] for machine in machines]).reshape(len(names), 2)
    params: dict[str, Any] = {"support": support, "weight": weight, "offset": offset}
    options = {"placements": len(names), "supports": most}
    if len(names) > 1:
        share = MOST_WINDOWS // len(names)  # a rare placement keeps its windows
        rows = np.sort(np.concatenate([draw_rows(generator, r, share) for r in rows_of_names]))
        classes = SVC(C=CLASS_C, kernel="rbf", gamma=gamma).fit(x[rows], labels[rows])
        params["class_support"] = classes.support_vectors_
        params["class_weight"], params["class_offset"] = pair_weights(classes, len(names))
        options["class_supports"] = len(classes.support_vectors_)
    model = dataclasses.replace(config.model, options={**config.model.options, **options})
    network = models.from_config(model)
    zeros = {"uncertainty": {"log_std": np.zeros(3)}}
    variables = {"params": params, "batch_stats": zeros}
    variables = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), variables)
    windows = jnp.asarray(held_out.windows, jnp.float32)
    predict: Any = jax.jit(network.apply)
    parts = [windows[k : k + CHUNK] for k in range(0, len(windows), CHUNK)]
    chunks = [predict(variables, part).displacement for part in parts]
    error = held_out.displacement - np.concatenate(chunks)[:, :2]
    mse = [*np.mean(error**2, axis=0), 1.0]
    log_std = jnp.asarray(0.5 * np.log(np.maximum(mse, 1e-8)), jnp.float32)
    variables = {**variables, "batch_stats": {"uncertainty": {"log_std": log_std}}}
    config = dataclasses.replace(config, model=model)
    return TrainedNetwork(config, network, variables, epoch=0, step=0)


def draw_rows(generator: np.random.Generator, rows: np.ndarray, most: int) -> np.ndarray:
    """These rows, or `most` of them, in their order."""
    if len(rows) <= most:
        return rows
    return np.sort(generator.choice(rows, most, replace=False))


def pair_weights(machine: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights of all support vectors, and the offset, for each pair of classes of a C-SVC: positive
    for the first of both."""
    ends = np.cumsum([0, *machine.n_support_])
    dual, rows = machine.dual_coef_, []
    for first, second in itertools.combinations(range(count), 2):
        row = np.zeros(dual.shape[1])
        of_first, of_second = (slice(ends[k], ends[k + 1]) for k in (first, second))
        row[of_first] = dual[second - 1, of_first]
        row[of_second] = dual[first, of_second]
        rows.append(row)
    weights, offset = np.array(rows), np.array(machine.intercept_)
    if count == 2:  # scikit-learn's sign for two classes
        weights, offset = -weights, -offset
    return weights, offset
