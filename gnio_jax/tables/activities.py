"""Predictions of networks for single windows by the walker's activity: errors, gate and attention
at rest and in motion."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gnio_jax import data, evaluation
from gnio_jax.errors import InputError
from gnio_jax.evaluation import tabulate
from gnio_jax.models import Network
from gnio_jax.networks import read_network

ACTIVITIES = ("standing", "slow", "walking", "running", "stairs")
STANDING, SLOW, RUNNING, CLIMBING = 0.05, 0.8, 1.9, 0.12
"""Limits of the mean speed over a window, m/s: standing below the first, slow walking below the
second, running above the third; on stairs where the vertical part is above the last (ours)."""
HORIZONTAL = slice(0, 2)
DIAGNOSTICS = ("gate", "scale", "attention")


class Recordings(NamedTuple):
    """A split of a dataset."""

    dataset: str
    data_root: str | None
    split: str


class PredictedWindows(NamedTuple):
    """Every window of a split with a trusted reference, cut with the reference's attitude."""

    truth: Float[np.ndarray, "m 3"]
    """Displacement, m."""
    displacement: Float[np.ndarray, "m 3"]
    """The network's displacement, m."""
    std: Float[np.ndarray, "m 3"]
    """Standard deviation of one window, with the factors that `gnio calibrate` fitted to windows,
    m. The filter's `measurement_scale` is not included, because it is for many overlapping
    windows."""
    diagnostics: dict[str, np.ndarray]
    """`gate`, `scale` (m, 3) and `attention` (m, heads, prototypes), if the network has them."""
    activity: Int[np.ndarray, "m"]
    """Number in ACTIVITIES."""


def predict_split(workdir: Path, recordings: Recordings) -> PredictedWindows:
    """The predictions of the network of a run for the windows of a split of a dataset. Raises
    `InputError` for recordings without poses."""
    run = read_network(workdir)
    config = run.config.data
    sequences = data.load(*recordings)
    for sequence in sequences:
        if sequence.waypoints is not None:
            subject = f"{recordings.dataset} {recordings.split}"
            problem = f"{sequence.name} has waypoints, no poses"
            raise InputError(subject, problem, "name another --dataset or --split")
    prepared, _ = evaluation.prepare(sequences, config, orientation="reference")
    network = Network.of(run.model, run.variables)
    predicted = evaluation.infer(network, prepared, config, diagnostics=DIAGNOSTICS)
    # There is a row for each stride; rows before the end of the first window have neither.
    references = [evaluation.reference_displacements(recording, 0.0) for recording in prepared]
    truth, displacement = (
        np.concatenate([rows.value for rows in parts]) for parts in (references, predicted)
    )
    std = np.concatenate([rows.std for rows in predicted])
    trusted = np.isfinite(truth).all(1) & np.isfinite(displacement).all(1)
    return PredictedWindows(
        truth[trusted],
        displacement[trusted],
        std[trusted] * run.config.filter.noise.std_factor,
        {
            name: np.concatenate([rows.diagnostics[name] for rows in predicted])[trusted]
            for name in predicted[0].diagnostics
        },
        activity(truth[trusted], config.window_seconds),
    )


def activity(displacement: Float[np.ndarray, "m 3"], seconds: float) -> Int[np.ndarray, "m"]:
    """The walker's activity, from the reference's displacement of a window, m. Ours: the limits."""
    speed = np.linalg.norm(displacement[:, HORIZONTAL], axis=1) / seconds
    climb = np.abs(displacement[:, 2]) / seconds
    conditions = {
        "stairs": climb > CLIMBING,
        "standing": np.hypot(speed, climb) < STANDING,
        "slow": speed < SLOW,
        "running": speed > RUNNING,
    }
    numbers = [ACTIVITIES.index(name) for name in conditions]
    return np.select(list(conditions.values()), numbers, ACTIVITIES.index("walking"))


def by_activity(windows: PredictedWindows) -> dict[str, dict[str, float]]:
    """For each activity that occurs: number of windows, rms error of the displacement, m, rms of
    the error over its standard deviation, median length of the displacement, m, and the median
    |gate| and scale of the horizontal axes, if there is a gate."""
    figures = {}
    for number, name in enumerate(ACTIVITIES):
        rows = windows.activity == number
        if not rows.any():
            continue
        error = windows.displacement[rows] - windows.truth[rows]
        normalised = error / windows.std[rows]
        figures[name] = {
            "windows": float(rows.sum()),
            "error": float(np.sqrt((error**2).sum(1).mean())),
            "normalised": float(np.sqrt((normalised**2).mean())),
            "length": float(np.median(np.linalg.norm(windows.displacement[rows], axis=1))),
        }
        for key in ("gate", "scale"):
            if key in windows.diagnostics:
                values = windows.diagnostics[key][rows, HORIZONTAL]
                figures[name][key] = float(np.median(np.abs(values)))
    return figures


def mean_over_seeds(seeds: list[PredictedWindows]) -> dict[str, dict[str, float]]:
    """The figures of each activity, as means over the seeds."""
    figures = [by_activity(windows) for windows in seeds]
    return {
        name: {key: float(np.mean([seed[name][key] for seed in figures])) for key in keys}
        for name, keys in figures[0].items()
    }


def render(by_method: dict[str, dict[str, dict[str, float]]]) -> str:
    """Networks × activities as Markdown."""
    columns = {
        "error": "rms error m",
        "normalised": "error / σ, rms",
        "length": "median length m",
        "gate": "median gate",
        "scale": "median scale",
    }
    table = [
        [
            method,
            name,
            f"{values['windows']:.0f}",
            *(tabulate.number(values.get(key), 3) for key in columns),
        ]
        for method, figures in by_method.items()
        for name, values in figures.items()
    ]
    return tabulate.markdown(["network", "windows of", "n", *columns.values()], table)


def entropy(attention: Float[np.ndarray, "m h p"]) -> tuple[float, float]:
    """The spread of the attention over the prototypes: the entropy of a window, as a mean over
    windows and heads, and that of the mean over the windows, as shares of log p.

    If both are near 1, every window attends equally to all prototypes. If the first is small and
    the second large, windows attend to different prototypes.
    """
    largest = np.log(attention.shape[-1])
    of_window, of_mean = (
        -(weights * np.log(np.maximum(weights, 1e-12))).sum(-1).mean() / largest
        for weights in (attention, attention.mean(0))
    )
    return float(of_window), float(of_mean)


def attention_by_activity(
    windows: PredictedWindows,
) -> tuple[list[str], Float[np.ndarray, "a p"]]:
    """Activities that occur in at least five windows, and for each the ratio of the attention of
    each prototype to its average (1: as on average)."""
    attention = windows.diagnostics["attention"].mean(1)
    counts = np.bincount(windows.activity, minlength=len(ACTIVITIES))
    common = np.flatnonzero(counts >= 5)
    means = [attention[windows.activity == number].mean(0) for number in common]
    return [ACTIVITIES[number] for number in common], np.array(means) / attention.mean(0)


def information(windows: PredictedWindows, draws: int = 20) -> tuple[float, float]:
    """Mutual information, bits, of the activity and the prototype with the most attention (over the
    mean of the heads), and the same with shuffled activities, which is the value by chance for this
    number of windows."""
    strongest = windows.diagnostics["attention"].mean(1).argmax(1)
    rng = np.random.default_rng(0)
    shuffled = [
        _mutual_information(rng.permutation(windows.activity), strongest) for _ in range(draws)
    ]
    return _mutual_information(windows.activity, strongest), float(np.mean(shuffled))


def _mutual_information(a: Int[np.ndarray, "m"], b: Int[np.ndarray, "m"]) -> float:
    joint = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(joint, (a, b), 1 / len(a))
    independent = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
    occurs = joint > 0
    return float((joint[occurs] * np.log2(joint[occurs] / independent[occurs])).sum())
