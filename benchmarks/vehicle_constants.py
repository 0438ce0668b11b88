"""The error of a vehicle's filter on KITTI's held-out drives, with constants chosen without them.

    python -m benchmarks.vehicle_constants --data-root DIR [--folds 3] [--only 0 1 2]
        [--low-pass 0.03 0.06 0.09] [--without mounting_std mounting_seconds lever_std]
        [--all-drives]

The drives of a fold are held out whole; without `--folds` each drive is a fold of its own. All is
chosen by the other drives, and the held-out drives are measured once:

- The filter has 19 constants (`UNITS`). The fit starts at the package's defaults, with the states
  of `STATES`, and is damped Gauss-Newton steps (SciPy) with the derivatives through the whole
  filter (JAX). What it minimises is the mean of two errors, `t_rel` of all pieces and its mean
  over drives, plus a penalty times the squared distance from the start in `UNITS`.
- The penalty and the time constant of the IMU's low-pass (`filter.low_pass_seconds`) are those with
  the smallest error of approximate leave-one-out: for each training drive one Gauss-Newton step
  from the fit goes towards the constants without it, and this drive is measured with them.

Nothing is drawn, so there are no seeds. The filter starts at the reference's pose and velocity, and
gets no displacement and no rest. `--low-pass 0` is the same protocol with the low-pass left in.
`--without` names numbers of the constraint that are not fitted: gradients are zero then, and the
mounting and the lever are no states without `mounting_std mounting_seconds lever_std`. The lines of
the defaults are of the start of the fit, which has these states unless they are left out. `--only`
runs some folds. With `--all-drives` none is held out, and the settings of the fit are printed as
in `configs/vehicles.yaml`. The brackets are 95 % intervals of a bootstrap over drives (10,000
draws).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

from gnio_jax import config as configuration  # noqa: E402
from gnio_jax import data  # noqa: E402
from gnio_jax.config import DataConfig, FilterSettings  # noqa: E402
from gnio_jax.evaluation.metrics import pieces  # noqa: E402
from gnio_jax.evaluation.prepare import PreparedRecording, prepare  # noqa: E402
from gnio_jax.filtering import initial_state, make_filter, run_filter  # noqa: E402
from gnio_jax.filtering.batch import padded_signals  # noqa: E402
from gnio_jax.filtering.nonholonomic import NonHolonomic  # noqa: E402
from gnio_jax.filtering.settings import free_parameters, with_free_parameters  # noqa: E402
from gnio_jax.numerics import matrix_from_quaternion  # noqa: E402

WINDOWS = DataConfig(rate=100.0, window_seconds=0.1, stride_seconds=0.1)
UNITS = {
    "measurements.nonholonomic.lateral_std": 1.0,
    "measurements.nonholonomic.vertical_std": 1.0,
    "noise.gyro_density": 1.0,
    "noise.accel_density": 1.0,
    "noise.gyro_bias_walk": 1.0,
    "noise.accel_bias_walk": 1.0,
    "start.tilt": 0.7,
    "start.velocity": 0.7,
    "start.gyro_bias": 1.0,
    "start.accel_bias": 0.7,
    "measurements.nonholonomic.yaw": 0.05,
    "measurements.nonholonomic.pitch": 0.05,
    "measurements.nonholonomic.lever_x": 0.3,
    "measurements.nonholonomic.lever_z": 0.3,
    "measurements.nonholonomic.pitch_gradient": 0.3,
    "measurements.nonholonomic.sideslip_gradient": 0.3,
    "measurements.nonholonomic.mounting_std": 1.0,
    "measurements.nonholonomic.mounting_seconds": 1.0,
    "measurements.nonholonomic.lever_std": 1.0,
}
"""The constants of the fit, and how much of each free parameter is one unit of it: a factor e or 2,
0.005 rad, 0.3 m, 0.003 rad/(m/s²) (`settings.free_parameters`; ours)."""
STATES = {"mounting_std": 0.01, "mounting_seconds": 20.0, "lever_std": 0.3}
"""Where the fit starts the errors of the mounting: rad, s and m (ours)."""
PENALTIES = (0.3, 0.03, 0.003)
"""%, per squared unit. The fit with one of them starts at that with the one before."""
ROUNDING = 0.3
"""%. An error ε counts as √(ε² + ROUNDING²) in the fit, so that its derivative exists at zero."""
STEPS = 12
"""Evaluations of a fit at most, its start included. It ends earlier where a step changes the
objective or the place by less than a thousandth."""
PADDING = 200
"""Drives are padded to a multiple of this number of strides, and pieces to one of this number: few
shapes, few compilations."""

Point = np.ndarray
"""(c,) a place of the fit, in units; zeros are its start."""


class Choice(NamedTuple):
    """What is chosen by the training drives of a fold."""

    low_pass_seconds: float
    penalty: float
    point: Point


class FoldResult(NamedTuple):
    """A fold whose drives were held out."""

    choice: Choice
    default_errors: dict[str, np.ndarray]
    """Drive -> errors of its pieces, %, at the start of the fit with the chosen time constant."""
    errors: dict[str, np.ndarray]
    """The same with the chosen constants."""


def default_settings(low_pass_seconds: float) -> FilterSettings:
    """The start of the fit: the package's defaults with the non-holonomic constraint, whose numbers
    are all named, and with `STATES` if they are fitted."""
    numbers = {name: value for name, value in NonHolonomic()._asdict().items() if value is not None}
    for name, value in STATES.items():
        if f"measurements.nonholonomic.{name}" in UNITS:
            numbers[name] = value
    return FilterSettings(low_pass_seconds=low_pass_seconds, measurements={"nonholonomic": numbers})


def settings_at(low_pass_seconds: float, point: Point) -> FilterSettings:
    """The settings at a place (c,) of the fit, which may be traced."""
    defaults = default_settings(low_pass_seconds)
    free = free_parameters(defaults, UNITS)
    steps = zip(UNITS.items(), point, strict=True)
    return with_free_parameters(
        defaults, {name: free[name] + unit * step for (name, unit), step in steps}
    )


def motion_of_pieces(low_pass_seconds, point, start, gyro, accel, rows):
    """R_iᵀ (p_j − p_i) (m, 3) of the rows (2, m) i, j of a drive, with the filter at a point."""
    ekf = make_filter(WINDOWS, settings_at(low_pass_seconds, point))
    strides = len(gyro) // WINDOWS.stride
    absent = jnp.full((strides, 3), jnp.nan), jnp.zeros((strides, 3, 3))
    _, history = run_filter(ekf, initial_state(ekf, *start), gyro, accel, *absent)
    rotation = jnp.concatenate([start[0][None], history.rotation])
    position = jnp.concatenate([start[2][None], history.position])
    first, last = rows
    return jnp.einsum("mji,mj->mi", rotation[first], position[last] - position[first])


run_drive = jax.jit(motion_of_pieces, static_argnums=0)


@partial(jax.jit, static_argnums=0)
def differentiate_drive(low_pass_seconds, point, *drive):
    """The derivatives (m, 3, c) of `motion_of_pieces` by the point."""
    return jax.jacfwd(partial(motion_of_pieces, low_pass_seconds))(point, *drive)


class Drive(NamedTuple):
    """A drive and its pieces, as arrays of few shapes."""

    name: str
    group: str
    signals: tuple
    """Pose and velocity at the start, gyro and accel (n, 3), rows (2, m)."""
    motion: np.ndarray
    """(m, 3) motion of the reference in each piece, in the body at its beginning, m."""
    length: np.ndarray
    """(m,) nominal lengths, m."""


def make_drive(recording: PreparedRecording) -> Drive:
    """Pad a recording. The rows behind the pieces are zeros."""
    reference = recording.reference
    first, last, length = pieces(reference, WINDOWS.stride_seconds)
    back = np.swapaxes(matrix_from_quaternion(reference.orientation[first]), 1, 2)
    move = reference.position[last] - reference.position[first]
    samples = -(-recording.strides // PADDING) * PADDING * WINDOWS.stride
    (gyro,), (accel,) = padded_signals([(recording.gyro, recording.accel)], samples)
    start = recording.start.rotation, recording.start.velocity, recording.start.position
    rows = np.zeros((2, -(-len(first) // PADDING) * PADDING), int)
    rows[:, : len(first)] = first, last
    signals = start, gyro, accel, rows
    motion = np.einsum("nij,nj->ni", back, move)
    return Drive(recording.name, recording.group, signals, motion, length)


def relative_errors(drive: Drive, low_pass_seconds: float, point: Point) -> np.ndarray:
    """The error of motion (m, 3) in each piece, % of its length. Its norm is KITTI's relative error
    of translation (`metrics.piece_errors`)."""
    motion = np.asarray(run_drive(low_pass_seconds, point, *drive.signals))
    return 100 * (motion[: len(drive.length)] - drive.motion) / drive.length[:, None]


def differentiate(drive: Drive, low_pass_seconds: float, point: Point) -> np.ndarray:
    """The derivatives (m, 3, c) of `relative_errors`."""
    derivatives = np.asarray(differentiate_drive(low_pass_seconds, point, *drive.signals))
    return 100 * derivatives[: len(drive.length)] / drive.length[:, None, None]


def measure_drive(drive: Drive, low_pass_seconds: float, point: Point) -> np.ndarray:
    """KITTI's relative errors of translation of all pieces of a drive, %."""
    return np.linalg.norm(relative_errors(drive, low_pass_seconds, point), axis=1)


def mean_errors(errors: Iterable[np.ndarray]) -> np.ndarray:
    """Mean over all pieces, mean over drives and median over drives, %."""
    errors = list(errors)
    of_drives = [of_drive.mean() for of_drive in errors]
    return np.array([np.concatenate(errors).mean(), np.mean(of_drives), np.median(of_drives)])


def weights_of_pieces(drives: Sequence[Drive]) -> list[float]:
    """Weight of a piece of each drive in the mean of the first two `mean_errors`."""
    counts = [len(drive.length) for drive in drives]
    return [0.5 / sum(counts) + 0.5 / (len(drives) * count) for count in counts]


def fit(drives: Sequence[Drive], low_pass_seconds: float, penalty: float, start: Point) -> Point:
    """Minimise Σ w √(ε² + ROUNDING²) + penalty |x|² over the pieces of these drives.

    Each piece has three residuals, w times its error. SciPy's loss function sees their squares, so
    it can count the three together; without its second derivative a step is one of iteratively
    reweighted least squares.
    """
    weights = weights_of_pieces(drives)
    of_pieces = np.repeat(weights, [len(drive.length) for drive in drives])
    ridge = np.sqrt(2 * penalty)

    def residuals(point):
        parts = [
            weight * relative_errors(drive, low_pass_seconds, point).ravel()
            for weight, drive in zip(weights, drives, strict=True)
        ]
        return np.concatenate([*parts, ridge * point])

    def derivatives(point):
        parts = [
            weight * differentiate(drive, low_pass_seconds, point).reshape(-1, len(UNITS))
            for weight, drive in zip(weights, drives, strict=True)
        ]
        return np.concatenate([*parts, ridge * np.eye(len(UNITS))])

    def count_norms(squares):
        """ρ, ρ' and ρ'' of each residual, where ½ Σ ρ is the objective."""
        rho = np.stack([squares, np.ones(len(squares)), np.zeros(len(squares))])
        triples = squares[: -len(UNITS)].reshape(-1, 3).sum(1)
        norm = np.repeat(np.sqrt(triples + (ROUNDING * of_pieces) ** 2), 3)
        rho[:2, : -len(UNITS)] = 2 * norm / 3, 1 / norm
        return rho

    limits = {"ftol": 1e-3, "xtol": 1e-3, "gtol": None, "max_nfev": STEPS}
    return least_squares(residuals, start, derivatives, loss=count_norms, **limits).x


def leave_one_out(
    drives: Sequence[Drive], low_pass_seconds: float, penalty: float, point: Point
) -> float:
    """The objective of each drive with about the constants that a fit without it would have, %.

    These are one Gauss-Newton step from `point`, the fit with all of them. A step that is longer
    than 1.5 units in a constant is shortened. The weights of the remaining drives are not raised.
    One step is too short, so the value is too small, and more so for a small penalty.
    """
    curvatures, slopes = [], []
    for weight, drive in zip(weights_of_pieces(drives), drives, strict=True):
        error = relative_errors(drive, low_pass_seconds, point)
        derivative = differentiate(drive, low_pass_seconds, point)
        scale = weight / np.sqrt((error**2).sum(1) + ROUNDING**2)
        curvatures.append(np.einsum("n,ncj,nck->jk", scale, derivative, derivative))
        slopes.append(np.einsum("n,ncj,nc->j", scale, derivative, error))
    ridge = 2 * penalty * np.eye(len(UNITS))
    errors = []
    for drive, curvature, slope in zip(drives, curvatures, slopes, strict=True):
        remaining = sum(slopes) - slope + 2 * penalty * point
        step = -np.linalg.solve(sum(curvatures) - curvature + ridge, remaining)
        step *= min(1.0, 1.5 / np.abs(step).max())
        errors.append(measure_drive(drive, low_pass_seconds, point + step))
    value = mean_errors(errors)[:2].mean()
    return value if np.isfinite(value) else np.inf


def choose(drives: Sequence[Drive], low_pass: Sequence[float]) -> Choice:
    """The constants, the penalty and the low-pass by these drives."""
    choices = []
    for seconds in low_pass:
        point = np.zeros(len(UNITS))
        for penalty in PENALTIES:
            point = fit(drives, seconds, penalty, point)
            choice = Choice(seconds, penalty, point)
            choices.append((leave_one_out(drives, *choice), choice))
    error, choice = min(choices, key=lambda pair: pair[0])
    if not np.isfinite(error):
        raise ValueError("no fit has finite errors on its drives")
    return choice


def evaluate_fold(
    training: Sequence[Drive], held_out: Sequence[Drive], low_pass: Sequence[float]
) -> FoldResult:
    """Choose by the training drives of a fold, and then measure the drives that are held out."""
    choice = choose(training, low_pass)
    points = np.zeros(len(UNITS)), choice.point
    return FoldResult(
        choice,
        *(
            {drive.name: measure_drive(drive, choice.low_pass_seconds, p) for drive in held_out}
            for p in points
        ),
    )


def describe_errors(errors: Mapping[str, np.ndarray]) -> str:
    """The three means with the intervals of the first two."""
    rng, rows = np.random.default_rng(0), [errors[name] for name in sorted(errors)]
    counts, sums = np.array([len(row) for row in rows]), np.array([row.sum() for row in rows])
    drawn = rng.integers(0, len(rows), (10_000, len(rows)))
    draws = sums[drawn].sum(1) / counts[drawn].sum(1), (sums / counts)[drawn].mean(1)
    low_high = [np.percentile(values, [2.5, 97.5]) for values in draws]
    pieces_mean, drives_mean, drives_median = mean_errors(rows)
    return (
        f"all pieces {pieces_mean:.2f} % ({low_high[0][0]:.2f} to {low_high[0][1]:.2f}), "
        f"mean over drives {drives_mean:.2f} % ({low_high[1][0]:.2f} to {low_high[1][1]:.2f}), "
        f"median {drives_median:.2f} %"
    )


def describe_settings(settings: FilterSettings) -> str:
    """The constants of the fit as lines of a configuration."""
    values = configuration.flatten(settings)
    numbers: dict[str, Any] = {}
    for name in ("low_pass_seconds", *UNITS):
        *groups, constant = name.split(".")
        section = numbers
        for group in groups:
            section = section.setdefault(group, {})
        section[constant] = float(f"{float(values[name]):.3g}")
    return configuration.to_yaml({"filter": numbers}).rstrip()


def load_drives(root: str | None, folds: int | None) -> tuple[list[Drive], dict[str, int]]:
    """The drives that have a piece, by name, and the fold of each group: `folds` ones, which depend
    on the names and lengths of all drives, or one for each group."""
    sequences = sorted(data.load("kitti", root, "all"), key=lambda sequence: sequence.name)
    recordings, _ = prepare(sequences, WINDOWS)
    drives = [
        make_drive(recording)
        for recording in recordings
        if pieces(recording.reference, WINDOWS.stride_seconds).shape[1]
    ]
    if folds is not None:
        return drives, data.folds(sequences, folds)
    groups = sorted({drive.group for drive in drives})
    return drives, {group: number for number, group in enumerate(groups)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data-root", help="KITTI's folder, as for gnio evaluate")
    parser.add_argument("--folds", type=int, help="default: each drive is a fold of its own")
    parser.add_argument("--only", type=int, nargs="+", help="folds to run; default: all")
    parser.add_argument("--low-pass", type=float, nargs="+", default=[0.03, 0.06, 0.09])
    parser.add_argument("--without", nargs="+", default=[], help="numbers that are not fitted")
    parser.add_argument(
        "--all-drives", action="store_true", help="fit to all drives; hold none out"
    )
    arguments = parser.parse_args()
    for name in arguments.without:
        if UNITS.pop(f"measurements.nonholonomic.{name}", None) is None:
            parser.error(f"--without: {name} is no number of the constraint that is fitted")
    if arguments.all_drives and (arguments.folds, arguments.only) != (None, None):
        parser.error("--all-drives: holds no drive out; leave out --folds and --only")
    if "mounting_std" in arguments.without and "mounting_seconds" not in arguments.without:
        parser.error("--without mounting_std: mounting_seconds has no effect then; name it, too")
    drives, fold_of = load_drives(arguments.data_root, arguments.folds)
    every = sorted({fold_of[drive.group] for drive in drives})
    numbers = every if arguments.only is None else arguments.only
    if not set(numbers) <= set(every):
        parser.error(f"--only: there are the folds 0 to {every[-1]}")
    total = sum(len(drive.length) for drive in drives)
    print(f"{len(drives)} drives, {total} pieces", flush=True)
    defaults = np.zeros(len(UNITS))
    unchanged = {drive.name: measure_drive(drive, 0.0, defaults) for drive in drives}
    print(f"defaults, low-pass left in: {describe_errors(unchanged)}", flush=True)
    if arguments.all_drives:
        tau, penalty, point = choose(drives, arguments.low_pass)
        fitted = {drive.name: measure_drive(drive, tau, point) for drive in drives}
        print(f"constants of all drives, on them: {describe_errors(fitted)}")
        print(f"penalty {penalty:g}\n{describe_settings(settings_at(tau, point))}", flush=True)
        return
    default_errors, errors = {}, {}
    for number in numbers:
        training = [drive for drive in drives if fold_of[drive.group] != number]
        held_out = [drive for drive in drives if fold_of[drive.group] == number]
        result = evaluate_fold(training, held_out, arguments.low_pass)
        default_errors |= result.default_errors
        errors |= result.errors
        tau, penalty, point = result.choice
        free = free_parameters(settings_at(tau, point), UNITS)
        print(f"fold {number}, {', '.join(result.errors)}: {describe_errors(result.errors)}")
        print(f"  low-pass {tau:g} s, penalty {penalty:g}, free parameters {free}", flush=True)
    differences = {name: error - unchanged[name] for name, error in default_errors.items()}
    print(f"defaults, low-pass chosen: {describe_errors(default_errors)}")
    print(f"  minus low-pass left in: {describe_errors(differences)}")
    print(f"constants chosen: {describe_errors(errors)}", flush=True)


if __name__ == "__main__":
    main()
