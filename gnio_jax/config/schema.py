"""The sections of an experiment's configuration: frozen dataclasses whose field comments are the
text of `--help` and whose types carry the bounds of the values.

A section that relates several fields to each other checks them in `check`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from gnio_jax.config.bounds import (
    Count,
    FiniteNonNegative,
    Fraction,
    NonNegative,
    NonNegativeCount,
    Positive,
    Probability,
    TwoOrThree,
)
from gnio_jax.config.through_filter import ThroughFilter
from gnio_jax.errors import InputError


@dataclass(frozen=True)
class DataConfig:
    """Which recordings are read, and how windows are cut from them."""

    rate: Positive = 200.0
    """Samples per second to which every recording is resampled, Hz."""
    window_seconds: Positive = 1.0
    """Length of the network's window, s (paper: 1 s)."""
    context_seconds: NonNegative = 0.0
    """IMU before the window that the network sees too, s; it still tells the displacement over the
    window (ours; paper: none)."""
    stride_seconds: Positive = 0.1
    """Distance between window starts, and between the filter's clones, s (paper: 0.1 s)."""
    train_stride_seconds: Positive = 0.1
    """Distance between window starts in training, s (paper: 0.1 s). A shorter one shows more phases
    of the same steps."""
    window_rotation: Literal["per_sample", "single"] = "per_sample"
    """Rotate each sample with its own attitude, or the whole window with the attitude at its start
    (eq. 1 read literally)."""
    train_split: str = "train"
    """Split of the dataset for training."""
    val_split: str = "val"
    """Split of the dataset for validation, which chooses the best checkpoint."""
    folds: Count = 1
    """Folds into which the sessions (or people) of the training split are shared; 1 shares nothing.
    A network for each fold gives gnio calibrate walks that were not learnt from (ours)."""
    left_out: NonNegativeCount = 0
    """With several folds: the one that is left out of training."""
    residency: Literal["device", "host", "auto"] = "device"
    """Where recordings lie in training on windows: on the device, or on the disk, from which
    batches are read ahead; auto: on the disk if they take more than half of the device's memory.
    The numbers are the same (ours)."""

    @property
    def window(self) -> int:
        """Samples in a window."""
        return round(self.window_seconds * self.rate)

    @property
    def context(self) -> int:
        """Samples before a window that the network sees too."""
        return round(self.context_seconds * self.rate)

    @property
    def seen(self) -> int:
        """Samples that the network sees: the context and the window."""
        return self.context + self.window

    @property
    def stride(self) -> int:
        """Samples between window starts, which is also one clone interval of the filter."""
        return round(self.stride_seconds * self.rate)

    @property
    def train_stride(self) -> int:
        """Samples between window starts in training."""
        return round(self.train_stride_seconds * self.rate)

    def check(self, prefix: str, source: str) -> None:
        """Window, context and strides are whole samples, and strides fill window and context."""
        for name in (
            "window_seconds",
            "context_seconds",
            "stride_seconds",
            "train_stride_seconds",
        ):
            samples = getattr(self, name) * self.rate
            if abs(samples - round(samples)) >= 1e-6:
                problem = f"is not a whole number of samples at {self.rate:g} Hz ({samples:g})"
                raise InputError(source, f"field '{prefix}{name}' {problem}")
        if self.window % self.stride:
            problem = f"must divide the window of {self.window_seconds:g} s"
            raise InputError(source, f"field '{prefix}stride_seconds' {problem}")
        if self.context % self.stride:
            problem = f"must divide the context of {self.context_seconds:g} s"
            raise InputError(source, f"field '{prefix}stride_seconds' {problem}")
        if self.left_out >= self.folds:
            problem = f"must be below data.folds, which is {self.folds}, found {self.left_out}"
            raise InputError(source, f"field '{prefix}left_out' {problem}")


@dataclass(frozen=True)
class AugmentConfig:
    """Random changes of a training window (TLIO's; the paper is silent). Zero or false switches one
    off. In training through the filter `yaw` alone plays a part (ours)."""

    gyro_bias: NonNegative = 0.05
    """Half-width of the uniform constant gyro bias, rad/s."""
    accel_bias: NonNegative = 0.2
    """Half-width of the uniform constant accelerometer bias, m/s²."""
    tilt_degrees: NonNegative = 5.0
    """Largest tilt of gravity about a random horizontal axis, degrees."""
    yaw: bool = True
    """Turn window and target by a random yaw; through the filter, piece and reference."""
    gyro_noise: NonNegative = 0.0
    """Standard deviation of white gyro noise, rad/s."""
    accel_noise: NonNegative = 0.0
    """Standard deviation of white accelerometer noise, m/s²."""
    shift_samples: NonNegativeCount = 0
    """Shift a training window by up to this many samples either way, where the recording allows it
    (RoNIN, DeepILS)."""


@dataclass(frozen=True)
class ModelConfig:
    """The network and its options. An option that is not given takes the network's own default,
    which is the published one. An option that the network does not have is refused."""

    name: str = "gnio"
    """Network in the registry of `gnio_jax.models`."""
    width: Count | None = None
    """Channels of the first encoder group; the others follow (gnio, tlio, ronin_resnet, deepils:
    64)."""
    bank_size: NonNegativeCount | None = None
    """Prototypes in the Motion Bank; 0 leaves the bank out (gnio: 64)."""
    bank_heads: Count | None = None
    """Attention heads of the bank's query (gnio: 8)."""
    bank_std: Positive | None = None
    """Standard deviation of the prototypes before training (gnio: 1). Near 1/√d, for d features,
    all prototypes receive the same attention."""
    head: Literal["gated", "linear"] | None = None
    """Displacement as scale × gate, or a plain linear layer (gnio: gated)."""
    gate: Literal["tanh", "sigmoid"] | None = None
    """Activation of the gate (gnio: tanh)."""
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] | None = None
    """Activation of the scale (gnio: softplus)."""
    uncertainty: Literal["head", "calibrated", "constant"] | None = None
    """Source of the standard deviation: a head (paper), a head times one factor per axis, or one
    constant per axis. Factor and constant are fitted to the errors on the validation split
    (gnio: head)."""
    output_dim: TwoOrThree | None = None
    """Dimensions of the displacement: 3, or 2 without the vertical, as published (ronin_resnet,
    deepils, ctin, imot)."""
    dropout: Probability | None = None
    """Fraction of activations dropped in training (tlio, ronin_resnet, deepils: 0.5; imot: 0.1)."""
    equivariance: Literal["none", "four_headings", "canonical_frame"] = "none"
    """A window turned about the vertical gives the displacement turned alike, for every network:
    the mean over four headings of the window, at inference, or a frame that a small network finds
    in the window (EqNIO)."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Factors of matrix products and convolutions in training on windows (ours). Sums, parameters,
    statistics, loss and update are float32 either way, and so is the network once it is trained."""


@dataclass(frozen=True)
class LossConfig:
    """The training loss (paper §III-F), and the extra terms of the other networks."""

    name: Literal["weighted_sum", "velocity_and_covariance"] = "weighted_sum"
    """Weighted sum of squared error, absolute error and negative log-likelihood of the
    displacement, with the weights below; or CTIN's loss: errors of velocity and position and the
    likelihood of each sample's velocity, weighted by two learnt parameters."""
    mse_weight: float = 1e2
    """λ_MSE."""
    mae_weight: float = 0.0
    """Weight of the absolute error, summed over the axes (DeepILS: equal to λ_MSE)."""
    nll_weight: float = 1e-4
    """λ_NLL."""
    nll_from_epoch: FiniteNonNegative = 0.0
    """Epochs before the likelihood counts. Above 0: the two-stage reading of the paper's text."""
    log_std_from_epoch: FiniteNonNegative = 0.0
    """Epochs before the likelihood trains the uncertainty; until then it trains the displacement
    alone (TLIO: 10)."""
    log_std_floor: float | None = None
    """Smallest log standard deviation in the likelihood (TLIO: log 1e-3); none by default."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam with linear warm-up and cosine decay (paper §IV-A), or the schedules of the other
    networks."""

    schedule: Literal["cosine", "constant", "plateau"] = "cosine"
    """Learning rate after the warm-up: cosine decay to the last step, constant, or reduced whenever
    the validation error no longer falls."""
    epochs: Count = 200
    """Passes over the training windows."""
    batch_size: Count = 1024
    """Windows per step."""
    accumulate: Count = 1
    """Parts of a batch whose gradients are computed one after another and averaged: less memory for
    the same step. In training, batch normalisation then sees a part."""
    learning_rate: Positive = 1e-4
    """Peak learning rate, reached after the warm-up."""
    start_learning_rate: float = 1e-6
    """Learning rate at the first step."""
    end_learning_rate: float = 1e-6
    """Learning rate at the last step."""
    warmup_epochs: FiniteNonNegative = 5.0
    """Epochs of linear warm-up; a run shorter than twice this warms up for its first half."""
    clip_norm: Positive | None = None
    """Largest global norm of the gradient; none by default."""
    weight_decay: NonNegative = 0.0
    """Factor of the parameter that is added to its gradient, before Adam (CTIN: 1e-6)."""
    plateau_epochs: Count = 10
    """Epochs without a smaller squared error on the validation split before the learning rate falls
    (RoNIN, DeepILS); for the plateau schedule."""
    plateau_factor: Fraction = 0.1
    """Factor applied to the learning rate on a plateau; for the plateau schedule."""
    best_by: Literal["loss", "squared_error"] = "loss"
    """Mean over the validation split that chooses the best checkpoint: the loss, or the squared
    error of the displacement. The choice begins anew where `loss.nll_from_epoch` or
    `loss.log_std_from_epoch` changes what is trained."""
    statistics_windows: NonNegativeCount = 16384
    """Augmented training windows from which the statistics of batch normalisation are estimated
    before every validation and checkpoint (ours); 0 keeps the running averages of the last
    steps."""
    ema_decay: Probability = 0.0
    """Share of the averaged parameters that a step keeps, e.g. 0.999 (ours): the averages are
    validated, kept as best and evaluated, while training goes on without them. 0 averages
    nothing."""

    def check(self, prefix: str, source: str) -> None:
        """Running statistics of batch normalisation are not those of averaged parameters. Parts of
        a batch have one size."""
        if self.batch_size % self.accumulate:
            problem = f"field '{prefix}accumulate' is {self.accumulate}"
            remedy = f"it must divide {prefix}batch_size, which is {self.batch_size}"
            raise InputError(source, problem, remedy)
        if self.ema_decay and not self.statistics_windows:
            problem = f"field '{prefix}ema_decay' is set without {prefix}statistics_windows"
            remedy = "averaged parameters want statistics of their own: set it, e.g. to 16384"
            raise InputError(source, problem, remedy)


CONSIDERED_FIELDS = (
    "considered_gyro_bias_std",
    "considered_scale_std",
    "considered_heading_std_degrees",
    "considered_slope_std",
)
"""Fields of `FilterOptions`: errors that the filter reports but does not estimate."""


@dataclass(frozen=True)
class FilterOptions:
    """Noise and initial uncertainty of the stochastic-cloning EKF (paper §III-G; TLIO's values)."""

    gyro_density: Positive = 3.16e-4
    """White gyro noise, rad/s/√Hz."""
    accel_density: Positive = 1.0e-3
    """White accelerometer noise, m/s²/√Hz."""
    gyro_bias_walk: NonNegative = 1e-6
    """Random walk of the gyro bias, rad/s/√s."""
    accel_bias_walk: NonNegative = 1e-4
    """Random walk of the accelerometer bias, m/s²/√s."""
    tilt_std_degrees: NonNegative = 1.0
    """Initial standard deviation of roll and pitch."""
    yaw_std_degrees: NonNegative = 0.1
    """Initial standard deviation of yaw."""
    velocity_std: NonNegative = 1.0
    """Initial standard deviation of the velocity, m/s."""
    position_std: NonNegative = 1e-3
    """Initial standard deviation of the position, m."""
    gyro_bias_std: NonNegative = 1e-4
    """Initial standard deviation of the gyro bias, rad/s."""
    accel_bias_std: NonNegative = 0.02
    """Initial standard deviation of the accelerometer bias, m/s²."""
    measurement_scale: Positive = 10.0
    """Factor of the network's covariance in the update."""
    std_factor_x: Positive = 1.0
    """Factor of the network's standard deviation along x of the window's yaw frame (ours; what
    `gnio calibrate` finds that it lacks)."""
    std_factor_y: Positive = 1.0
    """The same along y."""
    std_factor_z: Positive = 1.0
    """The same along z."""
    window_error_share: Probability = 0.0
    """Share of a window's standard deviation that lasts beyond the window (ours); 0: its error is
    white."""
    window_error_seconds: Positive = 0.5
    """Time constant of that error, s."""
    scale_error_std: NonNegative = 0.0
    """Standard deviation of the walker's speed over what the network says of it, as a fraction
    (ours); 0: the displacements have no such error."""
    heading_error_std_degrees: NonNegative = 0.0
    """Standard deviation of the displacements' heading (ours); 0: they have no such error."""
    walk_error_seconds: Positive = 60.0
    """Time constant of both, s."""
    considered_gyro_bias_std: NonNegative = 0.0
    """Standard deviation, rad/s, of the gyro's bias that the filter does not try to estimate but
    reports in the covariance of its trajectories (ours; consider covariance analysis). The
    trajectory does not depend on this nor on the next three. Smoother and Tracker count them where
    they are given (`considered=`)."""
    considered_scale_std: NonNegative = 0.0
    """The same of the displacements' scale, as a fraction."""
    considered_heading_std_degrees: NonNegative = 0.0
    """The same of their heading."""
    considered_slope_std: NonNegative = 0.0
    """The same of their slope, metres up for each metre forward."""
    mahalanobis_fail_scale: NonNegative = 0.0
    """0 skips an update that the χ² gate rejects; above 0 the update is applied with its covariance
    multiplied by this."""
    window_rotation: Literal["per_sample", "single", "tlio"] | None = None
    """How the tight coupling cuts and rotates the network's windows; by default as in training.
    `tlio` does it as TLIO's tracker: a sample earlier and without the filter's biases, for weights
    trained that way."""


@dataclass(frozen=True)
class TrainConfig:
    """One experiment: everything `gnio train` needs, kept with the run as config.yaml."""

    dataset: str = "synthetic"
    """Dataset to learn from; `gnio data list` shows the known ones."""
    data_root: str | None = None
    """Folder of the dataset; by default $GNIO_DATA/<dataset>, then data/<dataset>."""
    workdir: str | None = None
    """Folder for checkpoints and logs; by default runs/<dataset>_<model>."""
    init_from: str | None = None
    """Run, or package of weights (see gnio weights), with the same network, whose best weights
    training starts from; by default they are drawn. Through the filter, `gnio train` also begins
    with its filter options."""
    seed: int = 0
    """Seed of the initial parameters, the shuffling and the augmentation."""
    data: DataConfig = field(default_factory=DataConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    filter: FilterOptions = field(default_factory=FilterOptions)
    through_filter: ThroughFilter = field(default_factory=ThroughFilter)
    checkpoint_every_seconds: float = 600.0
    """Longest time between checkpoints within an epoch, s; every epoch ends with one anyway."""

    def check(self, prefix: str, source: str) -> None:
        """Four headings are averaged only if training shows windows of every heading. A network
        that learns through the filter has weights, and its pieces are whole strides and longer
        than a window and its context. A network that predicts every sample takes no context."""
        if self.data.context and self.model.name == "ctin":
            problem = f"field '{prefix}data.context_seconds' is not for ctin"
            raise InputError(source, problem, "it predicts every sample it sees: set it to 0")
        if self.model.equivariance == "four_headings" and not self.augment.yaw:
            problem = f"field '{prefix}model.equivariance' is four_headings without augment.yaw"
            remedy = "training must show every heading: set augment.yaw to true"
            raise InputError(source, problem, remedy)
        self._check_through_filter(prefix, source)

    def _check_through_filter(self, prefix: str, source: str) -> None:
        through = self.through_filter
        if not through.learn:
            return
        if self.optim.ema_decay:
            problem = f"field '{prefix}optim.ema_decay' is for training on windows alone"
            raise InputError(source, problem, "set it to 0")
        if self.optim.accumulate > 1:
            problem = f"field '{prefix}optim.accumulate' is for training on windows alone"
            raise InputError(source, problem, "set it to 1")
        if self.model.dtype != "float32":
            problem = f"field '{prefix}model.dtype' is for training on windows alone"
            raise InputError(source, problem, "set it to float32")
        if self.data.residency == "host":
            problem = f"field '{prefix}data.residency' is for training on windows alone"
            raise InputError(source, problem, "set it to device")
        for name in ("piece_seconds", "truncate_seconds"):
            strides = getattr(through, name) / self.data.stride_seconds
            if abs(strides - round(strides)) >= 1e-6:
                problem = f"is not a whole number of strides of {self.data.stride_seconds:g} s"
                raise InputError(source, f"field '{prefix}through_filter.{name}' {problem}")
        if through.gate_softness > 0 and self.filter.mahalanobis_fail_scale > 0:
            problem = "makes no sense beside filter.mahalanobis_fail_scale"
            field_name = f"field '{prefix}through_filter.gate_softness'"
            raise InputError(source, f"{field_name} {problem}", "set one of them to 0")
        seen = self.data.context_seconds + self.data.window_seconds
        if through.piece_seconds < seen + 2 * self.data.stride_seconds:
            problem = f"must be longer than the {seen:g} s that the network sees"
            raise InputError(source, f"field '{prefix}through_filter.piece_seconds' {problem}")
