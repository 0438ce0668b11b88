"""What networks say of single windows, sorted by what the walker did: errors, gate and attention at
rest and in motion."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gnio_jax import data, models
from gnio_jax.evaluation import odometry
from gnio_jax.evaluation.odometry import Network, Setup
from gnio_jax.training import checkpoint

ACTIVITIES = ("standing", "slow", "walking", "running", "stairs")
STANDING, SLOW, RUNNING, CLIMBING = 0.05, 0.8, 1.9, 0.12
"""Limits of the mean speed over a window, m/s: standing below the first, slow walking below the
second, running above the third; on stairs where the vertical part is above the last."""


class Said(NamedTuple):
    """Every window of a split with a trusted reference, cut with the reference's attitude."""

    truth: Float[np.ndarray, "m 3"]
    """Displacement, m."""
    displacement: Float[np.ndarray, "m 3"]
    log_std: Float[np.ndarray, "m 3"]
    diagnostics: dict[str, np.ndarray]
    """`gate`, `scale` (m, 3) and `attention` (m, heads, prototypes), where the network has them."""
    activity: Int[np.ndarray, "m"]
    """Number in ACTIVITIES."""


def said(workdir: Path, split: str) -> Said:
    """What the best checkpoint of a run says of the windows of a split of its dataset."""
    run = checkpoint.load_run(workdir)
    config = run.config.data
    setup = Setup("integrate", orientation="reference")
    recordings, _ = odometry.prepare(
        data.load(run.config.dataset, run.config.data_root, split), config, setup
    )
    network = Network(models.Inference(run.model), models.inference_variables(run.model, run.variables))
    attitudes = [odometry.attitude(r, config, "reference") for r in recordings]
    found = odometry.predict_windows(
        network, recordings, attitudes, config, keep=("gate", "scale", "attention")
    )
    truth = np.concatenate([odometry.true_displacements(r, config) for r in recordings])
    good = np.isfinite(truth).all(1)
    diagnostics = {
        key: np.concatenate([p.diagnostics[key] for p in found])[good]
        for key in found[0].diagnostics
    }
    displacement, log_std = (
        np.concatenate([np.asarray(getattr(p, name)) for p in found])[good]
        for name in ("displacement", "log_std")
    )
    return Said(
        truth[good],
        displacement,
        log_std,
        diagnostics,
        activity(truth[good], config.window_seconds),
    )


def activity(displacement: Float[np.ndarray, "m 3"], seconds: float) -> Int[np.ndarray, "m"]:
    """What the walker does, by the reference's displacement of a window, m. Ours: the limits above."""
    speed, climb = (
        np.linalg.norm(displacement[:, :2], axis=1) / seconds,
        np.abs(displacement[:, 2]) / seconds,
    )
    conditions = [
        climb > CLIMBING,
        np.hypot(speed, climb) < STANDING,
        speed < SLOW,
        speed > RUNNING,
    ]
    numbers = [ACTIVITIES.index(name) for name in ("stairs", "standing", "slow", "running")]
    return np.select(conditions, numbers, ACTIVITIES.index("walking"))


def by_activity(windows: Said) -> dict[str, dict[str, float]]:
    """For each activity that occurs: windows, rms error of the displacement, m, rms of the error
    over its standard deviation, median length of the displacement, m, and the median |gate| and
    scale of the horizontal axes, where there is a gate."""
    found = {}
    for number, name in enumerate(ACTIVITIES):
        those = windows.activity == number
        if not those.any():
            continue
        error = windows.displacement[those] - windows.truth[those]
        found[name] = {
            "windows": float(those.sum()),
            "error": float(np.sqrt((error**2).sum(1).mean())),
            "normalised": float(np.sqrt(((error / np.exp(windows.log_std[those])) ** 2).mean())),
            "length": float(np.median(np.linalg.norm(windows.displacement[those], axis=1))),
        }
        for key in ("gate", "scale"):
            if key in windows.diagnostics:
                found[name][key] = float(np.median(np.abs(windows.diagnostics[key][those, :2])))
    return found


def entropy(attention: Float[np.ndarray, "m h p"]) -> tuple[float, float]:
    """Mean entropy of the attention, and that of its mean over the windows, each a share of that of
    a uniform one, log p.

    Both near 1: every window sees all prototypes alike. The first small, the second large: windows
    choose, and choose differently.
    """
    largest = np.log(attention.shape[-1])
    each, mean = (
        -(a * np.log(np.maximum(a, 1e-12))).sum(-1).mean() / largest
        for a in (attention, attention.mean(0))
    )
    return float(each), float(mean)


def attention_by_activity(windows: Said) -> tuple[list[str], Float[np.ndarray, "a p"]]:
    """Activities that occur, and for each how much more attention each prototype gets than on
    average (1: as on average)."""
    attention = windows.diagnostics["attention"].mean(1)
    usual = attention.mean(0)
    names, lifts = [], []
    for number, name in enumerate(ACTIVITIES):
        those = windows.activity == number
        if those.sum() >= 5:
            names.append(name)
            lifts.append(attention[those].mean(0) / usual)
    return names, np.array(lifts)


def information(windows: Said, draws: int = 20) -> tuple[float, float]:
    """Mutual information, bits, of the activity and the prototype most attended to (over the mean
    of the heads), and the same with the activities shuffled, which is what chance alone makes of so
    few windows."""
    strongest = windows.diagnostics["attention"].mean(1).argmax(1)
    rng = np.random.default_rng(0)
    chance = np.mean([_mutual(rng.permutation(windows.activity), strongest) for _ in range(draws)])
    return _mutual(windows.activity, strongest), float(chance)


def _mutual(a: Int[np.ndarray, "m"], b: Int[np.ndarray, "m"]) -> float:
    joint = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(joint, (a, b), 1 / len(a))
    independent = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
    there = joint > 0
    return float((joint[there] * np.log2(joint[there] / independent[there])).sum())
