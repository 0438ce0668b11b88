"""The options that functions of the library take from a command: frozen dataclasses whose field
comments are the text of `--help`. `gnio train` takes a `TrainConfig`. Options that only a command
reads are in its file in `commands/`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gnio_jax.config.schema import FILE_ONLY, Count, FilterSettings, Folder, Rate, Words

Table = Literal[
    "complexity",
    "published",
    "comparison",
    "components",
    "gates",
    "bank-size",
    "trajectories",
    "standing",
]

CalibratedGroup = Literal["measurement", "noise", "start", "window"]


@dataclass(frozen=True)
class EvaluateConfig:
    network: str | None = None
    """Network: the folder of a run, a package or a name (see gnio weights); by default the newest
    run below runs/. Results go to the folder eval/ of a run, and to evaluations/NAME of a published
    network."""
    dataset: str | None = None
    """Dataset to evaluate on; by default the run's own. If the run has learnt from several, name
    one."""
    data_root: str | None = None
    """Folder of the dataset; by default the run's (for its own dataset), $GNIO_DATA/<dataset>, or
    data/<dataset>."""
    split: str = "test"
    """Split of the dataset."""
    estimator: Literal["ekf", "integrate", "imu_only"] = "ekf"
    """The paper's filter, the sum of the displacements, or the IMU integrated without the network.
    """
    coupling: Literal["tight", "loose"] = "tight"
    """For the ekf: the network runs inside the filter, or before it over all windows with a given
    orientation."""
    orientation: Literal["filter", "device", "reference"] | None = None
    """Attitude that rotates the network's windows; by default the filter's for the tight coupling,
    else the reference's. Without a filter, `filter` is the gyro integrated from the start."""
    init: Literal["reference", "static"] = "reference"
    """Start from the reference's pose and velocity, or from gravity with yaw, velocity and position
    zero."""
    gyro_bias: Literal["zero", "rest", "reference"] = "zero"
    """Initial gyro bias: zero, the mean of a rest at the start, or the first 10 s against the
    reference orientation."""
    alignment: Literal["origin", "none", "yaw_position", "se3"] = "origin"
    """How an estimate is aligned with the reference before absolute errors are computed: by
    position and yaw at the start, not at all, or by least squares."""
    checkpoint: Literal["best", "latest"] = "best"
    """Weights of a run: its best ones, or those of its latest checkpoint."""
    batch_size: Annotated[Count, FILE_ONLY] = 16
    """Recordings estimated side by side."""
    plots: bool = True
    """Draw every sequence and the distribution of the errors, and write report.html. If an earlier
    evaluation has these files, they are made again even with --no-plots."""
    rerun: str | None = None
    """File to write for the viewer Rerun, NAME.rrd: paths, covariances, IMU, gate."""
    filter: Annotated[FilterSettings | None, FILE_ONLY] = None
    """Noise and start of the filter; by default the run's own."""
    set: Annotated[tuple[str, ...], Words("filter.FIELD=VALUE", repeated=True)] = ()
    """A setting of the filter by its name in YAML; it may be given several times."""


@dataclass(frozen=True)
class CalibrateConfig:
    network: str | None = None
    """Network: the folder of a run, a package or a name (see gnio weights); by default the newest
    run below runs/."""
    out: str | None = None
    """Folder of the calibrated run; by default the network's folder with _calibrated after its
    name, or runs/NAME_calibrated for a published network."""
    data_root: tuple[str, ...] = ()
    """Folder of the run's dataset, or one for each of several; by default the run's,
    $GNIO_DATA/<dataset>, or data/<dataset>."""
    split: str | None = None
    """Split whose recordings are fitted: the run's validation split (default) or its training
    split. Other splits are refused, because a filter must not be tested on recordings to which it
    was fitted."""
    out_of_fold: tuple[str, ...] = ()
    """Runs, one for each fold: gnio train --data.train-split train-0of4, then train-1of4
    and so on. The filter is then fitted to the training split, and each session is predicted by the
    network that was trained without it."""
    fit: tuple[CalibratedGroup, ...] = ("measurement", "noise", "window")
    """What is fitted by the likelihood of the innovations: `measurement`, the factor of the
    network's covariance; `noise`, the IMU's; `start`, the standard deviations of the initial
    biases; `window`, the part of a window's error that is temporally correlated. The factors of the
    axes and the consider covariance are always fitted."""
    average_headings: bool = False
    """Average the network over four headings, as model.equivariance: four_headings does, even if
    the run has another setting. The network must have learnt from walks turned by a random yaw."""


@dataclass(frozen=True)
class TablesConfig:
    table: Annotated[Table, Words("TABLE", named=False)]
    """complexity, published, comparison, components, gates, bank-size, trajectories or standing."""
    base: str = "quickstart"
    """Config that gives every row its recordings, budget and augmentation (not for complexity
    and published)."""
    dataset: str | None = None
    """Dataset that is measured; by default the config's. If the config has several, name one."""
    data_root: str | None = None
    """Folder of the measured dataset; by default the config's (for its own dataset),
    $GNIO_DATA/<dataset>, or data/<dataset>. Another folder of the config's own dataset is the one
    to learn from, too."""
    split: str = "test"
    """Split that is measured."""
    estimator: Literal["ekf", "integrate"] = "ekf"
    """The paper's filter, or the sum of the displacements with the reference's orientation."""
    calibrate: bool = False
    """Calibrate every run on its validation split before it is measured."""
    seeds: Count = 3
    """Number of runs of every row. Their seeds are 0, 1, 2, ..."""
    epochs: Count | None = None
    """Epochs of every run, instead of the config's."""
    methods: str = "tlio,ronin_resnet,deepils,ctin,imot,gnio"
    """Networks of comparison, trajectories and standing, or systems (eqnio_tlio, eqnio_ronin,
    airimu, rio, bins), separated by commas, or all networks; the others are compared with the
    first."""
    sequences: str | None = None
    """Sequences that trajectories draws, separated by commas; by default the first eight."""
    out: Folder = Path("runs/tables")
    """Folder of the runs and the tables."""


@dataclass(frozen=True)
class CompareConfig:
    rows: Annotated[tuple[str, ...], Words("NETWORKS", named=False)]
    """Networks: folders of runs, packages or names; the others are compared with the first. A name
    without its seed stands for all seeds: runs/gnio for runs/gnio_s0, runs/gnio_s1, ... The folder
    of an evaluation is one row."""
    dataset: str | None = None
    """Dataset whose evaluations are compared; by default that of each run. If a network has learnt
    from several, name one."""
    split: str = "test"
    """Split whose evaluations are compared."""
    estimator: Literal["ekf", "integrate", "imu_only"] = "ekf"
    """Estimator whose evaluations are compared."""
    data_root: str | None = None
    """Folder of the dataset, for networks that are not evaluated yet; by default the run's,
    $GNIO_DATA/<dataset>, or data/<dataset>."""
    metrics: tuple[str, ...] | None = None
    """Metrics to compare, by their names in metrics.json; by default those of ate, rpe_1s,
    yaw_rmse, path_length_ratio, nis and nees that the evaluations have."""
    out: str | None = None
    """Name of files to write: OUT.md and OUT.csv, the table, and OUT.png, the first metric of every
    sequence. By default the table is only shown."""


@dataclass(frozen=True)
class ImportOptions:
    """Properties that a recording may not state. By default they come from its format or header, or
    they are detected. An ambiguous recording is refused."""

    columns: Annotated[tuple[str, ...], Words("OURS=THEIRS")] = ()
    """For a CSV: our name and the file's name of each column with another name: time=stamp
    gyro_x=wx ... Our names are time, gyro_x..z, accel_x..z, those of a reference (qw..qz, px..pz,
    vx..vz), and accel_time if the accelerometer's time is another column. "a+b" is the sum of two
    columns (gravity and user acceleration) or one stamp (secs+nsecs, date+time), "-a" the opposite.
    In a file without a header, columns are numbered from 0."""
    accel_path: Path | None = None
    """CSV of the accelerometer, if it is another file than the gyro's."""
    where: str | None = None
    """For a CSV with rows of several sensors: COLUMN=VALUE of the rows to take."""
    sample_rate: Rate | None = None
    """For a CSV without stamps: rows are samples, so many in a second, Hz."""
    time_unit: str | None = None
    """Unit of the stamps: s, ms, us, ns, or the seconds of one stamp, as 1e-4; detected by the rate
    of an IMU, 10 to 2000 Hz."""
    gyro_unit: str | None = None
    """Unit of the gyro: rad/s, deg/s, mdps, counts in a unit as 131/deg/s, or their size as
    0.00875*deg/s."""
    accel_unit: str | None = None
    """Unit of the accelerometer: m/s2, g, mg, cm/s2, counts in a unit as 16384/g, or their size as
    0.061*mg; detected by the magnitude of gravity."""
    accel_sign: Literal["android", "ios", "detect"] | None = None
    """At rest and level, the up axis reads +1 g (android) or −1 g (ios: all axes are negated).
    detect assumes that the screen points up more than down. A CSV has android's sign by default,
    because the data alone do not show it."""
    imu_topic: str | None = None
    """Topic of sensor_msgs/Imu, if the bag has several."""
    accel_topic: str | None = None
    """Topic of the accelerometer, if it has its own."""
    reference_topic: str | None = None
    """Topic of poses, odometry or transforms in a bag that has several; /tf:CHILD_FRAME for TF."""
