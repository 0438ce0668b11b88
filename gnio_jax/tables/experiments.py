"""The rows of the paper's tables as configurations, and the published figures."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

from gnio_jax import models
from gnio_jax.config import (
    DataConfig,
    LossConfig,
    ModelConfig,
    OptimConfig,
    SegmentTraining,
    TrainConfig,
)
from gnio_jax.errors import InputError
from gnio_jax.models.gnio import GNIO
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.training.windows import NO_MOTION

METHODS = ("tlio", "ronin_resnet", "deepils", "ctin", "imot", "gnio")
"""The networks of table II, and RoNIN's, which it leaves out."""

TLIO_HELD, TLIO_BATCH, PAPER_EPOCHS = 9.0, 1024, 200
"""TLIO's uncertainty does not learn in its first 9 epochs of batches of 1,024 (its code counts from
1 and begins at 10); the paper trains every network for 200 epochs."""

REGULARISATION: dict[str, dict[str, float]] = {
    "tlio": {"clip_norm": 0.1},
    "ctin": {"weight_decay": 1e-6},
}
"""Settings of the published recipes besides loss and budget. TLIO needs its clip: when its
uncertainty begins to learn, the gradients of the likelihood are so large that they destroy what its
displacements have learnt."""


OTHER_BLOCKS = ("rep", "fourier", "wavelet")
"""Blocks of the trunk besides the one that it has by default."""


class System(NamedTuple):
    """A network of this package with other options than its own row: a published system with the
    main options of its recipe, or a block of the trunk. Everything else is as in the network's own
    row."""

    network: str
    options: dict[str, Any] = {}
    """Fields of the model."""
    loss: dict[str, Any] = {}
    """Fields of the loss that differ from the network's."""
    regularisation: dict[str, float] = {}
    """Fields of the optimizer that differ from the network's."""


SYSTEMS = {
    "eqnio_tlio": System("tlio", {"equivariance": "o2_frame"}),
    "eqnio_ronin": System("ronin_resnet", {"equivariance": "o2_frame"}),
    "airimu": System(
        "tlio",
        {"equivariance": "none", "corrector": "airimu"},
        {
            "mse_weight": 1.0,
            "nll_weight": 1e-2,
            "preintegration_weight": 1.0,
            "log_std_from_epoch": 0.0,
            "log_std_floor": None,
        },
        {"clip_norm": 1.0, "weight_decay": 1e-4},
    ),
    "rio": System("ronin_resnet", loss={"rotation_weight": 1.0}),
    "bins": System("gnio", {"bank_size": 0, "head": "bins"}, {"name": "bins"}),
    **{f"trunk_{block}": System("trunk", {"block": block}) for block in OTHER_BLOCKS},
}
"""Rows by their names. Those of systems are the names of their recipes in configs/baselines. `rio`
keeps the normalisation over batches at every width (ours): with as many groups as channels, as in a
narrow network, group normalisation takes the strength of every window away."""

PUBLISHED = {
    ("oxiod", "seen"): {"tlio": 2.67, "ctin": 2.32, "imot": 1.86, "gnio": 0.74},
    ("oxiod", "unseen"): {"tlio": 2.54, "ctin": 3.34, "imot": 0.90, "gnio": 0.71},
    ("ridi", "seen"): {"tlio": 1.58, "ctin": 1.39, "imot": 1.68, "deepils": 1.56, "gnio": 1.22},
    ("ridi", "unseen"): {"tlio": 1.49, "ctin": 1.86, "imot": 1.49, "deepils": 1.48, "gnio": 1.19},
    ("ronin", "seen"): {"tlio": 5.95, "ctin": 4.62, "imot": 3.78, "deepils": 4.80, "gnio": 4.31},
    ("ronin", "unseen"): {"tlio": 7.10, "ctin": 5.61, "imot": 5.31, "deepils": 6.80, "gnio": 5.02},
    ("idol", "seen"): {"tlio": 5.89, "ctin": 2.90, "imot": 2.22, "gnio": 3.45},
    ("idol", "unseen"): {"tlio": 5.34, "ctin": 3.69, "imot": 3.00, "gnio": 3.89},
}
"""Published ATE, m (paper, table II), by dataset and split, then by network."""

PUBLISHED_GATES = {
    ("sigmoid", "linear"): 2.05,
    ("tanh", "linear"): 2.00,
    ("tanh", "exp"): 1.94,
    ("tanh", "abs"): 1.92,
    ("tanh", "pos_elu"): 1.85,
    ("tanh", "softplus"): 1.84,
}
"""Published RMSE on TLIO's set, m (paper), by the functions of gate and scale."""

PUBLISHED_BANKS = {0: None, 16: 2.07, 32: None, 64: 1.98, 128: 2.07}
"""Published RMSE on TLIO's set, m (paper), by the number of prototypes in the bank."""


class TableRow(NamedTuple):
    """One row of a table before it is run."""

    name: str
    """Name of the row and of its folder, which the tables with this row share."""
    label: str
    config: TrainConfig
    published: float | None = None
    """The paper's figure, m."""


class Experiment(NamedTuple):
    """A table of the paper: its rows, of which the others are compared with the first."""

    title: str
    source: str
    """Location of the published figures, and their data."""
    rows: list[TableRow]


# --- one row


def method(name: str, base: TrainConfig) -> TrainConfig:
    """`base` with another network or one of `SYSTEMS`, its loss and regularisation: the same
    recordings, augmentation (but `NO_MOTION` with a corrector), equivariance unless the system
    has its own, batches, epochs and learning rate. A network that sees the body has its axes in its
    windows, and no other has them. The filter measures the velocity of a network that predicts it.
    A network with memory learns on the segments of `base`, if there are any, in batches with as
    many seconds of walks. Losses differ, so every row's checkpoint is the one with the smallest
    squared error on the validation split."""
    network, options, other_loss, other_regularisation = SYSTEMS.get(name, System(name))
    equivariance = {
        option: getattr(base.model, option)
        for option in ("equivariance", *models.frame_options(base.model.equivariance))
    }
    if "equivariance" in options:
        equivariance = scaled_size(
            ("frame_width",), base, name=network, equivariance=options["equivariance"]
        )
    size = scaled_size(("width", "particles"), base, name=network)
    model = ModelConfig(name=network, **equivariance, **size, **options)
    regularisation = {**REGULARISATION.get(network, {}), **other_regularisation}
    optim = dataclasses.replace(base.optim, best_by="squared_error", **regularisation)
    network_loss = dataclasses.replace(loss(network, base), **other_loss)
    config = dataclasses.replace(base, model=model, loss=network_loss, optim=optim)
    built = models.from_config(model)
    if model.equivariance != "device_heading":  # it alone hides axes
        changes = dataclasses.replace(base.augment, hidden_axes_share=0.0)
        config = dataclasses.replace(config, augment=changes)
    if not isinstance(built, NetworkWithMemory):
        config = dataclasses.replace(config, segments=SegmentTraining())
    elif base.segments.seconds:
        seconds = base.optim.batch_size * base.data.window_seconds
        optim = dataclasses.replace(
            optim, batch_size=max(round(seconds / base.segments.seconds), 1)
        )
        config = dataclasses.replace(config, optim=optim)
    if model.corrector != "none":
        changes = dataclasses.replace(config.augment, **NO_MOTION)
        config = dataclasses.replace(config, augment=changes)
    sees_body = models.channels(built) == 12
    if sees_body != (base.data.window_rotation == "body_axes"):
        rotation = "body_axes" if sees_body else DataConfig().window_rotation
        rotated = dataclasses.replace(base.data, window_rotation=rotation)
        config = dataclasses.replace(config, data=rotated)
    if "velocity" in models.quantities(built):
        settings = dataclasses.replace(base.filter, measures="velocity")
        config = dataclasses.replace(config, filter=settings)
    return config


def scaled_size(sizes: tuple[str, ...], base: TrainConfig, **network: str) -> dict[str, int]:
    """The first of the options `sizes` that a network has, at the share of its published value that
    `base` has of GNIO's width, or the next value that the network can have; if there is none near
    it, the network says why. Networks have a width; iMoT, whose features are the samples of a
    window, has a number of particles, and EqNIO's network for the frame has a width of its own.
    Empty, for the published size, for networks without such an option, and for those with memory,
    which are small."""
    published = models.create(**network)
    option = next((size for size in sizes if hasattr(published, size)), None)
    if isinstance(published, NetworkWithMemory) or option is None or base.model.width is None:
        return {}
    full = getattr(published, option)
    size = max(round(base.model.width / GNIO.width * full), 1)
    larger = range(size, size + full)
    return {option: next(filter(partial(accepts, network, option), larger), size)}


def accepts(network: dict[str, str], option: str, value: int) -> bool:
    """Whether a network can have this option: the width of CTIN is a multiple of its heads."""
    try:
        models.create(**network, **{option: value})
    except InputError:
        return False
    return True


def loss(network: str, base: TrainConfig) -> LossConfig:
    """The published loss of a network. GNIO and the networks of ours have that of the experiment,
    and every likelihood has its bound on outliers."""
    bound = base.loss.outlier_sigmas
    match network:
        case "gnio" | "gru" | "state_space" | "experts" | "trunk":  # the others are ours
            return base.loss
        case "ionet":
            return LossConfig(name="polar")
        case "airio":
            return LossConfig(name="body_velocity")
        case "tlio":
            fixed = {"log_std_from_epoch": held_epochs(base.optim), "log_std_floor": -6.907755}
            return LossConfig(mse_weight=0.0, nll_weight=1.0, outlier_sigmas=bound, **fixed)
        case "deepils":
            return LossConfig(mse_weight=1.0, mae_weight=1.0, nll_weight=0.0)
        case "ctin":
            return LossConfig(name="velocity_and_covariance", outlier_sigmas=bound)
        case _:
            return LossConfig(mse_weight=1.0, nll_weight=0.0)


def held_epochs(optim: OptimConfig) -> float:
    """Epochs in which TLIO's uncertainty does not learn: the published number. Ours: a shorter run
    holds it fixed for the same number of steps as the published epochs and batches, but at most for
    half of the run."""
    if optim.epochs >= PAPER_EPOCHS:
        return TLIO_HELD
    return min(TLIO_HELD * optim.batch_size / TLIO_BATCH, optim.epochs / 2)


def variant(base: TrainConfig, **options: Any) -> TrainConfig:
    """GNIO with other options of the model."""
    config = method("gnio", base)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **options))


# --- the tables


def comparison(
    base: TrainConfig, dataset: str, split: str, networks: tuple[str, ...] = METHODS
) -> Experiment:
    """All networks, measured on a split of a dataset; the others are compared with the first."""
    published = PUBLISHED.get((dataset, split), {})
    source = "no published figure for this split"
    if published:
        source = f"paper, table II: ATE on {dataset} {split}"
    rows = [TableRow(name, name, method(name, base), published.get(name)) for name in networks]
    return Experiment("Networks", source, rows)


def components(base: TrainConfig) -> Experiment:
    """Bank and gated head, each alone and both. The paper's baseline is TLIO's own network; the
    plain linear head on GNIO's pooled features is a further row."""
    plain = variant(base, bank_size=0, head="linear")
    bank, gated = variant(base, head="linear"), variant(base, bank_size=0)
    return Experiment(
        "Components",
        "paper, component ablation: RMSE on TLIO's set",
        [
            TableRow("tlio", "baseline (TLIO)", method("tlio", base), 2.40),
            TableRow("gnio_bank-0_linear", "encoder + linear head", plain),
            TableRow("gnio_linear", "+ bank", bank, 1.98),
            TableRow("gnio_bank-0", "+ gated head", gated, 1.84),
            TableRow("gnio", "+ bank + gated head", method("gnio", base), 1.66),
        ],
    )


def gates(base: TrainConfig) -> Experiment:
    """Activations of gate and scale, without the bank: the paper's best row equals its gate-only
    row."""

    rows = []
    for (gate, scale), published in PUBLISHED_GATES.items():
        name, options = f"gnio_bank-0_{gate}_{scale}", {"gate": gate, "scale": scale}
        if (gate, scale) == ("tanh", "softplus"):  # the defaults: the row of `components`
            name, options = "gnio_bank-0", {}
        config = variant(base, bank_size=0, **options)
        rows.append(TableRow(name, f"{gate} × {scale}", config, published))
    source = "paper, gate and scale functions: RMSE on TLIO's set, without the bank"
    return Experiment("Gate and scale", source, rows)


def bank_sizes(base: TrainConfig) -> Experiment:
    """Prototypes in the bank, with the linear head: the paper's m = 64 equals its bank-only row."""
    rows = []
    for size, published in PUBLISHED_BANKS.items():
        name, options = f"gnio_bank-{size}_linear", {"bank_size": size}
        if size == 64:  # the default: the row of `components`
            name, options = "gnio_linear", {}
        config = variant(base, head="linear", **options)
        rows.append(TableRow(name, f"m = {size}" if size else "no bank", config, published))
    source = "paper, size of the bank: RMSE on TLIO's set, with the linear head"
    return Experiment("Bank size", source, rows)
