"""Static configuration: frozen dataclasses, strict YAML, validated once before anything is loaded.

One experiment is one YAML file of a `TrainConfig`; a run keeps its own as `config.yaml`. Fields
named on the command line win over the file, the file over the defaults, and the defaults are the
paper's.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from gnio_jax.files import replacing
from gnio_jax.types import InputError


@dataclass(frozen=True)
class DataConfig:
    """Which recordings, and how windows are cut from them."""

    rate: float = 200.0
    """Samples per second everything is resampled to, Hz."""
    window_seconds: float = 1.0
    """Length of the network's window, s (paper: 1 s)."""
    stride_seconds: float = 0.1
    """Distance of window starts, and of the filter's clones, s (paper: 0.1 s)."""
    train_stride_seconds: float = 0.1
    """Distance of window starts in training, s (paper: 0.1 s); a shorter one shows more phases of
    the same steps."""
    window_rotation: Literal["per_sample", "single"] = "per_sample"
    """Rotate each sample with its own attitude, or the whole window with that of its start (eq. 1
    read literally)."""
    train_split: str = "train"
    """Split of the dataset the network learns from."""
    val_split: str = "val"
    """Split of the dataset that chooses the best checkpoint."""

    @property
    def window(self) -> int:
        """Samples in a window."""
        return round(self.window_seconds * self.rate)

    @property
    def stride(self) -> int:
        """Samples between window starts, which is also one clone interval of the filter."""
        return round(self.stride_seconds * self.rate)

    @property
    def train_stride(self) -> int:
        """Samples between window starts in training."""
        return round(self.train_stride_seconds * self.rate)


@dataclass(frozen=True)
class AugmentConfig:
    """Random changes of a training window (TLIO's; the paper is silent). Zero or false switches one
    off."""

    gyro_bias: float = 0.05
    """Half-width of the uniform constant gyro bias, rad/s."""
    accel_bias: float = 0.2
    """Half-width of the uniform constant accelerometer bias, m/s²."""
    tilt_degrees: float = 5.0
    """Largest tilt of gravity about a random horizontal axis, degrees."""
    yaw: bool = True
    """Turn window and target by a random yaw."""
    gyro_noise: float = 0.0
    """Standard deviation of white gyro noise, rad/s."""
    accel_noise: float = 0.0
    """Standard deviation of white accelerometer noise, m/s²."""
    shift_samples: int = 0
    """Shift a training window by up to this many samples either way, where the recording allows it
    (RoNIN, DeepILS)."""


@dataclass(frozen=True)
class ModelConfig:
    """The network and its options. An option that is not given is the network's own, which is the
    published one; one that it does not have is refused."""

    name: str = "gnio"
    """Network in the registry of `gnio_jax.models`."""
    width: int | None = None
    """Channels of the first encoder group; the others follow (gnio, tlio, ronin_resnet, deepils:
    64)."""
    bank_size: int | None = None
    """Prototypes in the Motion Bank; 0 leaves the bank out (gnio: 64)."""
    bank_heads: int | None = None
    """Attention heads of the bank's query (gnio: 8)."""
    bank_std: float | None = None
    """Standard deviation of the prototypes before training (gnio: 1). Near 1/√d of their d features
    all are attended to alike."""
    head: Literal["gated", "linear"] | None = None
    """Displacement as scale × gate, or a plain linear layer (gnio: gated)."""
    gate: Literal["tanh", "sigmoid"] | None = None
    """Activation of the gate (gnio: tanh)."""
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] | None = None
    """Activation of the scale (gnio: softplus)."""
    uncertainty: Literal["head", "calibrated", "constant"] | None = None
    """Standard deviation from a head (paper); from a head and multiplied by one factor per axis; or
    one constant per axis. Factor and constant are those of the errors on the validation split
    (gnio: head)."""
    output_dim: int | None = None
    """3, or 2 for a network that says nothing of the vertical, as published (ronin_resnet, deepils,
    ctin, imot)."""
    dropout: float | None = None
    """Share of the activations that training drops (tlio, ronin_resnet, deepils: 0.5; imot: 0.1).
    """


@dataclass(frozen=True)
class LossConfig:
    """What training minimises (paper §III-F), and the terms of the networks that it is compared
    with."""

    name: Literal["weighted_sum", "velocity_and_covariance"] = "weighted_sum"
    """The weights below times squared error, absolute error and negative log-likelihood of the
    displacement; or CTIN's: errors of velocity and position and the likelihood of each sample's
    velocity, weighted by two parameters that are learnt."""
    mse_weight: float = 1e2
    """λ_MSE."""
    mae_weight: float = 0.0
    """Weight of the absolute error, summed over the axes (DeepILS: that of the squared one)."""
    nll_weight: float = 1e-4
    """λ_NLL."""
    nll_from_epoch: float = 0.0
    """Epochs before the likelihood counts: above 0 the two-stage reading of the paper's text."""
    log_std_from_epoch: float = 0.0
    """Epochs before the likelihood moves the uncertainty; until then only the displacement learns
    from it (TLIO: 10)."""
    log_std_floor: float | None = None
    """Smallest log standard deviation the likelihood sees (TLIO: log 1e-3); none by default."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam with linear warm-up and cosine decay (paper §IV-A), or the schedules of the networks
    that it is compared with."""

    schedule: Literal["cosine", "constant", "plateau"] = "cosine"
    """After the warm-up: a cosine to the end, no change, or smaller steps whenever the validation
    error no longer falls."""
    epochs: int = 200
    """Passes over the training windows."""
    batch_size: int = 1024
    """Windows per step."""
    learning_rate: float = 1e-4
    """Peak, reached after the warm-up."""
    start_learning_rate: float = 1e-6
    """At the first step."""
    end_learning_rate: float = 1e-6
    """At the last step."""
    warmup_epochs: float = 5.0
    """Epochs of linear warm-up; a run shorter than twice this warms up for its first half."""
    clip_norm: float | None = None
    """Largest global norm of the gradient; none by default."""
    weight_decay: float = 0.0
    """Added to the gradient, times the parameter, before Adam (CTIN: 1e-6)."""
    plateau_epochs: int = 10
    """Of the plateau: epochs without a smaller squared error on the validation split before the
    learning rate falls (RoNIN, DeepILS)."""
    plateau_factor: float = 0.1
    """Of the plateau: factor applied to the learning rate when it falls."""
    best_by: Literal["loss", "squared_error"] = "loss"
    """Which mean over the validation split chooses the best checkpoint: the loss, or the squared
    error of the displacement. The choice begins anew where `loss.nll_from_epoch` or
    `loss.log_std_from_epoch` changes what is trained."""
    statistics_windows: int = 16384
    """Augmented training windows over which the statistics of batch normalisation are estimated
    before every validation and checkpoint (ours); 0 keeps the running averages of the last
    steps."""


@dataclass(frozen=True)
class FilterOptions:
    """What the stochastic-cloning EKF believes about the IMU and its start (paper §III-G; TLIO's
    values)."""

    gyro_density: float = 3.16e-4
    """White gyro noise, rad/s/√Hz."""
    accel_density: float = 1.0e-3
    """White accelerometer noise, m/s²/√Hz."""
    gyro_bias_walk: float = 1e-6
    """Random walk of the gyro bias, rad/s/√s."""
    accel_bias_walk: float = 1e-4
    """Random walk of the accelerometer bias, m/s²/√s."""
    tilt_std_degrees: float = 1.0
    """Initial standard deviation of roll and pitch."""
    yaw_std_degrees: float = 0.1
    """Initial standard deviation of yaw."""
    velocity_std: float = 1.0
    """Initial standard deviation of the velocity, m/s."""
    position_std: float = 1e-3
    """Initial standard deviation of the position, m."""
    gyro_bias_std: float = 1e-4
    """Initial standard deviation of the gyro bias, rad/s."""
    accel_bias_std: float = 0.02
    """Initial standard deviation of the accelerometer bias, m/s²."""
    measurement_scale: float = 10.0
    """The network's covariance is multiplied by this before the update."""
    mahalanobis_fail_scale: float = 0.0
    """0 skips a rejected update; above 0 its covariance is multiplied by this and it is applied."""
    window_rotation: Literal["per_sample", "single", "tlio"] | None = None
    """Of the tight coupling: how the network's windows are cut and rotated; without it as in
    training. `tlio` is as TLIO's tracker does it, a sample earlier and without the filter's biases:
    for weights that were trained there."""


@dataclass(frozen=True)
class TrainConfig:
    """One experiment: everything `python train.py` needs, kept with the run as config.yaml."""

    dataset: str = "synthetic"
    """Dataset to learn from; `python train.py --dataset ?` lists the known ones."""
    data_root: str | None = None
    """Folder of the dataset; without it $GNIO_DATA/<dataset>, then data/<dataset>."""
    workdir: str | None = None
    """Where checkpoints and logs go; without it runs/<dataset>_<model>."""
    seed: int = 0
    """Seed of the initial parameters, the shuffling and the augmentation."""
    data: DataConfig = field(default_factory=DataConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    filter: FilterOptions = field(default_factory=FilterOptions)
    checkpoint_every_seconds: float = 600.0
    """Longest time between checkpoints within an epoch, s; every epoch ends with one anyway."""


def load(path: str | Path) -> TrainConfig:
    """Read a `TrainConfig` from a YAML file. Raises `InputError` on a missing file, an unknown key
    or a wrong type."""
    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            path, "no such config file", "see configs/ for the ones that come with the package"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})") from None
    except yaml.YAMLError as error:
        raise InputError(path, f"is not YAML ({' '.join(str(error).split())})") from None
    return _build(TrainConfig, {} if content is None else content, str(path), "")


def save(path: str | Path, config: TrainConfig) -> None:
    """Write `config` as YAML that `load` reads back to an equal value."""
    with replacing(path) as temporary:
        temporary.write_text(
            yaml.safe_dump(dataclasses.asdict(config), sort_keys=False), encoding="utf-8"
        )


def newest_run(folder: str | Path = "runs") -> Path:
    """The run below `folder` that was trained last. Raises `InputError` when there is none."""
    runs = [path.parent for path in Path(folder).glob("*/config.yaml")]
    if not runs:
        raise InputError(
            folder,
            "holds no run",
            "train one with python train.py, or name its folder with --workdir",
        )
    return max(
        runs,
        key=lambda run: max(
            path.stat().st_mtime
            for path in (run / "config.yaml", run / "metrics.jsonl")
            if path.exists()
        ),
    )


def _build(kind: type, content: Any, source: str, prefix: str) -> Any:
    if not isinstance(content, dict):
        raise InputError(
            source,
            f"{prefix.rstrip('.') or 'the file'} must be a mapping of fields, found {type(content).__name__}",
        )
    hints = typing.get_type_hints(kind)
    for key in content:
        if key not in hints:
            close = difflib.get_close_matches(str(key), hints, n=1)
            raise InputError(
                source,
                f"unknown field '{prefix}{key}'",
                f"did you mean '{prefix}{close[0]}'?"
                if close
                else f"known fields: {', '.join(hints)}",
            )
    return kind(
        **{key: _value(hints[key], value, source, prefix + key) for key, value in content.items()}
    )


def _value(hint: Any, value: Any, source: str, name: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, source, name + ".")
    # `Literal[...] | None` is a typing.Union, `int | None` is not
    options = (
        typing.get_args(hint)
        if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
        else (hint,)
    )
    if value is None and type(None) in options:
        return None
    for option in options:
        if typing.get_origin(option) is Literal:
            if value in typing.get_args(option):
                return value
        elif option is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif option in (int, str, bool) and type(value) is option:
            return value
    wanted = " or ".join(_spell(option) for option in options)
    remedy = ""
    if isinstance(value, str) and float in options:
        try:
            remedy = f"YAML reads '{value}' as text: write {float(value)!r} with a dot and a sign, such as 1.0e-4"
        except ValueError:
            pass
    raise InputError(source, f"field '{name}' must be {wanted}, found {value!r}", remedy)


def _spell(option: Any) -> str:
    if typing.get_origin(option) is Literal:
        return "one of " + ", ".join(typing.get_args(option))
    return {
        float: "a number",
        int: "a whole number",
        str: "text",
        bool: "true or false",
        type(None): "null",
    }[option]


def validate(config: TrainConfig, source: str = "config") -> TrainConfig:
    """Return `config` if its values make sense together; raises `InputError` naming the first field
    that does not."""

    def require(condition: bool, name: str, problem: str) -> None:
        if not condition:
            raise InputError(source, f"field '{name}' {problem}")

    data, optim, model = config.data, config.optim, config.model
    positive = {
        "data.rate": data.rate, "data.window_seconds": data.window_seconds, "data.stride_seconds": data.stride_seconds,
        "data.train_stride_seconds": data.train_stride_seconds, "optim.learning_rate": optim.learning_rate,
        "filter.measurement_scale": config.filter.measurement_scale, "filter.gyro_density": config.filter.gyro_density,
        "filter.accel_density": config.filter.accel_density,
    }  # fmt: skip
    for name, value in positive.items():
        require(value > 0, name, f"must be positive, found {value!r}")
    for name, value in [
        ("optim.epochs", optim.epochs),
        ("optim.batch_size", optim.batch_size),
        ("model.width", model.width),
        ("model.bank_heads", model.bank_heads),
        ("optim.plateau_epochs", optim.plateau_epochs),
    ]:
        require(value is None or value >= 1, name, f"must be at least 1, found {value!r}")
    require(
        model.bank_std is None or model.bank_std > 0,
        "model.bank_std",
        f"must be positive, found {model.bank_std!r}",
    )
    for section in ("augment", "filter"):
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            require(
                isinstance(value, str | None) or value >= 0,
                f"{section}.{key}",
                f"must not be negative, found {value!r}",
            )
    for name, seconds in [("data.window_seconds", data.window_seconds), ("data.stride_seconds", data.stride_seconds),
                          ("data.train_stride_seconds", data.train_stride_seconds)]:  # fmt: skip
        samples = seconds * data.rate
        require(
            abs(samples - round(samples)) < 1e-6,
            name,
            f"is not a whole number of samples at {data.rate:g} Hz ({samples:g})",
        )
    require(
        data.window % data.stride == 0,
        "data.stride_seconds",
        f"must divide the window of {data.window_seconds:g} s",
    )
    require(
        model.bank_size is None or model.bank_size >= 0,
        "model.bank_size",
        f"must not be negative, found {model.bank_size!r}",
    )
    require(
        model.output_dim in (None, 2, 3),
        "model.output_dim",
        f"must be 2 or 3, found {model.output_dim!r}",
    )
    require(
        model.dropout is None or 0 <= model.dropout < 1,
        "model.dropout",
        f"must be at least 0 and below 1, found {model.dropout!r}",
    )
    require(
        0 < optim.plateau_factor < 1,
        "optim.plateau_factor",
        f"must be between 0 and 1, found {optim.plateau_factor!r}",
    )
    require(
        optim.weight_decay >= 0,
        "optim.weight_decay",
        f"must not be negative, found {optim.weight_decay!r}",
    )
    for name, number in [
        ("optim.warmup_epochs", optim.warmup_epochs),
        ("optim.statistics_windows", optim.statistics_windows),
        ("loss.nll_from_epoch", config.loss.nll_from_epoch),
        ("loss.log_std_from_epoch", config.loss.log_std_from_epoch),
    ]:
        require(0 <= number < math.inf, name, f"must be finite and not negative, found {number!r}")
    require(
        optim.clip_norm is None or optim.clip_norm > 0,
        "optim.clip_norm",
        "must be positive or null",
    )
    return config


@dataclass(frozen=True)
class EvaluateConfig:
    """What `python evaluate.py` is asked for."""

    workdir: str | None = None
    """Folder of the run, with its config.yaml and checkpoints; without it the newest below runs/.
    Results go to its folder eval/."""
    dataset: str | None = None
    """Dataset to evaluate on; without it the run's own."""
    data_root: str | None = None
    """Folder of the dataset; without it the run's (for its own dataset), $GNIO_DATA/<dataset>, or
    data/<dataset>."""
    split: str = "test"
    """Split of the dataset."""
    estimator: Literal["ekf", "integrate", "imu_only"] = "ekf"
    """The paper's filter, the displacements summed, or the IMU integrated without the network."""
    coupling: Literal["tight", "loose"] = "tight"
    """Of the ekf: the network inside the filter, or over all windows before it with a given
    orientation."""
    orientation: Literal["filter", "device", "reference"] | None = None
    """Attitude that rotates the network's windows; by default the filter's for the tight coupling,
    else the reference's. Without a filter, `filter` is the gyro integrated from the start."""
    init: Literal["reference", "static"] = "reference"
    """Start from the reference's pose and velocity, or from gravity with yaw, velocity and position
    zero."""
    gyro_bias: Literal["zero", "rest", "reference"] = "zero"
    """First gyro bias: zero, the mean of a rest at the start, or the first 10 s against the
    reference orientation."""
    alignment: Literal["origin", "none", "yaw_position", "se3"] = "origin"
    """How an estimate is laid on the reference before absolute errors: start position and yaw, not
    at all, least squares."""
    checkpoint: Literal["best", "latest"] = "best"
    """Which checkpoint of the run."""
    batch_size: int = 16
    """Recordings estimated side by side."""
    plots: bool = True
    """Draw the trajectories, errors, displacements and the errors' distribution."""
    filter: FilterOptions = field(default_factory=FilterOptions)
    """Noise and start of the filter; fields that are not given are the run's own."""
