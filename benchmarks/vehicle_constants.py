"""The error of a vehicle's filter on KITTI's held-out drives, with constants chosen without them.

    python -m benchmarks.vehicle_constants --data-root DIR [--seeds 0 1 2] [--folds 3]
        [--only 0 1 2] [--trials 156] [--low-pass 0 0.03 0.06 0.09]

The drives of a fold are held out whole. Everything is chosen within the other drives (nested
cross-validation), and the held-out drives are measured once:

- The time constant of the IMU's low-pass (`filter.low_pass_seconds`) is the one of `--low-pass`
  with which the package's default constants have the smallest objective.
- The penalty on the distance from the defaults is one of three. The training drives are divided
  into two halves. Each half is searched, and the other one is measured.
- A search has 14 constants (`UNITS`) and starts at the defaults. It is an evolution strategy of
  `--trials` trials. Its objective is the mean of two errors, `t_rel` of all pieces and its mean
  over drives, plus the penalty times the squared distance in `UNITS`.

The filter starts at the reference's pose and velocity, and gets no displacement and no rest. Only
the seed of the search differs between the seeds, so the low-pass is chosen once for each fold.
`--low-pass 0` is the same protocol with the low-pass left in. `--only` runs some folds. The
brackets are 95 % intervals of a bootstrap over drives (10,000 draws).

SciPy has no CMA-ES. Its methods without derivatives are for few constants or for many more trials,
so the strategy is written out below and needs no other package.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from gnio_jax import data  # noqa: E402
from gnio_jax.config import DataConfig, FilterSettings  # noqa: E402
from gnio_jax.evaluation.metrics import piece_errors, pieces  # noqa: E402
from gnio_jax.evaluation.prepare import PreparedRecording, prepare  # noqa: E402
from gnio_jax.evaluation.trajectory import Trajectory  # noqa: E402
from gnio_jax.filtering import initial_state, make_filter, run_filter  # noqa: E402
from gnio_jax.filtering.batch import padded_signals  # noqa: E402
from gnio_jax.filtering.nonholonomic import NonHolonomic  # noqa: E402
from gnio_jax.filtering.settings import free_parameters, with_free_parameters  # noqa: E402
from gnio_jax.numerics import filled_up, quaternion_from_matrix  # noqa: E402

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
}
"""The constants of the search, and how much of each free parameter is one unit of the search: a
factor e or 2, 0.005 rad, 0.3 m (`settings.free_parameters`; ours)."""
PENALTIES = (0.003, 0.03, 0.3)
"""%, per squared unit of the search."""
POPULATION = 12
"""Trials of one generation, which are filtered side by side. 4 + ⌊3 ln 14⌋ would be 11."""
PADDING = 200
"""Drives are padded to a multiple of this number of strides: few lengths, few compilations."""
FAILED = 99.0
"""The objective of a trial whose path is not finite, %."""

Points = np.ndarray
"""(m, 14) places of the search, in units of the search; zeros are the defaults."""


class Choice(NamedTuple):
    """What is chosen by the training drives of a fold."""

    low_pass_seconds: float
    penalty: float
    point: Points
    """(14,)."""


class FoldResult(NamedTuple):
    """A fold whose drives were held out."""

    choice: Choice
    default_errors: dict[str, np.ndarray]
    """Drive -> errors of its pieces, %, with the defaults and the chosen time constant."""
    errors: dict[str, np.ndarray]
    """The same with the chosen constants."""


def default_settings(low_pass_seconds: float) -> FilterSettings:
    """The package's defaults with the non-holonomic constraint, whose numbers are all named."""
    numbers = NonHolonomic()._asdict()
    return FilterSettings(low_pass_seconds=low_pass_seconds, measurements={"nonholonomic": numbers})


def settings_at(low_pass_seconds: float, point: Points) -> FilterSettings:
    """The settings at a place (14,) of the search, which may be traced."""
    defaults = default_settings(low_pass_seconds)
    free = free_parameters(defaults, UNITS)
    steps = zip(UNITS.items(), point, strict=True)
    return with_free_parameters(
        defaults, {name: free[name] + unit * step for (name, unit), step in steps}
    )


@partial(jax.jit, static_argnums=0)
def run_points(low_pass_seconds, points, pose, gyro, accel):
    """Rotations (m, K, 3, 3) and positions (m, K, 3) of a drive, with the filter at each point."""

    def run(point):
        ekf = make_filter(WINDOWS, settings_at(low_pass_seconds, point))
        strides = len(gyro) // WINDOWS.stride
        absent = jnp.full((strides, 3), jnp.nan), jnp.zeros((strides, 3, 3))
        _, history = run_filter(ekf, initial_state(ekf, *pose), gyro, accel, *absent)
        return history.rotation, history.position

    return jax.vmap(run)(points)


def measure_drive(
    drive: PreparedRecording, low_pass_seconds: float, points: Points
) -> list[np.ndarray]:
    """KITTI's relative errors of translation of all pieces of a drive, %, for each point."""
    samples = -(-drive.strides // PADDING) * PADDING * WINDOWS.stride
    (gyro,), (accel,) = padded_signals([(drive.gyro, drive.accel)], samples)
    pose = drive.start.rotation, drive.start.velocity, drive.start.position
    padded = filled_up(points, max(len(points), POPULATION))
    rotation, position = map(np.asarray, run_points(low_pass_seconds, padded, pose, gyro, accel))
    errors = []
    for i in range(len(points)):
        matrices = np.concatenate([pose[0][None], rotation[i, : drive.strides]])
        path = np.concatenate([pose[2][None], position[i, : drive.strides]])
        estimate = Trajectory(drive.time, path, quaternion_from_matrix(matrices))
        errors.append(100 * piece_errors(estimate, drive.reference, WINDOWS.stride_seconds)[:, 0])
    return errors


def mean_errors(errors: Iterable[np.ndarray]) -> np.ndarray:
    """Mean over all pieces, mean over drives and median over drives, %."""
    errors = list(errors)
    of_drives = [of_drive.mean() for of_drive in errors]
    return np.array([np.concatenate(errors).mean(), np.mean(of_drives), np.median(of_drives)])


def objective(
    drives: Sequence[PreparedRecording], low_pass_seconds: float, points: Points
) -> np.ndarray:
    """Mean of the error of all pieces and of its mean over drives, %, for each point."""
    by_drive = [measure_drive(drive, low_pass_seconds, points) for drive in drives]
    values = [mean_errors(errors)[:2].mean() for errors in zip(*by_drive, strict=True)]
    return np.where(np.isfinite(values), values, FAILED)


def minimise(
    function: Callable[[Points], np.ndarray],
    dimensions: int,
    trials: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """The mean of the last generation of an evolution strategy that starts at zero with a standard
    deviation of 0.5.

    CMA-ES with rank-one and rank-µ updates and cumulative step lengths, positive weights only
    (Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772, with its default
    parameters; c_c is 4 / (n + 4), without its terms in µ_eff / n, and the damping is 1 + c_σ, as
    it is for many dimensions). `function` gives the values of the points (POPULATION, dimensions)
    of a generation; `trials` // POPULATION generations are tried.
    """
    d, parents = dimensions, POPULATION // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    mass = 1 / np.sum(weights**2)  # µ_eff
    path_rate, step_rate = 4 / (d + 4), (mass + 2) / (d + mass + 5)  # c_c, c_σ
    rank_one = 2 / ((d + 1.3) ** 2 + mass)
    rank_mu = min(1 - rank_one, 2 * (mass - 2 + 1 / mass) / ((d + 2) ** 2 + mass))
    normal_length = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2))  # E |N(0, I)|
    mean, std, shape = np.zeros(d), 0.5, np.eye(d)
    path, step_path = np.zeros(d), np.zeros(d)
    for generation in range(1, trials // POPULATION + 1):
        variances, axes = np.linalg.eigh(shape)
        lengths = np.sqrt(np.maximum(variances, 1e-12))
        steps = (rng.standard_normal((POPULATION, d)) * lengths) @ axes.T
        parent_steps = steps[np.argsort(function(mean + std * steps))[:parents]]
        step = weights @ parent_steps
        mean = mean + std * step
        whitened = axes @ ((axes.T @ step) / lengths)
        step_path = (1 - step_rate) * step_path + np.sqrt(
            step_rate * (2 - step_rate) * mass
        ) * whitened
        length = np.linalg.norm(step_path)
        expected_length = np.sqrt(1 - (1 - step_rate) ** (2 * generation)) * normal_length
        short = length < (1.4 + 2 / (d + 1)) * expected_length
        path = (1 - path_rate) * path + short * np.sqrt(path_rate * (2 - path_rate) * mass) * step
        shape = (1 - rank_one - rank_mu) * shape + rank_one * np.outer(path, path)
        shape += rank_mu * (parent_steps.T * weights) @ parent_steps
        std *= np.exp(step_rate / (1 + step_rate) * (length / normal_length - 1))
    return mean


def search(
    drives: Sequence[PreparedRecording],
    low_pass_seconds: float,
    penalty: float,
    trials: int,
    rng: np.random.Generator,
) -> Points:
    """The point (14,) that a search with these drives ends at."""

    def penalised(points):
        distance = np.sum(points**2, axis=1)
        return objective(drives, low_pass_seconds, points) + penalty * distance

    return minimise(penalised, len(UNITS), trials, rng)


def choose_low_pass(drives: Sequence[PreparedRecording], seconds: Sequence[float]) -> float:
    """The time constant with which the defaults have the smallest objective on these drives. One
    constant alone is no choice and costs no run."""
    if len(seconds) == 1:
        return seconds[0]
    defaults = np.zeros((1, len(UNITS)))
    return min(seconds, key=lambda tau: objective(drives, tau, defaults)[0])


def choose(
    drives: Sequence[PreparedRecording], low_pass_seconds: float, trials: int, seed: Sequence[int]
) -> Choice:
    """The penalty by two halves of the drives, and then the constants by all of them."""
    halves, inner_errors = (drives[0::2], drives[1::2]), []
    for penalty in PENALTIES:
        errors = []
        for i, half in enumerate(halves):
            rng = np.random.default_rng([*seed, i])
            point = search(half, low_pass_seconds, penalty, trials, rng)
            errors += [
                measure_drive(drive, low_pass_seconds, point[None])[0] for drive in halves[1 - i]
            ]
        inner_errors.append(mean_errors(errors)[:2].mean())
    penalty = PENALTIES[int(np.argmin(inner_errors))]
    rng = np.random.default_rng([*seed, 2])
    return Choice(low_pass_seconds, penalty, search(drives, low_pass_seconds, penalty, trials, rng))


class Fold(NamedTuple):
    """The drives of a fold, and the constant of the low-pass that the others choose for it. No seed
    changes them."""

    training: list[PreparedRecording]
    held_out: list[PreparedRecording]
    low_pass_seconds: float


def make_fold(
    drives: Sequence[PreparedRecording],
    fold_of: Mapping[str, int],
    number: int,
    low_pass: Sequence[float],
) -> Fold:
    """Divide the drives, and choose the low-pass by those that are not held out."""
    training = [drive for drive in drives if fold_of[drive.group] != number]
    held_out = [drive for drive in drives if fold_of[drive.group] == number]
    return Fold(training, held_out, choose_low_pass(training, low_pass))


def evaluate_fold(fold: Fold, trials: int, seed: Sequence[int]) -> FoldResult:
    """Choose by the training drives of a fold, and then measure the drives that are held out."""
    choice = choose(fold.training, fold.low_pass_seconds, trials, seed)
    points = np.stack([np.zeros(len(UNITS)), choice.point])
    errors = {
        drive.name: measure_drive(drive, fold.low_pass_seconds, points) for drive in fold.held_out
    }
    return FoldResult(choice, *({name: pair[i] for name, pair in errors.items()} for i in (0, 1)))


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


def load_drives(root: str | None, folds: int) -> tuple[list[PreparedRecording], dict[str, int]]:
    """The drives that have a piece, by name, and the fold of each group, which depends on the names
    and lengths of all drives."""
    sequences = sorted(data.load("kitti", root, "all"), key=lambda sequence: sequence.name)
    recordings, _ = prepare(sequences, WINDOWS)
    drives = [
        recording
        for recording in recordings
        if pieces(recording.reference, WINDOWS.stride_seconds).shape[1]
    ]
    return drives, data.folds(sequences, folds)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data-root", help="KITTI's folder, as for gnio evaluate")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--only", type=int, nargs="+", help="folds to run; default: all")
    parser.add_argument("--trials", type=int, default=156, help="of one search")
    parser.add_argument("--low-pass", type=float, nargs="+", default=[0.0, 0.03, 0.06, 0.09])
    arguments = parser.parse_args()
    numbers = range(arguments.folds) if arguments.only is None else arguments.only
    if not set(numbers) <= set(range(arguments.folds)):
        parser.error(f"--only: there are the folds 0 to {arguments.folds - 1}")
    drives, fold_of = load_drives(arguments.data_root, arguments.folds)
    total = sum(pieces(drive.reference, WINDOWS.stride_seconds).shape[1] for drive in drives)
    print(f"{len(drives)} drives, {total} pieces", flush=True)
    defaults = np.zeros((1, len(UNITS)))
    unchanged = {drive.name: measure_drive(drive, 0.0, defaults)[0] for drive in drives}
    print(f"defaults, low-pass left in: {describe_errors(unchanged)}", flush=True)
    folds = {n: make_fold(drives, fold_of, n, arguments.low_pass) for n in numbers}
    by_seed = []
    for seed in arguments.seeds:
        default_errors, errors = {}, {}
        for number, fold in folds.items():
            result = evaluate_fold(fold, arguments.trials, (seed, number))
            default_errors |= result.default_errors
            errors |= result.errors
            tau, penalty, point = result.choice
            free = free_parameters(settings_at(tau, point), UNITS)
            print(f"seed {seed}, fold {number}: {describe_errors(result.errors)}", flush=True)
            print(f"  low-pass {tau:g} s, penalty {penalty:g}, free parameters {free}", flush=True)
        if not by_seed:
            differences = {name: error - unchanged[name] for name, error in default_errors.items()}
            print(f"defaults, low-pass chosen: {describe_errors(default_errors)}", flush=True)
            print(f"  minus low-pass left in: {describe_errors(differences)}", flush=True)
        by_seed.append(errors)
        print(f"seed {seed}: {describe_errors(errors)}", flush=True)
    mean = {name: np.mean([errors[name] for errors in by_seed], axis=0) for name in by_seed[0]}
    print(f"mean of {len(by_seed)} seed(s), piece by piece: {describe_errors(mean)}", flush=True)


if __name__ == "__main__":
    main()
