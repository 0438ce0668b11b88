"""The sections of an experiment: frozen dataclasses, and tuples of numbers that the filter uses
directly. The comments of the fields are the text of `--help`; their types have bounds.

A section that relates several fields to each other checks them in `check`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn

from gnio_jax.errors import InputError


class Location(NamedTuple):
    """The location of a setting or a section in a file or on the command line."""

    source: str
    field: str = ""
    """Names joined by dots; empty at the top."""

    def child(self, name: str) -> Location:
        """The field `name` of this section."""
        return Location(self.source, f"{self.field}.{name}" if self.field else name)

    def refuse(self, problem: str, remedy: str = "") -> NoReturn:
        """Raise an `InputError` about this location."""
        text = f"field '{self.field}' {problem}" if self.field else problem
        raise InputError(self.source, text, remedy)


class Bound(NamedTuple):
    """A condition that a value, or each number of a tuple, must fulfil. A field that is None has no
    value and fulfils every bound."""

    holds: Callable[[Any], bool]
    problem: str
    """The text of the message after the field's name."""


class Words(NamedTuple):
    """The form of a field on the command line if it is not --name VALUE."""

    metavar: str = ""
    """The name of the value in the help, if its type would say too little."""
    named: bool = True
    """The field is given without its name, as in gnio track FILE; for a section, the fields are
    given without the section's name."""
    repeated: bool = False
    """A list whose items are given one by one: --set a=1 --set b=2."""


FILE_ONLY = "file only"
"""Mark of a field that is no option of the command line; --set reaches it."""
UNNAMED = Words(named=False)
LONGEST_INPUT = 60.0
"""Longest window with its context, s (ours): the filter keeps a clone for each stride of it."""
Number = Any
"""A float in a file. Inside a JAX program it may be an array, so type checkers accept any type."""


class Entries(Mapping[str, Any]):
    """A mapping that cannot change, with its entries in the order in which they are written."""

    def __init__(self, entries: Mapping[str, Any] | None = None) -> None:
        self._entries = {
            name: Entries(value) if isinstance(value, dict) else value
            for name, value in (entries or {}).items()
        }

    def __getitem__(self, name: str) -> Any:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __hash__(self) -> int:
        return hash(tuple(self._entries.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mapping) and list(self.items()) == list(other.items())

    def __repr__(self) -> str:
        return repr(self._entries)


ABOVE_ZERO = Bound(lambda value: 0 < value < math.inf, "must be positive and finite")
NOT_NEGATIVE = Bound(lambda value: 0 <= value < math.inf, "must be finite and not negative")
FACTOR_LIMITS = (1e-6, 1e6)
FACTOR = Bound(
    lambda value: FACTOR_LIMITS[0] <= value <= FACTOR_LIMITS[1], "must be from 1e-6 to 1e6"
)
FINITE = Bound(math.isfinite, "must be finite")
SHARE = Bound(lambda value: 0 <= value < 1, "must be at least 0 and below 1")
PACE = Bound(lambda value: 0.1 <= value <= 10, "must be from 0.1 to 10")

Positive = Annotated[float, ABOVE_ZERO]
NonNegative = Annotated[float, NOT_NEGATIVE]
Finite = Annotated[float, FINITE]
Probability = Annotated[float, SHARE]
Width = Annotated[int, Bound(lambda value: 1 <= value <= 4096, "must be from 1 to 4096")]
Share = Annotated[float, Bound(lambda value: 0 <= value <= 1, "must be from 0 to 1")]
Factor = Annotated[float, PACE]
Tilt = Annotated[float, Bound(lambda value: 0 < value < 90, "must be above 0 and below 90")]
Count = Annotated[int, Bound(lambda value: 1 <= value < 2**31, "must be at least 1 and below 2^31")]
NonNegativeCount = Annotated[
    int, Bound(lambda value: 0 <= value < 2**31, "must not be negative and below 2^31")
]
Seed = Annotated[int, Bound(lambda value: 0 <= value < 2**32, "must be from 0 to 2^32 - 1")]
Rate = Annotated[float, Bound(lambda value: 1 <= value <= 10000, "must be from 1 to 10000 Hz")]
NewFile = Annotated[Path, Bound(lambda path: not path.is_dir(), "must not be a folder")]
Folder = Annotated[Path, Bound(lambda path: not path.is_file(), "must be a folder")]


def _is_whole(number: float) -> bool:
    """Whether it is a whole number of samples or strides, to rounding, and below 10^9."""
    return number == 0 or (0.5 < number < 1e9 and abs(number - round(number)) < 1e-6)


@dataclass(frozen=True)
class DataConfig:
    """Which recordings are read, and how windows are cut from them."""

    rate: Positive = 200.0
    """Samples per second to which every recording is resampled, Hz."""
    window_seconds: Positive = 1.0
    """Length of the network's window, s (paper: 1 s)."""
    context_seconds: NonNegative = 0.0
    """IMU before the window that the network sees too, s; it still predicts the displacement over
    the window (ours; paper: none)."""
    stride_seconds: Positive = 0.1
    """Distance between window starts, and between the filter's clones, s (paper: 0.1 s)."""
    train_stride_seconds: Positive = 0.1
    """Distance between window starts in training, s (paper: 0.1 s). With a shorter distance the
    network sees the same steps at more phases."""
    window_rotation: Literal["per_sample", "single", "body_axes", "hidden_axes"] = "per_sample"
    """Rotate each sample with its own attitude, or the whole window with the attitude at its start
    (eq. 1 read literally). body_axes is per_sample with the x and y axes of the body as six more
    channels, for networks that see the body (ai_imu, airio, device_heading, and a corrector);
    hidden_axes has zeros there (device_heading)."""
    train_split: str = "train"
    """Split of the dataset for training. train-0of4 leaves out the first of four folds of it, in
    which people and sessions are whole: with a network for each fold, gnio calibrate has walks that
    were not used for training (ours)."""
    val_split: str = "val"
    """Split of the dataset for validation, which chooses the best checkpoint."""
    weights: tuple[Positive, ...] = ()
    """For several datasets: how often an epoch visits the windows of each. With 0.5 it visits half
    of them, drawn again in every epoch; with 2 it visits all of them twice. The default is 1 for
    each (ours)."""
    poses_by: Annotated[str | None, FILE_ONLY] = None
    """Calibrated network: the folder of a run, a package or a name (see gnio weights). From its
    displacements the smoother makes poses for walks with waypoints; by default these poses are
    interpolated (ours)."""

    @property
    def window(self) -> int:
        """Samples in a window."""
        return round(self.window_seconds * self.rate)

    @property
    def context(self) -> int:
        """Samples before a window that the network sees too."""
        return round(self.context_seconds * self.rate)

    @property
    def input_samples(self) -> int:
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

    def check(self, location: Location) -> None:
        """Check that window, context and strides are whole samples, that strides fill window and
        context, and that both together are not longer than `LONGEST_INPUT`."""
        for name in ("window_seconds", "context_seconds", "stride_seconds", "train_stride_seconds"):
            samples = getattr(self, name) * self.rate
            if not _is_whole(samples):
                problem = f"is not a whole number of samples at {self.rate:g} Hz ({samples:g})"
                location.child(name).refuse(problem)
        if self.window_seconds + self.context_seconds > LONGEST_INPUT:
            longest = "context" if self.context_seconds else "window"
            problem = f"makes an input of more than {LONGEST_INPUT:g} s"
            location.child(f"{longest}_seconds").refuse(problem)
        if self.window % self.stride:
            location.child("stride_seconds").refuse(
                f"must divide the window of {self.window_seconds:g} s"
            )
        if self.context % self.stride:
            location.child("stride_seconds").refuse(
                f"must divide the context of {self.context_seconds:g} s"
            )


@dataclass(frozen=True)
class AugmentConfig:
    """Random changes of a training window, as in TLIO (the paper names none). Zero or false
    switches a change off. Training through the filter uses only `yaw` and the low-pass (ours)."""

    gyro_bias: NonNegative = 0.05
    """Half-width of the uniform constant gyro bias, rad/s."""
    accel_bias: NonNegative = 0.2
    """Half-width of the uniform constant accelerometer bias, m/s²."""
    tilt_degrees: NonNegative = 5.0
    """Largest tilt of gravity about a random horizontal axis, degrees."""
    yaw: bool = True
    """Turn window and target by a random yaw; through the filter, segment and reference. Without it
    the frame of a window has the heading of the phone, from which a network then learns how phones
    are held (docs/results/networks.md), and a segment keeps the axes of its recording's world."""
    noise: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Standard deviations of white noise of gyro (rad/s) and accelerometer (m/s²)."""
    shift_samples: NonNegativeCount = 0
    """Shift a training window by up to this many samples either way, where the recording allows it
    (RoNIN, DeepILS)."""
    low_pass_share: Probability = 0.0
    """Share of the windows, or segments, that pass a random low-pass. It is drawn for each of them
    and is the same for both sensors. Otherwise the network may recognise a phone by its bandwidth
    (ours, e.g. 0.5)."""
    low_pass_hertz: Annotated[tuple[Positive, Positive], FILE_ONLY] = (4.0, 25.0)
    """Lowest and highest cut-off of that low-pass, a Butterworth of order 1 to 3 that is passed
    forward and back, Hz."""
    scale: Annotated[tuple[Probability, Probability], FILE_ONLY] = (0.0, 0.0)
    """Half-widths of a window's uniform scale errors of gyro and accelerometer (ours)."""
    rest_share: Annotated[Probability, FILE_ONLY] = 0.0
    """Share of the windows that are replaced by windows of a phone at rest (ours)."""
    hidden_axes_share: Annotated[Share, FILE_ONLY] = 0.0
    """Share of the windows or segments whose heading model.equivariance: device_heading does not
    know, so that the network learns the direction from the gait, too (ours)."""
    mirror_share: Annotated[Share, FILE_ONLY] = 0.0
    """Share of the windows or segments that are mirrored from left to right, so that the left hand
    carries what the right one carried (ours). What is ahead of the phone remains ahead."""
    rocking_share: Annotated[Share, FILE_ONLY] = 0.0
    """Share of the windows or segments in which the phone rocks otherwise in the hand: its rate of
    turn about horizontal axes is turned about the vertical by any angle and scaled by a factor from
    0 to 1.25 (ours)."""
    walkway_share: Annotated[Share, FILE_ONLY] = 0.0
    """Share of the segments that are walked on a moving walkway: the same gait at another speed
    (`training.walkway`; ours)."""
    walkway: Annotated[tuple[Factor, Factor], FILE_ONLY] = (0.45, 2.0)
    """Smallest and largest factor of the mean speed on a walkway."""
    alternating_gain: Annotated[tuple[Factor, Factor], FILE_ONLY] = (1.0, 1.0)
    """Smallest and largest factor of the fast part of position and acceleration, for segments: of
    the gait without the mean motion (ours)."""
    vertical_gain: Annotated[tuple[Factor, Factor], FILE_ONLY] = (1.0, 1.0)
    """Smallest and largest further factor of the vertical fast part: how much of the body's bounce
    reaches the phone (ours)."""
    time_stretch: Annotated[tuple[Factor, Factor], FILE_ONLY] = (1.0, 1.0)
    """Smallest and largest factor of the pace at which a segment is played (ours)."""

    def check(self, location: Location) -> None:
        """Check that no range has its ends in the wrong order."""
        for name in (
            "low_pass_hertz",
            "walkway",
            "alternating_gain",
            "vertical_gain",
            "time_stretch",
        ):
            low, high = getattr(self, name)
            if low > high:
                location.child(name).refuse(
                    "has the larger one first", "give the smaller one first"
                )


@dataclass(frozen=True)
class ModelConfig:
    """The network and its options: those that networks of this package have, and `options`. An
    option that is not given takes the network's own default, which is the published one. An option
    that the network does not have is refused."""

    name: str = "gnio"
    """Name of the network, one of the package or of a plugin."""
    width: Width | None = None
    """Channels of the first encoder group; the others follow (gnio, tlio, ronin_resnet, deepils:
    64). Features of a sample (ctin, state_space: 96), of the first convolution (gru: 64), of the
    first block (ronin_tcn: 16), or units of a layer (ronin_lstm: 100)."""
    particles: Count | None = None
    """Velocities that attend to the window (imot, imot_text: 128)."""
    bank_size: NonNegativeCount | None = None
    """Prototypes in the Motion Bank; 0 leaves the bank out (gnio: 64, networks with memory: 0)."""
    bank_std: Positive | None = None
    """Standard deviation of the prototypes before training (gnio: 1). Near 1/√d, for d features,
    all prototypes receive the same attention."""
    head: Literal["gated", "linear", "bins"] | None = None
    """Displacement as scale × gate, or a plain linear layer (gnio: gated, networks with memory:
    linear), or a distribution over bins with its own uncertainty (gnio, trunk, networks with
    memory; VeloBins)."""
    reach: Positive | None = None
    """Largest displacement of the bins, m (3). Take 1.1 times the largest of the training
    windows."""
    block: Literal["star", "rep", "fourier", "wavelet"] | None = None
    """Kind of block of the network trunk (star)."""
    gate: Literal["tanh", "sigmoid"] | None = None
    """Activation of the gate (gnio: tanh)."""
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] | None = None
    """Activation of the scale (gnio: softplus)."""
    uncertainty: Literal["head", "calibrated", "constant"] | None = None
    """Source of the standard deviation: a head (paper), a head times one factor per axis, or one
    constant per axis. Factor and constant are fitted to the errors on the validation split
    (gnio: head)."""
    output_dim: Literal[2, 3] | None = None
    """Dimensions of the displacement: 3, or 2 without the vertical, as published (ronin_resnet,
    deepils, ctin, imot, ionext)."""
    normalisation: Literal["batch", "group"] | None = None
    """Normalisation of the convolutions (ronin_resnet: batch). group is that of RIO: over the
    samples of one window and 32 groups of channels, alike in training and inference."""
    equivariance: Literal[
        "none",
        "four_headings",
        "canonical_frame",
        "device_heading",
        "o2_frame",
        "so2_frame",
        "so2_frame_shallow",
    ] = "none"
    """How a network is made equivariant, so that its displacement turns with a window that is
    turned about the vertical. four_headings is the mean over four headings of the window, at
    inference, or over four memories of a network that has one; canonical_frame uses a frame that a
    small network finds in the window; device_heading uses the heading of the device if its screen
    faces up, as people hold it ahead (a network with memory sees it beside its samples, by four
    memories). The others are EqNIO's networks for the frame: with
    reflections (o2_frame), without them (so2_frame: around TLIO, so2_frame_shallow: around
    RoNIN)."""
    frame_width: Annotated[Count | None, FILE_ONLY] = None
    """Vectors, and scalars, in a layer of EqNIO's network for the frame (o2_frame: 64, the others:
    128)."""
    largest_tilt: Annotated[Tilt | None, FILE_ONLY] = None
    """Angle from the vertical up to which the normal of a screen faces up for device_heading,
    degrees (60)."""
    corrector: Literal["none", "airimu"] = "none"
    """A network that corrects the samples before any other sees them (AirIMU)."""
    options: Annotated[Mapping[str, float | int | bool | str | None], FILE_ONLY] = field(
        default_factory=Entries
    )
    """Options that only a network of a plugin has, by their names; --set model.options.NAME=VALUE
    gives one."""

    def __post_init__(self) -> None:
        if isinstance(self.options, dict):
            object.__setattr__(self, "options", Entries(self.options))


@dataclass(frozen=True)
class LossConfig:
    """The training loss (paper §III-F), and the extra terms of the other networks."""

    name: Literal["weighted_sum", "velocity_and_covariance", "polar", "body_velocity", "bins"] = (
        "weighted_sum"
    )
    """Weighted sum of squared error, absolute error and negative log-likelihood of the
    displacement, with the weights below; or CTIN's loss, which has errors of velocity and position
    and the likelihood of each sample's velocity, weighted by two trainable parameters; or IONet's
    (polar), the squared errors of length and angle; or AirIO's (body_velocity), Huber's loss and
    the likelihood of the velocities in the body; or VeloBins' (bins), Huber's loss of the mean and
    the divergence of the distribution from one about the truth."""
    mse_weight: NonNegative = 1e2
    """λ_MSE."""
    mae_weight: NonNegative = 0.0
    """Weight of the absolute error, summed over the axes (DeepILS: equal to λ_MSE)."""
    nll_weight: NonNegative = 1e-4
    """λ_NLL."""
    nll_from_epoch: NonNegative = 0.0
    """Epochs at the start without the likelihood. A value above 0 is the two-stage training that
    the paper's text can also mean."""
    log_std_from_epoch: NonNegative = 0.0
    """Epochs before the likelihood trains the uncertainty; until then it trains the displacement
    alone (TLIO: 9)."""
    log_std_floor: Finite | None = None
    """Smallest log standard deviation in the likelihood (TLIO: log 1e-3); none by default."""
    angle_weight: Annotated[NonNegative, FILE_ONLY] = 1.0
    """Weight of the squared angle, m²/rad², in the loss polar (IONet's κ, which is not
    published)."""
    rotation_weight: Annotated[NonNegative, FILE_ONLY] = 0.0
    """Weight of the rotation consistency (RIO: 1): the negative cosine between the prediction,
    turned by a random angle, and the prediction for the window turned by it."""
    balance_weight: Annotated[NonNegative, FILE_ONLY] = 0.01
    """Weight of the balance between experts, for networks with a router (ours)."""
    preintegration_weight: Annotated[NonNegative, FILE_ONLY] = 0.0
    """Weight of the preintegration loss, from which a corrector learns (AirIMU: 1)."""
    outlier_sigmas: Annotated[Positive | None, FILE_ONLY] = None
    """Standard deviations beyond which the likelihood of an error grows only with its logarithm
    (ours, e.g. 10); none by default, as in the paper."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam with linear warm-up and cosine decay (paper §IV-A), or the schedules of the other
    networks."""

    schedule: Literal["cosine", "constant", "plateau"] = "cosine"
    """Learning rate after the warm-up: cosine decay to 1e-6 at the last step, constant, or divided
    by ten whenever the squared error on the validation split has not fallen for 10 epochs (RoNIN,
    DeepILS)."""
    epochs: Count = 200
    """Passes over the training windows."""
    batch_size: Count = 1024
    """Windows per step."""
    learning_rate: Positive = 1e-4
    """Peak learning rate, reached after the warm-up."""
    start_learning_rate: Annotated[NonNegative, FILE_ONLY] = 1e-6
    """Learning rate at the first step."""
    warmup_epochs: NonNegative = 5.0
    """Epochs of linear warm-up; a run shorter than twice this warms up for its first half."""
    clip_norm: Positive | None = None
    """Largest global norm of the gradient; none by default."""
    weight_decay: NonNegative = 0.0
    """Weight decay: this factor times the parameter is added to its gradient before Adam (CTIN:
    1e-6)."""
    best_by: Literal["loss", "squared_error", "latest"] = "loss"
    """What chooses the checkpoint that is kept as the best: the smallest mean over the validation
    split of the loss, or of the squared error of the displacement; or "latest", the last epoch
    whose squared error is finite, as fits a learning rate that falls to zero and validation walks
    of few people. The choice begins anew where `loss.nll_from_epoch` or `loss.log_std_from_epoch`
    changes what is trained."""
    statistics_windows: NonNegativeCount = 16384
    """Augmented training windows from which the statistics of batch normalisation are estimated
    before every validation and checkpoint (ours); 0 keeps the running averages of the last
    steps."""


class CorrelatedError(NamedTuple):
    """The part of a window's error that is temporally correlated (ours): a first-order Gauss–Markov
    process, because windows overlap and the errors of successive windows are correlated."""

    share: Annotated[Number, SHARE] = 0.8
    """Share c of the network's standard deviation; the rest is white."""
    seconds: Annotated[Number, ABOVE_ZERO] = 0.5
    """Time constant τ, s."""


class NoiseModel(NamedTuple):
    """White noise of the IMU as densities, so that it does not depend on the rate, random walks of
    its biases, and the factors of the network's covariances. Each number may be traced.

    The defaults of the IMU are TLIO's per-sample values, tuned at about 1 kHz, as densities.
    """

    gyro_density: Annotated[Number, ABOVE_ZERO] = 3.16e-4
    """White gyro noise, rad/s/√Hz."""
    accel_density: Annotated[Number, ABOVE_ZERO] = 1.0e-3
    """White accelerometer noise, m/s²/√Hz."""
    gyro_bias_walk: Annotated[Number, NOT_NEGATIVE] = 1e-6
    """Random walk of the gyro bias, rad/s/√s."""
    accel_bias_walk: Annotated[Number, NOT_NEGATIVE] = 1e-4
    """Random walk of the accelerometer bias, m/s²/√s."""
    std_factor: Annotated[tuple[Number, Number, Number], FACTOR] = (1.0, 1.0, 1.0)
    """Factors of the network's standard deviations along x, y, z of the window's yaw frame (ours;
    `gnio calibrate` fits them)."""
    measurement_scale: Annotated[Number, FACTOR] = 10.0
    """Factor of the network's covariance in the update: overlapping windows are not independent
    (TLIO)."""
    correlation: CorrelatedError | None = None
    """Temporally correlated part of a window's error; by default the error is white."""

    @classmethod
    def per_sample(
        cls,
        gyro_std: Any,
        accel_std: Any,
        dt: Any,
        gyro_bias_walk: Any = 1e-6,
        accel_bias_walk: Any = 1e-4,
    ) -> NoiseModel:
        """The noise with the given standard deviations of one sample, rad/s and m/s², at `dt`
        seconds per sample: density = σ √dt."""
        root = dt**0.5
        return cls(gyro_std * root, accel_std * root, gyro_bias_walk, accel_bias_walk)


class InitialStd(NamedTuple):
    """Standard deviations of the initial state; the defaults are TLIO's. Each may be traced."""

    tilt: Annotated[Number, NOT_NEGATIVE] = math.radians(1.0)
    """Rotation about the world's x and y, rad."""
    yaw: Annotated[Number, NOT_NEGATIVE] = math.radians(0.1)
    """Rotation about the world's z, rad."""
    velocity: Annotated[Number, NOT_NEGATIVE] = 1.0
    """Velocity, m/s."""
    position: Annotated[Number, NOT_NEGATIVE] = 1e-3
    """Position, m."""
    gyro_bias: Annotated[Number, NOT_NEGATIVE] = 1e-4
    """Gyro bias, rad/s."""
    accel_bias: Annotated[Number, NOT_NEGATIVE] = 0.02
    """Accelerometer bias, m/s²."""


TLIO_STD = InitialStd()


class ConsideredStd(NamedTuple):
    """Standard deviations of errors that the filter does not estimate but reports in the covariance
    of its trajectories (ours; consider covariance analysis). No trajectory depends on them."""

    gyro_bias: Annotated[Number, NOT_NEGATIVE] = 0.0
    """Error of the first bias estimate of each gyro axis, rad/s."""
    scale: Annotated[Number, NOT_NEGATIVE] = 0.0
    """Logarithm of the scale of the displacements."""
    heading: Annotated[Number, NOT_NEGATIVE] = 0.0
    """Heading of the displacements, rad."""
    slope: Annotated[Number, NOT_NEGATIVE] = 0.0
    """Slope of the displacements, metres up for each metre forward."""
    raw_gyro_bias: Annotated[Number, NOT_NEGATIVE] = 0.0
    """Further error of a raw gyro's first bias along the vertical at the start, rad/s. A gyro is
    raw if its recording has `imu_compensated: no` and its bias starts from zero."""


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """The options of the filter, which are fixed when it is compiled. The defaults are TLIO's."""

    measures: Literal["displacement", "velocity"] = "displacement"
    """What the filter measures of the network: the displacement over its window, or for a network
    that predicts one (airio) its velocity in the body at the window's end, in metres per window."""
    mahalanobis_fail_scale: NonNegative = 0.0
    """0 skips a rejected measurement; above 0 it is applied with its covariance multiplied by
    this."""
    log_std_min: Finite = -4.0
    """The network's log standard deviation is raised to at least this (`run_odometry` only)."""
    gate_threshold: Positive = 11.345
    """Largest rᵀ S⁻¹ r that passes, of a displacement and of a velocity at rest: 99 % of χ² with
    three degrees of freedom."""
    convergence_seconds: NonNegative = 10.0
    """The gate remains open until the oldest clone is more than this after initialisation, s."""
    success_seconds: NonNegative = 0.5
    """When the last success is older than this, the gate pauses: everything passes, s."""
    pause_seconds: NonNegative = 1.0
    """Length of such a pause, s."""
    rest_gyro: NonNegative = 0.05
    """Bound of |gyro − b_g| of a quiet IMU, rad/s."""
    rest_accel: NonNegative = 0.3
    """Bound of | |accel − b_a| − g | of a quiet IMU, m/s²."""
    rest_by: Literal["samples", "means"] = "samples"
    """What these are bounds of: every sample, or the mean over each clone interval. An engine
    shakes the samples of a car at rest, and hardly their mean."""
    rest_seconds: NonNegative = 0.5
    """How long the IMU must be quiet before it counts as at rest, s."""
    rest_test_seconds: NonNegative = 0.0
    """For this long after `rest_seconds`, s, a rest without a displacement must pass the χ² test
    with `gate_threshold`: a car on a smooth road is quiet for moments. A longer rest is taken in
    any case, because the filter's velocity may be wrong. 0: there is no such test."""
    bridge_seconds: NonNegative = 0.1
    """For this long, s, the last IMU sample stands in for missing ones; then the filter coasts with
    constant attitude and velocity, and windows are no measurements."""
    gap_gyro_std: NonNegative = 1.0
    """Standard deviation of the rate that a gap may hide, rad/s. That of a held sample grows with
    its age and reaches this value at `bridge_seconds`."""
    gap_accel_std: NonNegative = 3.0
    """Standard deviation of the acceleration that a gap may hide, m/s²."""
    low_pass_seconds: NonNegative = 0.0
    """Time constant τ of a first-order low-pass that the IMU itself has applied to its output, s.
    The filter undoes it: each sample x becomes x + τ dx/dt (ours). 0: there is none."""
    error: Literal["invariant", "additive"] | None = None
    """The error of velocity and positions. invariant: after an update it is expressed at the new
    estimate, so that no later displacement shows a yaw that nobody measured (right-invariant EKF,
    Barrau and Bonnabel). additive: it is not, as in TLIO. By default additive where
    `window_rotation` is tlio, else invariant."""
    speed_limit: Positive = 100.0
    """Largest plausible speed, m/s. A displacement that is faster is rejected. An estimate that
    exceeds it has diverged, and is not `healthy` from then on (ours)."""


@dataclass(frozen=True)
class FilterSettings(FilterOptions):
    """The stochastic-cloning EKF of an experiment (paper §III-G; TLIO's values). Its sections are
    the tuples that `filtering.run_odometry` takes."""

    noise: NoiseModel = field(default_factory=NoiseModel)
    """Noise of the IMU and of the network's displacements."""
    start: InitialStd = TLIO_STD
    """Standard deviations of the initial state."""
    considered: ConsideredStd = field(default_factory=ConsideredStd)
    """Errors that are not estimated but included in the covariance (Schmidt's consider states)."""
    measurements: Mapping[str, Mapping[str, Number] | None] = field(default_factory=Entries)
    """Measurements besides the displacement, by their names, each with its numbers; they are taken
    after the displacement of a clone interval, in this order. zero_velocity: {std: 0.02} measures a
    velocity of zero with a standard deviation of 0.02 m/s while the IMU rests. `null` takes one
    away. Others are those that a plugin registers (ours)."""
    window_rotation: Literal["per_sample", "single", "body_axes", "hidden_axes", "tlio"] | None = (
        None
    )
    """How the tight coupling cuts and rotates the network's windows; by default as in training.
    `tlio` does it as TLIO's tracker: a sample earlier and without subtracting the filter's biases,
    for weights trained that way. `hidden_axes` hides the axes of the body from a network with
    model.equivariance: device_heading, for a device that is no phone."""
    corrector: str | None = None
    """Network with model.corrector (the folder of a run, a package or a name), whose corrector
    comes before network and filter: both get corrected samples, and the filter takes the variances
    that it predicts in the place of the densities in `noise` (AirIMU)."""
    raw_gyro_bias: NonNegative | None = None
    """Standard deviation of the first gyro bias for phones that subtract no bias, rad/s (ours):
    recordings with `imu_compensated: no`. By default it is that of `start`. Evaluation and tracking
    apply it to the two components that are level at the start; calibration, and the poses of walks
    with waypoints, to all three."""

    def __post_init__(self) -> None:
        if isinstance(self.measurements, dict):  # A hash needs entries that cannot change.
            object.__setattr__(self, "measurements", Entries(self.measurements))


SHORTEST_HORIZON = 1.0
"""Shortest time over which the losses through the filter compare displacements, s."""
Part = Literal["noise", "measurement", "start", "uncertainty", "head", "encoder", "all"]
"""A part of network and filter that can be trained."""


@dataclass(frozen=True)
class ThroughFilter:
    """Training with the network in the filter's loop (ours), from the weights of `init_from`. The
    section `optim` counts segments of recordings instead of windows; `loss` is for windows alone,
    and so is `augment` except its `yaw` and low-pass."""

    learn: Annotated[tuple[Part, ...], Words("PART")] = ()
    """Parts that are trained through the filter. Without this option the network is trained on
    windows. noise: the filter's densities and bias walks; measurement: the factors of the network's
    covariance, the correlation of its errors, and the numbers of `filter.measurements`; start: the
    standard deviations at the start; uncertainty, head, encoder: the network's; all: everything.
    Options of the filter that are 0 are not trained."""
    piece_seconds: Positive = 60.0
    """Length of the segments of recordings that are filtered, s."""
    truncate_seconds: NonNegative = 10.0
    """The filter, and the memory of a network that has one, continues without gradient after every
    interval of this length, s; 0: the gradient goes through the whole segment."""
    start_spread: Annotated[NonNegative, FILE_ONLY] = 1.0
    """Each segment starts with errors that are drawn from the filter's standard deviations at the
    start times this factor. 0: at the reference, with biases of zero, as an evaluation does."""
    filter_learning_rate: Positive = 0.03
    """Peak learning rate of the logarithms of the filter's options; the network's is
    optim.learning_rate. Both have its schedule."""
    displacement_weight: NonNegative = 100.0
    """Weight of the relative error of displacements over 1, 5, 10, 30 and 60 s."""
    yaw_weight: NonNegative = 1000.0
    """Weight of the relative error of yaw over the same times."""
    innovation_weight: NonNegative = 0.1
    """Weight of the negative log-likelihood of the innovations."""
    state_weight: NonNegative = 0.1
    """Weight of the negative log-likelihood of the true velocity and position under the filter's
    covariance."""
    translation_weight: Annotated[NonNegative, FILE_ONLY] = 0.0
    """Weight of KITTI's relative error of translation, over pieces of 100, 200, ... 800 m of each
    segment: the metric `t_rel`, for vehicles."""
    window_weight: Annotated[NonNegative, FILE_ONLY] = 100.0
    """Weight of the squared error of each window's displacement."""


@dataclass(frozen=True)
class SegmentTraining:
    """Training of a network with memory on segments of walks, with the attitude of the reference
    (ours). The section `optim` counts segments instead of windows, and `augment` changes segments:
    all but `shift_samples`."""

    seconds: NonNegative = 0.0
    """Length of the segments, s. 0 trains on windows (with a memory that begins anew in each)."""
    truncate_seconds: NonNegative = 0.0
    """The memory continues without gradient after every interval of this length, s; 0: the gradient
    goes through the whole segment."""
    horizon_weight: NonNegative = 0.0
    """Weight of the relative squared error of displacements over 5, 10, 30 and 60 windows."""


@dataclass(frozen=True)
class TrainConfig:
    """One experiment: everything `gnio train` needs, kept with the run as config.yaml."""

    dataset: str | tuple[str, ...] = "synthetic"
    """Dataset to learn from, or several; `gnio data list` shows the known ones. Several datasets
    must have splits of the same names, and the mean of their validation figures chooses the best
    checkpoint."""
    data_root: str | None = None
    """Folder of the dataset; by default, and for each of several, $GNIO_DATA/<dataset>, then
    data/<dataset>."""
    workdir: str | None = None
    """Folder for checkpoints and logs; by default runs/<dataset>_<model>."""
    init_from: str | None = None
    """Network of the same kind: the folder of a run, a package or a name (see gnio weights).
    Training starts from its weights, by default from random ones. Through the filter, `gnio train`
    also begins with its filter options."""
    seed: Seed = 0
    """Seed of the initial parameters, the shuffling and the augmentation."""
    data: DataConfig = field(default_factory=DataConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    filter: Annotated[FilterSettings, FILE_ONLY] = field(default_factory=FilterSettings)
    segments: SegmentTraining = field(default_factory=SegmentTraining)
    through_filter: ThroughFilter = field(default_factory=ThroughFilter)

    @property
    def datasets(self) -> tuple[str, ...]:
        """The datasets to learn from, one or several."""
        return (self.dataset,) if isinstance(self.dataset, str) else self.dataset

    def check(self, location: Location) -> None:
        """Check the sections together. Several datasets must differ, be in their usual folders and
        have a weight each, or none. Four headings are averaged only if training shows windows of
        every heading. Training through the filter needs weights to start from, and segments of
        whole strides that are longer than a window and its context. What the network itself asks
        for is checked with it (`models.from_experiment`)."""
        names, weights = self.datasets, self.data.weights
        for name in ("data_root", "workdir", "init_from"):
            if "\0" in (getattr(self, name) or ""):
                location.child(name).refuse("holds a zero, which no name of a file has")
        if len(set(names)) < len(names) or not names:
            location.child("dataset").refuse("is empty, or names a dataset twice", "name each once")
        if len(names) > 1 and self.data_root is not None:
            problem = f"is the folder of one dataset, and there are {len(names)}"
            remedy = "leave it out and set $GNIO_DATA to the folder that holds theirs"
            location.child("data_root").refuse(problem, remedy)
        if weights and len(weights) != len(names):
            problem = f"has {len(weights)} values for {len(names)} datasets"
            location.child("data.weights").refuse(problem, "give one for each, or none")
        frame = self.model.equivariance
        if frame in ("four_headings", "device_heading") and not self.augment.yaw:
            problem = f"is {frame} without augment.yaw"
            remedy = "training must show every heading: set augment.yaw to true"
            location.child("model.equivariance").refuse(problem, remedy)
        if self.augment.hidden_axes_share and frame != "device_heading":
            problem = "is for model.equivariance: device_heading, the network that uses them"
            location.child("augment.hidden_axes_share").refuse(problem, "leave it out")
        self._check_segments(location)
        self._check_through_filter(location)

    def refuse_unused(self, location: Location) -> None:
        """Refuse settings that this training does not use, unless they have their defaults: those
        of segments and of training through the filter where there is none, and that of a loss that
        is not chosen. A run that is there keeps what it has, so this is not part of `check`."""
        segments = "is for training on segments (segments.seconds)"
        through = "is for training through the filter (through_filter.learn)"
        unused: dict[str, str] = {}
        if not self.segments.seconds:
            changes = ("walkway_share", "walkway", "alternating_gain", "time_stretch")
            unused |= dict.fromkeys((f"augment.{name}" for name in changes), segments)
            losses = ("truncate_seconds", "horizon_weight")
            unused |= dict.fromkeys((f"segments.{name}" for name in losses), segments)
        if not self.through_filter.learn:
            unused |= {f"through_filter.{name}": through for name in vars(self.through_filter)}
        if self.segments.seconds and not self.through_filter.learn:
            unused["augment.shift_samples"] = "is for training on windows"
        if self.loss.name != "polar":
            unused["loss.angle_weight"] = "is for loss.name: polar"
        default = TrainConfig()
        for name, problem in unused.items():
            section, field = name.split(".")
            ours, theirs = (getattr(getattr(run, section), field) for run in (self, default))
            if ours != theirs:
                value = list(theirs) if isinstance(theirs, tuple) else theirs
                location.child(name).refuse(problem, f"leave it out, or set it to {value}")

    def _check_segments(self, location: Location) -> None:
        segments, data = self.segments, self.data
        if not segments.seconds:
            return
        for name in ("seconds", "truncate_seconds"):
            if not _is_whole(getattr(segments, name) / data.stride_seconds):
                problem = f"is not a whole number of strides of {data.stride_seconds:g} s"
                location.child(f"segments.{name}").refuse(problem)
        if segments.seconds < 2 * data.window_seconds:
            problem = f"must be at least two windows of {data.window_seconds:g} s"
            location.child("segments.seconds").refuse(problem)
        if data.context_seconds or data.window_rotation == "single":
            problem = "are for networks whose windows have no context and rotate every sample"
            location.child("segments").refuse(problem)
        if self.loss.name not in ("weighted_sum", "bins"):
            location.child("segments").refuse(f"have no loss '{self.loss.name}'")

    def _check_through_filter(self, location: Location) -> None:
        through = self.through_filter
        if not through.learn:
            return
        if not _is_whole(through.piece_seconds / self.data.stride_seconds):
            problem = f"is not a whole number of strides of {self.data.stride_seconds:g} s"
            location.child("through_filter.piece_seconds").refuse(problem)
        if not _is_whole(through.truncate_seconds / self.data.stride_seconds):
            problem = f"is not a whole number of strides of {self.data.stride_seconds:g} s"
            location.child("through_filter.truncate_seconds").refuse(problem)
        if through.piece_seconds < SHORTEST_HORIZON:
            problem = f"must be at least {SHORTEST_HORIZON:g} s, the shortest horizon of its losses"
            location.child("through_filter.piece_seconds").refuse(problem)
        if self.filter.mahalanobis_fail_scale > 0:
            problem = "makes no sense beside the soft gate of training through the filter"
            location.child("filter.mahalanobis_fail_scale").refuse(problem, "set it to 0")
        if self.filter.corrector is not None:
            problem = "is not for training through the filter, which has no variances of samples"
            location.child("filter.corrector").refuse(problem, "train first, and set it after that")
        if self.model.corrector != "none":
            problem = "learns from its preintegration, and not through the filter"
            location.child("model.corrector").refuse(problem, "set it to none")
        input_seconds = self.data.context_seconds + self.data.window_seconds
        if through.piece_seconds < input_seconds + 2 * self.data.stride_seconds:
            problem = f"must be longer than the {input_seconds:g} s that the network sees"
            location.child("through_filter.piece_seconds").refuse(problem)
